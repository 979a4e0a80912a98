"""COLMAP's depth and normal maps on disk.

ASCII ``width&height&channels&`` followed by little-endian float32, plane after plane. The code is our own because
``pycolmap.NormalMap`` (4.2.1) writes interleaved memory as if it were planar.
"""

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np
import xxhash
from numpy.typing import NDArray

from colmap_sph.errors import DamageError, InputError, reason_of
from colmap_sph.project.files import atomic_file, open_regular
from colmap_sph.scene import in_bands

# Depths beyond, in any unit, come from damage.
_FARTHEST = 1e12
_MAX_HEADER = 30
# Of the square of a normal's length.
_UNIT_TOLERANCE = 0.01
# Values of a plane that are looked at together: what stays in the processor's cache.
_BAND_VALUES = 1 << 16
_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")


def write_depth_map(path: Path, depth: NDArray[np.float32]) -> str:
    """Write a depth map in COLMAP's format; returns the `files.whole_digest` of the file.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    depth : (H, W) float32 ndarray
        z-depth in model units along the ray ``K⁻¹ (col, row, 1)``; 0 (or not finite) where there is none.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    if depth.ndim != 2:
        raise ValueError(f"a depth map has shape (H, W), not {depth.shape}")
    # Fusion's test is `depth <= 0`, which NaN passes.
    return _write_planes(path, [np.where(np.isfinite(depth), depth, 0.0)], (*depth.shape, 1))


def read_depth_map(path: Path, digest: str | None = None) -> NDArray[np.float32]:
    """Read a COLMAP depth map.

    Parameters
    ----------
    path : Path
    digest : str, optional
        Of the whole file, as it must be.

    Returns
    -------
    (H, W) float32 ndarray

    Raises
    ------
    DamageError
        The file is another than the digest says.
    InputError
        It is missing, cannot be read, or is no depth map.
    """
    return np.asarray(_read_planes(path, 1, digest)[0])


def is_map_there(path: Path) -> bool:
    """Whether there is a map file; `InputError` where something else is there, which would count as none."""
    if path.is_file():
        return True
    if os.path.lexists(path):
        raise InputError(
            f"The map {path} cannot be read (it is not a regular file); delete it and compute it again."
        )
    return False


def depth_if_readable(path: Path) -> NDArray[np.float32] | None:
    """Read a COLMAP depth map; None where it is missing or damaged, which whoever needs it will tell."""
    with suppress(InputError):
        return read_depth_map(path)
    return None


def write_normal_map(path: Path, normals: NDArray[np.float32]) -> str:
    """Write a normal map in COLMAP's format; returns the `files.whole_digest` of the file.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    normals : (H, W, 3) float32 ndarray
        Unit vectors in the camera frame, towards the camera; (0, 0, 0) (or not finite) where there is none.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise ValueError(f"a normal map has shape (H, W, 3), not {normals.shape}")
    finite = np.isfinite(normals).all(axis=2)
    return _write_planes(path, (np.where(finite, normals[..., k], 0.0) for k in range(3)), (*finite.shape, 3))


