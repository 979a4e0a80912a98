"""Disparities of a view's pairs → its depth map.

Each pair gives one depth candidate per pixel, read along the pixel's ray from the pair's disparity map, with a
standard deviation from its geometry. The candidates vote: the largest mutually consistent cluster wins, and its
weighted mean is the *photometric* depth. Depth maps of neighbouring views then check each other: what enough of
them confirm and few see through is the *geometric* depth.

Depth is z in the camera frame along the ray K⁻¹ (col, row, 1): COLMAP's fusion reads depth maps so.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import View, pixel_transfer
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Side, rectified_ray_from_pixel

# Slope of the steepest surface that is looked for around a pixel, as depth over width.
_STEEPEST = 4.0
# Candidates of all pairs are voted on in bands of rows of about this size.
_BAND_BYTES = 8 << 20


@dataclass(frozen=True)
class DepthOptions:
    """How a view's pairs become its depth map."""

    disparity_sigma: float = 0.2
    """Standard deviation, pixels, of a disparity on a smooth surface; where disparities are rough it is larger.
    The scale of every tolerance below."""
    max_disparity_step: float = 2.0
    """Neighbouring disparities that differ by more than this (pixels) belong to different surfaces."""
    vote_tolerance: float = 3.0
    """Two candidates agree when they differ by less than this many standard deviations."""
    min_support: int = 1
    """Pairs that must agree on a photometric depth."""
    max_reprojection_error: float = 2.0
    """Two views' depths agree when the point, seen by the other view, projects back within this many pixels."""
    consistency_tolerance: float = 4.5
    """… and when they differ by less than this many standard deviations."""
    min_consistent: int = 2
    """Views, of those that share a pair with the image, that must confirm a geometric depth; one is enough for a
    point that no other has in view."""
    max_contradiction: float = 0.5
    """A depth is dropped when more views look through it than this share of those that confirm it."""
    min_contradicting_support: int = 2
    """Pairs that must agree on a view's photometric depth before it can look through another's. A view with fewer
    pairs contradicts no other."""
    min_surface: float = 0.6
    """Where one view alone confirms a depth, at least this share of the 7 x 7 pixels around it must be of the same
    surface: what a single pair found in passing is rarely right."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name in (
            "disparity_sigma",
            "max_disparity_step",
            "vote_tolerance",
            "max_reprojection_error",
            "consistency_tolerance",
        ):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be positive, not {getattr(self, name)}.")
        for name in ("min_support", "min_contradicting_support"):
            if not 1 <= getattr(self, name) <= 255:
                raise OptionError(f"{name} must lie in 1..255, not {getattr(self, name)}.")
        if not 0 <= self.min_consistent <= 255:
            raise OptionError(f"min_consistent must lie in 0..255, not {self.min_consistent}.")
        if not self.max_contradiction >= 0:
            raise OptionError(f"max_contradiction must not be negative, not {self.max_contradiction}.")
        if not 0 <= self.min_surface <= 1:
            raise OptionError(f"min_surface must lie in 0..1, not {self.min_surface}.")


# Which options `estimate_depth` reads, and which `check_depth`.
VOTE_OPTIONS = ("disparity_sigma", "max_disparity_step", "vote_tolerance", "min_support")
CHECK_OPTIONS = (
    "max_reprojection_error",
    "consistency_tolerance",
    "min_consistent",
    "max_contradiction",
    "min_contradicting_support",
    "min_surface",
)


@dataclass(frozen=True, eq=False)
class DepthEstimate:
    """A view's depth map with its uncertainty.

    Attributes
    ----------
    depth : (H, W) float32 ndarray
        z-depth, model units; 0 = none.
    sigma : (H, W) float32 ndarray
        Its standard deviation, model units.
    support : (H, W) uint8 ndarray
        Number of pairs (photometric) or views (geometric) behind it.
    """

    depth: NDArray[np.float32]
    sigma: NDArray[np.float32]
    support: NDArray[np.uint8]


def right_disparity(pair: PairDisparity, max_step: float) -> NDArray[np.float32]:
    """The disparity map carried to the right image's pixels, (H, W_right) float32, NaN = none."""
    right = np.empty((pair.geometry.height, pair.geometry.right_width), dtype=np.float32)
    _native.transfer_disparity(pair.disparity, max_step, right)
    return right


