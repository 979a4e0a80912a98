"""Cells of a surface and a view's depth map → where the view sees them, and how well."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.surface.raster import Raster

# Towards the image's border a view counts for less, from this part of its width on: images meet inside of both.
_BORDER = 0.1
_AT_BORDER = 0.3


@dataclass(frozen=True, eq=False)
class Found:
    """What a depth map says about points.

    Attributes
    ----------
    is_free : ndarray of bool
        In view, and no depth around is nearer.
    matches : ndarray of bool
        A depth around is the point's own.
    is_hole : ndarray of bool
        There are no depths around.
    """

    is_free: NDArray[np.bool_]
    matches: NDArray[np.bool_]
    is_hole: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Sight:
    """What a view sees of a raster's cells.

    Attributes
    ----------
    columns, rows : (h, w) float32 ndarray
        Where open cells lie in the view: indices of its pixels' centres, as `cv2.remap` takes them.
    is_seen : (h, w) bool ndarray
        Its depth map shows the very surface there, and nothing nearer beside it.
    is_open : (h, w) bool ndarray
        In view, and nothing that is nearer is known: seen, or without a depth.
    worth : (h, w) float32 ndarray
        Pixels of the view per cell, less towards the image's border; 0 where it is not open.
    """

    columns: NDArray[np.float32]
    rows: NDArray[np.float32]
    is_seen: NDArray[np.bool_]
    is_open: NDArray[np.bool_]
    worth: NDArray[np.float32]


def sight_of(
    view: View,
    full_view: View,
    depth: NDArray[np.float32],
    height: NDArray[np.float32],
    raster: Raster,
    tolerance: float,
) -> Sight:
    """Look from a view at a surface.

    Parameters
    ----------
    view, full_view : View
        The part of the view that `depth` covers, and the whole of it.
    depth : (view.height, view.width) float32 ndarray
        z-depth along the ray K⁻¹ (column, row, 1), model units; 0 = none.
    height : (raster.height, raster.width) float32 ndarray
        NaN where there is no surface.
    raster : Raster
    tolerance : float
        By which depths of the same surface differ at most, model units.

    Returns
    -------
    Sight
    """
    cells, x, y, z = _projected(view, height, raster)
    found = looked_up(depth, x, y, z, tolerance)
    is_open = found.is_free & (found.matches | found.is_hole)
    cells, x, y, z = cells[is_open], x[is_open], y[is_open], z[is_open]
    worth = _pixels_per_cell(view, raster, x, y, z) * towards_border(x, y, view, full_view)

    def placed(values: NDArray[Any] | bool, kind: type) -> NDArray[Any]:
        whole: NDArray[Any] = np.zeros(height.size, kind)
        whole[cells] = values
        return whole.reshape(height.shape)

    return Sight(
        placed(x - 0.5, np.float32),
        placed(y - 0.5, np.float32),
        placed(found.matches[is_open], np.bool_),
        placed(True, np.bool_),
        placed(worth, np.float32),
    )


def looked_up(
    depth: NDArray[np.float32],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    tolerance: float,
) -> Found:
    """Compare points with the four depths around them in a depth map.

    Parameters
    ----------
    depth : (H, W) float32 ndarray
        z-depth along the ray K⁻¹ (column, row, 1), model units; 0 = none.
    x, y, z : float64 ndarrays of one shape
        Image coordinates of the points, NaN for none, and their depths.
    tolerance : float
        By which depths of the same surface differ at most, model units.

    Returns
    -------
    Found
    """
    height, width = depth.shape
    # Depth maps hold the depths of pixels' upper left corners.
    left = np.floor(np.nan_to_num(x, nan=-2.0)).astype(np.int64)
    top = np.floor(np.nan_to_num(y, nan=-2.0)).astype(np.int64)
    inside = (left >= 0) & (top >= 0) & (left + 1 < width) & (top + 1 < height) & (z > 0)
    index = np.where(inside, top * width + left, 0)
    flat = depth.ravel()
    around = [flat.take(index + step, mode="clip") for step in (0, 1, width, width + 1)]
    nearest = np.full(z.shape, np.inf, np.float32)
    matches = np.zeros(z.shape, bool)
    for each in around:
        np.minimum(nearest, np.where(each > 0, each, np.inf), out=nearest)
        matches |= (each > 0) & (np.abs(each - z) <= tolerance)
    return Found(inside & (nearest >= z - tolerance), matches, ~np.isfinite(nearest))


def _projected(
    view: View, height: NDArray[np.float32], raster: Raster
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Cells whose surface lies in front of a view and in it; their image coordinates x and y, and depths."""
    matrix, shift = raster.cells_from_camera(view)
    pixels = view.K @ np.linalg.inv(matrix)
    start = pixels @ shift
    column = np.arange(raster.width)
    row = np.arange(raster.height)[:, None]
    h = height.astype(np.float64)
    u, v, z = (pixels[k, 0] * column + (pixels[k, 1] * row - start[k]) + pixels[k, 2] * h for k in range(3))
    # NaN is nowhere.
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < view.width * z) & (v < view.height * z)
    cells = np.flatnonzero(inside)
    far = z.ravel()[cells]
    return cells, u.ravel()[cells] / far, v.ravel()[cells] / far, far


