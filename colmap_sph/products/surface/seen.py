"""A workspace → its views with depth maps, and roughly where each of them sees something."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.products.maps.reading import at_map_size, no_depth, views_with_maps
from colmap_sph.project.images.reading import read_colours
from colmap_sph.project.map_files import is_depth, read_some_pixels
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View

# Pixels along the longer side of a map that are looked at beforehand.
_SAMPLES = 128


@dataclass(frozen=True, eq=False)
class SeenView:
    """A view as large as its maps, and samples of what it sees.

    Attributes
    ----------
    view : View
    index : int
        Its place among all views of the scene.
    step : int
        Pixels from sample to sample.
    pixels : (n, 2) int32 ndarray
        Column and row of samples with a depth.
    points : (n, 3) float32 ndarray
        Their points, scene frame.
    footprint : (n,) float32 ndarray
        What the pixel covers there, across the view: depth over focal length, units of the scene.
    """

    view: View
    index: int
    step: int
    pixels: NDArray[np.int32]
    points: NDArray[np.float32]
    footprint: NDArray[np.float32]


def seen_views(workspace: Workspace) -> tuple[Scene, list[SeenView]]:
    """Look at the geometric depth maps of a workspace, see `views_with_maps`.

    Raises
    ------
    InputError
        There are no maps or no model, or a map is damaged or not of its image's size.
    NoResultError
        No map has any depth.
    """
    scene, mapped = views_with_maps(workspace)
    found = [seen for each in mapped if (seen := _seen(*each)) is not None]
    if not found:
        raise no_depth(workspace)
    return scene, found


def _seen(index: int, view: View, path: Path) -> SeenView | None:
    view = at_map_size(view, path)
    width, height = view.width, view.height
    step = max(1, -(-max(width, height) // _SAMPLES))
    rows = np.arange(min(step // 2, height - 1), height, step)
    columns = np.arange(min(step // 2, width - 1), width, step)
    depth = read_some_pixels(path, (height, width), rows, columns)
    has_depth = is_depth(depth)
    if not has_depth.any():
        return None
    row, column = np.nonzero(has_depth)
    z = depth[row, column].astype(np.float64)
    pixels = np.stack([columns[column], rows[row]], axis=1)
    rays = np.column_stack([pixels, np.ones(len(z))]) @ view.inverse_K.T
    points = (rays * z[:, None]) @ view.R + view.center
    footprint = z / np.sqrt(view.K[0, 0] * view.K[1, 1])
    return SeenView(
        view.without_points(),
        index,
        step,
        pixels.astype(np.int32),
        points.astype(np.float32),
        footprint.astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a view: its camera cropped, and the maps there."""

    view: View
    depth: NDArray[np.float32]
    normals: NDArray[np.float32]


Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels, the last two excluded."""


def read_part(workspace: Workspace, view: View, box: Box, *, with_normals: bool = True) -> Part:
    """Read the maps of a part of a view; `InputError` where they are damaged or not of one size."""
    left, top, right, bottom = box
    rows = np.arange(top, bottom)
    columns = np.arange(left, right)
    shape = (view.height, view.width)
    depth = read_some_pixels(workspace.depth_map_path(view.name, "geometric"), shape, rows, columns)
    depth[~is_depth(depth)] = 0
    normals = np.zeros((3, 0, 0), np.float32)
    if with_normals:
        normals = read_some_pixels(workspace.normal_map_path(view.name, "geometric"), (*shape, 3), rows, columns)
    return Part(view.cropped(*box), depth, normals)


def read_picture(workspace: Workspace, view: View) -> NDArray[np.uint8]:
    """(H, W, 3) colours of a view's image, red, green and blue, as large as its maps."""
    path = workspace.image_path(view.name)
    colours = read_colours(path, (view.width, view.height) if view.full_size is not None else None)
    if colours.shape[:2] != (view.height, view.width):
        raise InputError(f"{path} is not of its camera's size; undistort it again.")
    return np.ascontiguousarray(colours[..., ::-1])
