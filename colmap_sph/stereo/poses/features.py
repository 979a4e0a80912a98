"""Features of two photographs → how far their matches lie from common epipolar planes.

Features (SIFT; Lowe, 2004) are matched by what they look like, without poses. So they tell whether poses are right
where nothing else does: of a model without points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.rectified_pair import Float

# Pixels of the longer side of the images in which features are found, and how many in those of one photograph.
_LONGEST = 800
_MOST_FEATURES = 1500
_FEWEST_FEATURES = 200
# The second most alike must be less alike by so much, as a ratio of distances.
_RATIO = 0.75
# Features lie in one epipolar plane where they are no farther from it than so many pixels, or this share of the
# longer side.
_FAR_PIXELS = 2.0
_FAR_SHARE = 0.01

# A view, its grey image (H, W) uint8, and a mask that is 0 where no feature is wanted.
Shown = tuple[View, NDArray[np.uint8], NDArray[np.uint8] | None]


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a photograph.

    Attributes
    ----------
    rays : (n, 3) float64 ndarray
        Unit vectors, world frame.
    descriptors : (n, 128) float32 ndarray
    tolerance : (n,) float64 ndarray
        How far poses may be off there, radians.
    """

    rays: Float
    descriptors: NDArray[np.float32]
    tolerance: Float

    def __len__(self) -> int:
        return len(self.rays)


def find_features(views: Sequence[Shown]) -> Features:
    """Find the features of a photograph.

    Parameters
    ----------
    views : sequence of (View, (H, W) uint8 ndarray, (H, W) uint8 ndarray or None)
        Its views, their grey images, and masks that are 0 where no feature is wanted.

    Returns
    -------
    Features
    """
    most = max(_MOST_FEATURES // len(views), _FEWEST_FEATURES)
    found = [_of_view(*shown, most) for shown in views]
    return Features(
        np.concatenate([each.rays for each in found]),
        np.concatenate([each.descriptors for each in found]),
        np.concatenate([each.tolerance for each in found]),
    )


def _of_view(view: View, image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, most: int) -> Features:
    scale = min(_LONGEST / max(image.shape), 1.0)
    width, height = (max(round(scale * side), 1) for side in (view.width, view.height))
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    wanted = None if mask is None else cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    points, descriptors = cv2.SIFT.create(most).detectAndCompute(small, wanted)
    if not points:
        return Features(np.empty((0, 3)), np.empty((0, 128), np.float32), np.empty(0))
    pixels = (np.array([point.pt for point in points]) + 0.5) * [view.width / width, view.height / height]
    rays = np.linalg.solve(view.K, np.column_stack([pixels, np.ones(len(pixels))]).T)
    rays /= np.linalg.norm(rays, axis=0)
    tolerance = max(_FAR_PIXELS, _FAR_SHARE * max(view.width, view.height)) / float(view.K[0, 0])
    return Features((view.R.T @ rays).T, np.asarray(descriptors), np.full(len(points), tolerance))


def match_features(first: Features, second: Features) -> NDArray[np.int64]:
    """(n, 2) rows of features of two photographs that are most alike, each way, and clearly more than others."""
    if min(len(first), len(second)) < 2:  # nothing to be more alike than
        return np.empty((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    two_best = matcher.knnMatch(first.descriptors, second.descriptors, 2)
    back = [match.trainIdx for match in matcher.match(second.descriptors, first.descriptors)]
    rows = [
        (best.queryIdx, best.trainIdx)
        for best, other in two_best
        if best.distance < _RATIO * other.distance and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(rows, np.int64).reshape(-1, 2)


def inverted(features: Features, view: View) -> Features:
    """The features of a photograph that is one view, if its pose were world_from_cam."""
    return replace(features, rays=features.rays @ view.R.T @ view.R.T)


def with_focal_length(features: Features, view: View, factor: float) -> Features:
    """The features of a photograph that is one view, if its focal length were `factor` times what it is."""
    rays = features.rays @ view.R.T
    rays[:, 2] *= factor
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    return replace(features, rays=rays @ view.R)


def epipolar_distances(first: Features, second: Features, matches: NDArray[np.int64], baseline: Float) -> Float:
    """How far matches lie from one epipolar plane, as a share of how far poses may be off.

    Parameters
    ----------
    first, second : Features
    matches : (n, 2) int64 ndarray
    baseline : (3,) float64 ndarray
        From one centre to the other, world frame.

    Returns
    -------
    (n,) float64 ndarray
        1: by 2 pixels or, where that is more, a hundredth of the longer side of the image.

    Examples
    --------
    Rays to one point, and from the second place also one that looks past it by 5 degrees, upwards:

    >>> point = np.array([0.0, 0, 10])
    >>> baseline = np.array([1.0, 0, 0])
    >>> up = np.array([0, np.sin(np.radians(5)), np.cos(np.radians(5))])
    >>> first, second = (
    ...     Features(rays / np.linalg.norm(rays, axis=1)[:, None], np.empty((2, 128)), np.full(2, 0.01))
    ...     for rays in (np.array([point, point]), np.array([point - baseline, up]))
    ... )
    >>> epipolar_distances(first, second, np.array([[0, 0], [1, 1]]), baseline).round(1).tolist()
    [0.0, 8.7]
    """
    there, here = first.rays[matches[:, 0]], second.rays[matches[:, 1]]
    tolerance = np.maximum(first.tolerance[matches[:, 0]], second.tolerance[matches[:, 1]])
    off = np.maximum(_angle_off(here, there, baseline), _angle_off(there, here, baseline))
    return np.asarray(off / tolerance)


def _angle_off(rays: Float, others: Float, baseline: Float) -> Float:
    """(n,) sine of the angle between rays and the planes of the baseline and other rays."""
    normals = np.cross(others, baseline)
    lengths = np.linalg.norm(normals, axis=1)
    across = np.abs((rays * normals).sum(axis=1))
    return np.asarray(np.divide(across, lengths, out=np.zeros(len(rays)), where=lengths > 0))
