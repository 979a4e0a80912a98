"""Modules of Unix; None where the system has none of them."""

import importlib
from typing import Any


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


fcntl = _imported("fcntl")
resource = _imported("resource")
