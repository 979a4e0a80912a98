"""Folders in the places of files that a run writes: told before it works for hours, not when it writes them."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path

from colmap_sph.errors import OutputError
from colmap_sph.platforms.files import is_link
from colmap_sph.project.state.array_file import SUFFIX
from colmap_sph.project.workspace import Workspace


def check_no_folders(workspace: Workspace, files: Iterable[Path] = ()) -> None:
    """Raise `OutputError` where a folder is in the place of a file.

    Parameters
    ----------
    workspace : Workspace
        Need not exist.
    files : iterable of Path
        What a run writes there, beside disparity maps and what it writes for all images together. They are many,
        and gone through only where a folder is called as files are.
    """
    below = chain.from_iterable(map(_folders_below, (workspace.state_dir, workspace.stereo_dir)))
    folders = {path for path in below if path.suffix}
    folders.update(path for path in workspace.cloud_paths if path.is_dir() and not is_link(path))
    if not folders:
        return
    pairs = (
        path for path in sorted(folders) if path.suffix == SUFFIX and path.parent.parent == workspace.pairs_dir
    )
    for path in chain(pairs, workspace.state_files, files):
        if path in folders:
            raise OutputError(f"{path} is a folder, and a file goes there; remove it, or give it another name.")


def _folders_below(root: Path) -> Iterator[Path]:
    waiting = [root]
    while waiting:
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            found = [Path(each.path) for each in entries if each.is_dir(follow_symlinks=False)]
            waiting += found
            yield from found
