"""Sparse points of a pair → which image is the left one, and where its coarsest level is expected to match."""

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.scene import Photograph, Scene, View, observed_by
from colmap_sph.stereo.rectified_pair import Float, RectifiedPair, Side, coordinates_of_rays

Seeds = NDArray[np.floating]
"""(n, 3) left columns, left rows and disparities, pixels, of sparse points in a rectified pair."""

# Seeds are rounded to so many parts of a pixel, so that the last digits of their points do not count.
_STEPS = 4
# So many tell what can be told, and travel well.
_MOST = 256
# A pixel is predicted from so many seeds around it, by a plane. Those nearer than this share of the image's
# shorter side, or so many pixels of the level, count alike.
_NEIGHBOURS = 12
_ALIKE_SHARE = 0.04
_LEAST_ALIKE = 2.0
# Slopes are held back as if so many times as many seeds, at that distance and at the distance of the nearest one,
# told of none: beyond the outermost seeds little is known.
_STIFFNESS = 0.125
_UNKNOWN_STIFFNESS = 0.1

# Images that see their points equally fine, but for this share, stay in the order of their names.
_EQUALLY_FINE = 1.02


def shared_points(scene: Scene, left: View | Photograph, right: View | Photograph) -> Float:
    """(n, 3) sparse points that both views observe, world frame."""
    return scene.points[observed_by(left, right)[1]]


def finer_first(points: Float, first: View, second: View) -> tuple[View, View]:
    """The two views, that which sees the (n, 3) points that they share finer before the other.

    Pixels of the left image are looked for in the right one, which is stretched or squeezed to that end: a coarser
    image can be stretched, while a finer one would lose pixels.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return first, second
    fineness = [view.K[0, 0] / np.linalg.norm(points - view.center, axis=1) for view in (first, second)]
    coarser = float(np.median(fineness[1] / fineness[0])) > _EQUALLY_FINE
    return (second, first) if coarser else (first, second)


def seeds_of_points(left: View, right: View, pair: RectifiedPair, points: Float) -> Seeds:
    """Where a rectified pair shows points.

    Parameters
    ----------
    left, right : View
    pair : RectifiedPair
    points : (n, 3) float64 ndarray
        World frame.

    Returns
    -------
    (m, 3) float32 ndarray
        Column and row in the left rectified image, and disparity, of the points inside of both images and of the
        pair's range, rounded to quarters of a pixel; at most 256, from all over the points' order.
    """
    left_places = _places(left, pair, "left", points)
    right_places = _places(right, pair, "right", points)
    seeds = np.column_stack([left_places, left_places[:, 0] - right_places[:, 0]])
    with np.errstate(invalid="ignore"):
        inside = _inside(pair, "left", left_places) & _inside(pair, "right", right_places)
        inside &= (seeds[:, 2] >= pair.min_disparity) & (seeds[:, 2] <= pair.max_disparity)
    seeds = seeds[inside]
    kept = np.linspace(0, len(seeds) - 1, min(len(seeds), _MOST)).astype(int)
    return np.asarray(np.round(seeds[kept] * _STEPS) / _STEPS, dtype=np.float32)


def _places(view: View, pair: RectifiedPair, side: Side, points: Float) -> Float:
    rays = (points - view.center) @ pair.rectified_from_world.T
    if pair.surface == "frame":
        rays = np.where(rays[:, 2:] > 0, rays, np.nan)
    return coordinates_of_rays(pair, side, rays)


def _inside(pair: RectifiedPair, side: Side, places: Float) -> NDArray[np.bool_]:
    middle = np.array([pair.width(side) - 1, pair.height - 1]) / 2
    return np.asarray((np.abs(places - middle) <= middle).all(axis=1))


def interpolated_disparity(seeds: Seeds, shape: tuple[int, ...], scale: float) -> NDArray[np.float32]:
    """Disparity between seeds: of every pixel the plane through those around it, the near ones first.

    Parameters
    ----------
    seeds : (n, 3) float32 ndarray
        As of `seeds_of_points`; at least one.
    shape : (int, int)
        Rows and columns of the level.
    scale : float
        Pixels of full resolution to one of the level.

    Returns
    -------
    (H, W) float32 ndarray
        Pixels of the level.
    """
    exact = np.asarray(seeds, dtype=np.float64)
    columns, rows = ((exact[:, axis] + 0.5) / scale - 0.5 for axis in (0, 1))
    alike = max(_ALIKE_SHARE * min(shape), _LEAST_ALIKE)
    # Smooth at that distance: planes at the centres of cells half as wide, linear between these.
    cell = max(round(alike / 2), 1)
    height, width = (-(-side // cell) for side in shape)
    planes = np.empty((height, width), dtype=np.float32)
    weights = (_NEIGHBOURS, alike, _STIFFNESS, _UNKNOWN_STIFFNESS)
    _native.seed_planes(columns, rows, exact[:, 2] / scale, *weights, cell, planes)
    fine = cv2.resize(planes, (width * cell, height * cell))
    return np.asarray(fine[: shape[0], : shape[1]], dtype=np.float32)
