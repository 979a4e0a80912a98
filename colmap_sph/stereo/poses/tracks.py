"""Ties of all pairs → tracks through several images: their points, their errors, how the images hang together.

A corner of an image is the same whichever partner it is measured in (see `ties.find_corners`), so the ties of one
image at one corner are one track: a star of the image and all partners that show the corner.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.rectified_pair import Float

Indices = NDArray[np.int64]

# Ties at one corner of an image differ by the rounding of their files.
_SAME_CORNER = 0.05
_STEPS = 4
# Of the trace of a point's normal equations: rays that are nearly parallel leave its distance where it is.
_REGULARISER = 1e-9


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points that are in no model.

    Attributes
    ----------
    track : (m,) int64 ndarray
        Number of the track of each observation: 0, 1, …, ascending.
    view : (m,) int64 ndarray
        Index of its view; the first of a track is the one with the corner.
    pixels : (m, 2) float64 ndarray
        Image coordinates.
    """

    track: Indices
    view: Indices
    pixels: Float

    def __len__(self) -> int:
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def only(self, kept: NDArray[np.bool_]) -> "Tracks":
        """Those tracks, (n,) bool, numbered anew."""
        chosen = kept[self.track]
        numbers = np.cumsum(kept) - 1
        return Tracks(numbers[self.track[chosen]], self.view[chosen], self.pixels[chosen])


@dataclass(frozen=True, eq=False)
class ImageTies:
    """Ties of a pair: (n, 2) image coordinates in its left and its right image."""

    left: Float
    right: Float


def tracks_of_ties(ties: Mapping[tuple[str, str], ImageTies], index_of: Mapping[str, int]) -> Tracks:
    """Join ties at one corner of an image to tracks.

    Parameters
    ----------
    ties : mapping
        Of each pair of image names, left and right.
    index_of : mapping of str to int
        Index of each view.

    Returns
    -------
    Tracks
        Through two images or more.
    """
    if not any(len(found.left) for found in ties.values()):
        return Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    left = np.concatenate([found.left for found in ties.values()])
    right = np.concatenate([found.right for found in ties.values()])
    sizes = [len(found.left) for found in ties.values()]
    from_view = np.repeat([index_of[pair[0]] for pair in ties], sizes)
    to_view = np.repeat([index_of[pair[1]] for pair in ties], sizes)
    corners = np.column_stack([from_view, np.rint(left / _SAME_CORNER / 2)]).astype(np.int64)
    _, first, track = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    track = track.ravel()
    # Each track begins with its corner, then come its ties.
    order = np.argsort(np.concatenate([np.arange(len(first)), track]), kind="stable")
    return Tracks(
        np.concatenate([np.arange(len(first)), track])[order].astype(np.int64),
        np.concatenate([from_view[first], to_view])[order].astype(np.int64),
        np.concatenate([left[first], right])[order],
    )


def triangulated(tracks: Tracks, views: Sequence[View]) -> Float:
    """(n, 3) points, world frame, with the least squares of reprojection; NaN where rays are parallel."""
    K, R, t = _cameras(tracks, views)
    homogeneous = np.column_stack([tracks.pixels, np.ones(len(tracks.pixels))])
    rays = np.einsum("mji,mj->mi", R, np.linalg.solve(K, homogeneous[:, :, None])[:, :, 0])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    centers = -np.einsum("mji,mj->mi", R, t)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    points = _solved(tracks, across, np.einsum("mij,mj->mi", across, centers))
    for _ in range(_STEPS):
        pixels, depth = _projected(points[tracks.track], K, R, t)
        KR = K @ R
        jacobian = (KR[:, :2] - pixels[:, :, None] * KR[:, 2:]) / depth[:, None, None]
        normal = np.einsum("mki,mkj->mij", jacobian, jacobian)
        points = points + _solved(tracks, normal, np.einsum("mki,mk->mi", jacobian, tracks.pixels - pixels))
    return points


