"""Limits that Unix sets a process; Windows has none of them. Loaded first, so it imports next to nothing."""

from contextlib import suppress

from colmap_sph.platforms.unix import resource


def open_files_limit() -> int | None:
    """How many files this process may have open at a time; None where nothing limits it."""
    return _soft("RLIMIT_NOFILE")


def address_space_limit() -> int | None:
    """Bytes of addresses that this process may use, ``ulimit -v``; None where nothing limits it."""
    return _soft("RLIMIT_AS")


def data_limit() -> int | None:
    """Bytes of data that this process may have, ``ulimit -d``; None where nothing limits it."""
    return _soft("RLIMIT_DATA")


def raise_open_files_limit(wanted: int) -> None:
    """Allow this process to have so many files open at a time, or as many as it may."""
    if resource is None:
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def _soft(name: str) -> int | None:
    kind = getattr(resource, name, None)
    if kind is None:
        return None
    soft, _ = resource.getrlimit(kind)
    return None if soft == resource.RLIM_INFINITY else soft