def read_normal_map(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP normal map as an (H, W, 3) float32 array; `InputError` where it is missing or damaged."""
    return np.ascontiguousarray(read_normal_planes(path).transpose(1, 2, 0))


def read_normal_planes(path: Path, digest: str | None = None) -> NDArray[np.float32]:
    """Read a COLMAP normal map as it lies in the file: a (3, H, W) float32 array; else as `read_depth_map`."""
    return _read_planes(path, 3, digest)


def read_some_pixels(
    path: Path, shape: tuple[int, ...], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Read a map at the crossings of some rows and columns, and of the file only these rows.

    Parameters
    ----------
    path : Path
    shape : tuple of int
        (H, W) or (H, W, 3), as it must be.
    rows, columns : (h,) and (w,) int64 ndarray

    Returns
    -------
    (h, w) or (3, h, w) float32 ndarray

    Raises
    ------
    InputError
        The file is missing, cannot be read, or is no map of this shape.
    """
    channels = shape[2] if len(shape) == 3 else 1
    found = np.empty((channels, len(rows), len(columns)), np.float32)
    try:
        with open_regular(path) as file:
            start = file.read(_MAX_HEADER)
            size = file.seek(0, 2)
            (height, width), header = _parse_header(path, start, size, channels)
            if (height, width) != shape[:2]:
                raise InputError(f"The map {path} is not of its image's size; compute it again.")
            for channel in range(channels):
                for place, row in enumerate(rows):
                    file.seek(header + 4 * width * (channel * height + int(row)))
                    found[channel, place] = _read_values(path, file, width)[columns]
    except OSError as error:
        raise InputError(f"The map {path} cannot be read ({reason_of(error)}); compute it again.") from error
    return found if len(shape) == 3 else found[0]


def _write_planes(path: Path, planes: Iterable[NDArray[np.floating]], shape: tuple[int, int, int]) -> str:
    """Write planes one after the other, so that only one has to be in memory; `shape` is (H, W, planes)."""
    height, width, channels = shape
    with atomic_file(path, sync=False) as file:  # whoever vouches for it waits for the disk
        file.write(f"{width}&{height}&{channels}&".encode())
        for plane in planes:
            file.write(np.ascontiguousarray(plane, dtype="<f4").data)
        return file.digest


def check_map(path: Path, shape: tuple[int, ...]) -> None:
    """Raise `InputError` unless a map file is whole and its map has this shape: (H, W) or (H, W, 3).

    COLMAP's fusion trusts the files: it fuses one that is cut off or of another size without a word, or raises an
    error that does not name it.
    """
    start, size = _start_of(path)
    channels = shape[2] if len(shape) == 3 else 1
    found, _ = _parse_header(path, start, size, channels)
    if found != shape[:2]:
        raise InputError(
            f"The map {path} has {found[1]} x {found[0]} pixels, but its image {shape[1]} x {shape[0]}; "
            "delete it and compute it again."
        )


def map_size(path: Path, channels: int = 1) -> tuple[int, int]:
    """Width and height of a map of 1 or 3 channels; `InputError` where its file is not whole."""
    start, size = _start_of(path)
    (height, width), _ = _parse_header(path, start, size, channels)
    return width, height


def depth_on_disk(path: Path) -> NDArray[np.float32]:
    """A depth map as (H, W) values of which only what is looked at is read; `InputError` where it is damaged."""
    start, size = _start_of(path)
    shape, header = _parse_header(path, start, size, 1)
    return np.memmap(path, "<f4", "r", header, shape)


def has_depth(path: Path, *, possible: bool = False) -> bool:
    """Whether a depth map has a depth anywhere, or a possible one; it is read as far as the first one."""
    values = depth_on_disk(path).reshape(-1)
    bands = (values[first : first + _BAND_VALUES] for first in range(0, len(values), _BAND_VALUES))
    return any((is_depth(band) if possible else band > 0).any() for band in bands)


def is_depth(values: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which values of a depth map are possible depths, and neither none nor damage."""
    return np.asarray((values > 0) & (values < _FARTHEST))


def _start_of(path: Path) -> tuple[bytes, int]:
    """The first bytes of a map file, and its size."""
    try:
        with open_regular(path) as file:
            return file.read(_MAX_HEADER), file.seek(0, 2)
    except OSError as error:
        raise InputError(f"The map {path} cannot be read ({reason_of(error)}); compute it again.") from error


def _parse_header(path: Path, start: bytes, size: int, channels: int) -> tuple[tuple[int, int], int]:
    """Return (height, width) and the header's length, from the first bytes of a map file of `size` bytes."""
    header = _HEADER.match(start)
    if header is None:
        raise InputError(f"{path} is not a COLMAP depth or normal map; delete it and compute it again.")
    width, height, found = (int(number) for number in header.groups())
    if found != channels:
        raise InputError(f"{path} has {found} channels where {channels} are expected; compute it again.")
    if size - header.end() != 4 * width * height * channels:
        raise InputError(f"{path} is truncated or damaged; delete it and compute it again.")
    return (height, width), header.end()


def _read_planes(path: Path, channels: int, digest: str | None) -> NDArray[np.float32]:
    """Read a map file as a (channels, H, W) array."""
    try:
        with open_regular(path) as file:
            start = file.read(_MAX_HEADER)
            size = file.seek(0, 2)
            (height, width), header = _parse_header(path, start, size, channels)
            file.seek(header)
            values = _read_values(path, file, channels * height * width)
    except OSError as error:
        raise InputError(f"The map {path} cannot be read ({reason_of(error)}); compute it again.") from error
    if digest is not None and digest != _digest(start[:header], values):
        raise DamageError(f"The map {path} is not what this program wrote; run again, to make it anew.")
    return values.astype(np.float32, copy=False).reshape(channels, height, width)


def _read_values(path: Path, file: BinaryIO, count: int) -> NDArray[np.float32]:
    values = np.empty(count, "<f4")
    if file.readinto(values.view(np.uint8).data) != values.nbytes:  # type: ignore[attr-defined]
        raise InputError(f"{path} is truncated or damaged; delete it and compute it again.")
    return values


def _digest(header: bytes, values: NDArray[np.float32]) -> str:
    state = xxhash.xxh3_128(header)
    state.update(values.data)
    return state.hexdigest()


def find_flaw(depth: NDArray[np.float32], normals: NDArray[np.float32]) -> str | None:
    """Say what makes maps unfit for fusion, whoever wrote them.

    Parameters
    ----------
    depth : (H, W) float32 ndarray
    normals : (3, H, W) float32 ndarray

    Returns
    -------
    str or None
        None where depths are finite, and normals unit vectors or zero.
    """
    # Neither NaN nor infinity gets past both; a sum of them all could overflow.
    if not np.isfinite([depth.min(), depth.max()]).all():
        return "a depth that is not finite"
    # What is too large to be squared becomes infinite, and is found so.
    with np.errstate(over="ignore", invalid="ignore"):
        for rows in in_bands(depth.shape, _BAND_VALUES):
            x, y, z = normals[:, rows]
            squared = x * x
            squared += y * y
            squared += z * z
            none = squared == 0
            is_short = np.count_nonzero(squared >= 1 - _UNIT_TOLERANCE) + np.count_nonzero(none) < squared.size
            # In this form, as no comparison with NaN holds, and the largest of some with NaN is NaN.
            is_long = not squared.max() <= 1 + _UNIT_TOLERANCE
            # The square of a tiny number is 0, too.
            if is_short or is_long or any(plane[none].any() for plane in (x, y, z)):
                return "a normal that is not of unit length"
    return None
