"""Folders and files made for the user: errors are sentences, and no file is ever half-written."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from colmap_sph.errors import OutputError, reason_of


def make_dir(folder: Path) -> None:
    """Create `folder` and its parents; `OutputError` where that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"The folder {folder} cannot be created ({reason_of(error)}); choose another --output."
        ) from error


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
    # Short, so that it fits wherever the real name fits; one per thread, which writes one file at a time.
    temporary = path.parent / f".{os.getpid()}-{threading.get_ident()}.tmp"
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
