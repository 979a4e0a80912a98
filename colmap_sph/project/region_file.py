"""What a user gives as a region → the region: a box, a file of one, or polygons in a file of GeoJSON; and back."""

import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OptionError, reason_of
from colmap_sph.project.files import read_small
from colmap_sph.scene import Region

AUTO = "auto"
"""As a region: the program draws it, see `drawn_region`."""

_MAX_BYTES = 8 << 20
_MAX_CORNERS = 20_000
# Larger than any coordinate in a map, in any unit.
_MOST = 1e12
# A rotation's four numbers are as those of a unit quaternion to this much.
_NEARLY_UNIT = 0.01
_GEOMETRIES = ("Polygon", "MultiPolygon", "GeometryCollection", "Feature", "FeatureCollection")


def read_region(given: str) -> Region:
    """The region that ``--region`` names.

    Parameters
    ----------
    given : str
        ``x0,y0,z0,x1,y1,z1``: least and largest coordinates; ``cx,cy,cz,sx,sy,sz,qw,qx,qy,qz``: the middle of a
        box, its sides, and the rotation from the model to the box as COLMAP writes rotations; or the path of a
        file, of six or ten such numbers, or GeoJSON.

    Returns
    -------
    Region
        In the model's coordinates.

    Raises
    ------
    OptionError
        The numbers are no box.
    InputError
        The file cannot be read, or holds neither a box nor polygons.

    Examples
    --------
    >>> read_region("0,0,-1,20,10,8").box.tolist()
    [[0.0, 0.0, -1.0], [20.0, 10.0, 8.0]]

    A box turned by 90° about z: 20 long in y, 10 wide in x.

    >>> turned = read_region("5,10,0,20,10,8,0.70711,0,0,0.70711")
    >>> turned.along(np.array([5.0, 19, 0])).round(3), turned.box[0].round(3)
    (array([-19.,   5.,   0.]), array([-20.,   0.,  -4.]))
    """
    path = Path(given)
    words = given.split(",")
    if len(words) > 1 and all(map(_is_number, words)):
        region = _box(words)
        if region is None:
            raise OptionError(
                f"--region must be a box x0,y0,z0,x1,y1,z1 with the least x, y and z first, or a turned one "
                f"cx,cy,cz,sx,sy,sz,qw,qx,qy,qz, not {given!r}.",
                "region",
            )
        return region
    content = _content(path, "--region")
    if content.lstrip().startswith("{"):
        return _of_geojson(path, content)
    region = _box(content.split())
    if region is None:
        raise InputError(
            f"The region {path} holds neither polygons in GeoJSON nor the least x y z and the largest x y z of a "
            "box, or the ten numbers of a turned one; mend it."
        )
    return region


def read_box_file(path: Path, option: str) -> Region:
    """Read COLMAP's file of a bounding box: six numbers, least x, y and z, and most; `InputError` for all else."""
    words = _content(path, option).split()
    region = _box(words) if len(words) == 6 else None
    if region is None:
        raise InputError(
            f"The bounding box {path} does not hold the least x y z and the largest x y z of a box; mend it."
        )
    return region


def _content(path: Path, option: str) -> str:
    try:
        return read_small(path, _MAX_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"The region {path} cannot be read ({reason_of(error)}); check {option}.") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _box(words: list[str]) -> Region | None:
    if len(words) not in (6, 10) or not all(map(_is_number, words)):
        return None
    numbers = np.array([float(word) for word in words])
    if len(words) == 10:
        return _turned_box(numbers[:3], numbers[3:6], numbers[6:])
    box = numbers.reshape(2, 3)
    is_box = not np.isnan(box).any() and (box[0] < box[1]).all()
    return Region(box) if is_box else None


def _turned_box(
    middle: NDArray[np.float64], sides: NDArray[np.float64], quaternion: NDArray[np.float64]
) -> Region | None:
    is_box = np.isfinite(middle).all() and (sides > 0).all()
    if not is_box or not abs(np.linalg.norm(quaternion) - 1) < _NEARLY_UNIT:
        return None
    from scipy.spatial.transform import Rotation  # which takes long to load

    axes = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    return Region(axes @ middle + np.array([-0.5, 0.5])[:, None] * sides, axes=axes)


