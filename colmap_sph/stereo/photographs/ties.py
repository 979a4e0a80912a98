"""Matched pair of photographs that were cut into views → ties, as `poses.ties` measures those of two views."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.poses.ties import MAX_TIES, Ties, find_ties
from colmap_sph.stereo.rectified_pair import (
    Float,
    RectifiedPair,
    Side,
    pixel_from_rectified_ray,
    rays_of_coordinates,
    rectified_coordinates,
)

# Corners that are tried, in all views together: most of them lie on no plane, or have no match.
_MOST_CORNERS = 2 * MAX_TIES

Photo = tuple[View, NDArray[np.uint8] | NDArray[np.float32], Float]
"""A view, its grey undistorted image, and (n, 2) corners in it, the best first."""


def find_ties_of_photographs(
    left: Sequence[Photo], right: Sequence[Photo], geometry: RectifiedPair, disparity: NDArray[np.float32]
) -> Ties:
    """Measure corners of the left photograph's views in those views of the right one that own their matches.

    Parameters
    ----------
    left, right : sequence of Photo
        Views of one centre each; the corners of the right ones do not matter.
    geometry : RectifiedPair
    disparity : (H, W_left) float32 ndarray
        Of the left image's pixels; NaN = none.

    Returns
    -------
    Ties
        At most `MAX_TIES`.
    """
    found = []
    for number, (view, image, corners) in enumerate(left):
        corners = corners[: _MOST_CORNERS // len(left)]
        places = rectified_coordinates(view, geometry, "left", corners)
        is_own = _owners([photo[0] for photo in left], geometry, "left", places) == number
        corners, places = corners[is_own], places[is_own]
        middle = np.rint(places).astype(int)
        inside = ((middle >= 0) & (middle < [geometry.left_width, geometry.height])).all(axis=1)
        corners, places, middle = corners[inside], places[inside], middle[inside]
        matched = places - np.column_stack([disparity[middle[:, 1], middle[:, 0]], np.zeros(len(middle))])
        owners = _owners([photo[0] for photo in right], geometry, "right", matched)
        for owner in np.unique(owners[owners >= 0]):
            other = right[owner]
            own = corners[owners == owner]
            found.append(find_ties((view, image), (other[0], other[1]), geometry, disparity, own))
    ties = [np.concatenate(parts) for parts in zip(*((t.left, t.right, t.sigma) for t in found), strict=True)]
    step = -(-len(ties[0]) // MAX_TIES) or 1 if ties else 1
    return Ties(*(part[::step] for part in ties)) if ties else Ties.none()


def _owners(views: Sequence[View], geometry: RectifiedPair, side: Side, places: Float) -> NDArray[np.int64]:
    """(n,) numbers of the views that own the rays of (n, 2) rectified places; -1 where none has them, or NaN."""
    owners = np.full(len(places), -1)
    nearest = np.zeros(len(places))
    rays = rays_of_coordinates(geometry, side, places)
    for number, view in enumerate(views):
        x, y, cosine = pixel_from_rectified_ray(view, geometry) @ rays
        nearer = (cosine > nearest) & (x > 0) & (x < view.width * cosine) & (y > 0) & (y < view.height * cosine)
        owners[nearer] = number
        nearest[nearer] = cosine[nearer]
    return owners
