"""Disparities of a view's pairs → its photometric depth map.

Each pair gives one depth candidate per pixel, read along the pixel's ray from the pair's disparity map, with a
standard deviation from its geometry. The candidates vote: the largest mutually consistent cluster wins, and its
weighted mean is the *photometric* depth.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Side, rectified_ray_from_pixel

# Pairs are sampled coarsely where images are soft, and finely where they are sharp: what is matched there is less
# sure, or surer, by up to these factors.
_LEAST_SOFTNESS = 0.8
_MOST_SOFTNESS = 2.0
# A pair whose rows disagree by more rectified pixels is wrong rather than imprecise, and agrees with nothing more.
_MOST_RESIDUAL = 1.0
# Depths are known to a tenth at least: those that are not lie nearly at infinity, as skies and glare do, which
# match anywhere near the far end of what is searched.
_LEAST_PRECISION = 10.0
# Candidates of all pairs are voted on in bands of rows of about this size.
_BAND_BYTES = 8 << 20


@dataclass(frozen=True)
class VoteOptions:
    """How the pairs of a view vote on its depth."""

    disparity_sigma: float = 0.25
    """Standard deviation, rectified pixels, of a disparity on a smooth surface of a pair with sharp images and
    perfect poses and lenses, sampled as finely as these. It is larger where disparities are rough, where the rows
    of a pair disagree, and where a pair is sampled more coarsely than its images, and smaller where it is sampled
    more finely. It is the scale of all tolerances, those of the
    confirmation among them."""
    max_disparity_step: float = 2.0
    """Neighbouring disparities that differ by more than this (pixels) belong to different surfaces."""
    tolerance: float = 3.0
    """Two candidates agree when they differ by less than this many standard deviations."""
    min_support: int = 1
    """Pairs that must agree on a photometric depth; those with partners that stand side by side count as one."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name in ("disparity_sigma", "max_disparity_step", "tolerance"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be positive, not {getattr(self, name)}.", name)
        if not 1 <= self.min_support <= 255:
            raise OptionError(f"min_support must lie in 1..255, not {self.min_support}.", "min_support")


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
    options: VoteOptions,
    rows: slice = slice(None),
    residual: float = 0.0,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Triangulate a pair's disparities along the rays of one of its images.

    On the sphere the distance along the ray is ρ = b cos θ_r / sin δ (left image), on the plane Z = b f / (d + d₀)
    (Elhashash & Qin, §3.4).

    Parameters
    ----------
    view : View
        The image whose depth is wanted.
    disparity : (H, W) float32 ndarray
        Disparity map in the rectified image of that side; NaN = none.
    geometry : RectifiedPair
    side : {"left", "right"}
    options : VoteOptions
    rows : slice, optional
        Rows of the view to do, h of them.
    residual : float
        How far poses and lenses shift the pair's rays against each other, radians: its row residual.

    Returns
    -------
    depth, sigma : (h, view.width) float32 ndarray
        z-depth and its standard deviation, model units; 0 = none.
    """
    first, end, _ = rows.indices(view.height)
    depth = np.empty((end - first, view.width), dtype=np.float32)
    sigma = np.empty_like(depth)
    _triangulate(view, disparity, geometry, side, options, residual, first, depth, sigma)
    return depth, sigma


def _triangulate(
    view: View,
    disparity: NDArray[np.float32],
    geometry: RectifiedPair,
    side: Side,
    options: VoteOptions,
    residual: float,
    first: int,
    depth: NDArray[np.float32],
    sigma: NDArray[np.float32],
) -> None:
    """Write what `depth_candidates` gives, for rows from `first` on."""
    _native.depth_candidates(
        backend(),
        disparity,
        np.ascontiguousarray(rectified_ray_from_pixel(view, geometry)),
        (geometry.columns_per_radian, geometry.rows_per_radian),
        (geometry.column_origin(side), geometry.row_origin),
        geometry.disparity_origin,
        geometry.baseline,
        _disparity_sigma(view, geometry, options, residual),
        options.max_disparity_step,
        geometry.surface == "spherical",
        geometry.flatness,
        side == "left",
        first,
        depth,
        sigma,
    )


def _disparity_sigma(view: View, geometry: RectifiedPair, options: VoteOptions, residual: float) -> float:
    """Standard deviation of a pair's disparities on smooth surfaces, rectified pixels."""
    columns, _ = geometry.scales
    softness = min(max(float(view.K[0, 0]) / columns, _LEAST_SOFTNESS), _MOST_SOFTNESS)
    shift = min(residual * columns, _MOST_RESIDUAL)
    return math.hypot(options.disparity_sigma * softness, shift)