def as_given(region: Region) -> str:
    """What a user may give to get a finite box, or one a little larger, in as few digits as will do.

    Examples
    --------
    >>> as_given(Region(np.array([[-1.23456, 0, 10], [8, 1234.5678, 20]])))
    '-1.24,0,10,8,1234.57,20'
    >>> print(as_given(read_region("5,10,0,20,10,8,0.70711,0,0,0.70711")))
    5,10,0,20.01,10.01,8.01,0.7071068,0,0,0.7071068
    """
    sides = np.diff(region.box, axis=0)[0]
    step = 10.0 ** (math.floor(math.log10(sides.min())) - 2)
    if region.axes is None:
        return _numbers([*np.floor(region.box[0] / step) * step, *np.ceil(region.box[1] / step) * step], step)
    from scipy.spatial.transform import Rotation

    middle = region.axes.T @ region.box.mean(axis=0)
    quaternion = np.roll(Rotation.from_matrix(region.axes).as_quat(canonical=True), 1)
    turn = _numbers(quaternion, 1e-7)
    sides = np.ceil(sides / step + 1) * step  # rounding may move the middle
    return f"{_numbers(np.round(middle / step) * step, step)},{_numbers(sides, step)},{turn}"


def _numbers(values: Iterable[float], step: float) -> str:
    """Values that are multiples of a power of ten."""
    decimals = max(-round(math.log10(step)), 0)
    texts = [f"{value:.{decimals}f}" for value in values]
    return ",".join(text.rstrip("0").rstrip(".") if decimals else text for text in texts)


def _of_geojson(path: Path, content: str) -> Region:
    try:
        rings = list(_polygons(json.loads(content, parse_constant=_refuse)))
        corners = sum(len(ring) for polygon in rings for ring in polygon)
        if not rings:
            raise ValueError("it has no polygon")
        if corners > _MAX_CORNERS:
            raise ValueError(f"its polygons have {corners} corners, more than {_MAX_CORNERS}: simplify them")
        polygons = tuple(tuple(map(_ring, polygon)) for polygon in rings)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"The region {path} is no GeoJSON with polygons ({reason_of(error)}); mend it.") from None
    outline = np.concatenate([polygon[0] for polygon in polygons])
    box = np.array([[*outline.min(axis=0), -np.inf], [*outline.max(axis=0), np.inf]])
    return Region(box, polygons)


def _refuse(word: str) -> None:
    raise ValueError(f"{word} is no number")


def _polygons(value: Any) -> Iterator[list[Any]]:
    """Coordinates of all polygons of an object; `ValueError` for what is none."""
    kind = value.get("type") if isinstance(value, dict) else None
    if kind not in _GEOMETRIES:
        named = f"{kind:.40}" if isinstance(kind, str) else "something else"
        raise ValueError(f"it holds {named}, where a Polygon or MultiPolygon belongs")
    if kind == "Feature":
        yield from _polygons(value.get("geometry"))
    elif kind in ("FeatureCollection", "GeometryCollection"):
        for part in _list(value.get("features" if kind == "FeatureCollection" else "geometries")):
            yield from _polygons(part)
    else:
        coordinates = _list(value.get("coordinates"))
        for polygon in [coordinates] if kind == "Polygon" else coordinates:
            if not _list(polygon):
                raise ValueError("a polygon has no outline")
            yield [_list(ring) for ring in polygon]


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError("a list is missing where its coordinates or parts belong")
    return value


def _ring(corners: list[Any]) -> NDArray[np.float64]:
    """(n, 2) corners of a ring, the last of which, the same as the first, is left out."""
    is_place = [
        isinstance(corner, list)
        and len(corner) >= 2
        and all(isinstance(number, (int, float)) and not isinstance(number, bool) for number in corner[:2])
        for corner in corners
    ]
    if not all(is_place):
        raise ValueError("a corner is not two numbers, x and y")
    ring = np.array([corner[:2] for corner in corners], dtype=np.float64).reshape(-1, 2)
    if not (np.abs(ring) <= _MOST).all():
        raise ValueError("a corner is not finite, or farther away than anything")
    if len(ring) > 1 and (ring[0] == ring[-1]).all():
        ring = ring[:-1]
    if len(np.unique(ring, axis=0)) < 3:
        raise ValueError("a ring has fewer than three corners")
    if np.linalg.matrix_rank(ring - ring[0]) < 2:
        raise ValueError("a ring has no area")
    return ring
