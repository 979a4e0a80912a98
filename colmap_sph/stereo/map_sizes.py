"""Depth and normal maps → smaller ones, as if the image had fewer pixels; depth at pixels' centres."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View

# Depth on a surface seen at a grazing angle is taken no farther along it than by this factor.
_MOST_CHANGE = 1.25


def reduced_maps(
    depth: NDArray[np.float32], normals: NDArray[np.float32], view: View, target: View
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sample maps where the rays of a view with fewer pixels are.

    Each pixel takes the nearest one, whose depth is carried along its plane to the pixel's own ray: so no two
    surfaces are mixed, and a plane stays a plane.

    Parameters
    ----------
    depth : (H, W) float32 ndarray
        z-depth along the ray K⁻¹ (col, row, 1), model units; 0 = none.
    normals : (3, H, W) float32 ndarray
        Unit vectors in the camera frame.
    view, target : View
        The camera with the maps' pixels, and the same with fewer, see `View.resized`.

    Returns
    -------
    depth, normals : (h, w) and (3, h, w) float32 ndarray
    """
    rows, row_of = _nearest(target.height, view.height)
    columns, column_of = _nearest(target.width, view.width)
    nearest = normals[:, row_of[:, None], column_of]
    factor = _carried(nearest, view, (row_of, column_of), (rows, columns))
    reduced = depth[row_of[:, None], column_of] * factor
    return reduced.astype(np.float32), np.ascontiguousarray(nearest)


def at_pixel_centres(depth: NDArray[np.float32], normals: NDArray[np.float32], view: View) -> NDArray[np.float32]:
    """Take depth from where COLMAP's maps have it to the centres of the pixels, where other programs look for it.

    COLMAP's maps hold at (col, row) the depth along the ray of the image point (col, row), half a pixel to the
    upper left of the pixel's centre. Each depth is carried along its plane; without a normal it stays as it
    is.

    Parameters
    ----------
    depth, normals, view
        As of `reduced_maps`.

    Returns
    -------
    (H, W) float32 ndarray
        z-depth along the ray K⁻¹ (col + 0.5, row + 0.5, 1).
    """
    rows = np.arange(view.height)
    columns = np.arange(view.width)
    factor = _carried(normals, view, (rows, columns), (rows + 0.5, columns + 0.5))
    return np.asarray(depth * factor, np.float32)


def _carried(
    normals: NDArray[np.float32],
    view: View,
    there: tuple[NDArray[Any], NDArray[Any]],
    here: tuple[NDArray[Any], NDArray[Any]],
) -> NDArray[np.float64]:
    """By what depth changes along its plane from rows and columns there to those here; 1 where it cannot tell."""
    inverse = view.inverse_K
    # On the plane n · z r = n · z' r', r and r' the rays of depth 1.
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = _along(normals, inverse, *there) / _along(normals, inverse, *here)
    factor[~((factor > 1 / _MOST_CHANGE) & (factor < _MOST_CHANGE))] = 1.0
    return factor


def _nearest(count: int, of: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Where `count` integer pixels lie among `of`, and the nearest of these."""
    places = np.arange(count) * (of / count)
    return places, np.minimum(np.rint(places).astype(np.int64), of - 1)


def _along(
    normals: NDArray[np.float32],
    inverse: NDArray[Any],
    rows: NDArray[Any],
    columns: NDArray[Any],
) -> NDArray[np.float64]:
    """(h, w) products of normals with the rays of depth 1 through rows and columns."""
    ray_x = inverse[0, 0] * columns + inverse[0, 1] * rows[:, None] + inverse[0, 2]
    ray_y = inverse[1, 1] * rows[:, None] + inverse[1, 2]
    return np.asarray(normals[0] * ray_x + normals[1] * ray_y + normals[2])
