"""Image files: are they there, whole, and of their camera's size; their grey values and their colours.

What is wrong with a file must be known beforehand: COLMAP's undistortion ends the whole process at an image that
is not of its camera's size, and turns a damaged one into a half-grey image without a word.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, reason_of
from colmap_sph.platforms.files import is_link
from colmap_sph.project.images import jpeg
from colmap_sph.project.images.decoding import UnsupportedError, is_jpeg, read_header, read_pixels, unreadable
from colmap_sph.project.images.depth import narrow_range, stretched
from colmap_sph.project.images.jpeg import DamagedError
from colmap_sph.scene import View

# Bytes per pixel while an image is read.
_READ_BYTES = 11.0
# Rows that are floating-point numbers at a time.
_BAND_ROWS = 256
# The luma of ITU-R BT.601, which JPEG stores.
_LUMA = (0.299, 0.587, 0.114)


class Problem(str):
    """What is wrong with an image, as the end of a sentence; its classes are the kinds of problems."""

    __slots__ = ()


class WrongSize(Problem):
    """It has another size (width, height) than its camera."""

    found: tuple[int, int]
    wanted: tuple[int, int]

    def __new__(cls, found: tuple[int, int], wanted: tuple[int, int]) -> "WrongSize":
        words = f"has {found[0]} x {found[1]} pixels, but its camera {wanted[0]} x {wanted[1]}"
        problem = super().__new__(cls, words)
        problem.found = found
        problem.wanted = wanted
        return problem


class Missing(Problem):
    """There is no regular file of its name."""


class Damaged(Problem):
    """It is empty, damaged, or no image."""


class Unsupported(Problem):
    """It is an image of a kind that is not read."""


class Unreadable(Problem):
    """The system does not let it be read."""


def image_problem(path: Path, width: int, height: int, *, decode: bool = True) -> Problem | None:
    """Say what is wrong with an image, as the end of a sentence, or return None.

    Parameters
    ----------
    path : Path
        Image file; it is decoded if its header is right.
    width, height : int
        Size of its camera in pixels, without regard to any EXIF orientation, which COLMAP ignores too.
    decode : bool
        Whether to look further than at its header.

    Returns
    -------
    Problem or None
        Such as ``"is missing"``; None for a good image.
    """
    try:
        if not path.is_file():
            if is_link(path) and not path.exists():
                return Missing("is a link to a file that is missing")
            return Missing("is not a regular file" if path.exists() else "is missing")
        if not path.stat().st_size:
            return Damaged("is empty")
        header = read_header(path)
        # Before anything is decoded: a small file can hold a huge image.
        if (header.width, header.height) != (width, height):
            return WrongSize((header.width, header.height), (width, height))
        if decode:
            read_pixels(path)
    except OSError as error:
        return Unreadable(f"cannot be read ({reason_of(error)})")
    except UnsupportedError as error:
        return Unsupported(f"cannot be used: {error} (convert it to PNG, under the same name)")
    except DamagedError as error:
        return Damaged(f"is damaged or no image ({error})")
    return None


def grey_bytes(path: Path) -> int:
    """Bytes per pixel of what `read_grey` gives."""
    try:
        return 1 if is_jpeg(path) else 4
    except OSError:
        return 4


Size = tuple[int, int]


def fitted(pixels: NDArray[Any], size: Size | None) -> NDArray[Any]:
    """An image, reduced to a size (width, height) where it has another; None: as it is."""
    if size is None or pixels.shape[1::-1] == size:
        return pixels
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def bytes_to_reduce(*views: View) -> float:
    """Largest bytes in use while one of the views' images is read, of those that are reduced then."""
    sizes = [view.file_size for view in views if view.full_size is not None]
    return max((_READ_BYTES * width * height for width, height in sizes), default=0.0)


def read_grey(path: Path, size: Size | None = None) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Read the grey values (0..255) of an undistorted image as exactly as its file holds them.

    Parameters
    ----------
    path : Path
    size : (int, int), optional
        Width and height that it is reduced to.

    Returns
    -------
    (H, W) uint8 or float32 ndarray
        JPEG stores whole grey values (uint8); those of other formats' colours and depths have fractions. Where an
        image of more than 8 bits uses a small part of its range only, it is stretched.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    try:
        if is_jpeg(path) and jpeg.jpeg_size(data := path.read_bytes()) is not None:
            return fitted(jpeg.decode_jpeg(data, "GRAY")[..., 0], size)
        pixels = read_pixels(path)
    except (OSError, DamagedError) as error:
        raise _unreadable(path, error) from error
    values = narrow_range(pixels)
    grey = np.empty(pixels.shape[:2], dtype=np.float32)
    for first in range(0, len(grey), _BAND_ROWS):
        rows = slice(first, first + _BAND_ROWS)
        # Of 8 bits, which are never stretched, that would be the number itself.
        is_plain = pixels.dtype == np.uint8
        band = pixels[rows].astype(np.float32) if is_plain else stretched(pixels[rows], values) * np.float32(255)
        grey[rows] = band[..., 0] if band.shape[2] == 1 else cv2.transform(band, np.array([_LUMA], np.float32))
    return fitted(grey, size)


def read_whole_grey(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """The same as `read_grey`, in whole numbers: (H, W) uint8."""
    grey = read_grey(path, size)
    if grey.dtype == np.uint8:
        return np.asarray(grey, np.uint8)
    return np.rint(grey).astype(np.uint8)


def read_colours(path: Path, size: Size | None = None) -> NDArray[np.uint8]:
    """Read the colours of an undistorted image: (H, W, 3) uint8, blue, green and red, as COLMAP sees them.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    try:
        pixels = read_pixels(path, deep=False)
    except (OSError, DamagedError) as error:
        raise _unreadable(path, error) from error
    colours = np.ascontiguousarray(pixels[..., ::-1])  # of JPEG as it was decoded
    return fitted(colours if colours.shape[2] == 3 else colours.repeat(3, axis=2), size)


def read_small_colours(path: Path, longest: int) -> NDArray[np.uint8]:
    """Read an image small: (h, w, 3) uint8, blue, green and red, its longest side at most `longest` pixels.

    A JPEG image is decoded at an eighth, a quarter or half its size where that is enough.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    try:
        data = path.read_bytes() if is_jpeg(path) else b""
        size = jpeg.jpeg_size(data)
    except OSError as error:
        raise _unreadable(path, error) from error
    if size is not None and size[2] != "CMYK":
        try:
            picture = jpeg.decode_small(data, longest)
        except DamagedError as error:
            raise _unreadable(path, error) from error
    else:
        picture = read_colours(path)
    scale = longest / max(picture.shape[:2])
    if scale >= 1:
        return picture
    width, height = (max(round(scale * side), 1) for side in picture.shape[1::-1])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _unreadable(path: Path, error: Exception) -> InputError:
    return unreadable(path, error, "undistort it again or remove it from the model")
