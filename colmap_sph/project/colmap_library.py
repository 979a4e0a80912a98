"""COLMAP's library: its version, and its own messages, which it writes straight to the terminal."""

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap

COLMAP_VERSION: str = pycolmap.__version__


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's messages to warnings and errors."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
