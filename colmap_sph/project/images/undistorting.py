"""Original image → undistorted one in the same place of the workspace, for what COLMAP cannot do itself.

COLMAP cuts images to 8 bits, knows no lens fields, and cannot write under names whose ending says no kind of
image.
"""

import os
import re
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OutputError
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.images.decoding import date_of, is_jpeg, read_pixels, unreadable
from colmap_sph.project.images.depth import ValueRange, stretched
from colmap_sph.project.images.jpeg import DamagedError
from colmap_sph.project.images.orientation import copy_without_orientation
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.lens.straight import place_in_original, straight_camera
from colmap_sph.scene import in_bands

# Pixels that are floating-point numbers at a time.
_BAND_PIXELS = 1 << 18
# Endings of names for which COLMAP knows how to write the file; under others JPEG or PNG is written.
_ENDINGS = {".bmp", ".exr", ".hdr", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tga", ".tif", ".tiff"}
_WHITE = 65535
# Of files that hold the time of writing where no other is known.
_DATED_ENDINGS = {".exr", ".tif", ".tiff"}
_NO_DATE = b"    :  :     :  :  "  # as Exif writes one that is not known


def undistort_deep(
    source: Path,
    camera: pycolmap.Camera,
    options: pycolmap.UndistortCameraOptions,
    target: Path,
    values: ValueRange,
    field: LensField | None = None,
) -> None:
    """Undistort an image of more than 8 bits as COLMAP undistorts others, to 16 bits.

    Parameters
    ----------
    source : Path
    camera : pycolmap.Camera
        Its camera.
    options : pycolmap.UndistortCameraOptions
        With which the other images are undistorted.
    target : Path
        File to write: a TIFF image where it is called so, else PNG, whatever it is called.
    values : ValueRange
        What becomes black and white, as `common_ranges` has found for images of its kind.
    field : LensField, optional
        Of this camera.

    Raises
    ------
    InputError
        The image is damaged, or not of its camera's size.
    OutputError
        `target` cannot be written.
    """
    image = read_original(source, camera.width, camera.height, values)
    # Else COLMAP would copy it.
    if field is not None or not (camera.is_undistorted() and options.max_image_size < 0):
        image = undistorted_pixels(image, camera, options, field)
    kind = ".tif" if target.suffix.lower() in (".tif", ".tiff") else ".png"
    make_dir(target.parent)
    with atomic_file(target) as file:
        file.write(cv2.imencode(kind, image[..., ::-1])[1].data)


def undistort_bent(
    source: Path,
    camera: pycolmap.Camera,
    options: pycolmap.UndistortCameraOptions,
    target: Path,
    field: LensField,
) -> None:
    """Undistort an image of 8 bits whose camera has a lens field; otherwise as `undistort_deep`."""
    image = undistorted_pixels(read_original(source, camera.width, camera.height, None), camera, options, field)
    write_undistorted(pycolmap.Bitmap.from_array(np.squeeze(image)), source, target)


def read_original(source: Path, width: int, height: int, values: ValueRange | None) -> NDArray[Any]:
    """Read an image of this size: (H, W, 3 or 1), uint8, or uint16 where `values` become black and white.

    Raises
    ------
    InputError
        It is damaged, or not of this size.
    """
    if values is None:
        return _read(source, (width, height), deep=False)
    return _stretched(_read(source, (width, height), deep=True), values)


def _read(source: Path, size: tuple[int, int], *, deep: bool) -> NDArray[Any]:
    try:
        image = read_pixels(source, deep=deep)
    except (OSError, DamagedError) as error:
        raise unreadable(source, error) from error
    if image.shape[1::-1] != size:
        raise InputError(f"{source} is not of its camera's size; start again.")
    return image


def write_undistorted(bitmap: pycolmap.Bitmap, source: Path, target: Path) -> None:
    """Write an image that `pycolmap.undistort_image` has made, without a tag that turns it.

    Parameters
    ----------
    bitmap : pycolmap.Bitmap
    source : Path
        The original. Where the name of `target` says no kind of image that COLMAP writes, it becomes a JPEG image
        if this one is, else PNG.
    target : Path

    Raises
    ------
    OutputError
        It cannot be written.
    """
    ending = target.suffix
    if ending.lower() not in _ENDINGS:
        ending = ".jpg" if is_jpeg(source) else ".png"
    make_dir(target.parent)
    written = target.parent / f".{os.getpid()}-{threading.get_ident()}.tmp{ending}"
    try:
        if not bitmap.write(written):
            raise OutputError(f"{target} cannot be written; check space and permissions.")
        if ending.lower() in _DATED_ENDINGS:
            _forget_time_of_writing(written, source)
        copy_without_orientation(written, target)
    finally:
        written.unlink(missing_ok=True)


def _forget_time_of_writing(written: Path, source: Path) -> None:
    """Blank the date of a file but where it is the original's: the same image makes the same bytes again."""
    date = date_of(written).encode()
    if date in (b"", date_of(source).encode()):
        return
    # Wherever it is: of two directories that a TIFF file may have, the first is not read.
    places = [match.start() for match in re.finditer(re.escape(date), written.read_bytes())]
    with written.open("r+b") as file:
        for place in places:
            file.seek(place)
            file.write(_NO_DATE)


def _stretched(pixels: NDArray[Any], values: ValueRange) -> NDArray[np.uint16]:
    image = pixels if pixels.dtype == np.uint16 else np.empty(pixels.shape, np.uint16)
    for rows in in_bands(pixels.shape, _BAND_PIXELS):
        image[rows] = np.rint(stretched(pixels[rows], values) * _WHITE)
    return image


def undistorted_pixels(
    image: NDArray[Any],
    camera: pycolmap.Camera,
    options: pycolmap.UndistortCameraOptions,
    field: LensField | None = None,
) -> NDArray[Any]:
    """An image as its undistorted camera sees it; reduced by half or more only after the warp, as COLMAP does.

    Parameters
    ----------
    image : (H, W, channels) uint8 or uint16 ndarray
        Original.
    camera : pycolmap.Camera
        Its camera.
    options : pycolmap.UndistortCameraOptions
    field : LensField, optional
        Of this camera.

    Returns
    -------
    (h, w, channels) ndarray
        Black where it shows what lies beyond the border of the original.
    """
    target = straight_camera(camera, options, field)
    size = (target.height, target.width)
    scale = min(target.width / camera.width, target.height / camera.height)
    reduce = size != image.shape[:2] and scale < options.warp_options.direct_warp_min_scale
    if reduce:
        target.rescale(camera.width, camera.height)
    warped = np.empty((target.height, target.width, image.shape[2]), image.dtype)
    for rows in in_bands(warped.shape, _BAND_PIXELS):
        warped[rows] = _warped_rows(image, place_in_original(camera, target, field, rows), target.width)
    return _resized(warped, size) if reduce else warped


def _warped_rows(image: NDArray[Any], seen: NDArray[np.float64], width: int) -> NDArray[Any]:
    """Some rows of `width` pixels, from where they lie in the original, between four pixels; black beyond."""
    # Images without distortion must not lose their border to the last digit.
    place = np.round(seen - 0.5, 9)
    place[~np.isfinite(place).all(axis=1)] = -1
    low = np.floor(place)
    inside = ((low >= 0) & (low < (image.shape[1] - 1, image.shape[0] - 1))).all(axis=1)
    x, y = (part[inside, None].astype(np.float32) for part in (place - low).T)
    left, top = low[inside].astype(np.intp).T
    above = image[top, left] * (1 - x) + image[top, left + 1] * x
    below = image[top + 1, left] * (1 - x) + image[top + 1, left + 1] * x
    warped = np.zeros((len(place), image.shape[2]), image.dtype)
    warped[inside] = np.rint(above * (1 - y) + below * y)
    return warped.reshape(-1, width, image.shape[2])


def _resized(image: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Reduce an image to (height, width) by the filter that COLMAP uses."""
    height, width = size
    spec = oiio.ImageSpec(width, height, image.shape[2], image.dtype.name)
    reduced = oiio.ImageBuf(spec)
    if not oiio.ImageBufAlgo.resize(reduced, oiio.ImageBuf(image), "triangle", nthreads=1):
        raise MemoryError(reduced.geterror())
    return np.asarray(reduced.get_pixels(image.dtype.name), image.dtype).reshape(height, width, image.shape[2])
