"""Files as each system has them: opened, waited for, put in another's place, and links told from folders."""

import errno
import os
import stat
import sys
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import psutil

from colmap_sph.platforms.unix import fcntl

# Flags that a system lacks ask for what it does anyway, or cannot do. Without O_BINARY, Windows would change line
# ends; O_NONBLOCK does not wait for whoever is at the other end of a pipe.
_ALWAYS = sum(getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NOINHERIT", "O_BINARY", "O_NONBLOCK"))
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)
_FOLDER = getattr(os, "O_DIRECTORY", 0)
# Unix opens folders as it does files, and replaces and removes files that are open. Windows does neither.
_IS_UNIX = bool(_FOLDER)
# What a file system answers that cannot sync at all: there is nothing to wait for then.
_NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.ENOSYS}
# Seconds for others to let go of a file: a virus scanner or an indexer does so soon.
_PATIENCE = 2.0
_LONGEST_WAIT = 0.2
# Seconds to find out who has a file open.
_SEARCH = 5.0
_ROOM_BYTES = 1 << 20


def open_descriptor(path: Path, flags: int, *, follow: bool = True) -> int:
    """Open a file, and neither wait for the other end of a pipe nor change line ends.

    Parameters
    ----------
    path : Path
    flags : int
        As of `os.open`, without those that only some systems have.
    follow : bool
        Whether it may be a link. Windows looks just after it has opened the file; whoever changes the folder at
        that moment can deceive it.

    Raises
    ------
    OSError
        It cannot be opened, or is a link.
    """
    descriptor = os.open(path, flags | _ALWAYS | (0 if follow else _NO_LINK), 0o666)
    if not follow and not _NO_LINK and is_link(path):
        os.close(descriptor)
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return descriptor


def is_link(path: Path) -> bool:
    """Whether a path is itself a symbolic link or, on Windows, a junction, which leads elsewhere just so."""
    return path.is_symlink() or is_junction(path)


def plain_path(path: Path) -> Path:
    """The same place as an absolute path without ``..``, through the links that are typed: only where ``..`` goes
    back over one, by where that leads to. Windows takes ``..`` out of the text before it looks at any link.

    What may not be looked at counts as a folder: nothing leads through it either, as whoever opens the path tells.
    """
    typed = Path.cwd() / path
    if sys.platform == "win32":
        return Path(os.path.normpath(typed))
    plain = Path(typed.anchor)
    for part in typed.parts[1:]:
        if part != "..":
            plain = plain / part
            continue
        with suppress(PermissionError):
            plain = Path(os.path.realpath(plain)) if is_link(plain) else plain
        plain = plain.parent
    return plain


def is_junction(path: Path) -> bool:
    """Whether a path is a junction of Windows; Python before 3.12 takes it for a folder."""
    if sys.platform == "win32":
        with suppress(OSError):
            return path.lstat().st_reparse_tag == stat.IO_REPARSE_TAG_MOUNT_POINT
    return False


def sync_descriptor(descriptor: int) -> None:
    """Wait until the disk has a file's content; at once on file systems that cannot tell. Raises `OSError`."""
    try:
        if hasattr(fcntl, "F_FULLFSYNC"):
            # macOS: its fsync comes back when the disk has them in a cache of its own, which a power cut empties.
            with suppress(OSError):  # not known by all file systems
                fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
                return
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_SYNC:
            raise


def sync_file(path: Path) -> None:
    """Wait until the disk has a file's content; raises `OSError`."""
    # Windows waits only for who may write.
    descriptor = open_descriptor(path, os.O_RDONLY if _IS_UNIX else os.O_RDWR)
    try:
        sync_descriptor(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until the disk has the names in a folder; raises `OSError`.

    Windows opens no folders: there the journal of the file system brings names to the disk, in their order.
    """
    if _IS_UNIX:
        with suppress(PermissionError):  # one that may be written to, but not read
            sync_file(folder)


def look_again(folders: Iterable[Path]) -> None:
    """Forget what this machine remembers of folders on the network; need not exist."""
    for folder in folders:
        with suppress(OSError):
            if _IS_UNIX:
                os.close(open_descriptor(folder, os.O_RDONLY | _FOLDER))
            else:
                os.scandir(folder).close()


def move_into_place(source: Path, target: Path) -> None:
    """Give a file or folder another name, in place of the file that has it, in one step.

    Windows refuses while a program has one of them open, or a file in a folder that is renamed. Most let go of it
    soon, so it is tried for two seconds.

    Raises
    ------
    OSError
        It cannot be done; of a file that stays open, with the name of the program that has it.
    """
    deadline = time.monotonic() + _PATIENCE
    wait = 0.01
    while True:
        try:
            source.replace(target)
            return
        except PermissionError as error:
            if _IS_UNIX:
                raise
            if time.monotonic() + wait > deadline:
                raise _told(error, target) from error
        time.sleep(wait)
        wait = min(2 * wait, _LONGEST_WAIT)


def _told(error: PermissionError, target: Path) -> PermissionError:
    """The same error, which names the programs that have a file open, as far as that can be found out."""
    names: list[str] = []
    # Windows may be slow to tell, or not come back at all.
    search = threading.Thread(target=_find_holders, args=(target, names), daemon=True)
    search.start()
    search.join(_SEARCH)
    if not names:
        return error
    return PermissionError(error.errno, f"it is open in {', '.join(sorted(names))}; close it there", str(target))


def _find_holders(path: Path, names: list[str]) -> None:
    """Name programs that have a file open, or one in a folder; of others' programs the system tells nothing."""
    place = Path(os.path.realpath(path))
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if any(place in (Path(each.path), *Path(each.path).parents) for each in process.open_files()):
                names.append(f"{process.name()} (process {process.pid})")


def write_text(path: Path, text: str) -> None:
    """Write a text file as it is on all systems: in UTF-8, with line ends of one byte. Raises `OSError`."""
    path.write_text(text, encoding="utf-8", newline="\n")


def take_room(descriptor: int, size: int) -> None:
    """Give a new file so many bytes of room on the disk; raises `OSError` where there is none."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
        return
    for first in range(0, size, _ROOM_BYTES):
        os.write(descriptor, bytes(min(_ROOM_BYTES, size - first)))
