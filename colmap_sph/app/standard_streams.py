"""Standard streams that hold: closed ones are opened, and messages that nobody takes do not end the program.

This is loaded first, and imports next to nothing.
"""

import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.platforms.limits import (
    address_space_limit,
    data_limit,
    open_files_limit,
    raise_open_files_limit,
)
from colmap_sph.platforms.processes import become
from colmap_sph.platforms.processors import usable_cores
from colmap_sph.platforms.surroundings import is_console_of_windows

# What the program needs to load, and for a few threads: files open at a time, and bytes for it and for each core,
# for which linear algebra's libraries start threads of their own. Without it they crash.
_OPEN_FILES = 64
_ADDRESS_SPACE = (1 << 30, 64 << 20)
_DATA = (512 << 20, 16 << 20)
_WANTED_OPEN_FILES = 4096


def prepare_process() -> str | None:
    """Make the standard streams hold, and raise the limit of open files as far as allowed.

    Returns
    -------
    str or None
        Why the program cannot work: a sentence.
    """
    _open_what_is_closed()
    _be_in_utf8()
    if not is_console_of_windows(sys.stderr):
        raw = _Unfailing(2, "w", closefd=False)
        buffer = io.BufferedWriter(raw)
        encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
        sys.stderr = io.TextIOWrapper(buffer, encoding, errors="backslashreplace", line_buffering=True)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    raise_open_files_limit(_WANTED_OPEN_FILES)
    return _missing()


class _Unfailing(io.FileIO):
    """A descriptor whose other end may be gone or full: what is written then is lost, and nothing else.

    A run of hours does not end because the terminal or the log that it talks to has gone; what it says is in the
    workspace's log, too.
    """

    def write(self, data: Any, /) -> int:
        """Write bytes, or lose them."""
        try:
            while (written := super().write(data)) is None:  # a stream that does not block, and is full
                select.select([], [self.fileno()], [])
        except OSError:
            silence(self.fileno())
            return len(data)
        return written


def silence(descriptor: int) -> None:
    """Let all that is written to a descriptor from now on vanish, by libraries in C++ and at the end, too."""
    with suppress(OSError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, descriptor)
        os.close(null)


@contextmanager
def standard_output() -> Iterator[None]:
    """Print on the standard output, and nothing else, meanwhile.

    Raises
    ------
    OutputError
        It cannot be written. `BrokenPipeError` where its reader has seen enough.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(
            f"The standard output cannot be written ({reason_of(error)}); check its space."
        ) from error


def _open_what_is_closed() -> None:
    """A file opened later would get the number of a closed stream, and with it all messages of libraries."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free, which is this one
    if sys.stdout is None:
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), "utf-8", write_through=True)


def _be_in_utf8() -> None:
    """Start anew where names of files are taken for another encoding than that of COLMAP's models."""
    if sys.getfilesystemencoding() != "utf-8" and os.environ.get("PYTHONUTF8") != "1":
        os.environ["PYTHONUTF8"] = "1"
        become(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _missing() -> str | None:
    """A sentence about a limit of the process that is too low to load the program."""
    files = open_files_limit()
    if files is not None and files < _OPEN_FILES:
        return f"Only {files} files may be open at a time, and {_OPEN_FILES} are needed; allow more (ulimit -n)."
    for limit, option, (base, each) in (
        (address_space_limit(), "-v", _ADDRESS_SPACE),
        (data_limit(), "-d", _DATA),
    ):
        needed = 0 if limit is None else base + each * usable_cores()
        if limit is not None and limit < needed:
            return (
                f"The process may use only {limit >> 20} MiB of memory, and {needed >> 20} MiB are needed; "
                f"allow more (ulimit {option})."
            )
    return None
