"""The fused cloud on disk: ``fused.ply`` and ``fused.ply.vis`` in COLMAP's formats, put together from parts."""

import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import OutputError
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.map_coordinates import move_cloud, move_model
from colmap_sph.project.workspace import Workspace

# COLMAP derives the name of the visibility file from the cloud's.
CLOUD_FILES = ("fused.ply", "fused.ply.vis")
_HEADER = "\n".join(
    [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex {count}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header\n",
    ]
)


def write_part(stem: Path, bands: Iterable[tuple[NDArray[np.void], NDArray[np.uint32]]]) -> int:
    """Write points and their visibility to ``STEM.points`` and ``STEM.vis``; return the number of points.

    Parameters
    ----------
    stem : Path
    bands : iterable of (points, visibility)
        As of `fusion.fuse_view`.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    count = 0
    # One alone is an atomic file, whose temporary name is that of the thread.
    with atomic_file(stem.with_suffix(".points")) as cloud, stem.with_suffix(".vis").open("wb") as visible:
        for points, visibility in bands:
            cloud.write(points.data)
            visible.write(visibility.astype("<u4", copy=False).data)
            count += len(points)
    return count


def join_parts(stems: Sequence[Path], folder: Path, count: int) -> None:
    """Join parts, in this order, to the cloud of `count` points in `folder`; remove them."""
    starts = _HEADER.format(count=count).encode(), np.array(count, "<u8").tobytes()
    for name, start, suffix in zip(CLOUD_FILES, starts, (".points", ".vis"), strict=True):
        with atomic_file(folder / name) as file:
            file.write(start)
            for stem in stems:
                with stem.with_suffix(suffix).open("rb") as part:
                    shutil.copyfileobj(part, file)
                stem.with_suffix(suffix).unlink()


def check_places(workspace: Workspace) -> None:
    """Raise `OutputError` where a folder is in the cloud's place."""
    for name in CLOUD_FILES:
        if (workspace.root / name).is_dir():
            raise OutputError(f"{workspace.root / name} is a folder; remove it, the cloud goes there.")


def link_workspace(
    workspace: Workspace, model: pycolmap.Reconstruction, origin: NDArray[np.float64], folder: Path
) -> None:
    """Make `folder` a workspace of links, but for its model: `model`, moved to `origin`."""
    linked = Workspace(folder)
    make_dir(linked.sparse_dir)
    if origin.any():
        move_model(model, origin)
    model.write_binary(linked.sparse_dir)
    for link, target in ((linked.images_dir, workspace.images_dir), (linked.stereo_dir, workspace.stereo_dir)):
        # Relative, so that the workspace can be moved as a whole.
        link.symlink_to(os.path.relpath(target.resolve(), folder.resolve()))


def move_into_place(scratch: Path, workspace: Workspace, origin: NDArray[np.float64]) -> None:
    """Move the cloud that was made in `scratch` to its place, in the coordinates of the workspace's model.

    Where these are map coordinates, `scratch` is a linked workspace, and is kept as ``colmap_sph/local``.
    """
    shutil.rmtree(workspace.local_dir, ignore_errors=True)
    if origin.any():
        _keep_local_workspace(workspace.local_dir, scratch, origin)
    # A kill in between must not leave a cloud beside the visibility of another.
    (workspace.root / CLOUD_FILES[1]).unlink(missing_ok=True)
    for name in CLOUD_FILES:
        (scratch / name).replace(workspace.root / name)


def _keep_local_workspace(local: Path, scratch: Path, origin: NDArray[np.float64]) -> None:
    """Keep what was fused near the origin as `local`, and leave the cloud in map coordinates in `scratch`."""
    local.mkdir()
    for name in ("fused.ply", "images", "stereo", "sparse"):
        (scratch / name).rename(local / name)
    (local / "fused.ply.vis").symlink_to(Path("..", "..", "fused.ply.vis"))
    (local / "origin.txt").write_text(" ".join(map(repr, origin.tolist())) + "\n")
    move_cloud(local / "fused.ply", scratch / "fused.ply", origin)