def reprojection_errors(tracks: Tracks, points: Float, views: Sequence[View]) -> Float:
    """(m, 2) observed less projected image coordinates; NaN for points that are not in front of their camera."""
    pixels, depth = _projected(points[tracks.track], *_cameras(tracks, views))
    return np.asarray(np.where(depth[:, None] > 0, tracks.pixels - pixels, np.nan))


def track_errors(tracks: Tracks, points: Float, views: Sequence[View]) -> Float:
    """(n,) error of each track, pixels: what its observations miss, per degree of freedom.

    An observation has two, and a point takes three away: what is left says how far rays miss each other.
    """
    squares = (reprojection_errors(tracks, points, views) ** 2).sum(axis=1)
    number = np.bincount(tracks.track, minlength=len(tracks))
    return np.asarray(np.sqrt(np.bincount(tracks.track, squares, len(tracks)) / (2 * number - 3)))


def parallax_angles(tracks: Tracks, points: Float, views: Sequence[View]) -> Float:
    """(n,) largest angle, degrees, between the ray of the corner and those of its ties."""
    _, R, t = _cameras(tracks, views)
    rays = points[tracks.track] + np.einsum("mji,mj->mi", R, t)
    with np.errstate(invalid="ignore"):
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    first = np.searchsorted(tracks.track, np.arange(len(tracks)))
    # Of small angles the chord tells more digits than the cosine.
    chord = np.linalg.norm(rays - rays[first][tracks.track], axis=1)
    angles = 2 * np.degrees(np.arcsin(np.clip(chord / 2, 0, 1)))
    largest = np.zeros(len(tracks))
    np.maximum.at(largest, tracks.track, angles)
    return largest


def views_together(tracks: Tracks, num_views: int, least: int) -> NDArray[np.bool_]:
    """(num_views,) bool: views of the largest group that hangs together by pairs with so many ties or more."""
    # Not before: it takes its time to load, and few runs polish their poses.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first = np.searchsorted(tracks.track, np.arange(len(tracks)))
    corner_view = tracks.view[first][tracks.track]
    ones = np.ones(len(tracks.view))
    ties = coo_array((ones, (corner_view, tracks.view)), shape=(num_views, num_views)).tocsr()
    _, group = connected_components(ties >= least, directed=False)
    return np.asarray(group == np.bincount(group).argmax())


def thickness(points: Float) -> float:
    """How far points lie off their common plane, in units of their extent (root mean squares); 0 for under 4."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 4:
        return 0.0
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(spread[2] / max(spread[0], 1e-300))


def _cameras(tracks: Tracks, views: Sequence[View]) -> tuple[Float, Float, Float]:
    """K, R and t of each observation."""
    K, R, t = (np.stack([getattr(view, name) for view in views]) for name in ("K", "R", "t"))
    return K[tracks.view], R[tracks.view], t[tracks.view]


def _projected(points: Float, K: Float, R: Float, t: Float) -> tuple[Float, Float]:
    camera = np.einsum("mij,mj->mi", R, points) + t
    homogeneous = np.einsum("mij,mj->mi", K, camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        return homogeneous[:, :2] / homogeneous[:, 2:], camera[:, 2]


def _solved(tracks: Tracks, normal: Float, right: Float) -> Float:
    """(n, 3) solution of each track's equations, summed over its observations."""
    n = len(tracks)
    sums = np.zeros((n, 3, 3))
    np.add.at(sums, tracks.track, normal)
    sums += _REGULARISER * np.trace(sums, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    sides = np.zeros((n, 3))
    np.add.at(sides, tracks.track, right)
    good = np.isfinite(sums).all(axis=(1, 2)) & (np.linalg.det(np.nan_to_num(sums)) != 0)
    solution = np.full((n, 3), np.nan)
    solution[good] = np.linalg.solve(sums[good], sides[good][:, :, None])[:, :, 0]
    return solution
