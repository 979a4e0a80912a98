"""Cells of a surface and a view's depth map → where the view sees them, and how well."""

from dataclasses import dataclass

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
        Where the cells lie in the view: indices of its pixels' centres, as `cv2.remap` takes them.
    is_seen : (h, w) bool ndarray
        Its depth map shows the very surface there, and nothing nearer beside it.
    is_open : (h, w) bool ndarray
        In view, and nothing that is nearer is known: seen, or without a depth.
    worth : (h, w) float32 ndarray
        Pixels of the view per cell, less towards the image's border.
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
    x, y, z, worth = _projected(view, height, raster)
    found = looked_up(depth, x, y, z, tolerance)
    worth *= towards_border(x, y, view, full_view)
    return Sight(
        (x - 0.5).astype(np.float32),
        (y - 0.5).astype(np.float32),
        found.is_free & found.matches,
        found.is_free & (found.matches | found.is_hole),
        worth.astype(np.float32),
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
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Image coordinates x and y, depth, and pixels per cell; NaN where there is no surface or no image of it."""
    matrix, shift = raster.cells_from_camera(view)
    inverse = np.linalg.inv(matrix)
    pixels = view.K @ inverse
    start = pixels @ shift
    column = np.arange(raster.width)
    row = np.arange(raster.height)[:, None]
    h = height.astype(np.float64)
    u, v, z = (pixels[k, 0] * column + pixels[k, 1] * row + pixels[k, 2] * h - start[k] for k in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        x = u / z
        y = v / z
        # A level cell is spanned by two vectors of the camera frame, whose cross product is its area N; the
        # image of that is N · ray / z² times the focal lengths.
        across = np.cross(inverse[:, 0], inverse[:, 1])
        focal = np.linalg.inv(view.K)
        ray = focal @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        facing = np.abs(across @ ray).reshape(x.shape)
        worth = view.K[0, 0] * view.K[1, 1] * facing / z**2
    worth[~(np.isfinite(worth) & (z > 0))] = 0
    return x, y, z, worth


def towards_border(
    x: NDArray[np.float64], y: NDArray[np.float64], view: View, full_view: View
) -> NDArray[np.float64]:
    """From 1 inside of the image to less at its border."""
    left, top = full_view.K[:2, 2] - view.K[:2, 2]
    from_side = np.minimum(x + left, full_view.width - left - x) / full_view.width
    from_end = np.minimum(y + top, full_view.height - top - y) / full_view.height
    with np.errstate(invalid="ignore"):
        inner = np.clip(np.minimum(from_side, from_end) / _BORDER, 0, 1)
    return np.asarray(_AT_BORDER + (1 - _AT_BORDER) * np.nan_to_num(inner))


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
    guide = np.nan_to_num(height, nan=0.0).astype(np.float32)
    ours = np.where(usable, worth, np.float32(0))
    smooth = cv2.ximgproc.guidedFilter(guide, ours, radius, float(tolerance) ** 2)
    return np.where(usable, smooth, np.float32(-1))
