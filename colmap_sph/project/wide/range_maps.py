"""Maps of the views cut from a wide image → the range and normal of each of its own pixels, and their file.

The range is the distance from the camera's centre, along the ray of the pixel's centre.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OutputError, unwritable
from colmap_sph.project.files import SCRATCH_ENDING, atomic_file, make_dir
from colmap_sph.project.images.decoding import check_end
from colmap_sph.project.wide.projection import Lens, camera_rays
from colmap_sph.scene import in_bands

Pixels = NDArray[np.float32]

CHANNELS = ("range", "normal.X", "normal.Y", "normal.Z")
"""Of the file. Normals are unit vectors in the frame of the image's camera, towards it; 0 where there is none."""

# So few that what is computed of them stays in a processor's cache.
_BAND_PIXELS = 1 << 15
# Cosine between ray and normal below which a pixel's plane says nothing of the rays beside it.
_GRAZING = 0.05
# By which a plane may change the range within a pixel, relative to it.
_MOST_CHANGE = 0.1
# Views whose ranges differ by less show the same surface.
_SAME = 0.05


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """Maps of a view that was cut.

    Attributes
    ----------
    R : (3, 3) float64 ndarray
        From the frame of the image's camera to the view's.
    K : (3, 3) float64 ndarray
        Calibration matrix of the view.
    depth : (H, W) float32 ndarray
        COLMAP's depth map.
    normals : (H, W, 3) float32 ndarray
        COLMAP's normal map.
    """

    R: NDArray[np.float64]
    K: NDArray[np.float64]
    depth: Pixels
    normals: Pixels


def range_and_normals(lens: Lens, views: Sequence[ViewMaps]) -> tuple[Pixels, Pixels]:
    """What the views of an image know of its pixels.

    Of those with a depth there, the view whose axis is nearest to a pixel's ray says what surface it shows, and
    gives the normal. The range is the mean of all that see the same: they are refined one by one, so that errors
    even out.

    Parameters
    ----------
    lens : Lens
        Of the image.
    views : sequence of ViewMaps

    Returns
    -------
    range : (H, W) float32 ndarray
        0 where no view has a depth.
    normals : (H, W, 3) float32 ndarray
    """
    found = np.zeros((lens.height, lens.width), np.float32)
    normals = np.zeros((lens.height, lens.width, 3), np.float32)
    for rows in in_bands((lens.height, lens.width), _BAND_PIXELS):
        rays = np.ascontiguousarray(_rays(lens)[rows].reshape(-1, 3).T, np.float64)
        distance = np.zeros(rays.shape[1])
        normal = normals[rows].reshape(-1, 3)
        nearest = np.zeros(rays.shape[1])
        known = []
        for view in views:
            cosine = _along(view.R[2], rays)
            seen, here, normal_here = _looked_up(view, rays, np.flatnonzero(cosine > _least_cosine(view)))
            known.append((seen, here))
            nearer = cosine[seen] > nearest[seen]
            own = seen[nearer]
            distance[own] = here[nearer]
            normal[own] = normal_here[nearer] @ view.R
            nearest[own] = cosine[own]
        found[rows] = _mean_of_same(distance, known).reshape(-1, lens.width)
    return found, normals


def _mean_of_same(
    distance: NDArray[np.float64], known: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]]
) -> NDArray[np.float64]:
    """Of each pixel of `distance` (n,), the mean of the ranges that are of its surface.

    `known` has of each view the numbers (m,) of pixels and their ranges (m,).
    """
    total, count = np.zeros_like(distance), np.zeros_like(distance)
    for seen, here in known:
        is_same = np.abs(here - distance[seen]) < _SAME * distance[seen]
        total[seen[is_same]] += here[is_same]
        count[seen[is_same]] += 1
    return total / np.maximum(count, 1)


