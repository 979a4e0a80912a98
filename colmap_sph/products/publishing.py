"""Files and folders that other libraries write: in their places only when all is complete, and marked as ours."""

import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.platforms.files import move_into_place, sync_file, sync_folder, write_text
from colmap_sph.platforms.locks import holding, remove_lock
from colmap_sph.project.files import atomic_file, make_dir

MARK = "made_by_colmap_sph.txt"
"""A file in each folder that an export made, and may replace."""
_EARLIER = "earlier"


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Errors of the system while `path` is written, as one sentence about it."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({reason_of(error)}); check space and permissions, or choose another "
            "--output."
        ) from error


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Make a folder for products, and hold it: another command would take our temporary files for leftovers.

    Raises
    ------
    OutputError
        Another command is at work there, or the folder cannot be made.
    """
    new = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    with ExitStack() as held:
        for each in reversed(new):
            held.callback(_remove_empty, each)
        make_dir(folder)
        held.callback(remove_lock, folder)
        try:
            held.enter_context(holding(folder))
        except BlockingIOError as error:
            raise OutputError(
                f"Another command is at work in {folder}; wait for its end, or choose another --output."
            ) from error
        except OSError as error:
            raise OutputError(f"{folder} cannot be used ({reason_of(error)}); choose another --output.") from error
        yield


def _remove_empty(folder: Path) -> None:
    """Remove a folder in which nothing was made."""
    with suppress(OSError):
        folder.rmdir()


@contextmanager
def published(path: Path) -> Iterator[Path]:
    """A temporary path for a file, which becomes `path` when all went well, and is removed when not.

    Raises
    ------
    OutputError
        It cannot be written: a full disk, permissions, a folder in the way.
    """
    make_dir(path.parent)
    temporary = path.parent / f".{path.name}.part"
    try:
        with told(path):
            temporary.unlink(missing_ok=True)  # of a process that was killed
            check_no_folder(path)
            yield temporary
            sync_file(temporary)
            move_into_place(temporary, path)
            sync_folder(path.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def scratch_beside(path: Path) -> Iterator[Path]:
    """An empty folder beside a temporary path, which is removed with all that is in it."""
    folder = path.with_name(f"{path.name}.parts")
    shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed
    folder.mkdir()  # a new one, never one that a link leads to
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def published_folder(path: Path) -> Iterator[Path]:
    """An empty folder under a temporary name, which becomes `path` when all went well.

    A folder of an earlier export in its place is kept until another is there; a kill before loses neither.

    Raises
    ------
    OutputError
        It cannot be written, or something else is in its place.
    """
    clear_leftovers(path)
    check_replaceable(path)
    make_dir(path.parent)
    with scratch_beside(path.with_name(f".{path.name}")) as scratch:
        made = scratch / "made"
        try:
            with told(path):
                made.mkdir()
                yield made
                mark = f"Made by colmap_sph {version('colmap_sph')}, which replaces this folder.\n"
                write_text(made / MARK, mark)
                if path.exists():
                    move_into_place(path, scratch / _EARLIER)
                move_into_place(made, path)
                sync_folder(path.parent)
        finally:
            _put_back(path)


def clear_leftovers(path: Path) -> None:
    """Remove what is left of a product half-made, where a process was killed; one that it replaced is put back."""
    _put_back(path)
    part = path.with_name(f".{path.name}.part")
    for folder in (path.with_name(f".{path.name}.parts"), part.with_name(f"{part.name}.parts")):
        shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        part.unlink(missing_ok=True)


def _put_back(path: Path) -> None:
    """Give the folder of an earlier export its place, where none has come into it."""
    earlier = path.with_name(f".{path.name}.parts") / _EARLIER
    if os.path.lexists(earlier) and not os.path.lexists(path):
        with told(path):
            move_into_place(earlier, path)


def check_replaceable(path: Path) -> None:
    """Raise `OutputError` where something is in the way that no export has made."""
    if os.path.lexists(path) and not (path / MARK).is_file():
        raise OutputError(f"{path} is there already, and no export made it; choose another --output.")


def check_no_folder(path: Path) -> None:
    """Raise `OutputError` where a folder is in the place of a file."""
    if path.is_dir():
        raise OutputError(f"{path} is a folder, and a file goes there; remove it or choose another --output.")


def write_picture(path: Path, colours: NDArray[np.uint8]) -> None:
    """Write (h, w, 3) red, green and blue as PNG; `OutputError` where it cannot be written."""
    data = cv2.imencode(".png", colours[..., ::-1])[1].tobytes()
    with atomic_file(path) as file:
        file.write(data)
