"""Matched pair of photographs that were cut into views → ties, as `poses.ties` measures those of two views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.poses.ties import MAX_TIES, Ties, measure_ties, read_windows, surfaces_at
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
    lefts, rights = ([view for view, _, _ in photos] for photos in (left, right))
    tried = [corners[: _MOST_CORNERS // len(left)] for _, _, corners in left]
    numbers = np.repeat(np.arange(len(left)), [len(corners) for corners in tried])
    in_views = [
        rectified_coordinates(view, geometry, "left", each) for view, each in zip(lefts, tried, strict=True)
    ]
    places = np.concatenate(in_views)
    middle = np.rint(places).astype(int)
    inside = ((middle >= 0) & (middle < [geometry.left_width, geometry.height])).all(axis=1)
    own = np.flatnonzero(inside & (_owners(lefts, geometry, "left", places) == numbers))
    numbers, places, middle = numbers[own], places[own], middle[own]
    matched = places - np.column_stack([disparity[middle[:, 1], middle[:, 0]], np.zeros(len(own))])
    owners = _owners(rights, geometry, "right", matched)
    by_views = np.lexsort((owners, numbers))
    by_views = by_views[owners[by_views] >= 0]
    smooth, planes = surfaces_at(places[by_views], disparity)
    which = by_views[smooth]
    windows = _Windows(left, geometry, "left", numbers[which]), _Windows(right, geometry, "right", owners[which])
    ties = measure_ties(places[which], planes, *windows)
    step = -(-len(ties) // MAX_TIES) or 1
    return Ties(ties.left[::step], ties.right[::step], ties.sigma[::step])


@dataclass(frozen=True, eq=False)
class _Windows:
    """Reads the windows around places, each from the photo of its number."""

    photos: Sequence[Photo]
    geometry: RectifiedPair
    side: Side
    numbers: NDArray[np.int64]

    def __call__(self, places: Float, slopes: Float, length: int) -> NDArray[np.float32]:
        """See `read_windows`."""
        windows = np.empty((len(places), length, length), np.float32)
        for number in np.unique(self.numbers):
            view, image, _ = self.photos[number]
            which = self.numbers == number
            photo = (view, image)
            windows[which] = read_windows(photo, self.geometry, self.side, places[which], slopes[which], length)
        return windows


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
