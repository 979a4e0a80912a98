"""Points, or a view's depth map → what of it lies inside of a region."""

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Polygons, Region, View, in_bands

# Pixels that are looked at in one go.
_BAND_PIXELS = 1 << 21


def is_inside(region: Region, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of (n, 3) points lie inside of a region; those on the faces of its box do.

    Examples
    --------
    A square with a hole:

    >>> box = np.array([[0.0, 0, -np.inf], [4, 4, np.inf]])
    >>> outline = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
    >>> hole = np.array([[1.0, 1], [2, 1], [2, 2], [1, 2]])
    >>> points = np.array([[0.5, 0.5, 9], [1.5, 1.5, 9], [5, 1, 9]])
    >>> is_inside(Region(box, ((outline, hole),)), points).tolist()
    [True, False, False]
    """
    points = region.along(points)
    inside = np.asarray(((points >= region.box[0]) & (points <= region.box[1])).all(axis=1))
    if region.polygons:
        rows = np.flatnonzero(inside)
        inside[rows] = _in_any(region.polygons, points[rows, :2])
    return inside


def _in_any(polygons: Polygons, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of (n, 2) places lie in one of some polygons: on a ray from there an odd number of edges lies.

    Each edge is asked about the places in its range of y alone, which is why these are sorted.
    """
    order = np.argsort(places[:, 1], kind="stable")
    x, y = places[order].T
    found = np.zeros(len(order), bool)
    for rings in polygons:
        is_odd = np.zeros(len(order), bool)
        for ring in rings:
            ends = np.roll(ring, -1, axis=0)
            firsts = np.searchsorted(y, np.minimum(ring[:, 1], ends[:, 1]))
            lasts = np.searchsorted(y, np.maximum(ring[:, 1], ends[:, 1]))
            for k in np.flatnonzero(firsts < lasts):
                among = slice(firsts[k], lasts[k])
                (x0, y0), (x1, y1) = ring[k], ends[k]
                is_odd[among] ^= x[among] < x0 + (y[among] - y0) * ((x1 - x0) / (y1 - y0))
        found |= is_odd
    result = np.empty_like(found)
    result[order] = found
    return result


def pixels_inside(view: View, depth: NDArray[np.float32], region: Region) -> NDArray[np.bool_]:
    """Which pixels of a depth map lie inside of a region.

    Parameters
    ----------
    view : View
    depth : (H, W) float32 ndarray
        z-depth along the ray K⁻¹ (col, row, 1); 0 = none.
    region : Region
        In the view's world frame.

    Returns
    -------
    (H, W) bool ndarray
        False where there is no depth.
    """
    inside = np.zeros(depth.shape, bool)
    directions = view.R.T @ view.inverse_K
    for band in in_bands(depth.shape, _BAND_PIXELS):
        rows, columns = np.nonzero(depth[band] > 0)
        rows += band.start
        pixels = np.stack([columns, rows, np.ones_like(rows)]).astype(np.float64)
        points = (directions @ pixels * depth[rows, columns]).T + view.center
        inside[rows, columns] = is_inside(region, points)
    return inside


def drop_outside(view: View, depth: NDArray[np.float32], region: Region | None, margin: int = 0) -> None:
    """Set a view's depth map to 0, in place, at pixels outside of a region; None: all is wanted.

    Parameters
    ----------
    view : View
    depth : (H, W) float32 ndarray
        See `pixels_inside`.
    region : Region or None
    margin : int
        Pixels within so many rows and columns of one inside stay, too.
    """
    if region is None:
        return
    inside = pixels_inside(view, depth, region)
    if margin:
        inside = _widened(inside, margin)
    depth[~inside] = 0


def _widened(inside: NDArray[np.bool_], margin: int) -> NDArray[np.bool_]:
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return np.asarray(cv2.dilate(inside.view(np.uint8), kernel), dtype=bool)
