"""Network file systems: what another machine has just written may not be seen for a moment.

A machine remembers for up to a minute that a file was not there, or how large it was. To open a folder makes it
ask again.
"""

import errno
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from colmap_sph.errors import InputError
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.platforms.files import look_again

R = TypeVar("R")

PATIENCE = 5.0
"""Seconds that a file which must be there is waited for."""

_FIRST_WAIT = 0.1
_MISSING = {errno.ENOENT, errno.ESTALE}


def made_with_patience(make: Callable[[], Facts], folders: Iterable[Path], patience: float = PATIENCE) -> Facts:
    """Make a result; where a file is not there, wait a little and try again.

    Parameters
    ----------
    make : callable
        Raises `InputError` because of a missing file, or names some in `Facts.unread`.
    folders : iterable of Path
        Where its files are.
    patience : float
        Seconds.
    """
    deadline = time.monotonic() + patience
    wait = _FIRST_WAIT
    while True:
        try:
            facts = make()
            if not facts.unread or time.monotonic() + wait > deadline:
                return facts
        except InputError as error:
            if not _is_of_missing_file(error) or time.monotonic() + wait > deadline:
                raise
        time.sleep(wait)
        wait *= 2
        look_again(folders)


def _is_of_missing_file(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in _MISSING:
            return True
        error = error.__cause__
    return False
