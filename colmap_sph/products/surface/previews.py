"""Finished GeoTIFFs → small pictures of them, as the page of the workspace shows them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.publishing import write_picture
from colmap_sph.products.surface.geotiff import NO_HEIGHT, gdal
from colmap_sph.project.workspace import PREVIEW_PREFIX, PREVIEW_SIDE

_SURFACE = f"{PREVIEW_PREFIX}surface.png"
_ORTHOPHOTO = f"{PREVIEW_PREFIX}orthophoto.png"
PREVIEWS = (_SURFACE, _ORTHOPHOTO)
"""Names of the pictures."""
_NOTHING = 255
_SHADE = 0.55


def write_previews(files: Iterable[Path]) -> list[Path]:
    """Write small pictures beside ``dsm.tif``, in the light of ``hillshade.tif``, and ``orthophoto.tif``."""
    small = {path.name: _small(path) for path in files}
    folder = next(iter(files)).parent
    pictures = {_SURFACE: _coloured(small["dsm.tif"][0], small["hillshade.tif"][0])}
    if "orthophoto.tif" in small:
        *colours, alpha = small["orthophoto.tif"]
        pictures[_ORTHOPHOTO] = np.where(alpha[..., None] > 0, np.dstack(colours), np.uint8(_NOTHING))
    for name, picture in pictures.items():
        write_picture(folder / name, picture)
    return [folder / name for name in pictures]


def _small(path: Path) -> NDArray[Any]:
    """(bands, h, w), from the file's overviews."""
    with gdal().open(path) as file:
        scale = min(1.0, PREVIEW_SIDE / max(file.shape))
        height, width = (max(1, round(side * scale)) for side in file.shape)
        return np.asarray(file.read(out_shape=(file.count, height, width)))


def _coloured(height: NDArray[np.float32], shade: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w, 3) low blue, high yellow, in the shade's light."""
    there = height != NO_HEIGHT
    low, high = np.percentile(height[there], (1, 99)) if there.any() else (0.0, 1.0)
    steps = np.clip(255 * (height - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    colours = cv2.applyColorMap(steps, cv2.COLORMAP_VIRIDIS)[..., ::-1]
    light = np.where(shade > 0, 1 - _SHADE + _SHADE * shade / 255.0, 1.0)
    return np.where(there[..., None], colours * light[..., None], _NOTHING).astype(np.uint8)
