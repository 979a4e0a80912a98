"""Intermediate results on disk, in files that hold the key they were made under: disparity maps and estimates.

A pair's disparity map comes with the geometry that gives it meaning. Disparities are stored in 16 bits, 1/64 pixel
apart or as fine as the pair's range allows; 0 = none.
"""

from dataclasses import fields
from pathlib import Path
from typing import get_args

import numpy as np

from colmap_sph.project.state.array_file import ArrayType, Head, read_arrays, read_head, write_arrays
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Surface

_PAIR = "pair"
_ESTIMATE = "estimate"
_FINEST_STEP = 1 / 64
_CODES = 65535
_NUMBERS = [field.name for field in fields(RectifiedPair) if field.name not in ("surface", "rectified_from_world")]
_WHOLE_NUMBERS = ("height", "left_width", "right_width")


def write_pair(path: Path, pair: PairDisparity, key: str = "") -> None:
    """Write a pair's disparity map; `OutputError` where that fails.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    pair : PairDisparity
    key : str
        What `is_pair_there` shall find.
    """
    found = np.isfinite(pair.disparity)
    least = float(pair.disparity[found].min()) if found.any() else 0.0
    most = float(pair.disparity[found].max()) if found.any() else 0.0
    step = max(_FINEST_STEP, (most - least) / (_CODES - 1))
    codes = np.where(found, np.rint((pair.disparity - least) / step) + 1, 0).astype(np.uint16)
    texts = _texts_of(pair.left, pair.right, pair.geometry)
    write_arrays(path, _PAIR, key, [codes], texts=texts, numbers=[least, step, *_numbers_of(pair.geometry)])


def read_pair(path: Path) -> PairDisparity:
    """Read a pair's disparity map; `InputError` where the file is missing or damaged."""
    head, (codes,) = read_arrays(path, _PAIR, lambda head: [_codes_type(_geometry_of(head))])
    least, step = head.numbers[:2]
    disparity = (codes - np.float32(1)) * np.float32(step) + np.float32(least)
    disparity[codes == 0] = np.nan
    return PairDisparity(head.texts[0], head.texts[1], _geometry_of(head), disparity)


def is_pair_there(path: Path, key: str, left: str, right: str, geometry: RectifiedPair) -> bool:
    """Whether a file holds the disparity map of this pair, made under this key; only its head is read."""
    head = read_head(path)
    return (
        head is not None
        and (head.kind, head.key, head.texts) == (_PAIR, key, _texts_of(left, right, geometry))
        and _has_scale(head)
        and head.numbers[2:] == tuple(_numbers_of(geometry))
        and head.arrays == (_codes_type(geometry),)
    )


def disparity_bytes(path: Path) -> int:
    """About the memory that the disparity map of a pair's file takes; 0 where the file is missing.

    A missing file is for `read_pair` to report: another worker may have found it damaged and removed it.
    """
    try:
        return 2 * path.stat().st_size  # two bytes per pixel in the file, four in memory
    except OSError:
        return 0


def write_estimate(path: Path, estimate: DepthEstimate, key: str) -> None:
    """Write a photometric depth with its standard deviation and support; `OutputError` where that fails.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    estimate : DepthEstimate
    key : str
        What `is_estimate_there` shall find.
    """
    write_arrays(path, _ESTIMATE, key, [estimate.depth, estimate.sigma, estimate.support])


def read_estimate(path: Path, view: View) -> DepthEstimate:
    """Read what was voted for a view; `InputError` where it is missing, damaged or of another size."""
    _, arrays = read_arrays(path, _ESTIMATE, lambda _: _estimate_types(view))
    return DepthEstimate(*arrays)


def is_estimate_there(path: Path, key: str, view: View) -> bool:
    """Whether a file holds the estimate of a view, made under this key; only its head is read."""
    head = read_head(path)
    return (
        head is not None
        and (head.kind, head.key) == (_ESTIMATE, key)
        and head.arrays == tuple(_estimate_types(view))
    )


def _estimate_types(view: View) -> list[ArrayType]:
    return [(np.dtype(name), (view.height, view.width)) for name in ("<f4", "<f4", "<u1")]


def _codes_type(geometry: RectifiedPair) -> ArrayType:
    return np.dtype("<u2"), (geometry.height, geometry.left_width)


def _has_scale(head: Head) -> bool:
    """Whether there are a least disparity and a step above 0."""
    return len(head.numbers) > 1 and bool(np.isfinite(head.numbers[:2]).all()) and head.numbers[1] > 0


def _texts_of(left: str, right: str, geometry: RectifiedPair) -> tuple[str, ...]:
    return left, right, geometry.surface


def _numbers_of(geometry: RectifiedPair) -> list[float]:
    return [
        *geometry.rectified_from_world.ravel().tolist(),
        *(float(getattr(geometry, name)) for name in _NUMBERS),
    ]


def _geometry_of(head: Head) -> RectifiedPair:
    """The geometry in the head of a pair's file; `ValueError` where there is none."""
    if len(head.texts) != 3 or head.texts[2] not in get_args(Surface) or len(head.numbers) != 11 + len(_NUMBERS):
        raise ValueError("it does not describe a pair")
    if not np.isfinite(head.numbers).all() or not _has_scale(head):
        raise ValueError("it does not describe a pair")
    rotation = np.array(head.numbers[2:11]).reshape(3, 3)
    values: dict[str, float] = dict(zip(_NUMBERS, head.numbers[11:], strict=True))
    values |= {name: int(values[name]) for name in _WHOLE_NUMBERS}
    return RectifiedPair(surface=head.texts[2], rectified_from_world=rotation, **values)  # type: ignore[arg-type]
