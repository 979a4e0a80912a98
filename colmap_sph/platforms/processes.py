"""Signals that ask for the end, and processes that start others or become another program.

Loaded first, so it imports next to nothing.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

_IS_WINDOWS = sys.platform == "win32"
# Windows sends no SIGTERM. Ctrl-Break and the end of its window or session come as SIGBREAK; others have SIGHUP.
_BREAK: int | None = getattr(signal, "SIGBREAK", None)
_HANGUP: int | None = getattr(signal, "SIGHUP", None)
ENDING: tuple[int, ...] = tuple(
    number for number in (signal.SIGINT, signal.SIGTERM, _HANGUP, _BREAK) if number is not None
)
"""Numbers of the signals that ask for the end."""


def exit_code_of(number: int) -> int:
    """What a shell reports of a program that a signal ended: 130 of Ctrl-C, 143 of SIGTERM or SIGBREAK."""
    return 128 + (signal.SIGTERM if number == _BREAK else number)


@contextmanager
def held_back(number: int) -> Iterator[None]:
    """Let a signal wait meanwhile, where the system can."""
    if sys.platform == "win32" or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})


def apart() -> dict[str, Any]:
    """Arguments of `subprocess.Popen` for a process that Ctrl-C in this one's terminal does not reach."""
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


def become(program: str, arguments: Sequence[str]) -> None:
    """Let another program take this one's place, for whoever waits for it; raises `OSError`.

    Parameters
    ----------
    program : str
        Its file.
    arguments : sequence of str
        All of them, the name first.
    """
    if _IS_WINDOWS:  # whose exec ends this process at once, and leaves the other alone
        raise SystemExit(subprocess.call([program, *arguments[1:]]))
    os.execv(program, list(arguments))
