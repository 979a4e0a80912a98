"""Photograph that was cut into views → its rectified image, each pixel read from the view that owns its ray.

That is the view whose axis is nearest, of those that have the ray in their image, as in `owners`. The views are
samples of one photograph, so what comes of their seams is as smooth as the photograph.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.rectified_pair import RectifiedPair, Side
from colmap_sph.stereo.resampling import RayTables, ray_tables

# Rows that are read at a time, which bounds memory.
_BAND_ROWS = 64
# Every so many-th pixel tells where in a band a view is; it reaches no more than as many beyond.
_COARSE = 8

Image = NDArray[np.uint8] | NDArray[np.float32]


def resample_photograph(
    images: Sequence[Image],
    views: Sequence[View],
    pair: RectifiedPair,
    side: Side,
    masks: Sequence[NDArray[np.uint8] | None],
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Resample the views of a photograph to the sphere, as `resample` does with one.

    Parameters
    ----------
    images : sequence of (view.height, view.width) uint8 or float32 ndarray
        Grey, of each view.
    views : sequence of View
        Of one centre.
    pair : RectifiedPair
    side : {"left", "right"}
        Which of the pair's images the photograph is.
    masks : sequence of (view.height, view.width) uint8 ndarray or None
        255 where the image counts, 0 where it is to be ignored.

    Returns
    -------
    rectified : (H, W) float32 ndarray
    valid : (H, W) uint8 ndarray
        255 where a view has the ray in its image, and no ignored pixel of the view that owns it has a part in it.
    """
    shape = (pair.height, pair.width(side))
    rectified = np.zeros(shape, np.float32)
    valid = np.zeros(shape, np.uint8)
    pixels = [image.astype(np.float32, copy=False) for image in images]
    tables = [ray_tables(view, pair, side) for view in views]
    shown = [_shown_coarsely(*each) for each in zip(views, tables, strict=True)]
    for first in range(0, pair.height, _BAND_ROWS):
        band = slice(first, min(first + _BAND_ROWS, pair.height))
        nearness = np.zeros(rectified[band].shape, np.float32)
        for image, view, table, mask, is_shown in zip(pixels, views, tables, masks, shown, strict=True):
            columns = _columns_of(is_shown, band)
            if columns.start < columns.stop:
                target = (rectified[band, columns], valid[band, columns], nearness[:, columns])
                cosine = table.depths(band, columns)
                _read(image, table.source_pixels(view, band, columns), cosine, mask, *target)
    return rectified, valid


def _shown_coarsely(view: View, tables: RayTables) -> NDArray[np.bool_]:
    """Whether a view has the ray of every so many-th rectified pixel in its image."""
    every = slice(None, None, _COARSE)
    *_, inside = tables.source_pixels(view, every, every)
    return inside > 0


def _columns_of(is_shown: NDArray[np.bool_], band: slice) -> slice:
    """The columns of a band in which a view may have rays; none where it has none."""
    # Bands begin at rows that were looked at, and the first one beyond counts, too.
    rows = slice(band.start // _COARSE, -(-band.stop // _COARSE) + 1)
    found = np.flatnonzero(is_shown[rows].any(axis=0))
    if not len(found):
        return slice(0, 0)
    return slice(max((int(found[0]) - 1) * _COARSE, 0), (int(found[-1]) + 1) * _COARSE + 1)


def _read(
    image: NDArray[np.float32],
    source_pixels: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]],
    cosine: NDArray[np.float32],
    mask: NDArray[np.uint8] | None,
    rectified: NDArray[np.float32],
    valid: NDArray[np.uint8],
    nearness: NDArray[np.float32],
) -> None:
    """Read the pixels whose rays are nearer to the view's axis than to those of the views before."""
    columns, rows, inside = source_pixels
    owned = (inside > 0) & (cosine > nearness)
    if not owned.any():
        return
    np.copyto(nearness, cosine, where=owned)
    if mask is not None:
        inside[cv2.remap(mask, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) < 255] = 0
    values = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.copyto(rectified, values, where=owned)
    np.copyto(valid, inside, where=owned)
