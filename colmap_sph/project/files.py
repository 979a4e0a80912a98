"""Folders and files made, read and removed for the user: errors are sentences, no file is ever half-written."""

import errno
import os
import re
import shutil
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

import xxhash

from colmap_sph.errors import InputError, OutputError, reason_of, unwritable
from colmap_sph.platforms.files import (
    is_link,
    move_into_place,
    open_descriptor,
    sync_descriptor,
    sync_folder,
)
from colmap_sph.platforms.locks import holding

# What a file is called until it is complete: short, so that it fits wherever the real name fits. One for each file
# that a thread writes at a time; processes of other machines may have the same number. Earlier versions did not
# name the machine.
_TEMPORARY_NAME = ".{process}-{thread}-{depth}.tmp"
SCRATCH_ENDING = "-0-0.tmp"
"""Of a scratch folder's name, which begins with a dot, so that `remove_temporary_files` takes it for one."""
_TEMPORARY = re.compile(r"\.([\w-]{1,48}-)?\d+-\d+\.tmp")
_open_files = threading.local()
_check_before_writing: ContextVar[Callable[[], None] | None] = ContextVar("check_before_writing", default=None)
_READ_BYTES = 1 << 17
_HOST_LETTERS = 32


def process_name() -> str:
    """Name of this process among those of all machines that share a folder: host and number."""
    host = re.sub(r"[^\w-]", "_", socket.gethostname(), flags=re.ASCII)[:_HOST_LETTERS] or "_"
    return f"{host}-{os.getpid()}"


def make_dir(folder: Path) -> None:
    """Create `folder` and its parents; `OutputError` where that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"The folder {folder} cannot be created ({reason_of(error)}); choose another --output."
        ) from error


def real_path(path: Path) -> Path:
    """Where a path leads to, through all links; one that leads to itself is taken as it is."""
    return Path(os.path.realpath(path))


def free_space(path: Path) -> int:
    """Free bytes on the disk where a file or folder is, or would be."""
    return shutil.disk_usage(next(each for each in (path, *path.absolute().parents) if each.exists())).free


class NewFile:
    """A file that is being written, and the digest of what has been written to it so far."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._state = xxhash.xxh3_128()

    def write(self, data: bytes | memoryview) -> int:
        """Append bytes."""
        self._state.update(data)
        return self._file.write(data)

    @property
    def digest(self) -> str:
        """As `whole_digest` of the file."""
        return self._state.hexdigest()


@contextmanager
def atomic_file(path: Path, *, sync: bool = True) -> Iterator[NewFile]:
    """Open a file for writing that appears under its name only when it is complete, and on the disk.

    The bytes go to a temporary name in the same folder, which then replaces `path` in one step; after an
    error, an interruption or a power cut `path` is as it was, or complete.

    Parameters
    ----------
    path : Path
    sync : bool
        Whether to wait until the disk has it. Not for what is thrown away with the run.

    Raises
    ------
    OutputError
        The file cannot be written: permissions, a full disk, a folder in the way.
    """
    depth = getattr(_open_files, "number", 0)
    _open_files.number = depth + 1
    name = _TEMPORARY_NAME.format(process=process_name(), thread=threading.get_ident(), depth=depth)
    temporary = path.parent / name
    try:
        temporary.unlink(missing_ok=True)  # of a process with the same number that was killed
        with temporary.open("xb") as file:  # a new file, never one that a link leads to
            yield NewFile(file)
            file.flush()
            if sync:
                sync_descriptor(file.fileno())
        check = _check_before_writing.get()
        if check is not None:
            check()
        move_into_place(temporary, path)
        if sync:
            sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error
    finally:
        _open_files.number = depth
        with suppress(OSError):  # not there, or on a disk that has become read-only
            temporary.unlink()


@contextmanager
def writing_only_if(check: Callable[[], None]) -> Iterator[None]:
    """Call `check` before each file that `atomic_file` completes meanwhile; where it raises, there is no file."""
    token = _check_before_writing.set(check)
    try:
        yield
    finally:
        _check_before_writing.reset(token)


def open_regular(path: Path, *, follow: bool = True) -> BufferedReader:
    """Open a file for reading: a regular one, never a pipe or device, for which one could wait for ever.

    Parameters
    ----------
    path : Path
    follow : bool
        Whether it may be a link to a file.

    Raises
    ------
    OSError
        It is not there, cannot be opened, or is no regular file.
    """
    descriptor = open_descriptor(path, os.O_RDONLY, follow=follow)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_small(path: Path, max_bytes: int, *, follow: bool = True) -> bytes:
    """Read a whole file that cannot be large; otherwise as `open_regular`, and `OSError` for a larger one."""
    with open_regular(path, follow=follow) as file:
        if os.fstat(file.fileno()).st_size > max_bytes:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
        return file.read()


def whole_digest(path: Path) -> str:
    """Digest of every byte of a file: 32 hexadecimal digits.

    It finds damage; against someone who wants two files to have the same one it is no help.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    state = xxhash.xxh3_128()
    try:
        with open_regular(path) as file:
            while block := file.read(_READ_BYTES):
                state.update(block)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); check its permissions.") from error
    return state.hexdigest()


def set_aside(path: Path) -> Path:
    """Give a file, link or folder another name beside it, ``NAME.backup``, ``NAME.backup2`` …, and return that.

    Raises
    ------
    OutputError
        It cannot be renamed.
    """
    number = 1
    backup = path.with_name(f"{path.name}.backup")
    while os.path.lexists(backup):
        number += 1
        backup = path.with_name(f"{path.name}.backup{number}")
    try:
        move_into_place(path, backup)
    except OSError as error:
        raise OutputError(f"{path} cannot be set aside ({reason_of(error)}); check permissions.") from error
    return backup


@contextmanager
def folder_locked(folder: Path) -> Iterator[None]:
    """Wait until nobody else who calls this is at work in a folder; at once on disks that know no locks."""
    with holding(folder, wait=True):
        yield


def remove_temporary_files(folder: Path) -> None:
    """Remove what `atomic_file` left half-written below a folder, in a process that was killed; folders, too."""
    for path in list(folder.rglob(".*.tmp")):
        if _TEMPORARY.fullmatch(path.name):
            with suppress(OutputError):  # nothing takes it for the file itself
                remove(path)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it; `OutputError` where that is impossible."""
    try:
        if path.is_dir() and not is_link(path):
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path} cannot be removed ({reason_of(error)}); check permissions.") from error


@contextmanager
def scratch_folder(scratch: Path) -> Iterator[None]:
    """Start with an empty scratch folder and leave nothing behind, on success as on failure."""
    shutil.rmtree(scratch, ignore_errors=True)
    make_dir(scratch)
    try:
        yield
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