def _pixels_per_cell(
    view: View, raster: Raster, x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How many pixels of a view a level cell at these image coordinates and this depth covers."""
    # A cell is spanned by two vectors of the camera frame, whose cross product is its area N; the image of that is
    # N · ray / z² times the focal lengths.
    inverse = np.linalg.inv(raster.cells_from_camera(view)[0])
    across = np.cross(inverse[:, 0], inverse[:, 1]) @ view.inverse_K
    facing = np.abs(across[0] * x + across[1] * y + across[2])
    return np.asarray(view.K[0, 0] * view.K[1, 1] * facing / z**2)


def towards_border(
    x: NDArray[np.float64], y: NDArray[np.float64], view: View, full_view: View
) -> NDArray[np.float64]:
    """From 1 inside of the image to less at its border."""
    left, top = full_view.K[:2, 2] - view.K[:2, 2]
    from_side = np.minimum(x + left, full_view.width - left - x) / full_view.width
    from_end = np.minimum(y + top, full_view.height - top - y) / full_view.height
    inner = np.clip(np.minimum(from_side, from_end) / _BORDER, 0, 1)
    return np.asarray(_AT_BORDER + (1 - _AT_BORDER) * inner)


def smoothed_worth(
    worth: NDArray[np.float32],
    usable: NDArray[np.bool_],
    height: NDArray[np.float32],
    radius: int,
    tolerance: float,
) -> NDArray[np.float32]:
    """What a view is worth for all of the surface around a cell, up to edges in height; -1 where it is not usable.

    So neighbouring cells of one surface take the same view, and views meet along edges: costs filtered with the
    surface as guide (Hosni et al. 2011, with the guided filter of He et al. 2010).
    """
    smooth = np.full(worth.shape, -1, np.float32)
    # The filter looks so far around: two means, one of the other.
    part = tuple(_reach(np.asarray(usable.any(axis=axis)), 2 * radius + 1) for axis in (1, 0))
    guide = np.nan_to_num(height[part], nan=0.0).astype(np.float32)
    ours = np.where(usable[part], worth[part], np.float32(0))
    found = cv2.ximgproc.guidedFilter(guide, ours, radius, float(tolerance) ** 2)
    smooth[part] = np.where(usable[part], found, np.float32(-1))
    return smooth


def _reach(is_there: NDArray[np.bool_], around: int) -> slice:
    """From the first place to the last one, and so many around them."""
    places = np.flatnonzero(is_there)
    return slice(max(int(places[0]) - around, 0), int(places[-1]) + around + 1)
