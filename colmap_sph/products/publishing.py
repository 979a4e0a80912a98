"""Files that other libraries write: under temporary names, and in their places only when all is complete."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.project.files import make_dir, process_name, sync_file, sync_folder


@contextmanager
def published(path: Path) -> Iterator[Path]:
    """A temporary path for a file, which becomes `path` when all went well, and is removed when not.

    Raises
    ------
    OutputError
        It cannot be written: a full disk, permissions, a folder in the way.
    """
    make_dir(path.parent)
    temporary = path.parent / f".{process_name()}-{path.name}"
    try:
        if path.is_dir():
            raise OutputError(f"{path} is a folder, and a file goes there; remove it or choose another --output.")
        yield temporary
        sync_file(temporary)
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({reason_of(error)}); check space and permissions, or choose another "
            "--output."
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def scratch_beside(path: Path) -> Iterator[Path]:
    """An empty folder beside a temporary path, which is removed with all that is in it."""
    folder = path.with_name(f"{path.name}.parts")
    shutil.rmtree(folder, ignore_errors=True)  # of a process with the same number that was killed
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
