"""The fused cloud on disk: ``fused.ply`` and ``fused.ply.vis`` in COLMAP's formats, put together from parts."""

import os
import shutil
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from contextvars import copy_context
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import OutputError
from colmap_sph.platforms.files import is_link, move_into_place, write_text
from colmap_sph.platforms.links import link, symbolic_link
from colmap_sph.project.files import atomic_file, set_aside
from colmap_sph.project.map_coordinates import move_cloud, move_model
from colmap_sph.project.sparse_model import MODEL_FILES, RIG_FILES, write_model
from colmap_sph.project.workspace import Workspace

# Copied at a time: what a cache holds.
_COPY_BYTES = 1 << 18
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


def write_part(
    stem: Path, bands: Iterable[tuple[NDArray[np.void], NDArray[np.uint32]]], *, with_visibility: bool = True
) -> int:
    """Write points and their visibility to ``STEM.points`` and ``STEM.vis``; return the number of points.

    Parameters
    ----------
    stem : Path
    bands : iterable of (points, visibility)
        As of `fusion.fuse_view`.
    with_visibility : bool
        Whether to write the second file.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    count = 0
    with ExitStack() as opened:
        cloud = opened.enter_context(atomic_file(stem.with_suffix(".points"), sync=False))
        path = stem.with_suffix(".vis")
        visible = opened.enter_context(atomic_file(path, sync=False)) if with_visibility else None
        for points, visibility in bands:
            cloud.write(points.data)
            if visible is not None:
                visible.write(visibility.astype("<u4", copy=False).data)
            count += len(points)
    return count


def ply_header(count: int) -> bytes:
    """The header of a cloud of so many points."""
    return _HEADER.format(count=count).encode()


def join_parts(
    stems: Sequence[Path], folder: Path, count: int, *, with_visibility: bool = True
) -> tuple[str, ...]:
    """Join parts of a cloud, and remove them one by one: the disk never holds more than one part of each twice.

    Parameters
    ----------
    stems : sequence of Path
        Parts as `write_part` left them, in the order in which they are joined.
    folder : Path
        Where ``fused.ply`` and ``fused.ply.vis`` go.
    count : int
        Number of points of all parts together.
    with_visibility : bool
        Whether to make the second file.

    Returns
    -------
    tuple of str
        Digest of each of the two files, see `whole_digest`; empty for one that is not made.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    cloud, visible = Workspace(folder).cloud_paths
    files = [(".points", cloud, ply_header(count))]
    if with_visibility:
        files.append((".vis", visible, np.array(count, "<u8").tobytes()))
    with ThreadPoolExecutor(len(files)) as pool:
        joined = [pool.submit(copy_context().run, partial(_join, stems, *file)) for file in files]
    digests = [each.result() for each in joined]
    return *digests, *([] if with_visibility else [""])


def _join(stems: Sequence[Path], suffix: str, target: Path, start: bytes) -> str:
    with atomic_file(target, sync=False) as file:  # until it is in its place
        file.write(start)
        for stem in stems:
            with stem.with_suffix(suffix).open("rb") as part:
                shutil.copyfileobj(part, file, _COPY_BYTES)
            stem.with_suffix(suffix).unlink()
        return file.digest


def check_places(workspace: Workspace) -> None:
    """Raise `OutputError` where a folder is in the cloud's place."""
    for path in workspace.cloud_paths:
        if path.is_dir():
            raise OutputError(f"{path} is a folder; remove it, the cloud goes there.")


def link_workspace(
    workspace: Workspace, model: pycolmap.Reconstruction, origin: NDArray[np.float64], folder: Path
) -> None:
    """Make a workspace of links, but for its model.

    Parameters
    ----------
    workspace : Workspace
        Whose images and maps are linked to.
    model : pycolmap.Reconstruction
        Written there, moved so that `origin` is its origin; this object is moved, too.
    origin : (3,) float64 ndarray
        World coordinates.
    folder : Path
        The workspace to make; exists.

    Raises
    ------
    OSError, RuntimeError
        The system's, or COLMAP's, where something cannot be written; for the caller to put into a sentence.
    OutputError
        The model cannot be written.
    """
    linked = Workspace(folder)
    if origin.any():
        move_model(model, origin)
    write_model(model, linked.sparse_dir)
    for place, target in ((linked.images_dir, workspace.images_dir), (linked.stereo_dir, workspace.stereo_dir)):
        link(place, target)


def move_cloud_into_place(scratch: Path, workspace: Workspace, origin: NDArray[np.float64]) -> None:
    """Move a cloud to its place, in the coordinates of the workspace's model.

    Parameters
    ----------
    scratch : Path
        Folder in which the cloud was made. For a model in map coordinates it is a linked workspace, see
        `link_workspace`, and is kept as ``colmap_sph/local``.
    workspace : Workspace
    origin : (3,) float64 ndarray
        Map coordinates of what the cloud's points are relative to; zero for any other model.

    Raises
    ------
    OSError
        A file cannot be moved; for the caller to put into a sentence.
    OutputError
        The cloud in map coordinates cannot be written.
    """
    Workspace(workspace.local_dir).fused_path.unlink(missing_ok=True)
    remove_local_workspace(workspace)
    if origin.any():
        _keep_local_workspace(workspace, Workspace(scratch), origin)
    # A kill in between must not leave a cloud beside the visibility of another.
    workspace.visibility_path.unlink(missing_ok=True)
    for made, place in zip(Workspace(scratch).cloud_paths, workspace.cloud_paths, strict=True):
        if made.exists():  # visibility is not always wanted
            move_into_place(made, place)


def remove_local_workspace(workspace: Workspace) -> None:
    """Remove what this program left there but the cloud, of which a record knows; what COLMAP made stays."""
    local = Workspace(workspace.local_dir)
    for path in (local.images_dir, local.stereo_dir, local.visibility_path):
        if is_link(path):
            path.unlink()
    for name in (*MODEL_FILES, *RIG_FILES):
        (local.sparse_dir / f"{name}.bin").unlink(missing_ok=True)
    workspace.local_origin_path.unlink(missing_ok=True)
    for folder in (local.sparse_dir, local.root):
        with suppress(OSError):  # not there, or not empty
            folder.rmdir()


def _keep_local_workspace(workspace: Workspace, linked: Workspace, origin: NDArray[np.float64]) -> None:
    """Keep what was fused near the origin, and leave the cloud in map coordinates in its place."""
    local = Workspace(workspace.local_dir)
    local.root.mkdir(exist_ok=True)
    for made, kept in (
        (linked.fused_path, local.fused_path),
        (linked.images_dir, local.images_dir),
        (linked.stereo_dir, local.stereo_dir),
        (linked.sparse_dir, local.sparse_dir),
    ):
        if made in (linked.images_dir, linked.stereo_dir) and not is_link(made):
            continue  # no link, but a folder of links, on a disk that knows no others
        if os.path.lexists(kept):  # with files of the user
            set_aside(kept)
        move_into_place(made, kept)
    if linked.visibility_path.exists():
        symbolic_link(local.visibility_path, workspace.visibility_path)
    write_text(workspace.local_origin_path, " ".join(map(repr, origin.tolist())) + "\n")
    move_cloud(local.fused_path, linked.fused_path, origin)
