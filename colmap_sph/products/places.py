"""Where products go: a folder of their own, in which nothing is replaced that is not to be."""

import os
from collections.abc import Iterable
from pathlib import Path

from colmap_sph.errors import OutputError
from colmap_sph.products.publishing import check_no_folder
from colmap_sph.project.claim import check_ways_out
from colmap_sph.project.files import real_path
from colmap_sph.project.workspace import Workspace


def check_places(workspace: Workspace, folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Raise `OutputError` where files are there already, or the folder is no place for them."""
    check_no_input(workspace, folder)
    if folder.is_relative_to(workspace.root):
        check_ways_out(workspace.root, [folder])
    for path in (folder / name for name in names):
        if os.path.lexists(path) and not overwrite:
            raise OutputError(f"{path} is there already; give --overwrite, or another --output.")
        check_no_folder(path)


def check_no_input(workspace: Workspace, folder: Path) -> None:
    """Raise `OutputError` where products would lie among a workspace's files, or among the original images."""
    inputs = (
        workspace.images_dir,
        workspace.sparse_dir,
        workspace.masks_dir,
        workspace.stereo_dir,
        workspace.tiles_dir,
        workspace.state_dir,
    )
    real = real_path(folder)
    for place in inputs:
        if real.is_relative_to(real_path(place)):
            raise OutputError(f"{folder} lies in {place}, whose files are read; choose another --output.")
    # File managers leave hidden files of the same names in many folders.
    for path in workspace.images_dir.rglob("[!.]*"):
        parts = path.relative_to(workspace.images_dir).parts
        for levels in range(len(parts)):
            # The folder may be one of those below the folder of all images.
            is_below = real.parts[len(real.parts) - levels :] == parts[:levels]
            if is_below and real.joinpath(*parts[levels:]).is_file():
                raise OutputError(
                    f"{folder} has images of the model, such as {path.name}; choose another --output."
                )
