"""A grey image with its corners: what pairs are matched in and ties are measured in."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.project.images.reading import read_grey
from colmap_sph.stereo.poses.ties import find_corners

Grey = NDArray[np.uint8] | NDArray[np.float32]


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
