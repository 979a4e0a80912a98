"""A workspace → its mesh as PLY and GLB, by the method that is asked for."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, NoResultError, OptionError, counted
from colmap_sph.products.clouds.source import Cloud
from colmap_sph.products.clouds.spread import measured_cloud
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.mesh.glb import write_glb
from colmap_sph.products.mesh.obj import write_obj
from colmap_sph.products.mesh.options import MeshOptions
from colmap_sph.products.mesh.preview import PREVIEW, write_preview
from colmap_sph.products.mesh.texture.textured import Sheet, plain, textured
from colmap_sph.products.mesh.triangles import Triangles, joined, read_ply, write_ply
from colmap_sph.products.mesh.tsdf import Volume, open3d
from colmap_sph.products.places import check_places
from colmap_sph.products.publishing import alone_in
from colmap_sph.products.surface.placing import axes_on_map, level_axes
from colmap_sph.products.surface.seen import SeenView, seen_views
from colmap_sph.project.cloud_tiles import index_of
from colmap_sph.project.files import scratch_folder
from colmap_sph.project.meshing import poisson_mesh, simplify
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene

logger = logging.getLogger(__name__)

_DEPTHS = (6, 13)
# COLMAP's poisson crashes where it cuts off all of a surface, as it does of a few points that lie apart.
_FEWEST_POINTS = 100
# Nor does it survive normals of a length that nobody means: its squares run over.
_LONGEST_NORMAL = 1e3
# Depths of one surface, as the mesh and a view have it, differ by no more than this many pixels on it.
_TOLERANCE = 6.0


@dataclass(frozen=True, eq=False)
class MeshRequest:
    """What is to be made of a workspace, and where.

    Attributes
    ----------
    memory : int
        Bytes that the process may use while depth maps are averaged.
    overwrite : bool
        Whether files that are there already are replaced.
    """

    workspace: Workspace
    georeference: Georeference
    options: MeshOptions
    folder: Path
    memory: int
    threads: int
    overwrite: bool = False


def make_mesh(
    request: MeshRequest, start: Callable[[str, int], None], advance: Callable[[], None]
) -> tuple[list[Path], int]:
    """Make the mesh and write it; returns what was made, and its number of faces.

    Parameters
    ----------
    request : MeshRequest
    start, advance : callable
        Told that so many steps of something begin, and that one is done.

    Raises
    ------
    InputError, NoResultError, OptionError
        Open3D, maps or the cloud are missing, or there is no surface.
    OutputError
        The files cannot be written.
    """
    options = request.options
    options.check()
    if options.method == "tsdf":
        open3d()
    check_places(request.workspace, request.folder, _names(request), overwrite=request.overwrite)
    scene, seen = seen_views(request.workspace)
    gsd = float(np.median(np.concatenate([each.footprint for each in seen])))
    if options.voxel:
        _check_voxel(options, _size(seen))
    scratch = request.folder / ".mesh.tmp"
    with alone_in(request.folder), scratch_folder(scratch):
        if options.method == "tsdf":
            mesh = _of_maps(request, seen, options.voxel or gsd, start, advance)
        else:
            start("poisson", 1)
            mesh = _of_cloud(request, scene, seen, options.voxel or 2 * gsd, scratch)
            advance()
        if options.simplify < 1:
            start("simplify", 1)
            mesh = _simplified(mesh, request, scratch)
            advance()
        if not len(mesh.faces):
            raise NoResultError("There is no surface: give a larger --voxel or a smaller --min-images.")
        sheets = [plain(mesh)]
        if options.texture:
            start("texture", len(seen))
            sheets = textured(mesh, request.workspace, scene, seen, _TOLERANCE * gsd, scratch, advance)
        return _written(request, mesh, sheets, scene, seen), len(mesh.faces)


def _size(seen: list[SeenView]) -> float:
    """Longest side of all that is seen but for what lies far off."""
    points = np.concatenate([each.points for each in seen])
    return float(np.max(np.percentile(points, 99.5, axis=0) - np.percentile(points, 0.5, axis=0)))


def _check_voxel(options: MeshOptions, size: float) -> None:
    """Raise `OptionError` for a voxel that is given and cannot be had."""
    if options.voxel > size:
        raise OptionError(f"voxel is {options.voxel:g}, and all that is seen {size:g}; give less.", "voxel")
    least = size / 2 ** (_DEPTHS[1] + 0.5)
    if options.method == "poisson" and options.voxel < least:
        raise OptionError(
            f"voxel is {options.voxel:g}, and must be at least {least:g} here for poisson; give more.", "voxel"
        )


def _names(request: MeshRequest) -> list[str]:
    """What may be written, or replaced."""
    names = [*(f"mesh.{each}" for each in request.options.formats), PREVIEW]
    if "obj" in request.options.formats:
        names += ["mesh.mtl", *(path.name for path in request.folder.glob("mesh_*.jpg"))]
    return names


def _of_maps(
    request: MeshRequest,
    seen: list[SeenView],
    voxel: float,
    start: Callable[[str, int], None],
    advance: Callable[[], None],
) -> Triangles:
    volume = Volume(
        request.workspace, seen, voxel=voxel, min_views=request.options.min_images, memory=request.memory
    )
    start("mesh", len(volume.blocks))
    parts = []
    for part in volume.meshes():
        if len(part.faces):
            parts.append(part)
        advance()
    return joined(parts)


def _of_cloud(request: MeshRequest, scene: Scene, seen: list[SeenView], cell: float, scratch: Path) -> Triangles:
    """Of the cloud, near its origin where the model is in map coordinates."""
    workspace = request.workspace
    cloud = (workspace.local_dir / "fused.ply") if scene.origin.any() else workspace.fused_path
    if not cloud.is_file():
        option = " --fusion.max-points-per-file 0" if index_of(workspace) else ""
        raise InputError(
            f"{cloud} is missing, of which --method poisson makes a mesh; run colmap_sph run{option} first."
        )
    # All of the cloud is in the octree, also a few points that lie far off.
    sides = _checked_size(cloud, measured_cloud(workspace), cell) / cell  # which refuses one of other poses
    wanted = round(math.log2(max(sides, 1.0)))
    depth = int(np.clip(wanted, *_DEPTHS))
    if wanted > depth:
        logger.warning(
            "The mesh is coarser than %s, as poisson has %d cells along a side at most, not %d; give "
            "--method tsdf, which has no such bound, for finer ones",
            "--voxel asks for" if request.options.voxel else "the images",
            2**depth,
            sides,
        )
    mesh = scratch / "poisson.ply"
    poisson_mesh(cloud, mesh, depth=depth, trim=request.options.trim, threads=request.threads)
    return read_ply(mesh)


def _checked_size(path: Path, cloud: Cloud, cell: float) -> float:
    """Longest side of a cloud; `InputError` or `NoResultError` where COLMAP would make nothing of it, or crash."""
    sound = 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for piece in replace(cloud, has_images=False).pieces():  # images are of no use here, and take long to read
        if piece.normals is not None and len(piece.xyz):
            lengths = np.linalg.norm(piece.normals.astype(np.float64), axis=1)
            sound += int(((lengths > 1 / _LONGEST_NORMAL) & (lengths < _LONGEST_NORMAL)).sum())
            low, high = np.minimum(low, piece.xyz.min(axis=0)), np.maximum(high, piece.xyz.max(axis=0))
    if sound < cloud.count:
        raise InputError(
            f"{path} has {counted(cloud.count - sound, 'point')} without a normal of possible length, or without "
            "possible coordinates, and --method poisson needs both; fuse again, or give --method tsdf."
        )
    if sound < _FEWEST_POINTS:
        raise NoResultError(
            f"{path} has only {counted(sound, 'point')}, too few for a surface; try --method tsdf."
        )
    size = float((high - low).max())
    if size < cell:
        raise NoResultError(
            f"All points of {path} lie within {size:.3g}, less than one cell of {cell:.3g}, and make no surface; "
            "fuse again, or give --method tsdf."
        )
    return size


def _simplified(mesh: Triangles, request: MeshRequest, scratch: Path) -> Triangles:
    full, fewer = scratch / "full.ply", scratch / "fewer.ply"
    write_ply(full, mesh, mesh.points)
    simplify(full, fewer, ratio=request.options.simplify, threads=request.threads)
    from scipy.spatial import cKDTree  # which takes long to load

    found = read_ply(fewer)
    # COLMAP drops colours.
    _, nearest = cKDTree(mesh.points).query(found.points)
    return Triangles(found.points, mesh.colours[nearest], found.faces)


def _written(
    request: MeshRequest, mesh: Triangles, sheets: list[Sheet], scene: Scene, seen: list[SeenView]
) -> list[Path]:
    is_on_map = bool(request.georeference.crs) or not request.georeference.is_identity or bool(scene.origin.any())
    axes = _axes(request.georeference, scene, seen, is_on_map=is_on_map)

    def placed(points: NDArray[np.float32]) -> NDArray[np.floating]:
        return request.georeference.to_map(points.astype(np.float64) + scene.origin) if is_on_map else points

    paths = []
    for each in dict.fromkeys(request.options.formats):
        path = request.folder / f"mesh.{each}"
        paths.append(path)
        if each == "ply":
            write_ply(path, mesh, placed(mesh.points))
        elif each == "glb":
            write_glb(path, sheets, axes)
        else:
            paths += write_obj(path, sheets, [placed(sheet.points) for sheet in sheets])[1:]
    write_preview(request.folder / PREVIEW, mesh, axes)
    return [*paths, request.folder / PREVIEW]


def _axes(
    georeference: Georeference, scene: Scene, seen: list[SeenView], *, is_on_map: bool
) -> NDArray[np.float64]:
    """East, north and up in the scene's frame, or what comes next to them."""
    if is_on_map:
        return axes_on_map(scene, seen, georeference) @ georeference.rotation
    return level_axes(scene, seen)
