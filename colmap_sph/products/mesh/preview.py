"""A mesh → a small picture of it, as the page of the workspace shows it."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.publishing import write_picture
from colmap_sph.project.workspace import PREVIEW_PREFIX, PREVIEW_SIDE

PREVIEW = f"{PREVIEW_PREFIX}mesh.png"
"""Name of the picture."""
# From where it is looked at, above the horizon.
_ELEVATION = math.radians(50)
# Corners that a pixel has, about, so that nothing shows through.
_CORNERS = 4.0
_FARTHEST = (0.5, 99.5)
_NOTHING = 255


def write_preview(path: Path, mesh: Triangles, axes: NDArray[np.float64]) -> None:
    """Draw a mesh's corners as seen from the south and from above, without perspective.

    Parameters
    ----------
    path : Path
        PNG.
    mesh : Triangles
    axes : (3, 3) float64 ndarray
        Rows: to the right, to the top of a map, and up, in the mesh's frame.
    """
    sine, cosine = math.sin(_ELEVATION), math.cos(_ELEVATION)
    upwards = sine * axes[1] + cosine * axes[2]
    nearer = sine * axes[2] - cosine * axes[1]
    places = mesh.points @ np.stack([axes[0], -upwards, nearer]).T.astype(np.float32)
    low, high = np.percentile(places[:, :2], _FARTHEST, axis=0)
    extent = np.maximum(high - low, 1e-9)
    side = min(PREVIEW_SIDE, math.sqrt(len(places) / _CORNERS))
    scale = side / float(extent.max())
    width, height = (max(1, int(length * scale)) for length in extent)
    column, row = ((places[:, :2] - low) * scale).astype(np.int64).T
    order = np.argsort(places[:, 2], kind="stable")  # the nearest is drawn last
    is_shown = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    order = order[is_shown[order]]
    picture = np.full((height, width, 3), _NOTHING, np.uint8)
    picture[row[order], column[order]] = mesh.colours[order]
    write_picture(path, picture)
