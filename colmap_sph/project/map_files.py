"""COLMAP's depth and normal maps on disk.

ASCII ``width&height&channels&`` followed by little-endian float32, plane after plane. The code is our own because
``pycolmap.NormalMap`` (4.2.1) writes interleaved memory as if it were planar.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file, open_regular

_MAX_HEADER = 30
_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")


def write_depth_map(path: Path, depth: NDArray[np.float32]) -> None:
    """Write a depth map in COLMAP's format.

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
    _write_planes(path, [np.where(np.isfinite(depth), depth, 0.0)], (*depth.shape, 1))


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP depth map as an (H, W) float32 array; `InputError` where it is missing or damaged."""
    return np.asarray(_read_planes(path, channels=1)[0])


def write_normal_map(path: Path, normals: NDArray[np.float32]) -> None:
    """Write a normal map in COLMAP's format.

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
    _write_planes(path, (np.where(finite, normals[..., k], 0.0) for k in range(3)), (*finite.shape, 3))


def read_normal_map(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP normal map as an (H, W, 3) float32 array; `InputError` where it is missing or damaged."""
    return np.ascontiguousarray(read_normal_planes(path).transpose(1, 2, 0))


def read_normal_planes(path: Path) -> NDArray[np.float32]:
    """Read a COLMAP normal map as it lies in the file: a (3, H, W) float32 array; raises as `read_normal_map`."""
    return _read_planes(path, channels=3)


def _write_planes(path: Path, planes: Iterable[NDArray[np.floating]], shape: tuple[int, int, int]) -> None:
    """Write planes one after the other, so that only one has to be in memory; `shape` is (H, W, planes)."""
    height, width, channels = shape
    with atomic_file(path) as file:
        file.write(f"{width}&{height}&{channels}&".encode())
        for plane in planes:
            file.write(np.ascontiguousarray(plane, dtype="<f4").data)


def check_map(path: Path, shape: tuple[int, ...]) -> None:
    """Raise `InputError` unless a map file is whole and its map has this shape: (H, W) or (H, W, 3).

    COLMAP's fusion trusts the files: it fuses one that is cut off or of another size without a word, or raises an
    error that does not name it.
    """
    try:
        with open_regular(path) as file:
            start = file.read(_MAX_HEADER)
            size = path.stat().st_size
    except OSError as error:
        raise InputError(f"The map {path} cannot be read ({reason_of(error)}); compute it again.") from error
    channels = shape[2] if len(shape) == 3 else 1
    found, _ = _parse_header(path, start, size, channels)
    if found != shape[:2]:
        raise InputError(
            f"The map {path} has {found[1]} x {found[0]} pixels, but its image {shape[1]} x {shape[0]}; "
            "delete it and compute it again."
        )


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


def _read_planes(path: Path, *, channels: int) -> NDArray[np.float32]:
    """Read a map file as a (channels, H, W) array."""
    try:
        with open_regular(path) as file:
            start = file.read(_MAX_HEADER)
            size = path.stat().st_size
            (height, width), header = _parse_header(path, start, size, channels)
            file.seek(header)
            values = np.fromfile(file, "<f4", channels * height * width)
    except OSError as error:
        raise InputError(f"The map {path} cannot be read ({reason_of(error)}); compute it again.") from error
    if len(values) < channels * height * width:
        raise InputError(f"{path} is truncated or damaged; delete it and compute it again.")
    return values.astype(np.float32, copy=False).reshape(channels, height, width)
