"""Confirmed depth and normals → refined ones, by least-squares matching of small planes.

Every pixel's plane carries the window around it into the images of its partners. How far the windows differ there,
and how that changes with the plane, gives normal equations; all partners together move the plane a little, against
the pull of what the depth maps already know. This is multi-photo geometrically constrained matching (Grün &
Baltsavias, 1988): it uses all images at once, while the disparity maps saw two at a time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import View, pixel_transfer
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.normals import NormalOptions, fit_normals_anew
from colmap_sph.stereo.search.idle import at_once

# Pixels of a tile of so many rows and columns are matched in the same partners, found on one of its rows. The
# equations of as many rows are in memory at a time. See `depth.h`.
_TILE = 32
# Partners that bring the planes near in the rounds before the last, and that are enough where poses are precise.
_FEW_PARTNERS = 3
# Where no partner says anything, those count that say most elsewhere.
_ELSEWHERE = 1e-6
# Standard deviation of a match on a smooth surface, pixels.
_MATCH_SIGMA = 0.2
# Images that hold no more detail than those of half their size may be matched at that size. Windows are as large
# as four there, so that planes have less in common with the maps of others where they are as free.
_HALF_DETAIL = 0.5
_HALF_FREEDOM = 0.6
# Arrays of equations, and sources of one call; see `depth.h`.
_EQUATIONS = 12
_SOURCES = 32

# A partner's image, each pixel with the one below it, and where the pixels of the view lie in it.
_Partner = tuple[NDArray[np.uint16], NDArray[np.float64]]


@dataclass(frozen=True)
class RefinementOptions:
    """How depth and normals are refined on the images."""

    rounds: int = 2
    """Times that all planes are refined, at most: views with precise poses are refined once, as what comes between
    two rounds smooths. 0 leaves planes as the disparity maps gave them."""
    max_partners: int = 6
    """Partners in whose images a pixel is matched, at most: those that say most about the depth around it. Time
    grows with them. Three are as good for views with precise poses, which have no more."""
    depth_freedom: float = 6.0
    """How far a depth may move: the standard deviation of the pull to the confirmed depth, in those of that depth.
    The images can move it farther."""
    slope_freedom: float = 5.0
    """How far a plane may turn: the standard deviation of the pull to its slope, degrees."""
    contrast: float = 20.0
    """Pixels of a window that differ from its middle by more than this (grey values) hardly count."""
    min_score: float = 0.5
    """Partners whose window correlates less than this with the image's have no say."""
    smoothing_radius: int = 2
    """Radius of the window, pixels, in which planes are fitted again between two rounds."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if not 0 <= self.rounds <= 16:
            raise OptionError(f"rounds must lie in 0..16, not {self.rounds}.", "rounds")
        if not self.max_partners >= 1:
            raise OptionError(f"max_partners must be at least 1, not {self.max_partners}.", "max_partners")
        for name in ("depth_freedom", "contrast"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be positive, not {getattr(self, name)}.", name)
        if not 0 < self.slope_freedom < 90:
            message = f"slope_freedom must lie between 0 and 90 degrees, not {self.slope_freedom}."
            raise OptionError(message, "slope_freedom")
        if not -1 <= self.min_score < 1:
            raise OptionError(f"min_score must lie in -1..1, not {self.min_score}.", "min_score")
        if not 1 <= self.smoothing_radius <= 16:
            raise OptionError(
                f"smoothing_radius must lie in 1..16, not {self.smoothing_radius}.", "smoothing_radius"
            )

    def for_residual(self, pixels: float) -> "RefinementOptions":
        """The same for a view whose rows disagree with its partners' by so many pixels.

        One round, in few images, where that is less than matches are off by. Else each view's planes are drawn to
        where its own partners meet, the less so the more there are.
        """
        if pixels >= _MATCH_SIGMA:
            return self
        return replace(self, rounds=min(self.rounds, 1), max_partners=min(self.max_partners, _FEW_PARTNERS))

    def images_used(self, partners: int, *, half_size: bool = False) -> float:
        """In how many images a pixel is matched, all rounds together, where there are so many partners.

        The mean of all pixels: at half size but a quarter are matched.
        """
        last = min(partners, self.max_partners)
        used = (self.rounds - 1) * min(last, _FEW_PARTNERS) + last if self.rounds else 0
        return used / 4 if half_size else used


def suits_half_size(detail: float, pixels: float) -> bool:
    """Whether a view is refined at half its size as well as at its own.

    It is where its image has little detail, see `image_detail`, and where its rows disagree with its partners' by
    so many pixels that poses, not images, limit what can be known.
    """
    return detail <= _HALF_DETAIL and pixels >= _MATCH_SIGMA


def refine_maps(
    view: View,
    image: NDArray[np.uint8],
    estimate: DepthEstimate,
    normals: NDArray[np.float32],
    depth: NDArray[np.float32],
    sources: Sequence[tuple[View, NDArray[np.uint8]]],
    options: RefinementOptions,
    residual: float = 0.0,
    *,
    half_size: bool = False,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Refine a view's maps, in place, on the images of its partners.

    Parameters
    ----------
    view : View
    image : (H, W) uint8 ndarray
        Its grey image.
    estimate : DepthEstimate
        Confirmed depth, whose standard deviations say how far the planes may move.
    normals, depth : (H, W, 3) and (H, W) float32 ndarray, C-contiguous
        The planes that `fit_normals` fitted to it; changed.
    sources : sequence of (View, (h, w) uint8 ndarray)
        Partners and their grey images.
    options : RefinementOptions
    residual : float
        Row residual of the view's pairs, radians: imprecise poses pull planes to where the images of this view's
        partners meet, and not those of the next view's. The freer a plane the less it has in common with the maps
        of others, so it gets less freedom.
    half_size : bool
        Match images at half their size, in a quarter of the time, see `suits_half_size`; unless one is small.

    Returns
    -------
    normals, depth
        The parameters; where there was none, there is none.
    """
    if not sources or not options.rounds:
        return normals, depth
    smallest = min(*image.shape, *(side for _, source in sources for side in source.shape))
    if half_size and smallest >= 2 * _TILE:
        _refine_at_half_size(view, image, estimate, normals, depth, sources, options, residual)
        return normals, depth
    options = replace(options, depth_freedom=options.depth_freedom * _trust(residual * float(view.K[0, 0])))
    partners = [(_paired(source_image), pixel_transfer(view, source)) for source, source_image in sources]
    rank = _ranks(view, image, estimate, normals, depth, partners, options)
    K = np.ascontiguousarray(view.K)

    def refine(used: NDArray[np.bool_], first: int) -> None:
        rows = slice(first, min(first + _TILE, view.height), 1)
        planes = _planes_of_maps(view, normals, depth, rows)
        equations = _equations(image, partners, used, planes, rows, options)
        sigma = _freedom(estimate.sigma[rows], planes, options)
        slope_sigma = np.tan(np.radians(options.slope_freedom)) / float(view.K[0, 0])
        _native.refine_planes(equations, sigma, slope_sigma, planes)
        _native.maps_of_planes(planes, K, first, normals, depth)

    for done in range(options.rounds):
        if done:
            _smooth_planes(view, estimate, normals, depth, options.smoothing_radius)
        is_last = done == options.rounds - 1
        most = options.max_partners if is_last else min(options.max_partners, _FEW_PARTNERS)
        used = rank < most
        at_once(*(partial(refine, used[:, tile], _TILE * tile) for tile in range(used.shape[1])))
    return normals, depth


