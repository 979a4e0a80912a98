"""What is around a program: terminals, a screen, ports."""

import io
import os
import sys
from typing import Any

_IS_WINDOWS = sys.platform == "win32"


def is_console_of_windows(stream: Any) -> bool:
    """Whether Python writes to a stream by the calls of Windows' console, which take letters of all languages.

    The console reads bytes written to its descriptor in another alphabet.
    """
    return _IS_WINDOWS and isinstance(stream, io.TextIOWrapper) and stream.isatty()


def has_screen() -> bool:
    """Whether a browser can show something: without a desktop Linux has only those for the terminal."""
    names = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in names)


REUSES_PORTS = not _IS_WINDOWS
"""Whether a server may ask for a port whose last server has just ended: on Windows it would get one in use."""
