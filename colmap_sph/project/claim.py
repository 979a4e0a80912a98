"""One run at a time in a workspace; and what a killed one left half-written there is removed."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from colmap_sph.errors import OutputError
from colmap_sph.project.files import make_dir, remove_temporary_files
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
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        _lock(descriptor, workspace)
        _remove_leftovers(workspace)
        yield
    finally:
        os.close(descriptor)
        for path in created:
            with suppress(OSError):  # not empty
                path.rmdir()


def _lock(descriptor: int, workspace: Workspace) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OutputError(
            f"Another run is at work in {workspace.root}; wait for its end or choose another --output."
        ) from error
    except OSError:  # some network file systems have no locks
        pass


def _remove_leftovers(workspace: Workspace) -> None:
    shutil.rmtree(workspace.fusion_scratch_dir, ignore_errors=True)
    for folder in (workspace.stereo_dir, workspace.state_dir):
        remove_temporary_files(folder)