def _smooth_planes(
    view: View, estimate: DepthEstimate, normals: NDArray[np.float32], depth: NDArray[np.float32], radius: int
) -> None:
    """Fit planes anew to the depths that have moved, in place; a pixel without neighbours keeps its plane."""
    moved = replace(estimate, depth=depth)
    smooth_depth = fit_normals_anew(view, moved, NormalOptions(radius=radius), normals)
    np.copyto(depth, smooth_depth, where=smooth_depth != 0)


def _refine_at_half_size(
    view: View,
    image: NDArray[np.uint8],
    estimate: DepthEstimate,
    normals: NDArray[np.float32],
    depth: NDArray[np.float32],
    sources: Sequence[tuple[View, NDArray[np.uint8]]],
    options: RefinementOptions,
    residual: float,
) -> None:
    """As `refine_maps`, on images of half the size; all planes move as those of every second row and column do."""
    half_view, half_image = _halved(view, image)
    height, width = half_image.shape
    corners = (slice(0, 2 * height, 2), slice(0, 2 * width, 2))  # which both sizes have
    half_estimate = DepthEstimate(
        np.ascontiguousarray(estimate.depth[corners]),
        np.ascontiguousarray(estimate.sigma[corners]),
        np.ascontiguousarray(estimate.support[corners]),
    )
    half_maps = (np.ascontiguousarray(normals[corners]), np.ascontiguousarray(depth[corners]))
    rows = slice(0, height, 1)
    planes = _planes_of_maps(half_view, *half_maps, rows)
    half_options = replace(options, depth_freedom=_HALF_FREEDOM * options.depth_freedom)
    halves = [_halved(*source) for source in sources]
    refine_maps(half_view, half_image, half_estimate, *half_maps, halves, half_options, residual)
    there = planes[:1] > 0
    moves = np.where(there, _planes_of_maps(half_view, *half_maps, rows) - planes, 0)
    moves[1:] /= 2  # by pixels of full size
    _move_planes(view, np.concatenate([moves, there]), normals, depth)


