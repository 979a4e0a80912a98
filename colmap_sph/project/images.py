"""Image files: are they there, whole, and of their camera's size; and undistorted ones read.

What is wrong with a file must be known beforehand: COLMAP's undistortion ends the whole process at an image that
is not of its camera's size, and turns a file that was cut off into a half-grey image without a word.
"""

import mmap
import struct
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, reason_of

# Rows of colours that are floating-point numbers at a time.
_BAND_ROWS = 256
_JPEG_START = b"\xff\xd8"
_JPEG_SCAN = 0xDA
_JPEG_END = b"\xff\xd9"
# Start-of-frame markers; 0xC4, 0xC8 and 0xCC among them have other meanings.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_PNG_START = b"\x89PNG\r\n\x1a\n"


class _DamagedError(ValueError):
    """The header makes no sense or the file ends too early."""


class WrongSize(str):
    """What is wrong with an image of another size (width, height) than its camera, as the end of a sentence."""

    found: tuple[int, int]
    wanted: tuple[int, int]

    def __new__(cls, found: tuple[int, int], wanted: tuple[int, int]) -> "WrongSize":
        words = f"has {found[0]} x {found[1]} pixels, but its camera {wanted[0]} x {wanted[1]}"
        problem = super().__new__(cls, words)
        problem.found = found
        problem.wanted = wanted
        return problem


def image_problem(path: Path, width: int, height: int) -> str | None:
    """Say what is wrong with an image, as the end of a sentence, or return None.

    Parameters
    ----------
    path : Path
        Image file; JPEG and PNG are not decoded, other formats are.
    width, height : int
        Size of its camera in pixels, without regard to any EXIF orientation, which COLMAP ignores too.

    Returns
    -------
    str or None
        Such as ``"is missing"``; None for a good image.
    """
    if not path.is_file():
        return "is missing"
    try:
        found = _image_size(path)
    except OSError as error:
        return f"cannot be read ({reason_of(error)})"
    except (_DamagedError, struct.error, IndexError):
        return "is damaged or cut off"
    if found != (width, height):
        return WrongSize(found, (width, height))
    return None


def _image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a whole image; raise where it is damaged."""
    if path.stat().st_size == 0:
        raise _DamagedError
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:2] == _JPEG_START:
            return _jpeg_size(data)
        if data[:8] == _PNG_START:
            return _png_size(data)
    return _decoded_size(path)


def _jpeg_size(data: mmap.mmap) -> tuple[int, int]:
    """Walk the segments up to the first scan, which an end-of-image marker must follow."""
    size: tuple[int, int] | None = None
    offset = 2
    while True:
        if data[offset] != 0xFF:
            raise _DamagedError
        marker = data[offset + 1]
        if marker == 0xFF:  # padding
            offset += 1
            continue
        if marker == _JPEG_SCAN:
            break
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, offset + 5)
            size = (width, height)
        offset += 2 + int(struct.unpack_from(">H", data, offset + 2)[0])
    # Searched backwards, as cameras append previews and videos behind the image.
    if size is None or data.rfind(_JPEG_END, offset) < 0:
        raise _DamagedError
    return size


def _png_size(data: mmap.mmap) -> tuple[int, int]:
    width, height = struct.unpack_from(">II", data, 16)
    if data.rfind(b"IEND") < 0:
        raise _DamagedError
    return int(width), int(height)


def _decoded_size(path: Path) -> tuple[int, int]:
    bitmap = pycolmap.Bitmap.read(path, as_rgb=True)
    # OpenCV reads the image in later stages, and notices missing data where COLMAP's reader does not.
    if bitmap is None or cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) is None:
        raise _DamagedError
    return bitmap.width, bitmap.height


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


def grey_bytes(path: Path) -> int:
    """Bytes per pixel of what `read_grey` gives."""
    return 1 if _is_jpeg(path) else 4


def _is_jpeg(path: Path) -> bool:
    return path.suffix.lower() in (".jpg", ".jpeg")


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
    if _is_jpeg(path):
        return read_undistorted(path, cv2.IMREAD_GRAYSCALE)
    colours = read_undistorted(path, cv2.IMREAD_COLOR)
    grey = np.empty(colours.shape[:2], dtype=np.float32)
    for first in range(0, len(grey), _BAND_ROWS):
        rows = slice(first, first + _BAND_ROWS)
        grey[rows] = cv2.cvtColor(colours[rows].astype(np.float32), cv2.COLOR_BGR2GRAY)
    return grey
