"""Depth maps → a mesh by signed distances in voxels, block by block, by Open3D (Curless & Levoy 1996)."""

from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OptionError, reason_of
from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.surface.seen import Box, SeenView, read_part, read_picture
from colmap_sph.project.workspace import Workspace

# Voxels to each side of a surface in which its distance is averaged.
_TRUNCATION = 6.0
_UNIT = 8
# Bytes of a unit of 8³ voxels, with its part of the mesh; units that surfaces touch in a block, per unit of its
# face; bytes of a pixel while a view is read; of the program itself.
_UNIT_BYTES = 45_000.0
_UNITS_PER_FACE = 7.0
_PIXEL = 90.0
_PROGRAM = 600e6
_FEWEST_UNITS = 12
_MOST_UNITS = 128
_MOST_BLOCKS = 1_000_000


def open3d() -> Any:
    """The module; `InputError` where it is not installed, or the system lacks what it needs."""
    try:
        return import_module("open3d")
    except ModuleNotFoundError as error:
        raise InputError(
            "--method tsdf needs Open3D, which is not installed; install this program with it, pip install "
            "'.[mesh]', or give --method poisson."
        ) from error
    except (ImportError, OSError) as error:
        library = reason_of(error).split(":")[0]
        raise InputError(
            f"--method tsdf needs Open3D, which cannot be loaded for lack of {library}; install the system's "
            "libraries for it (Debian, Ubuntu: sudo apt install libusb-1.0-0 libgl1 libx11-6 libgomp1), or give "
            "--method poisson."
        ) from error


