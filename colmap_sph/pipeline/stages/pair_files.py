"""Intermediate results on disk, in files that hold the key they were made under: disparity maps and estimates.

A pair's disparity map comes with the geometry that gives it meaning, and with its ties. Disparities are stored
in 16 bits, 1/64 pixel apart or as fine as the pair's range allows; 0 = none.
"""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import InputError
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Result
from colmap_sph.project.state.array_file import ArrayType, Head, read_arrays, read_head, write_arrays
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.ties import MAX_MOVE, MAX_TIES, Ties, filled_residuals, row_residual
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Surface

_PAIR = "pair"
_ESTIMATE = "estimate"
_FINEST_STEP = 1 / 64
_CODES = 65535
_NUMBERS = [field.name for field in fields(RectifiedPair) if field.name not in ("surface", "rectified_from_world")]
_WHOLE_NUMBERS = ("height", "left_width", "right_width")
# Before the geometry: the least disparity, the step between two codes, the share of the rows and columns planned
# that it has, and the row residual, or this where there are too few ties for one.
_OWN_NUMBERS = 4
_UNKNOWN = -1.0
_TIE_COLUMNS = 5
# Of an estimate: its corner, and its facts.
_ESTIMATE_NUMBERS = 4


def write_pair(
    path: Path, pair: PairDisparity, key: str = "", ties: Ties | None = None, share: float = 1.0
) -> Facts:
    """Write a pair's disparity map and its ties; `OutputError` where that fails.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    pair : PairDisparity
    key : str
        What `facts_of_pair` shall find.
    ties : Ties, optional
    share : float
        Of the rows and columns of the geometry that `facts_of_pair` will ask for, see `RectifiedPair.resampled`.

    Returns
    -------
    Facts
        What `facts_of_pair` will say.
    """
    disparity = np.ascontiguousarray(pair.disparity)
    ends = np.empty(2, dtype=np.float32)
    _native.disparity_range(disparity, ends)
    least, most = ends.tolist()
    step = max(_FINEST_STEP, (most - least) / (_CODES - 1))
    codes = np.empty(disparity.shape, dtype=np.uint16)
    _native.code_disparity(disparity, least, step, codes)
    texts = _texts_of(pair.left, pair.right, pair.geometry)
    ties = ties or Ties.none()
    residual = row_residual(ties)
    table = np.column_stack([ties.left, ties.right, ties.sigma])
    own = [least, step, share, _UNKNOWN if residual is None else residual]
    arrays: list[NDArray[Any]] = [codes, table] if len(ties) else [codes]  # no array of a file is empty
    write_arrays(path, _PAIR, key, arrays, texts=texts, numbers=[*own, *_numbers_of(pair.geometry)])
    return _facts(residual, pair.geometry)


def read_pair(path: Path, key: str | None = None) -> PairDisparity:
    """Read a pair's disparity map; `InputError` where the file is missing, damaged, or not of the key, if any."""
    return read_pair_with_ties(path, key)[0]


def read_pair_with_ties(path: Path, key: str | None = None) -> tuple[PairDisparity, Ties]:
    """Read a pair's disparity map and its ties; raises as `read_pair`."""
    head, (codes, *tables) = read_arrays(path, _PAIR, lambda head: _array_types(head, _geometry_of(head)))
    _check_key(path, head, key)
    least, step = head.numbers[:2]
    disparity = np.empty(codes.shape, dtype=np.float32)
    _native.decode_disparity(codes, least, step, disparity)
    table = tables[0] if tables else np.empty((0, _TIE_COLUMNS), np.float32)
    ties = Ties(table[:, :2], table[:, 2:4], table[:, 4])
    return PairDisparity(head.texts[0], head.texts[1], _geometry_of(head), disparity), ties


def facts_of_pair(path: Path, key: str, left: str, right: str, geometry: RectifiedPair) -> Facts | None:
    """Say what is known of the disparity map of this pair, made under this key; None where it must be made.

    It may have fewer rows and columns than planned, as the file says.

    Only the head of the file is read.
    """
    head = read_head(path)
    if (
        head is None
        or (head.kind, head.key, head.texts) != (_PAIR, key, _texts_of(left, right, geometry))
        or not _has_scale(head)
    ):
        return None
    *_, share, residual = head.numbers[:_OWN_NUMBERS]
    geometry = geometry.resampled(share)
    if head.numbers[_OWN_NUMBERS:] != tuple(_numbers_of(geometry)):
        return None
    if head.arrays != tuple(_array_types(head, geometry)):
        return None
    return _facts(None if residual < 0 else residual, geometry)


def _facts(residual: float | None, geometry: RectifiedPair) -> Facts:
    return Facts(row_residual=None if residual is None else residual / geometry.scales[1])


def residuals_of(matched: Mapping[Pair, Result]) -> dict[Pair, float]:
    """Row residual of each pair, radians; those with too few ties have the median of all."""
    measured = filled_residuals([result.facts.row_residual for result in matched.values()])
    return dict(zip(matched, measured, strict=True))


