"""Folders held by one process, or by several together, until it lets go or ends, however it ends."""

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from colmap_sph.platforms.files import is_link, open_descriptor
from colmap_sph.platforms.unix import fcntl

_LOCK_FILE = ".lock"
_LONG = 1e6
"""Seconds."""


@contextmanager
def holding(folder: Path, *, shared: bool = False, wait: bool = False) -> Iterator[None]:
    """Hold a folder.

    By a lock on the folder itself. Windows has none: there it is on a file in it, by SQLite, which knows the locks
    of all systems, shared ones too. Where the disk has no locks, as some on the network, nothing is held.

    Parameters
    ----------
    folder : Path
        Exists.
    shared : bool
        Together with others who do so, but with nobody who holds it alone.
    wait : bool
        Until others let go of it.

    Raises
    ------
    BlockingIOError
        Others hold it, and it is not waited for.
    OSError
        The folder cannot be opened.
    """
    with _locked_file(folder, shared, wait) if fcntl is None else _locked_folder(folder, shared, wait):
        yield


@contextmanager
def _locked_folder(folder: Path, shared: bool, wait: bool) -> Iterator[None]:
    descriptor = open_descriptor(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise
        except OSError:  # there are no locks
            pass
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _locked_file(folder: Path, shared: bool, wait: bool) -> Iterator[None]:
    if not folder.is_dir():
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(folder))
    path = folder / _LOCK_FILE
    if is_link(path) or (path.exists() and path.stat().st_size):
        raise OSError(errno.EINVAL, f"{_LOCK_FILE} in it is not this program's; remove it", str(folder))
    with ExitStack() as opened:
        try:
            database = sqlite3.connect(path, _LONG if wait else 0.0, isolation_level=None, check_same_thread=False)
            opened.enter_context(closing(database))
            database.execute("BEGIN" if shared else "BEGIN EXCLUSIVE")
            database.execute("SELECT count(*) FROM sqlite_master")  # with this only, a shared lock is taken
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_BUSY:
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN), str(folder)) from error
            # there are no locks
        yield


def remove_lock(folder: Path) -> None:
    """Remove what locks have left in a folder that is to be removed itself; not where the folder is held."""
    if fcntl is None:
        with suppress(OSError):  # not there, or in use: Windows removes no file that is open
            (folder / _LOCK_FILE).unlink()
