"""How many processors this process may use at a time."""

import os
from contextlib import suppress


def usable_cores() -> int:
    """Cores that this process may use: those it is bound to, which can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    import psutil  # not before it is needed: the program begins with this

    with suppress(AttributeError, OSError, psutil.Error):  # macOS binds no process to cores
        return len(psutil.Process().cpu_affinity())
    return os.cpu_count() or 1
