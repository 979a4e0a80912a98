"""Wide image → the image and the mask of a view cut from it, sampled once."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.images.depth import ValueRange
from colmap_sph.project.images.undistorting import read_original
from colmap_sph.project.masks import read_mask
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.layout import Face, shown
from colmap_sph.project.wide.projection import PANORAMA, Lens, image_points
from colmap_sph.scene import in_bands

Places = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]

_BAND_PIXELS = 1 << 18
# PNG's fastest: views are read a few times, and disks are large.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
# Views of one lens follow each other; their places are kept, 9 bytes per pixel.
_KEPT = 6


def cut_image(
    source: Path, mask: Path | None, cut: Cut, values: ValueRange | None, target: Path, mask_target: Path
) -> None:
    """Write the image of a view and its mask, as PNG.

    Parameters
    ----------
    source : Path
        The wide image.
    mask : Path or None
        Its mask, if there is one.
    cut : Cut
    values : ValueRange or None
        What becomes black and white, of an image of more than 8 bits.
    target, mask_target : Path
        The mask is white only where no ignored pixel, and nothing beyond image and lens, has a part in the view.

    Raises
    ------
    InputError
        Image or mask cannot be read, or are not of the lens's size.
    OutputError
        A file cannot be written.
    """
    x, y, is_shown = _places(cut.lens, cut.face)
    image = read_original(source, cut.lens.width, cut.lens.height, values)
    view = _sampled(image, x, y)
    view[~is_shown] = 0
    white = is_shown
    if mask is not None:
        whole = read_mask(mask, cut.lens.width, cut.lens.height)
        if whole is None:
            raise InputError(f"The mask {mask} has disappeared; start again.")
        white = white & (_sampled(whole[:, :, None], x, y)[:, :, 0] == 255)
    _write(target, view[:, :, ::-1] if view.shape[2] == 3 else view)
    _write(mask_target, np.where(white, np.uint8(255), np.uint8(0)))


def _write(target: Path, pixels: NDArray[Any]) -> None:
    make_dir(target.parent)
    with atomic_file(target) as file:
        file.write(cv2.imencode(".png", np.ascontiguousarray(pixels), _PNG)[1].data)


def _sampled(image: NDArray[Any], x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[Any]:
    """Between four pixels; what lies beyond an image's left border is at its right one, as in a panorama."""
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(sampled).reshape(*x.shape, image.shape[2])


@lru_cache(maxsize=_KEPT)
def _places(lens: Lens, face: Face) -> Places:
    """Column and row in the wide image of each pixel of a view, (0, 0) the first pixel's centre; is it shown?"""
    x = np.empty((face.height, face.width), np.float32)
    y = np.empty_like(x)
    is_shown = np.empty(x.shape, np.bool_)
    for rows in in_bands((face.height, face.width), _BAND_PIXELS):
        points = image_points(lens, face.rays(rows))
        is_shown[rows] = shown(lens, points).reshape(-1, face.width)
        column, row = (np.nan_to_num(part, nan=0.5).reshape(-1, face.width) - 0.5 for part in points.T)
        x[rows] = column if lens.model == PANORAMA else np.clip(column, 0, lens.width - 1)
        y[rows] = np.clip(row, 0, lens.height - 1)
    return x, y, is_shown


def forget_places() -> None:
    """Let go of the places that are kept: no more views are to be cut."""
    _places.cache_clear()