def _band_rows(view: View, pairs: int) -> int:
    return min(max(_BAND_BYTES // (8 * view.width * max(pairs, 1)), 1), view.height)


def bytes_of_band(view: View, pairs: int) -> int:
    """Bytes in use while a band of rows is voted on: so many candidates of 8 each, and what is too unsure (6)."""
    return (8 * pairs + 6) * _band_rows(view, pairs) * view.width


def vote_depth(
    view: View,
    pairs: Iterable[PairDisparity],
    options: VoteOptions,
    stations: Sequence[int] | None = None,
    residuals: Sequence[float] | None = None,
    lead: str = "",
) -> DepthEstimate:
    """Photometric depth of a view: the vote of all its pairs.

    Parameters
    ----------
    view : View
    pairs : iterable of PairDisparity
        Pairs in which the view is the left or the right image.
    options : VoteOptions
    stations : sequence of int, optional
        Number of the station of each pair's partner, ascending (see `Stations`): partners of one station have one
        vote. Without it each is a station of its own.
    residuals : sequence of float, optional
        Row residual of each pair, radians. Without it poses and lenses are perfect.
    lead : str
        What pairs call the view by, where it was cut from a photograph: the name of the first of its views.

    Returns
    -------
    DepthEstimate

    Examples
    --------
    A disparity of 10 pixels, 1 unit of baseline and a focal length of 100 pixels: a depth of 1 · 100 / 10.

    >>> K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    >>> view = View(1, "a", 64, 48, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    >>> geometry = RectifiedPair(
    ...     surface="frame", rectified_from_world=np.eye(3), baseline=1.0, columns_per_radian=100.0,
    ...     rows_per_radian=100.0, row_origin=-24.0, left_origin=-32.0, right_origin=-32.0, height=48,
    ...     left_width=64, right_width=64, min_disparity=0.0, max_disparity=20.0,
    ... )
    >>> pair = PairDisparity("a", "b", geometry, np.full((48, 64), 10, np.float32))
    >>> estimate = vote_depth(view, [pair], VoteOptions())
    >>> round(float(estimate.depth[20, 30]), 4), int(estimate.support[20, 30])
    (10.0, 1)
    """
    sources: list[tuple[NDArray[np.float32], RectifiedPair, Side]] = []
    for pair in pairs:
        if pair.left == (lead or view.name):
            sources.append((pair.disparity, pair.geometry, "left"))
        else:
            sources.append((right_disparity(pair, options.max_disparity_step), pair.geometry, "right"))
        del pair  # before the next one is read
    shape = (view.height, view.width)
    voted = DepthEstimate(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8))
    numbers = np.arange(len(sources)) if stations is None else np.asarray(stations)
    shifts = [0.0] * len(sources) if residuals is None else residuals
    step = _band_rows(view, len(sources))
    room = np.empty(2 * len(sources) * step * view.width, np.float32)
    for first in range(0, view.height if sources else 0, step):
        rows = slice(first, min(first + step, view.height))
        size = (2, len(sources), rows.stop - first, view.width)
        depths, sigmas = room[: math.prod(size)].reshape(size)
        for source, residual, *found in zip(sources, shifts, depths, sigmas, strict=True):
            _triangulate(view, *source, options, residual, first, *found)
        _native.vote_depth(
            backend(),
            depths,
            sigmas,
            numbers.astype(np.int32),
            options.tolerance,
            voted.depth[rows],
            voted.sigma[rows],
            voted.support[rows],
        )
        is_unsure = voted.depth[rows] < _LEAST_PRECISION * voted.sigma[rows]
        voted.depth[rows][is_unsure | (voted.support[rows] < options.min_support)] = 0
    return voted
