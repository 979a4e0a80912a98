"""Cameras and points of a scene, or where it lies on the map → which way is up, as far as they tell."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View

# Rows of images are level as a rule. Where so little of them leaves their plane, that plane is the ground's; where
# they nearly all have one direction, there is no such plane.
_LEVEL = 0.1
_ONE_DIRECTION = 0.05
# The Earth's ellipsoid (WGS 84), metres. Photographs are taken from a kilometre below it to twelve above.
_SEMI_AXES = np.array([6378137.0, 6378137.0, 6356752.0])
_LOWEST, _HIGHEST = 0.9998, 1.002
# Heights on maps are less, in metres as in feet.
_MOST_HEIGHT = 50_000.0
# Cosine: so near to a direction is what images take for up, be they from above or oblique.
_NEAR_UP = 0.7


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


def east_north_up(place: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """East, north and up at a place in map coordinates, whose axes these are, unless they are geocentric (ECEF).

    In UTM a band of 13 km, some 57° from the equator or 33° south, has places that could be geocentric ones near
    the equator; there what the images take for up decides. Elsewhere it does not: of a façade it is to the front.

    Parameters
    ----------
    place : (3,) float64 ndarray
        Map coordinates; geocentric ones are in metres.
    up : (3,) float64 ndarray
        Unit vector along the axes of the map: about up, see `upwards`.

    Returns
    -------
    (3, 3) float64 ndarray
        Rows: unit vectors along the axes of the map.

    Examples
    --------
    >>> on_equator = np.array([0.0, 6378200.0, 0.0])
    >>> east_north_up(on_equator, np.array([0.0, 1.0, 0.0])).astype(int).tolist()
    [[-1, 0, 0], [0, 0, 1], [0, 1, 0]]
    >>> east_north_up(on_equator, np.array([0.0, 0.0, 1.0])).astype(int).tolist()
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    """
    normal = place / _SEMI_AXES**2
    normal = normal / (np.linalg.norm(normal) or 1.0)
    is_possible = _LOWEST < np.linalg.norm(place / _SEMI_AXES) < _HIGHEST
    if not is_possible or (abs(place[2]) < _MOST_HEIGHT and up @ normal < _NEAR_UP):
        return np.eye(3)
    east = np.array([-normal[1], normal[0], 0.0])
    east = east / np.linalg.norm(east) if east.any() else np.eye(3)[0]  # at a pole any will do
    return np.array([east, np.cross(normal, east), normal])
