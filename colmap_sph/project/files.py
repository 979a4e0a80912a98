"""Folders and files made and removed for the user: errors are sentences, and no file is ever half-written."""

import errno
import os
import re
import shutil
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from colmap_sph.errors import OutputError, reason_of

# What a file is called until it is complete: short, so that it fits wherever the real name fits; one per thread,
# which writes one file at a time.
_TEMPORARY_NAME = ".{process}-{thread}.tmp"
_TEMPORARY = re.compile(r"\.\d+-\d+\.tmp")


def make_dir(folder: Path) -> None:
    """Create `folder` and its parents; `OutputError` where that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"The folder {folder} cannot be created ({reason_of(error)}); choose another --output."
        ) from error


def free_space(path: Path) -> int:
    """Free bytes on the disk where a file or folder is, or would be."""
    return shutil.disk_usage(next(each for each in (path, *path.absolute().parents) if each.exists())).free


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file, or a link to one, for reading its bytes.

    Raises
    ------
    OSError
        It cannot be opened, or is something else: a pipe would keep the reader waiting for ever, a device may
        never end. For the caller to put into a sentence.
    """
    # Without waiting for somebody to write into a pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is not a regular file", str(path))


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that appears under its name only when it is complete.

    The bytes go to a temporary name in the same folder, which then replaces `path` in one step; after an
    error or an interruption `path` is as it was.

    Raises
    ------
    OutputError
        The file cannot be written: permissions, a full disk, a folder in the way.
    """
    name = _TEMPORARY_NAME.format(process=os.getpid(), thread=threading.get_ident())
    temporary = path.parent / name
    try:
        with temporary.open("wb") as file:
            yield file
        temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"{path} cannot be written ({reason_of(error)}); check space and permissions."
        ) from error
    finally:
        with suppress(OSError):  # not there, or on a disk that has become read-only
            temporary.unlink()


def remove_temporary_files(folder: Path) -> None:
    """Remove what `atomic_file` left half-written below a folder, in a process that was killed."""
    for path in folder.rglob(".*.tmp"):
        if _TEMPORARY.fullmatch(path.name):
            with suppress(OSError):  # nothing takes it for the file itself
                path.unlink()


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it; `OutputError` where that is impossible."""
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path} cannot be removed ({reason_of(error)}); check permissions.") from error
