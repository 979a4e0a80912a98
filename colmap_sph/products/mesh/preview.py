"""A mesh → a small picture of it, as the page of the workspace shows it."""

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.publishing import write_picture
from colmap_sph.project.workspace import PREVIEW_PREFIX, PREVIEW_SIDE

PREVIEW = f"{PREVIEW_PREFIX}mesh.png"
"""Name of the picture."""
# From where it is looked at, above the horizon.
_ELEVATION = math.radians(50)
# Of more triangles corners alone are drawn, which is faster; so many in a pixel that nothing shows through.
_MOST_FACES = 500_000
_CORNERS = 4.0
# Pixels from the picture's corner, which OpenCV can draw to.
_FAR = 30_000
_FARTHEST = (0.5, 99.5)
_NOTHING = 255


def write_preview(path: Path, mesh: Triangles, axes: NDArray[np.float64]) -> None:
    """Draw a mesh as seen from the south and from above, without perspective.

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
    is_large = len(mesh.faces) > _MOST_FACES
    side = min(PREVIEW_SIDE, math.sqrt(len(places) / _CORNERS)) if is_large else PREVIEW_SIDE
    scale = side / float(extent.max())
    width, height = (max(1, int(length * scale)) for length in extent)
    pixels = np.floor((places[:, :2] - low) * scale).clip(-_FAR, _FAR).astype(np.int32)
    picture = np.full((height, width, 3), _NOTHING, np.uint8)
    if is_large:
        is_shown = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        order = np.argsort(places[:, 2], kind="stable")  # the nearest is drawn last
        order = order[is_shown[order]]
        picture[pixels[order, 1], pixels[order, 0]] = mesh.colours[order]
    else:
        colours = mesh.colours[mesh.faces].mean(axis=1).tolist()
        for face in np.argsort(places[mesh.faces, 2].mean(axis=1), kind="stable"):
            cv2.fillConvexPoly(picture, pixels[mesh.faces[face]], colours[face])
    write_picture(path, picture)
