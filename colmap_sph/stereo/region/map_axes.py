"""Cameras and points of a scene → from where a map of it is drawn."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.region.vertical import east_north_up, upwards


def map_axes(
    views: Sequence[View],
    points: NDArray[np.float64],
    *,
    origin: NDArray[np.float64] | None = None,
    up: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Axes of a map of a scene.

    Parameters
    ----------
    views : sequence of View
        At least one.
    points : (n, 3) float64 ndarray
        Some points of its surface.
    origin : (3,) float64 ndarray, optional
        Map coordinates of the scene's origin, as `Scene.origin`; zeros where it is in a frame of its own.
    up : (3,) float64 ndarray, optional
        Unit vector; found from views and points where it is not given.

    Returns
    -------
    (3, 3) float64 ndarray
        Rows: to the right, to the top, and up, towards who looks at the map; a rotation.
    """
    up = upwards(views, points) if up is None else up
    if origin is not None and origin.any():
        return east_north_up(origin, up)
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
