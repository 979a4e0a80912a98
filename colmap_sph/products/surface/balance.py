"""Brightness and colour of the images at shared points → a gain for each image and colour."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.project.images.reading import read_small_colours
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene

# Small pictures, whose pixels are means of many: noise and small shifts play no part.
_LONGEST = 512
_ROUNDS = 30
# So many points speak for a gain of 1: an image with a few alone is left nearly as it is.
_PRIOR = 5.0
_MOST_GAIN = 2.0
_DARKEST = 8.0
_BRIGHTEST = 247.0


def balancing_gains(workspace: Workspace, scene: Scene, indices: Sequence[int]) -> NDArray[np.float32]:
    """Find what brings images to one brightness and colour at the sparse points that they share.

    Parameters
    ----------
    workspace : Workspace
    scene : Scene
    indices : sequence of int
        Views that take part.

    Returns
    -------
    (len(indices), 3) float32 ndarray
        Factors of red, green and blue; 1 where nothing is shared.
    """
    values, views, points = [], [], []
    for place, index in enumerate(indices):
        view = scene.views[index]
        if not len(view.point_indices):
            continue
        colours, seen = _colours_at(workspace, scene, index)
        values.append(colours)
        views.append(np.full(len(seen), place))
        points.append(seen)
    if not values:
        return np.ones((len(indices), 3), np.float32)
    gains = _solved(np.log(np.concatenate(values)), np.concatenate(views), np.concatenate(points), len(indices))
    return np.clip(np.exp(gains), 1 / _MOST_GAIN, _MOST_GAIN).astype(np.float32)


def _colours_at(workspace: Workspace, scene: Scene, index: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(n, 3) red, green and blue at the points that a view observes, and which points these are."""
    view = scene.views[index]
    picture = read_small_colours(workspace.image_path(view.name), _LONGEST)
    pixels, depth = view.project(scene.points[view.point_indices])
    scale = np.array([picture.shape[1] / view.width, picture.shape[0] / view.height])
    places = np.floor(np.nan_to_num(pixels * scale, nan=-1.0)).astype(np.int64)
    inside = (depth > 0) & (places >= 0).all(axis=1) & (places < picture.shape[1::-1]).all(axis=1)
    colours = np.full((len(places), 3), -1.0)
    colours[inside] = picture[places[inside, 1], places[inside, 0], ::-1]
    known = ((colours > _DARKEST) & (colours < _BRIGHTEST)).all(axis=1)
    return colours[known], view.point_indices[known]


def _solved(
    values: NDArray[np.float64], views: NDArray[np.int64], points: NDArray[np.int64], num_views: int
) -> NDArray[np.float64]:
    """(num_views, 3) logarithms of gains, by least squares: each point's values, with gains, equal their mean."""
    _, rows = np.unique(points, return_inverse=True)
    counts = np.bincount(rows)
    shared = counts[rows] > 1
    values, views, rows = values[shared], views[shared], rows[shared]
    gains = np.zeros((num_views, 3))
    weight = _PRIOR + np.bincount(views, minlength=num_views)
    for _ in range(_ROUNDS):
        for colour in range(3):
            balanced = values[:, colour] + gains[views, colour]
            mean = np.bincount(rows, balanced, minlength=len(counts)) / counts
            off = np.bincount(views, mean[rows] - values[:, colour], minlength=num_views)
            gains[:, colour] = off / weight
    return gains
