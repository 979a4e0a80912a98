"""COLMAP's library: its version, and its own messages, which it writes straight to the terminal."""

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap

COLMAP_VERSION: str = pycolmap.__version__


@contextmanager
def quiet_colmap(least: int = int(pycolmap.logging.WARNING)) -> Iterator[None]:
    """Keep COLMAP's messages to those of a level or above: by default warnings and errors."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = least
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
