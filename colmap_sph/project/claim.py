"""A workspace for one run, or for jobs that share it: no link leads out, and no other is at work there."""

import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.platforms.files import is_junction, is_link
from colmap_sph.platforms.locks import holding, remove_lock
from colmap_sph.project.files import make_dir, remove, remove_temporary_files
from colmap_sph.project.workspace import Workspace


@contextmanager
def claimed(workspace: Workspace) -> Iterator[None]:
    """Hold a workspace for one run, and remove temporary files of runs that were killed in it.

    The claim is a lock on its folder ``colmap_sph``, which the system drops with the process however that ends.
    The folder is created where missing, and removed again where nothing came into it.

    Raises
    ------
    OutputError
        Another run holds the workspace, or the folder cannot be made.
    """
    folder = workspace.state_dir
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    make_dir(folder)
    try:
        with _held(workspace):
            remove_leftovers(workspace)
            yield
    finally:
        if created:
            remove_lock(folder)
        for path in created:
            with suppress(OSError):  # not empty
                path.rmdir()


@contextmanager
def shared(workspace: Workspace) -> Iterator[None]:
    """Hold a workspace together with others that do so, but with nobody who holds it alone.

    What other processes have not finished is left alone.

    Raises
    ------
    OutputError
        A run holds the workspace for itself, or its folder ``colmap_sph`` is not there.
    """
    with _held(workspace, shared=True):
        yield


def check_folder(root: Path) -> None:
    """Raise `OutputError` where something that is no folder, or may not be written, is in a workspace's way."""
    there = next((path for path in (root, *root.parents) if os.path.lexists(path)), None)
    if there is not None and not there.is_dir():
        raise OutputError(f"{there} is no folder; choose another --output.")
    if there not in (None, root) and not os.access(there, os.W_OK | os.X_OK):
        raise OutputError(
            f"The folder {root} cannot be created: {there.absolute()} may not be written; give another --output."
        )


def check_links(workspace: Workspace, *, is_given: bool) -> None:
    """Raise `OutputError` where a link would have a run write or delete outside of the workspace.

    The workspace itself may be reached through links, and links from one place in it to another are as good as
    folders.

    Parameters
    ----------
    workspace : Workspace
        Need not exist.
    is_given : bool
        Whether its images, model and masks are the user's, which are only read and may be anywhere.
    """
    written = [workspace.state_dir, workspace.stereo_dir, workspace.tiles_dir, *workspace.cloud_paths]
    # Both are removed as a whole before anything is written there, and have links of our own inside.
    remade = {workspace.local_dir, workspace.fusion_scratch_dir}
    check_ways_out(workspace.root, written, unlinked=remade)
    if not is_given:
        made = (workspace.images_dir, workspace.sparse_dir, workspace.masks_dir)
        check_ways_out(workspace.root, made, remedy="give the folder as --workspace, which only reads there")


def check_ways_out(
    root: Path,
    places: Iterable[Path],
    *,
    unlinked: Collection[Path] = (),
    remedy: str = "choose another --output",
) -> None:
    """Raise `OutputError` where a link at one of the places, or in the folders there, leads out of a folder.

    Parameters
    ----------
    root : Path
        The folder.
    places : iterable of Path
        Files and folders in it; need not exist.
    unlinked : collection of Path
        Folders that must not be links at all, and are not looked into.
    remedy : str
        What the user may do instead.
    """
    top = Path(os.path.realpath(root))
    waiting = list(places)
    seen: set[Path] = set()
    while waiting:
        path = waiting.pop()
        target = Path(os.path.realpath(path))
        if is_link(path) and (path in unlinked or not target.is_relative_to(top)):
            raise OutputError(
                f"{path} is a link to {target}, where this program would write and delete; put a folder or file "
                f"of its own in its place, or {remedy}."
            )
        if path not in unlinked and target not in seen:
            seen.add(target)
            waiting += _folders_and_links(path)


def _folders_and_links(folder: Path) -> list[Path]:
    with suppress(OSError), os.scandir(folder) as entries:
        return [Path(each.path) for each in entries if _is_folder_or_link(each)]
    return []


def _is_folder_or_link(entry: os.DirEntry[str]) -> bool:
    return entry.is_symlink() or entry.is_dir(follow_symlinks=False) or is_junction(Path(entry.path))


@contextmanager
def _held(workspace: Workspace, *, shared: bool = False) -> Iterator[None]:
    with ExitStack() as held:
        try:
            held.enter_context(holding(workspace.state_dir, shared=shared))
        except BlockingIOError as error:
            raise OutputError(
                f"Another run is at work in {workspace.root}, or a product is being made of it; wait for its end "
                "or choose another --output."
            ) from error
        except OSError as error:
            raise OutputError(
                f"{workspace.state_dir} cannot be used ({reason_of(error)}); check permissions."
            ) from error
        yield


def remove_leftovers(workspace: Workspace) -> None:
    """Remove what processes that were killed left behind in a workspace that is held."""
    # First: with it other machines that still work for a run that was killed lose the right to write here.
    remove(workspace.token_path)
    shutil.rmtree(workspace.fusion_scratch_dir, ignore_errors=True)
    for folder in (workspace.stereo_dir, workspace.state_dir):
        remove_temporary_files(folder)
