"""Undistorted images, read for matching and for the cloud's colours."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError

# Rows of colours that are floating-point numbers at a time.
_BAND_ROWS = 256


def read_undistorted(path: Path, colour: int) -> NDArray[np.uint8]:
    """Read an undistorted image as OpenCV does, with its flag for grey or colour.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    # Undistorted images have their camera's orientation; an EXIF tag must not turn them.
    image = cv2.imread(str(path), colour | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"{path} cannot be read as an image; undistort it again or remove it from the model.")
    return np.asarray(image, dtype=np.uint8)


def read_grey(path: Path) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Read the grey values (0..255) of an undistorted image as exactly as its file holds them.

    Parameters
    ----------
    path : Path

    Returns
    -------
    (H, W) uint8 or float32 ndarray
        Files called .jpg or .jpeg store whole grey values (uint8); those of other formats' colours have fractions.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return read_undistorted(path, cv2.IMREAD_GRAYSCALE)
    colours = read_undistorted(path, cv2.IMREAD_COLOR)
    grey = np.empty(colours.shape[:2], dtype=np.float32)
    for first in range(0, len(grey), _BAND_ROWS):
        rows = slice(first, first + _BAND_ROWS)
        grey[rows] = cv2.cvtColor(colours[rows].astype(np.float32), cv2.COLOR_BGR2GRAY)
    return grey