def _along(row: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Products (n,) of a vector with (3, n) rays; for three numbers each this is quicker than BLAS."""
    return np.asarray(row[0] * rays[0] + row[1] * rays[1] + row[2] * rays[2])


def _least_cosine(view: ViewMaps) -> float:
    """Cosine of the angle between a view's axis and the farthest corner of its image, or a little less."""
    height, width = view.depth.shape
    corners = np.array([[x, y, 1.0] for x in (-1, width) for y in (-1, height)]) @ np.linalg.inv(view.K).T
    return float(1 / np.linalg.norm(corners, axis=1).max())


def _looked_up(
    view: ViewMaps, rays: NDArray[np.float64], which: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """What a view knows along `which` of (3, n) unit rays before it, in the frame of the image's camera.

    Returns the numbers (m,) of those along which it has a depth, the distances (m,) there, and normals (m, 3) in
    the view's frame.
    """
    height, width = view.depth.shape
    before = rays[:, which]
    local = [_along(row, before) for row in view.R]
    (fx, skew, cx), (_, fy, cy), _ = view.K
    # A value belongs to the ray through (column, row), see COLMAP's fusion.
    column = np.rint((fx * local[0] + skew * local[1]) / local[2] + cx)
    row = np.rint(fy * local[1] / local[2] + cy)
    inside = np.flatnonzero((column >= 0) & (row >= 0) & (column < width) & (row < height))
    columns, rows = column[inside].astype(np.int64), row[inside].astype(np.int64)
    depth = view.depth[rows, columns].astype(np.float64)
    known = np.flatnonzero(depth > 0)
    inside, columns, rows, depth = inside[known], columns[known], rows[known], depth[known]
    x, y, z = (part[inside] for part in local)
    normals = view.normals[rows, columns].astype(np.float64)
    own = np.column_stack([columns, rows, np.ones(len(known))]) @ np.linalg.inv(view.K).T
    towards = normals[:, 0] * x + normals[:, 1] * y + normals[:, 2] * z
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = depth * np.einsum("ni,ni->n", normals, own) / towards
        distance = depth / z
        is_plane = (towards < -_GRAZING) & (np.abs(plane / distance - 1) < _MOST_CHANGE)
    return which[inside], np.where(is_plane, plane, distance), normals


def pixels_shown(lens: Lens) -> int:
    """Number of an image's pixels that show something: the others lie beyond the lens."""
    return int(np.count_nonzero(~np.isnan(_rays(lens)[:, :, 0])))


@lru_cache(maxsize=1)
def _rays(lens: Lens) -> Pixels:
    """(H, W, 3) rays of the centres of a lens's pixels; NaN where it shows nothing."""
    rays = np.empty((lens.height, lens.width, 3), np.float32)
    for rows in in_bands((lens.height, lens.width), _BAND_PIXELS):
        x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
        rays[rows] = camera_rays(lens, np.column_stack([x.ravel(), y.ravel()])).reshape(-1, lens.width, 3)
    return rays


def forget_rays() -> None:
    """Let go of the rays that are kept: no more maps are to be made."""
    _rays.cache_clear()


def write_range_map(path: Path, distance: Pixels, normals: Pixels) -> str:
    """Write range and normals as an OpenEXR image with `CHANNELS`; returns the `files.whole_digest` of the file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    make_dir(path.parent)
    height, width = distance.shape
    spec = oiio.ImageSpec(width, height, len(CHANNELS), "float")
    spec.channelnames = CHANNELS
    spec["compression"] = "zip"
    spec["DateTime"] = ""  # else the time of writing: the same input makes the same bytes
    image = oiio.ImageBuf(spec)
    image.set_pixels(image.roi, np.ascontiguousarray(np.dstack([distance, normals]), np.float32))
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".range-", suffix=SCRATCH_ENDING) as folder:
            made = Path(folder) / "made.exr"
            if not image.write(str(made)):
                raise OutputError(f"{path} cannot be written ({image.geterror()}); check space and permissions.")
            check_end(made)
            with atomic_file(path, sync=False) as file:
                file.write(made.read_bytes())
                return file.digest
    except OSError as error:
        raise unwritable(path, error) from error


def read_range_map(path: Path) -> tuple[Pixels, Pixels]:
    """Read the range (H, W) and normals (H, W, 3) of `write_range_map`; `InputError` where it is no such file."""
    image = oiio.ImageBuf(str(path))
    if image.has_error or tuple(image.spec().channelnames) != CHANNELS:
        raise InputError(f"{path} is no range map, or damaged; run again.")
    pixels = np.asarray(image.get_pixels("float"), np.float32)
    return pixels[:, :, 0], pixels[:, :, 1:]
