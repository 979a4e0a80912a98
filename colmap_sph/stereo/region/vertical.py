"""Cameras and points of a scene → which way is up, as far as they tell."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View

# Rows of images are level as a rule. Where so little of them leaves their plane, that plane is the ground's; where
# they nearly all have one direction, there is no such plane.
_LEVEL = 0.1
_ONE_DIRECTION = 0.05


def upwards(views: Sequence[View], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) unit vector across the rows of all images; or where these say little, across the (n, 3) points."""
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
