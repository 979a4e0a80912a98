"""Depth and normal maps → cloud: one point for every piece of surface, from the pixel that sees it best.

Every pixel with a depth is looked up in the maps of the images that overlap its own. It becomes a point where
enough of them see the same surface and none sees that piece of it with a finer pixel. So the cloud is as dense as
its finest image everywhere, and an image is fused from the maps alone: images may be done in any order, by any
number of threads, with the maps of few images in memory, and the cloud is the same to the byte.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, Optional

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import POINT, View, in_bands, pixel_transfer
from colmap_sph.stereo.partners.stations import OWN_STATION
from colmap_sph.stereo.search.idle import at_once

# A bit for each of them, of which a byte has eight.
MAX_PARTNERS = 64
_BITS = 8
# Rows in which partners are looked at by one thread.
_BAND_ROWS = 256
# Points are made from so many pixels at a time: one that 50 images see takes 231 bytes.
_BAND_PIXELS = 1 << 16
# Code of a normal that is no unit vector.
_NOT_PACKED = 3


@dataclass(frozen=True)
class FusionOptions:
    """How maps become a cloud: under COLMAP's names, with defaults for our maps."""

    method: Literal["best-pixel", "colmap"] = "best-pixel"
    """Our own, a point from the pixel that sees a piece of surface best; or COLMAP's stereo_fusion."""
    input: Literal["geometric", "photometric"] = "geometric"
    """Maps to fuse: those that other views confirm, or the unchecked ones, fuller and with more outliers, which
    are made only then."""
    min_num_pixels: int = 2
    """Pixels, of different images, that must agree on a point (COLMAP: 5). In our own fusion images that stand
    side by side count as one."""
    # Not `float | None`, of which the command line's parser would load a library to check the default.
    max_reproj_error: Optional[float] = None  # noqa: UP045
    """A pixel makes no point of its own where it projects within this many pixels of the centre of a finer image's
    pixel that agrees: less makes a denser cloud. COLMAP's fusion merges pixels this near (COLMAP: 2). None: 0.35;
    0.5 for COLMAP's."""
    max_depth_error: float = 0.01
    """Largest relative difference of depths that agree."""
    max_normal_error: float = 30.0
    """Largest angle, degrees, of normals that agree (COLMAP: 10)."""
    check_num_images: int = 50
    """Overlapping images to look for agreement in; our own looks in no more than 64."""
    mask_path: Optional[Path] = None  # noqa: UP045
    """Folder of masks in undistorted geometry, named as those of --masks, black = excluded."""
    max_num_pixels: int = 10000
    """Most pixels to merge into one point (COLMAP's only)."""
    max_traversal_depth: int = 100
    """Longest chain of pixels, from image to image, that makes one point (COLMAP's only)."""
    use_cache: bool = False
    """Keep only part of the maps in memory, `cache_size` of them (COLMAP's only; ours always does)."""
    cache_size: float = 32.0
    """Gigabytes of maps to keep in memory with `use_cache`."""
    visibility: bool = True
    """Write fused.ply.vis, too: which images see each point, for COLMAP's meshers (our own method only)."""
    max_points_per_file: int = 500_000_000
    """Points of the cloud above which it is written as tiles, fused_tiles, with an index: each has the points of
    neighbouring images, and no more than this, but for single images that have; 0: always one file (our own method
    only)."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if self.method not in ("best-pixel", "colmap"):
            raise OptionError(f"method must be 'best-pixel' or 'colmap', not {self.method!r}.", "method")
        if self.input not in ("geometric", "photometric"):
            raise OptionError(f"input must be 'geometric' or 'photometric', not {self.input!r}.", "input")
        for name in ("min_num_pixels", "max_num_pixels", "max_traversal_depth", "check_num_images"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}.", name)
        if self.max_points_per_file < 0:
            raise OptionError(
                f"max_points_per_file must be at least 1, or 0 for no limit, not {self.max_points_per_file}.",
                "max_points_per_file",
            )
        if self.max_num_pixels < self.min_num_pixels:
            raise OptionError(
                f"max_num_pixels must not be less than min_num_pixels ({self.min_num_pixels}), "
                f"not {self.max_num_pixels}.",
                "max_num_pixels",
                "min_num_pixels",
            )
        for name in ("max_reproj_error", "max_depth_error", "max_normal_error", "cache_size"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise OptionError(f"{name} must be positive, not {value}.", name)

    @property
    def reprojection_error(self) -> float:
        """`max_reproj_error`, or what it is by default, pixels."""
        if self.max_reproj_error is not None:
            return self.max_reproj_error
        return 0.35 if self.method == "best-pixel" else 0.5

    def for_colmap(self) -> dict[str, Any]:
        """The options that COLMAP's fusion has, too, under its names."""
        values = {
            field.name: getattr(self, field.name)
            for field in fields(self)
            if field.name not in ("method", "input", "visibility", "max_points_per_file")
        }
        values["max_reproj_error"] = self.reprojection_error
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """A view with what is fused of it.

    Attributes
    ----------
    view : View
    index : int
        Its place among the images of the model: what ``fused.ply.vis`` calls it by.
    depth : (H, W) float32 ndarray
        z-depth along the ray K⁻¹ (col, row, 1), model units; 0 = none.
    normals : (3, H, W) float32 ndarray
        Unit vectors in the camera frame, towards the camera, plane by plane as in COLMAP's file.
    image : (H, W, 3) uint8 ndarray
        Blue, green, red, as OpenCV reads it.
    """

    view: View
    index: int
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    image: NDArray[np.uint8]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.depth.nbytes + self.normals.nbytes + self.image.nbytes


