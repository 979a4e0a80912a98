"""Where products go: a folder, in which nothing is replaced that is not to be."""

import os
from collections.abc import Iterable
from pathlib import Path

from colmap_sph.errors import OutputError
from colmap_sph.products.publishing import check_no_folder
from colmap_sph.project.claim import check_ways_out
from colmap_sph.project.workspace import Workspace


def check_places(workspace: Workspace, folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Raise `OutputError` where files are there already, or links lead the folder out of the workspace."""
    if folder.is_relative_to(workspace.root):
        check_ways_out(workspace.root, [folder])
    for path in (folder / name for name in names):
        if os.path.lexists(path) and not overwrite:
            raise OutputError(f"{path} is there already; give --overwrite, or another --output.")
        check_no_folder(path)
