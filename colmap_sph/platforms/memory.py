"""Memory of this machine and this process, and what the system allows it."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import suppress

import psutil

from colmap_sph.platforms.limits import address_space_limit, data_limit
from colmap_sph.platforms.unix import resource

# Taken for what is in use, where the system does not say.
_UNKNOWN_USED = 200 << 20
# Of glibc's mallopt: its parameters' numbers, and the largest threshold that it comes to by itself.
_TRIM_THRESHOLD = -1
_TOP_PAD = -2
_MMAP_THRESHOLD = -3
_MMAP_BYTES = 32 << 20


def available() -> int | None:
    """Bytes that new work may have on this machine without swapping; None where the system does not say."""
    with suppress(OSError, psutil.Error):
        return int(psutil.virtual_memory().available)
    return None


def resident() -> int:
    """Bytes of memory this process has in use."""
    with suppress(OSError, psutil.Error):
        return int(psutil.Process().memory_info().rss)
    return _UNKNOWN_USED


def most_resident() -> int:
    """The most bytes of memory that this process had in use."""
    if resource is None:
        with suppress(AttributeError, OSError, psutil.Error):
            return int(psutil.Process().memory_info().peak_wset)
        return resident()
    unit = 1 if sys.platform == "darwin" else 1024
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit


def free_under_limits() -> Iterator[int]:
    """Bytes left under ``ulimit -v`` and ``ulimit -d``, where this process has such limits."""
    limits = {"vms": address_space_limit(), "data": data_limit()}
    with suppress(OSError, psutil.Error):
        used = psutil.Process().memory_info()
        for field, limit in limits.items():
            if limit is not None and hasattr(used, field):
                yield limit - getattr(used, field)


def keep_freed_memory() -> None:
    """Have arrays of an image's size come from what others have left, not from the system's cleared pages.

    By itself glibc does so only for sizes that it has seen, and gives back what lies at the end of its heaps; of
    threads, whole heaps (64 MiB), unless padding fills what is free in the heap before them. Dask
    has its workers give all freed memory back at once, which made matching take half as long again. Other C
    libraries do as they do.
    """
    with suppress(OSError, AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_TRIM_THRESHOLD, 2 * _MMAP_BYTES)
        mallopt(_TOP_PAD, 2 * _MMAP_BYTES)
        mallopt(_MMAP_THRESHOLD, _MMAP_BYTES)


def give_back_freed_memory() -> None:
    """Give the system back what has been freed: glibc keeps what lies between memory in use, much after large
    images. Other C libraries do as they do.
    """
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def process_start_time() -> float | None:
    """When this process was started, in seconds since 1970; None where the system does not say."""
    with suppress(OSError, psutil.Error):
        return float(psutil.Process().create_time())
    return None