class Volume:
    """The scene in cubic blocks of voxels, of which one at a time is in memory.

    Parameters
    ----------
    workspace : Workspace
    seen : sequence of SeenView
    voxel : float
        Side of a voxel, units of the scene.
    min_views : int
        Views that must have been averaged at a voxel.
    memory : int
        Bytes that the process may use.

    Raises
    ------
    InputError
        Open3D is not there.
    OptionError
        The memory is too little, or there would be blocks without end.
    """

    def __init__(
        self, workspace: Workspace, seen: Sequence[SeenView], *, voxel: float, min_views: int, memory: int
    ) -> None:
        self._open3d = open3d()
        self._workspace = workspace
        self._seen = seen
        self._voxel = voxel
        self._min_views = min_views
        spare = memory - _PROGRAM - _PIXEL * max(each.view.file_size[0] * each.view.file_size[1] for each in seen)
        units = int(np.sqrt(max(spare, 0) / (_UNITS_PER_FACE * _UNIT_BYTES)))
        if units < _FEWEST_UNITS:
            least = memory - spare + _UNITS_PER_FACE * _UNIT_BYTES * (_FEWEST_UNITS + 1) ** 2
            raise OptionError(f"memory is too little for these maps: {int(least) >> 20}MiB would do.", "memory")
        self._side = min(units, _MOST_UNITS) * _UNIT * voxel
        self.blocks = self._find_blocks()
        """(n, 3) int64: blocks with a sample in or beside them, which begin at these numbers times their side."""

    def _find_blocks(self) -> NDArray[np.int64]:
        found: set[tuple[int, int, int]] = set()
        for each in self._seen:
            reach = self._reach(each)
            corners = np.array(np.meshgrid(*[(-reach, reach)] * 3)).reshape(3, -1).T
            for corner in corners:
                cells = np.floor((each.points + corner) / self._side).astype(np.int64)
                found.update(map(tuple, np.unique(cells, axis=0).tolist()))
            if len(found) > _MOST_BLOCKS:
                raise OptionError("voxel is too small for this scene; give a larger one, or 0.", "voxel")
        return np.array(sorted(found), np.int64).reshape(-1, 3)

    def _reach(self, seen: SeenView) -> float:
        """How far from a sample there may be surface that it stands for."""
        return 2.0 * seen.step * float(np.median(seen.footprint)) + 2 * _TRUNCATION * self._voxel

    def meshes(self) -> Iterator[Triangles]:
        """The mesh in each block."""
        for block in self.blocks:
            low = block * self._side
            yield self._mesh(low, low + self._side)

    def _mesh(self, low: NDArray[np.float64], high: NDArray[np.float64]) -> Triangles:
        core = self._open3d.core
        kinds = ((1,), (1,), (3,))
        grid = self._open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), (core.float32,) * 3, kinds, self._voxel, _UNIT, 1000, core.Device("CPU:0")
        )
        is_empty = True
        for each in self._seen:
            box = self._part_of(each, low, high)
            if box is not None:
                is_empty &= not self._integrate(grid, each, box, low, high)
        if is_empty:
            return _none()
        mesh = grid.extract_triangle_mesh(self._min_views - 0.5)
        if "positions" not in mesh.vertex or not len(mesh.vertex.positions):
            return _none()
        colours = np.clip(np.rint(mesh.vertex.colors.numpy() * 255), 0, 255).astype(np.uint8)
        return _inside(mesh.vertex.positions.numpy(), colours, mesh.triangle.indices.numpy(), low, high)

    def _part_of(self, seen: SeenView, low: NDArray[np.float64], high: NDArray[np.float64]) -> Box | None:
        """The part of a view that shows a block; None where it shows nothing of it."""
        reach = self._reach(seen)
        inside = ((seen.points >= low - reach) & (seen.points < high + reach)).all(axis=1)
        if not inside.any():
            return None
        pixels = seen.pixels[inside]
        left, top = (pixels.min(axis=0) - 2 * seen.step).clip(0).tolist()
        right, bottom = (pixels.max(axis=0) + 2 * seen.step + 1).tolist()
        return left, top, min(right, seen.view.width), min(bottom, seen.view.height)

    def _integrate(
        self, grid: Any, seen: SeenView, box: Box, low: NDArray[np.float64], high: NDArray[np.float64]
    ) -> bool:
        """Average a view into the voxels that it touches in and around a block; whether there are any."""
        part = read_part(self._workspace, seen.view, box, with_normals=False)
        view = part.view
        near = np.where(_in_box(view.K, view.R, view.center, part.depth, low, high, self._voxel), part.depth, 0)
        if not near.any():
            return False
        left, top, right, bottom = box
        colours = read_picture(self._workspace, seen.view)[top:bottom, left:right].astype(np.float32) / 255
        image = self._open3d.t.geometry.Image
        tensor = self._open3d.core.Tensor
        pose = np.eye(4)
        pose[:3] = view.cam_from_world
        # Open3D takes the pixel that a point lies in: right for colours, but depths are those of pixels' corners.
        nearest = view.K.copy()
        nearest[:2, 2] += 0.5
        frame = (tensor(pose), 1.0, float(part.depth.max()) * 1.01, _TRUNCATION)
        try:
            units = grid.compute_unique_block_coordinates(
                image(np.ascontiguousarray(near)), tensor(nearest), *frame
            )
        except RuntimeError:  # it looks at every fourth pixel only, and none of them is near
            return False
        depth = image(np.ascontiguousarray(part.depth))
        grid.integrate(units, depth, image(colours), tensor(nearest), tensor(view.K.copy()), *frame)
        return True


def _in_box(
    K: NDArray[np.float64],
    R: NDArray[np.float64],
    center: NDArray[np.float64],
    depth: NDArray[np.float32],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    voxel: float,
) -> NDArray[np.bool_]:
    """(h, w) which pixels have their point in a block or so near to it that its voxels feel them."""
    margin = (_TRUNCATION + 2) * voxel
    along = R.T @ np.linalg.inv(K)
    column = np.arange(depth.shape[1])
    row = np.arange(depth.shape[0])[:, None]
    inside = depth > 0
    for axis in range(3):
        place = (along[axis, 0] * column + along[axis, 1] * row + along[axis, 2]) * depth + center[axis]
        inside &= (place >= low[axis] - margin) & (place < high[axis] + margin)
    return inside


def _inside(
    points: NDArray[np.float32],
    colours: NDArray[np.uint8],
    faces: NDArray[np.int64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> Triangles:
    """The faces whose middle lies in a block: of each face one block's."""
    middle = points[faces].mean(axis=1, dtype=np.float64)
    faces = faces[((middle >= low) & (middle < high)).all(axis=1)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return Triangles(points[used], colours[used], renumbered.reshape(-1, 3).astype(np.int32))


def _none() -> Triangles:
    return Triangles(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.int32))