def depth_candidates(
    view: View,
    disparity: NDArray[np.float32],
    geometry: RectifiedPair,
    side: Side,
    options: DepthOptions,
    rows: slice = slice(None),
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Triangulate a pair's disparities along the rays of one of its images.

    On the sphere the distance along the ray is ρ = b cos θ_r / sin δ (left image), on the plane Z = b f / d
    (Elhashash & Qin, §3.4).

    Parameters
    ----------
    view : View
        The image whose depth is wanted.
    disparity : (H, W) float32 ndarray
        Disparity map in the rectified image of that side; NaN = none.
    geometry : RectifiedPair
    side : {"left", "right"}
    options : DepthOptions
    rows : slice, optional
        Rows of the view to do, h of them.

    Returns
    -------
    depth, sigma : (h, view.width) float32 ndarray
        z-depth and its standard deviation, model units; 0 = none.
    """
    first, end, _ = rows.indices(view.height)
    depth = np.empty((end - first, view.width), dtype=np.float32)
    sigma = np.empty_like(depth)
    _native.depth_candidates(
        backend(),
        disparity,
        np.ascontiguousarray(rectified_ray_from_pixel(view, geometry)),
        (geometry.columns_per_radian, geometry.rows_per_radian),
        (geometry.column_origin(side), geometry.row_origin),
        geometry.disparity_origin,
        geometry.baseline,
        options.disparity_sigma,
        options.max_disparity_step,
        geometry.model == "spherical",
        side == "left",
        first,
        depth,
        sigma,
    )
    return depth, sigma


def estimate_depth(view: View, pairs: Iterable[PairDisparity], options: DepthOptions) -> DepthEstimate:
    """Photometric depth of a view: the vote of all its pairs.

    Parameters
    ----------
    view : View
    pairs : iterable of PairDisparity
        Pairs in which the view is the left or the right image.
    options : DepthOptions

    Returns
    -------
    DepthEstimate
    """
    sources: list[tuple[NDArray[np.float32], RectifiedPair, Side]] = []
    for pair in pairs:
        if pair.left == view.name:
            sources.append((pair.disparity, pair.geometry, "left"))
        else:
            sources.append((right_disparity(pair, options.max_disparity_step), pair.geometry, "right"))
    shape = (view.height, view.width)
    voted = DepthEstimate(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8))
    step = max(_BAND_BYTES // (8 * view.width * max(len(sources), 1)), 1)
    for first in range(0, view.height if sources else 0, step):
        rows = slice(first, first + step)
        candidates = [depth_candidates(view, *source, options, rows) for source in sources]
        _native.vote_depth(
            np.stack([depth for depth, _ in candidates]),
            np.stack([sigma for _, sigma in candidates]),
            options.vote_tolerance,
            voted.depth[rows],
            voted.sigma[rows],
            voted.support[rows],
        )
    voted.depth[voted.support < options.min_support] = 0
    return voted


def check_depth(
    view: View,
    estimate: DepthEstimate,
    partners: Iterable[tuple[View, DepthEstimate]],
    options: DepthOptions,
) -> DepthEstimate:
    """Geometric depth of a view: what the depth maps of its partners confirm, averaged with theirs.

    Parameters
    ----------
    view : View
    estimate : DepthEstimate
        Its photometric depth.
    partners : iterable of (View, DepthEstimate)
        Neighbouring views and their photometric depths.
    options : DepthOptions

    Returns
    -------
    DepthEstimate
        `support` is the number of confirming partners.
    """
    shape = estimate.depth.shape
    observing, agreeing, contradicting = (np.zeros(shape, np.uint8) for _ in range(3))
    weighted, weight = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for partner, partner_estimate in partners:
        _native.check_consistency(
            backend(),
            estimate.depth,
            estimate.sigma,
            partner_estimate.depth,
            partner_estimate.sigma,
            partner_estimate.support,
            pixel_transfer(view, partner),
            pixel_transfer(partner, view),
            options.max_reprojection_error,
            options.consistency_tolerance,
            options.min_contradicting_support,
            observing,
            agreeing,
            contradicting,
            weighted,
            weight,
        )
    _native.confirm_depth(
        estimate.depth,
        estimate.sigma,
        options.min_consistent,
        options.max_contradiction,
        options.min_surface,
        _STEEPEST / view.K[0, 0],
        observing,
        agreeing,
        contradicting,
        weighted,
        weight,
    )
    return DepthEstimate(weighted, weight, agreeing)
