"""Cameras and points of a scene → which way is up, as far as they tell: from where a map of it is drawn."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View

# Rows of images are level as a rule. Where so little of them leaves their plane, that plane is the ground's; where
# they nearly all have one direction, there is no such plane.
_LEVEL = 0.1
_ONE_DIRECTION = 0.05


def map_axes(
    views: Sequence[View], points: NDArray[np.float64], *, is_georeferenced: bool = False
) -> NDArray[np.float64]:
    """Axes of a map of a scene.

    Parameters
    ----------
    views : sequence of View
        At least one.
    points : (n, 3) float64 ndarray
        Some points of its surface.
    is_georeferenced : bool
        Whether the scene is in map coordinates, whose z is up.

    Returns
    -------
    (3, 3) float64 ndarray
        Rows: to the right, to the top, and up, towards who looks at the map; a rotation.
    """
    if is_georeferenced:
        return np.eye(3)
    up = _up(views, points)
    # The long side of the scene lies across.
    level = points - points.mean(axis=0) if len(points) else np.zeros((1, 3))
    level = level - np.outer(level @ up, up)
    _, vectors = np.linalg.eigh(level.T @ level)
    right = vectors[:, 2] - (vectors[:, 2] @ up) * up
    if np.linalg.norm(right) < 0.5:  # no surface: any will do
        right = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    right = right / np.linalg.norm(right)
    top = np.cross(up, right)
    # Cameras look towards the top of the map, rather than out of it.
    ahead = sum(view.viewing_direction - view.R[1] for view in views) @ top
    right, top = (right, top) if ahead >= 0 else (-right, -top)
    return np.array([right, top, up])


def _up(views: Sequence[View], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vector across the rows of all images; or where these say little, across the surface."""
    rows = np.array([view.R[0] for view in views])
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    up = vectors[:, 0]
    if (values[1] < _ONE_DIRECTION or values[0] > _LEVEL) and len(points) > 3:
        spread = points - np.median(points, axis=0)
        near = np.linalg.norm(spread, axis=1)
        spread = spread[near <= np.percentile(near, 90)]
        up = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    # An image's top is up, or what is behind its camera.
    sign = sum(-view.R[1] - view.R[2] for view in views) @ up
    return np.asarray(up if sign >= 0 else -up)
