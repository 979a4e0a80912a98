"""A grey image with its corners: what pairs are matched in and ties measured in, and which pixels take part."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.project.images.reading import read_grey, read_small_colours
from colmap_sph.project.masks import read_view_mask
from colmap_sph.project.undistortion.rounding import coarsest_jpeg_step
from colmap_sph.scene import View
from colmap_sph.stereo.blank import blank_pixels
from colmap_sph.stereo.poses.standstill import still_pixels
from colmap_sph.stereo.poses.ties import find_corners

Grey = NDArray[np.uint8] | NDArray[np.float32]
Mask = NDArray[np.uint8]

# What stands still is looked for with so many pixels along an image's longest side.
_STILL_SIDE = 960
# Largest bytes in use then, per pixel of that size.
_STILL_BYTES = 75.0

kept_masks: LoadCache[Mask | None] = LoadCache(lambda mask: 0 if mask is None else mask.nbytes)
"""What `PhotoFile.kept_pixels` returned, and the small images of many views that others are compared with."""


@dataclass(frozen=True, eq=False)
class Photo:
    """A grey undistorted image, and its corners.

    Attributes
    ----------
    image : (H, W) uint8 or float32 ndarray
    corners : (n, 2) float64 ndarray
        See `find_corners`.
    """

    image: Grey
    corners: NDArray[np.float64]

    @classmethod
    def read(cls, path: Path, size: tuple[int, int] | None = None) -> "Photo":
        """Read an image, reduced to a size (width, height); `InputError` where it is missing or damaged."""
        image = read_grey(path, size)
        return cls(image, find_corners(image))

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return self.image.nbytes + self.corners.nbytes


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """A view without its sparse points, its image, where its mask would be, and what tells how that was made.

    `turned` are images that it is compared with, where something stands still in it, see `still_pixels`.
    """

    view: View
    image: Path
    mask: Path
    record: Path
    turned: tuple[Path, ...] = ()

    @property
    def jpeg_step(self) -> int:
        """How coarsely the image was rounded, or the original that it was made of; see `blank_pixels`."""
        return coarsest_jpeg_step(self.image, self.record)

    def kept_pixels(self, image: Grey, *, keep_blank: bool) -> Mask | None:
        """255 where its image takes part in matching, else 0; None where all of it does."""
        view = self.view
        stamps = " ".join(map(file_stamp, (self.mask, self.image, *self.turned)))
        key = f"{stamps} {view.width} {view.height} {keep_blank}"
        return kept_masks.get(key, lambda: self._kept_pixels(image, keep_blank=keep_blank))

    def _kept_pixels(self, image: Grey, *, keep_blank: bool) -> Mask | None:
        mask = read_view_mask(self.mask, self.view)
        if keep_blank:
            return mask
        ignored = blank_pixels(image, self.jpeg_step)
        if self.turned:
            ignored |= still_mask(self.view, self.image, self.turned)
        if not ignored.any():
            return mask
        counts = np.where(ignored, np.uint8(0), np.uint8(255))
        return counts if mask is None else np.minimum(counts, mask)


def still_mask(view: View, image: Path, turned: Sequence[Path]) -> Mask:
    """1 where an image of a view and those that it is compared with show the same, see `still_pixels`, else 0."""
    still = still_pixels(read_small_grey(image, _STILL_SIDE), map(_compared, turned))
    return np.asarray(cv2.resize(still, (view.width, view.height), interpolation=cv2.INTER_NEAREST), np.uint8)


def small_bytes(view: View) -> float:
    """Bytes of a view's small image, with which others are compared."""
    return view.num_pixels * min(_STILL_SIDE / max(view.width, view.height), 1.0) ** 2


def still_bytes(view: View) -> float:
    """Largest bytes in use while `still_mask` looks at a view."""
    return _STILL_BYTES * small_bytes(view)


def _compared(path: Path) -> Mask:
    """A small image that many are compared with."""
    small = kept_masks.get(f"{file_stamp(path)} small", lambda: read_small_grey(path, _STILL_SIDE))
    assert small is not None
    return small


def read_small_grey(path: Path, longest: int) -> Mask:
    """Read the grey values of an image, small: (h, w) uint8, its longest side at most `longest` pixels."""
    return np.asarray(cv2.cvtColor(read_small_colours(path, longest), cv2.COLOR_BGR2GRAY), np.uint8)
