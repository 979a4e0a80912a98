"""Exact depth maps from files: PNG, TIFF and NumPy, of the size that is expected, or not read at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OptionError, reason_of

DEPTH_ENDINGS = (".png", ".tif", ".tiff", ".npy")
_PNG_START = b"\x89PNG\r\n\x1a\n"
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def read_exact_depth(
    path: Path, *, shape: tuple[int, int], depth_scale: float | None = None
) -> NDArray[np.float32]:
    """Read an exact depth map: a one-channel image of 16 bits or more, or a NumPy file.

    Parameters
    ----------
    path : Path
        PNG, TIFF or ``.npy``; 0, negative or not finite = none.
    shape : (int, int)
        Rows and columns it must have.
    depth_scale : float, optional
        Model units per unit of the file; None: 1, and an error for integers, whose unit nothing tells.

    Returns
    -------
    (H, W) float32 ndarray
        z-depth at pixel centres in model units, 0 = none.

    Raises
    ------
    InputError
        A file that cannot be read, is no depth map, or has another size.
    OptionError
        Integers without a scale.
    """
    if not path.is_file():
        raise InputError(f"{path} is not a regular file; write the depth map again.")
    stored = _read_array(path, shape) if path.suffix == ".npy" else _read_image(path, shape)
    if depth_scale is None and stored.dtype.kind != "f":
        raise OptionError(
            f"{path} holds integers: give --depth-scale, the metres of one unit (such as 0.001 for millimetres)."
        )
    with np.errstate(over="ignore", invalid="ignore"):  # beyond 32 bits, or no number: none
        depth = stored.astype(np.float32) * np.float32(depth_scale or 1.0)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _read_array(path: Path, shape: tuple[int, int]) -> NDArray[np.generic]:
    """Read a ``.npy`` file; nothing is allocated before its header is known to fit the file and the image."""
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    # The header is Python text, and its parser raises anything.
    except Exception as error:
        raise InputError(
            f"{path} cannot be read as a NumPy array ({reason_of(error)}); write it again."
        ) from error
    _check_kind(path, array.shape[2] if array.ndim == 3 else 1, array.dtype, array.ndim == 2)
    _check_shape(path, array.shape[:2], shape)
    return np.array(array)


def _read_image(path: Path, shape: tuple[int, int]) -> NDArray[np.generic]:
    """Read a PNG or TIFF file; nothing is decoded before its header is known to fit the image."""
    with path.open("rb") as file:
        start = file.read(8)
    if start != _PNG_START and start[:4] not in _TIFF_STARTS:
        raise InputError(f"{path} cannot be read as an image: it is neither PNG nor TIFF; write it again.")
    image = OpenImageIO.ImageInput.open(str(path))
    if image is None:
        raise _unreadable(path, OpenImageIO.geterror())
    try:
        spec = image.spec()
        dtype = np.dtype(_DTYPES.get(spec.format.basetype, np.void))
        _check_kind(path, spec.nchannels, dtype, spec.depth <= 1)
        _check_shape(path, (spec.height, spec.width), shape)
        pixels = image.read_image(spec.format)
        if pixels is None or image.has_error:
            raise _unreadable(path, image.geterror())
    finally:
        image.close()
    return np.asarray(pixels).reshape(shape)


_DTYPES: dict[object, type[np.generic]] = {
    OpenImageIO.UINT8: np.uint8,
    OpenImageIO.INT8: np.int8,
    OpenImageIO.UINT16: np.uint16,
    OpenImageIO.INT16: np.int16,
    OpenImageIO.UINT32: np.uint32,
    OpenImageIO.INT32: np.int32,
    OpenImageIO.HALF: np.float16,
    OpenImageIO.FLOAT: np.float32,
    OpenImageIO.DOUBLE: np.float64,
}


def _unreadable(path: Path, reason: str) -> InputError:
    words = " ".join(reason.split()) or "its pixels are missing"
    return InputError(f"{path} cannot be read as an image, it may be damaged ({words}); write it again.")


def _check_kind(path: Path, channels: int, dtype: np.dtype[np.generic], flat: bool) -> None:
    if not flat or channels != 1 or dtype.itemsize == 1 or dtype.kind not in "uif":
        raise InputError(
            f"{path} is not a depth map: it has {channels} channel(s) of {dtype}; one channel of 16-bit integers "
            "or floating-point numbers is needed."
        )


def _check_shape(path: Path, found: tuple[int, ...], shape: tuple[int, int]) -> None:
    if found != shape:
        raise InputError(
            f"{path} has {found[1]} x {found[0]} pixels and its camera {shape[1]} x {shape[0]}; "
            "give the model of the images that the depth maps were made for."
        )