def _halved(view: View, image: NDArray[np.uint8]) -> tuple[View, NDArray[np.uint8]]:
    """A view and its image at half the size, without the last row or column where their number is odd."""
    height, width = (side // 2 for side in image.shape)
    even = np.ascontiguousarray(image[: 2 * height, : 2 * width])
    half = cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)
    return view.cropped(0, 0, 2 * width, 2 * height).resized(width, height), np.asarray(half, np.uint8)


def _move_planes(
    view: View, moves: NDArray[np.float32], normals: NDArray[np.float32], depth: NDArray[np.float32]
) -> None:
    """Move the planes of maps, in place, as those of every second row and column moved.

    `moves` are (4, H / 2, W / 2): of inverse depth and its changes per column and row, and whether there is a
    plane.
    """
    K = np.ascontiguousarray(view.K)
    for first in range(0, view.height, _TILE):
        rows = slice(first, min(first + _TILE, view.height), 1)
        around = moves[:, first // 2 : rows.stop // 2 + 1]
        *moved, share = _doubled(around, (rows.stop - first, view.width))
        planes = _planes_of_maps(view, normals, depth, rows)
        step = np.divide(moved, share, out=np.zeros_like(planes), where=share > 0)
        planes += np.where((planes[0] > 0) & (planes[0] + step[0] > 0), step, 0)
        _native.maps_of_planes(planes, K, first, normals, depth)


def _doubled(values: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
    """(n, *shape) values from those of every second row and column, linear between these and constant beyond."""
    for axis, size in enumerate(shape, start=1):
        places = np.arange(size)
        last = values.shape[axis] - 1
        before, after = (values.take(np.minimum(half, last), axis) for half in (places // 2, (places + 1) // 2))
        values = (before + after) / 2
    return values


def _paired(image: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """(H - 1, W) uint16: each pixel of an (H, W) image, and in the upper byte the one below it."""
    pairs = np.empty((max(image.shape[0] - 1, 0), *image.shape[1:], 2), np.uint8)
    pairs[..., 0] = image[:-1]
    pairs[..., 1] = image[1:]
    return pairs.view("<u2")[..., 0].astype(np.uint16, copy=False)


def _trust(residual: float) -> float:
    """What images say of a depth that their rows agree on to so many pixels, against those of perfect poses."""
    return _MATCH_SIGMA / math.hypot(_MATCH_SIGMA, residual)


def _ranks(
    view: View,
    image: NDArray[np.uint8],
    estimate: DepthEstimate,
    normals: NDArray[np.float32],
    depth: NDArray[np.float32],
    partners: list[_Partner],
    options: RefinementOptions,
) -> NDArray[np.int64]:
    """(partners, tile rows, tile columns) rank of each by what its image tells about the depth around a tile."""
    rows = slice(min(_TILE, view.height) // 2, view.height, _TILE)
    planes = _planes_of_maps(view, normals, depth, rows)
    sigma = _freedom(estimate.sigma[rows], planes, options)
    tile_columns = np.arange(0, view.width, _TILE)
    tile_rows = -(-view.height // _TILE)
    told = np.empty((len(partners), tile_rows, len(tile_columns)))
    for partner, in_tiles in zip(partners, told, strict=True):
        equations = _equations(image, [partner], np.ones((1, len(tile_columns)), np.bool_), planes, rows, options)
        weight, difference, curvature = (equations[k] for k in (0, 1, 6))
        with np.errstate(divide="ignore", invalid="ignore"):
            information = np.maximum(curvature, 0) * weight / (difference + 0.02 * weight) * sigma**2
        # What a pixel gains, in nats: a long baseline that few pixels match must not outdo all others.
        gain = np.log1p(np.where(weight > 0, information, 0)).astype(float)
        surveyed = np.add.reduceat(gain, tile_columns, axis=1)
        # The last tiles may have so few rows that none is surveyed.
        surveyed = np.pad(surveyed, ((0, tile_rows - len(surveyed)), (0, 0)), mode="edge")
        in_tiles[:] = cv2.blur(surveyed, (3, 3), borderType=cv2.BORDER_REPLICATE)
    told += _ELSEWHERE * told.mean(axis=(1, 2), keepdims=True)
    return np.argsort(np.argsort(-told, axis=0, kind="stable"), axis=0)


def _freedom(
    sigma: NDArray[np.float32], planes: NDArray[np.float32], options: RefinementOptions
) -> NDArray[np.float32]:
    """Standard deviation that planes' inverse depths are given, from that of their confirmed depth."""
    return np.asarray(options.depth_freedom * sigma * planes[0] ** 2, np.float32)


def _equations(
    image: NDArray[np.uint8],
    partners: Sequence[_Partner],
    used: NDArray[np.bool_],
    planes: NDArray[np.float32],
    rows: slice,
    options: RefinementOptions,
) -> NDArray[np.float32]:
    """(12, h, W) sums of the normal equations for planes of the image's `rows`.

    Of the partners that are `used`, (partners, tile columns), in each tile of columns.
    """
    equations = np.zeros((_EQUATIONS, *planes.shape[1:]), np.float32)
    for start in range(0, len(partners), _SOURCES):
        sources, transfers = zip(*partners[start : start + _SOURCES], strict=True)
        limits = options.contrast, options.min_score
        bits = np.left_shift(used[start : start + _SOURCES], np.arange(len(sources), dtype=np.uint32)[:, None])
        chosen = np.bitwise_or.reduce(bits, axis=0)
        _native.add_patch_equations(
            backend(),
            image,
            sources,
            np.stack(transfers),
            chosen,
            planes,
            rows.start,
            rows.step,
            *limits,
            equations,
        )
    return equations


def _planes_of_maps(
    view: View, normals: NDArray[np.float32], depth: NDArray[np.float32], rows: slice
) -> NDArray[np.float32]:
    """(3, h, W) inverse depth and its change per column and row, on `rows` of the maps; 0 where there is none."""
    planes = np.empty((3, len(range(*rows.indices(view.height))), view.width), np.float32)
    inverse_K = np.ascontiguousarray(view.inverse_K)
    _native.planes_of_maps(normals, depth, inverse_K, rows.start, rows.step, planes)
    return planes