def bytes_to_read(path: Path, lead: str) -> tuple[int, int] | None:
    """Memory for the disparity map that a pair's file holds for one of its images.

    Only the head of the file is read.

    Parameters
    ----------
    path : Path
    lead : str
        Name of the image, as the pair calls it.

    Returns
    -------
    (int, int) or None
        Bytes of the map, and how many more there are for a moment until it is there: its codes, or the left
        image's map for the right image. None where the file is missing or damaged, which is for `read_pair` to
        report: another worker may have found it so and removed it.
    """
    head = read_head(path)
    if head is None:
        return None
    try:
        geometry = _geometry_of(head)
    except ValueError:
        return None
    left, right = (4 * geometry.height * width for width in (geometry.left_width, geometry.right_width))
    codes = left // 2
    return (left, codes) if head.texts[0] == lead else (right, max(left, left + codes - right))


def write_estimate(
    path: Path, estimate: DepthEstimate, key: str, facts: Facts, *, corner: tuple[int, int] = (0, 0)
) -> None:
    """Write a photometric depth with its standard deviation and support; `OutputError` where that fails.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    estimate : DepthEstimate
    key : str
        What `facts_of_estimate` shall find.
    facts : Facts
        What it shall say: `coverage` and `in_region`.
    corner : (int, int)
        Column and row of the image where the estimate begins, for `pages/samples.py`.
    """
    numbers = (*map(float, corner), facts.coverage, facts.in_region)
    write_arrays(path, _ESTIMATE, key, [estimate.depth, estimate.sigma, estimate.support], numbers=numbers)


def read_estimate(path: Path, view: View, key: str | None = None) -> DepthEstimate:
    """Read what was voted for a view; `InputError` where it is missing, damaged, or of another size or key."""
    head, arrays = read_arrays(path, _ESTIMATE, lambda _: _estimate_types(view))
    _check_key(path, head, key)
    return DepthEstimate(*arrays)


def _check_key(path: Path, head: Head, key: str | None) -> None:
    """Raise `InputError` for what was not made under the key that it must have."""
    if key is not None and head.key != key:
        raise InputError(
            f"{path} was made anew with other options meanwhile; end other runs there, and run again."
        )


def facts_of_estimate(path: Path, key: str, view: View) -> Facts | None:
    """Say what is known of the estimate of a view, made under this key; None where it must be made.

    Only the head of the file is read.
    """
    head = read_head(path)
    if (
        head is None
        or (head.kind, head.key) != (_ESTIMATE, key)
        or head.arrays != tuple(_estimate_types(view))
        or len(head.numbers) != _ESTIMATE_NUMBERS
    ):
        return None
    *_, coverage, in_region = head.numbers
    return Facts(coverage, in_region) if 0 <= coverage <= 1 and 0 <= in_region <= 1 else None


def _estimate_types(view: View) -> list[ArrayType]:
    return [(np.dtype(name), (view.height, view.width)) for name in ("<f4", "<f4", "<u1")]


def _array_types(head: Head, geometry: RectifiedPair) -> list[ArrayType]:
    """Of what a pair's file must hold: disparities, and a table of ties where it has one."""
    types: list[ArrayType] = [(np.dtype("<u2"), (geometry.height, geometry.left_width))]
    if len(head.arrays) > 1:
        rows = min(*head.arrays[1][1][:1], MAX_TIES)
        types.append((np.dtype("<f4"), (rows, _TIE_COLUMNS)))
    return types


def _has_scale(head: Head) -> bool:
    """Whether there are a least disparity, a step above 0, a share of rows and columns, and a row residual."""
    own = head.numbers[:_OWN_NUMBERS]
    if len(own) != _OWN_NUMBERS or not np.isfinite(own).all():
        return False
    _, step, share, residual = own
    return step > 0 and 0 < share <= 1 and (residual == _UNKNOWN or 0 <= residual <= MAX_MOVE)


def _texts_of(left: str, right: str, geometry: RectifiedPair) -> tuple[str, ...]:
    return left, right, geometry.surface


def _numbers_of(geometry: RectifiedPair) -> list[float]:
    return [
        *geometry.rectified_from_world.ravel().tolist(),
        *(float(getattr(geometry, name)) for name in _NUMBERS),
    ]


def _geometry_of(head: Head) -> RectifiedPair:
    """The geometry in the head of a pair's file; `ValueError` where there is none."""
    if (
        len(head.texts) != 3
        or head.texts[2] not in get_args(Surface)
        or len(head.numbers) != _OWN_NUMBERS + 9 + len(_NUMBERS)
    ):
        raise ValueError("it does not describe a pair")
    if not np.isfinite(head.numbers).all() or not _has_scale(head):
        raise ValueError("it does not describe a pair")
    numbers = head.numbers[_OWN_NUMBERS:]
    rotation = np.array(numbers[:9]).reshape(3, 3)
    values: dict[str, float] = dict(zip(_NUMBERS, numbers[9:], strict=True))
    values |= {name: int(values[name]) for name in _WHOLE_NUMBERS}
    return RectifiedPair(surface=head.texts[2], rectified_from_world=rotation, **values)  # type: ignore[arg-type]
