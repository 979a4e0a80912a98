"""A view's maps and mask → what is needed of them for a page: values at a grid of pixels."""

import math
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.project.map_files import map_size, read_some_pixels
from colmap_sph.project.masks import read_mask
from colmap_sph.project.state.array_file import first_array
from colmap_sph.project.state.ownership import estimate_path, map_place
from colmap_sph.project.state.records import altered_files, read_record
from colmap_sph.project.wide.projection import Lens
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import View

# Samples along the longer side of an image: as many as there is room for, of 9 bytes each, and within these.
_SAMPLE_BYTES = 9
_ROOM = 64e6
_FEWEST = 24
_MOST = 192
# Depths beyond come from damage.
_FARTHEST = 1e12


def samples_per_side(views: int) -> int:
    """Samples along the longer side of an image, for so many views."""
    return int(np.clip(math.sqrt(_ROOM / (_SAMPLE_BYTES * max(views, 1))), _FEWEST, _MOST))


@dataclass(frozen=True, eq=False)
class MapSamples:
    """A view's depth at a grid of its pixels; what is too large to keep for all views is not here.

    Attributes
    ----------
    rows, columns : (h,) and (w,) int64 ndarray
        Of the pixels.
    photometric, geometric : (h, w) float32 ndarray
        Depths, 0 = none.
    has_photometric, has_geometric : bool
        Whether there are such maps. Where there is no photometric map, the depths are those that were voted, and
        so where another program's is beside a vote of ours.
    ignored : (h, w) bool ndarray
        Under the mask.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    photometric: NDArray[np.float32]
    geometric: NDArray[np.float32]
    has_photometric: bool
    has_geometric: bool
    ignored: NDArray[np.bool_]

    def has(self, kind: MapKind) -> bool:
        """Whether there is a map of this kind."""
        return self.has_geometric if kind == "geometric" else self.has_photometric

    @property
    def has_maps(self) -> bool:
        """Whether there is any depth of the view to show."""
        return self.has_photometric or self.has_geometric or bool(self.photometric.any())


def grid_of(view: View | Lens, per_side: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of pixels, evenly spread, about `per_side` of them along the longer side."""
    step = max(1, math.ceil(max(view.width, view.height) / per_side))
    first = step // 2
    # An image narrower than the step still has one.
    rows = np.arange(min(first, view.height - 1), view.height, step)
    columns = np.arange(min(first, view.width - 1), view.width, step)
    return rows, columns


def nearest_in(grid: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Places in an even grid next to values."""
    step = grid[1] - grid[0] if len(grid) > 1 else 1
    return np.asarray(np.clip(np.rint((values - grid[0]) / step), 0, len(grid) - 1), np.int64)


def read_samples(
    workspace: Workspace, view: View, per_side: int, kinds: Collection[MapKind] = get_args(MapKind)
) -> MapSamples:
    """Read a view's depth maps and mask at a grid of pixels; what is missing or damaged has no depth there.

    Maps of other `kinds` count as missing.
    """
    rows, columns = grid_of(view, per_side)
    photometric, geometric = (
        _depth(workspace, view, kind, rows, columns) if kind in kinds else None for kind in get_args(MapKind)
    )
    none = np.zeros((len(rows), len(columns)), np.float32)
    voted = None
    if "photometric" in kinds and (photometric is None or _is_foreign(workspace, view)):
        voted = _voted(workspace, view, rows, columns)
    if voted is not None:
        photometric = None
    return MapSamples(
        rows,
        columns,
        next(depth for depth in (photometric, voted, none) if depth is not None),
        none if geometric is None else geometric,
        photometric is not None,
        geometric is not None,
        _ignored(workspace, view)[np.ix_(rows, columns)] if workspace.masks_dir.is_dir() else none > 0,
    )


def _is_foreign(workspace: Workspace, view: View) -> bool:
    """Whether a view's photometric map is not as this program left it."""
    place = map_place(workspace, view.name, "photometric")
    return bool(altered_files(read_record(place.record), place.files))


def read_normals(workspace: Workspace, view: View, samples: MapSamples) -> NDArray[np.float32] | None:
    """(3, h, w) normals of the geometric map at a view's samples; None where there are none."""
    with suppress(InputError):
        path = workspace.normal_map_path(view.name, "geometric")
        return _read(path, view, 3, samples.rows, samples.columns)
    return None


def _read(
    path: Path, view: View, channels: int, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Read a map at pixels of its view's image, than which it may have fewer; see `read_some_pixels`."""
    width, height = map_size(path, channels)
    if not view.may_be_reduced_to(width, height):
        raise InputError(f"The map {path} is not of its image's size; compute it again.")
    shape = (height, width) if channels == 1 else (height, width, channels)
    return read_some_pixels(path, shape, rows * height // view.height, columns * width // view.width)


def _depth(
    workspace: Workspace, view: View, kind: MapKind, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float32] | None:
    try:
        path = workspace.depth_map_path(view.name, kind)
        depth = _read(path, view, 1, rows, columns)
    except InputError:
        return None
    return _sound(depth)


def _voted(
    workspace: Workspace, view: View, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float32] | None:
    """What was voted for pixels of a view, maybe in a part of it only; None where there is nothing of it."""
    try:
        head, voted = first_array(estimate_path(workspace, view.name), "estimate")
        left, top = map(int, head.numbers[:2])
        height, width = voted.shape
    except (OSError, ValueError, OverflowError):
        return None
    if left < 0 or top < 0 or left + width > view.width or top + height > view.height:
        return None
    depth = np.zeros((len(rows), len(columns)), np.float32)
    in_rows = (rows >= top) & (rows < top + height)
    in_columns = (columns >= left) & (columns < left + width)
    depth[np.ix_(in_rows, in_columns)] = voted[np.ix_(rows[in_rows] - top, columns[in_columns] - left)]
    return _sound(depth)


def _sound(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    depth[~((depth > 0) & (depth < _FARTHEST))] = 0
    return depth


def _ignored(workspace: Workspace, view: View) -> NDArray[np.bool_]:
    mask = None
    with suppress(InputError):
        mask = read_mask(workspace.mask_path(view.name), view.width, view.height)
    return np.zeros((view.height, view.width), bool) if mask is None else mask == 0
