"""Original image → undistorted one in the same place of the workspace, for what COLMAP cannot do itself.

COLMAP cuts images to 8 bits, and cannot write under names whose ending says no kind of image.
"""

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.images.decoding import is_jpeg, read_pixels
from colmap_sph.project.images.depth import ValueRange, stretched
from colmap_sph.project.images.jpeg import DamagedError
from colmap_sph.project.images.orientation import copy_without_orientation

# Pixels that are floating-point numbers at a time.
_BAND_PIXELS = 1 << 18
# Endings of names for which COLMAP knows how to write the file; under others JPEG or PNG is written.
_ENDINGS = {".bmp", ".exr", ".hdr", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tga", ".tif", ".tiff"}
_WHITE = 65535


def undistort_deep(
    source: Path,
    camera: pycolmap.Camera,
    options: pycolmap.UndistortCameraOptions,
    target: Path,
    values: ValueRange,
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

    Raises
    ------
    InputError
        The image is damaged, or not of its camera's size.
    OutputError
        `target` cannot be written.
    """
    try:
        image = _stretched(read_pixels(source), values)
    except (OSError, DamagedError) as error:
        reason = reason_of(error) if isinstance(error, OSError) else error
        raise InputError(f"{source} cannot be read as an image ({reason}); mend or remove it.") from error
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(f"{source} is not of its camera's size; start again.")
    if not (camera.is_undistorted() and options.max_image_size < 0):  # else COLMAP would copy it
        image = _undistorted(image, camera, options)
    kind = ".tif" if target.suffix.lower() in (".tif", ".tiff") else ".png"
    make_dir(target.parent)
    with atomic_file(target) as file:
        file.write(cv2.imencode(kind, image[..., ::-1])[1].data)


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
        copy_without_orientation(written, target)
    finally:
        written.unlink(missing_ok=True)


def _stretched(pixels: NDArray[Any], values: ValueRange) -> NDArray[np.uint16]:
    image = pixels if pixels.dtype == np.uint16 else np.empty(pixels.shape, np.uint16)
    for rows in _bands(*pixels.shape[:2]):
        image[rows] = np.rint(stretched(pixels[rows], values) * _WHITE)
    return image


def _bands(height: int, width: int) -> Iterator[slice]:
    step = max(1, _BAND_PIXELS // width)
    return (slice(first, min(first + step, height)) for first in range(0, height, step))


def _undistorted(
    image: NDArray[np.uint16], camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions
) -> NDArray[np.uint16]:
    """An image as its undistorted camera sees it; reduced by half or more only after the warp, as COLMAP does."""
    target = pycolmap.undistort_camera(options, camera)
    size = (target.height, target.width)
    scale = min(target.width / camera.width, target.height / camera.height)
    reduce = size != image.shape[:2] and scale < options.warp_options.direct_warp_min_scale
    if reduce:
        target.rescale(camera.width, camera.height)
    warped = np.empty((target.height, target.width, image.shape[2]), np.uint16)
    for rows in _bands(target.height, target.width):
        warped[rows] = _warped_rows(image, camera, target, rows)
    return _resized(warped, size) if reduce else warped


def _warped_rows(
    image: NDArray[np.uint16], camera: pycolmap.Camera, target: pycolmap.Camera, rows: slice
) -> NDArray[np.uint16]:
    """Some rows of what `target` sees, between four pixels each; black where one of them is beyond the border."""
    K = target.calibration_matrix()
    column, row = np.meshgrid(np.arange(target.width) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
    rays = np.ones((column.size, 3))
    rays[:, 0] = ((column - K[0, 2]) / K[0, 0]).ravel()
    rays[:, 1] = ((row - K[1, 2]) / K[1, 1]).ravel()
    # Images without distortion must not lose their border to the last digit.
    place = np.round(np.asarray(camera.img_from_cam(rays), np.float64) - 0.5, 9)
    place[~np.isfinite(place).all(axis=1)] = -1
    low = np.floor(place)
    inside = ((low >= 0) & (low < (image.shape[1] - 1, image.shape[0] - 1))).all(axis=1)
    x, y = (part[inside, None].astype(np.float32) for part in (place - low).T)
    left, top = low[inside].astype(np.intp).T
    above = image[top, left] * (1 - x) + image[top, left + 1] * x
    below = image[top + 1, left] * (1 - x) + image[top + 1, left + 1] * x
    warped = np.zeros((len(place), image.shape[2]), np.uint16)
    warped[inside] = np.rint(above * (1 - y) + below * y)
    return warped.reshape(*column.shape, image.shape[2])


def _resized(image: NDArray[np.uint16], size: tuple[int, int]) -> NDArray[np.uint16]:
    """Reduce an image to (height, width) by the filter that COLMAP uses."""
    height, width = size
    spec = oiio.ImageSpec(width, height, image.shape[2], "uint16")
    reduced = oiio.ImageBuf(spec)
    if not oiio.ImageBufAlgo.resize(reduced, oiio.ImageBuf(image), "triangle", nthreads=1):
        raise MemoryError(reduced.geterror())
    return np.asarray(reduced.get_pixels("uint16"), np.uint16).reshape(height, width, image.shape[2])