@dataclass(frozen=True, eq=False)
class PackedMaps:
    """The maps of a view in five sixths of the memory, from which they follow to the bit.

    Attributes
    ----------
    maps : ViewMaps
        With two planes of normals only, without the largest component of each.
    codes : (H, W) uint8 ndarray
        From which that follows.
    """

    maps: ViewMaps
    codes: NDArray[np.uint8]

    @staticmethod
    def of(maps: ViewMaps) -> "PackedMaps | None":
        """Pack maps; None where a normal is not as long as unit vectors are, but for rounding."""
        pair = np.empty((2, *maps.depth.shape), np.float32)
        codes = np.empty(maps.depth.shape, np.uint8)
        _native.pack_normals(maps.normals, pair, codes)
        return None if (codes == _NOT_PACKED).any() else PackedMaps(replace(maps, normals=pair), codes)

    def unpacked(self) -> ViewMaps:
        """The maps as they were."""
        normals = np.empty((3, *self.codes.shape), np.float32)
        _native.unpack_normals(self.maps.normals, self.codes, normals)
        return replace(self.maps, normals=normals)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.maps.nbytes + self.codes.nbytes


def fuse_view(
    reference: ViewMaps,
    partners: Iterable[ViewMaps | None],
    options: FusionOptions,
    offset: NDArray[np.float64] | float = 0.0,
    stations: Sequence[int] | None = None,
) -> Iterator[tuple[NDArray[np.void], NDArray[np.uint32]]]:
    """Make the points of a cloud which one view sees better than any other.

    A partner agrees with a pixel where the depth and the normal at the pixel next to its projection do. It covers
    it where that projection is within `max_reproj_error` of the partner's pixel, and that pixel stands for less
    surface: depth² / (fx fy |n · r|), r the ray of depth 1. As this orders all pixels, one at least of those that
    see a piece of surface is not covered. It has its own partners: where these are too few, for noise at a gate,
    no other pixel takes its place.

    Parameters
    ----------
    reference : ViewMaps
    partners : iterable of ViewMaps or None
        At most 64 are looked at, one after the other. None for one that has nothing to say.
    options : FusionOptions
    offset : (3,) float64 ndarray or 0
        Added to the points before they become 32-bit floats.
    stations : sequence of int, optional
        Number of the station of each partner, ascending (see `Stations`): partners of one station count as one,
        and those of the reference's own, 0, not at all. Without it each is a station of its own.

    Yields
    ------
    points : (n,) ndarray of `scene.POINT`
        World frame and `offset`; the colour is the mean over the views that agree.
    visibility : (m,) uint32 ndarray
        For each point the number of these views and their indices: ``fused.ply.vis``.
    """
    shape = reference.depth.shape
    most = MAX_PARTNERS if stations is None else min(len(stations), MAX_PARTNERS)
    covered = np.zeros(shape, np.uint8)
    agreeing = np.zeros((-(-most // _BITS), *shape), np.uint8)
    colour = reference.image.astype(np.uint16)
    reference = replace(reference, image=reference.image[:0].copy())  # may go: `colour` has it
    indices = np.zeros(1 + MAX_PARTNERS, np.uint32)
    indices[0] = reference.index
    others = iter(partners)
    for bit in range(most):
        partner = next(others, None)
        if partner is not None:
            indices[1 + bit] = partner.index
            at_once(*_in_bands(reference, partner, options, bit, covered, agreeing, colour))
        del partner  # or it is there while the next is read
    view = reference.view
    gates = (options.min_num_pixels, _station_bits(stations))
    pixels = (reference.depth, reference.normals, covered, agreeing, colour, *gates)
    world_from_pixel = view.R.T @ view.inverse_K
    world_from_camera = view.R.T
    frame = (np.ascontiguousarray(world_from_pixel), np.ascontiguousarray(world_from_camera), view.center + offset)
    for band in in_bands(shape, _BAND_PIXELS):
        rows = (band.start, band.stop)
        num_points, num_words = _native.count_points(*pixels, *rows)
        points = np.empty((num_points, POINT.itemsize), np.uint8)
        visibility = np.empty(num_words, np.uint32)
        _native.write_points(*pixels, *rows, *frame, indices, points, visibility)
        yield points.view(POINT)[:, 0], visibility


def _in_bands(
    reference: ViewMaps,
    partner: ViewMaps,
    options: FusionOptions,
    bit: int,
    *verdict: NDArray[np.unsignedinteger],
) -> Iterator[Callable[[], None]]:
    """Add what a partner says of every pixel: in bands of rows, which may be done in any order."""
    add = partial(
        _native.fuse_partner,
        reference.depth,
        reference.normals,
        reference.view.inverse_K,
        partner.depth,
        partner.normals,
        partner.view.inverse_K,
        partner.image,
        pixel_transfer(reference.view, partner.view),
        reference.view.R @ partner.view.R.T,
        options.reprojection_error,
        options.max_depth_error,
        np.cos(np.radians(options.max_normal_error)),
        partner.index < reference.index,
        bit,
    )
    for first in range(0, len(reference.depth), _BAND_ROWS):
        yield partial(add, first, min(first + _BAND_ROWS, len(reference.depth)), *verdict)


def _station_bits(stations: Sequence[int] | None) -> NDArray[np.uint64]:
    """Bits of partners at other stations than the view's own; last bits of stations, and bits of no partner."""
    elsewhere = (1 << MAX_PARTNERS) - 1
    last = elsewhere
    numbers = [] if stations is None else list(stations)[:MAX_PARTNERS]
    for bit, (number, following) in enumerate(pairwise(numbers)):
        if number == following:
            last &= ~(1 << bit)
    for bit, number in enumerate(numbers):
        if number == OWN_STATION:
            elsewhere &= ~(1 << bit)
    return np.array([elsewhere, last], dtype=np.uint64)
