"""The memory budget of a run: what is left of it, and a gate that work passes only with its share."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from colmap_sph.errors import OptionError
from colmap_sph.platforms import control_groups
from colmap_sph.platforms.memory import available, free_under_limits, give_back_freed_memory, resident

_UNITS = {"": 0, "K": 1, "M": 2, "G": 3, "T": 4}
# Of the memory that is free when a run starts, what it takes by itself.
_SAFE_SHARE = 0.7
# What the allocators and the interpreter keep beyond the arrays that are counted.
_SLACK = 1.15
# What a run tries to use of a machine whose memory others have taken: it swaps.
_LEAST = 256 << 20
# Taken for what is free where the system does not say.
_UNKNOWN_FREE = 4 << 30


def parse_memory(text: str) -> int:
    """Bytes of an amount such as "6GiB", "1500 MB" or "2G" (binary, as "2GiB"); 0 for an empty text.

    Raises
    ------
    OptionError
        Not an amount, or nothing.
    """
    if not text:
        return 0
    match = re.fullmatch(r"\s*(\d{1,15}(?:\.\d*)?)\s*([KMGT]?)(i?B)?\s*", text, re.IGNORECASE)
    if not match:
        shown = text if len(text) <= 40 else f"{text[:40]}…"
        raise OptionError(f"memory must be an amount such as 6GiB or 1500MB, not {shown!r}.", "memory")
    number, unit, suffix = match.groups()
    base = 1000 if suffix is not None and suffix.upper() == "B" else 1024
    amount = int(float(number) * base ** _UNITS[unit.upper()])
    if amount == 0:
        raise OptionError(
            f"memory must be more than {text!r}; leave it out for a safe share of what is free.", "memory"
        )
    return amount


def format_memory(amount: float) -> str:
    """Amount in MiB or GiB (below one, in KiB or bytes), rounded up, as `parse_memory` reads it."""
    if amount < 1 << 20:
        return f"{int(-(-amount // 1024))}KiB" if amount >= 1024 else f"{int(amount)}B"
    mebibytes = int(-(-amount // (1 << 20)))
    return f"{mebibytes}MiB" if mebibytes < 10240 else f"{-(-mebibytes // 1024)}GiB"


def budget(wanted: int) -> int:
    """Bytes a run may use: what is `wanted`, or (0) a safe share of what this process has free."""
    return wanted or int(_SAFE_SHARE * _free()) + resident()


def _free() -> int:
    """Bytes free on the machine, in this process's control groups, and under its own limits."""
    machine = available()
    free = _UNKNOWN_FREE if machine is None else max(machine, _LEAST)
    limits = (control_groups.free_memory(), *free_under_limits())
    return max(min([free, *(limit for limit in limits if limit is not None)]), 0)


@cache
def _at_start() -> int:
    """Bytes in use when the process asks first: before any stage, so that a dry run and the run ask alike."""
    return resident()


class MemoryGate:
    """Lets work begin when its share of a budget is free.

    Parameters
    ----------
    total : int
        Bytes of the whole process, what it has in use already among them.
    threads : int
        Workers that share them.
    in_use : int, optional
        What the process has in use already; without it, it is this process.
    source : str
        Where `total` comes from, for the message where it is too little.
    """

    def __init__(
        self,
        total: int,
        threads: int = 1,
        *,
        in_use: int | None = None,
        source: str = "--memory, or a share of what is free",
    ) -> None:
        self.threads = threads
        self._total = total
        self._outside = resident() if in_use is None else in_use
        self._needed_anyway = min(self._outside, _at_start()) if in_use is None else in_use
        self._source = source
        self._reserved = 0
        self._changed = threading.Condition()

    @property
    def free(self) -> int:
        """Bytes of the budget that neither the process has in use nor caches keep."""
        return max(self._total - self._outside, 0)

    def spare(self, needed: float) -> float:
        """Bytes for caches: of what is free, what the largest piece of work, of `needed` bytes, leaves."""
        return max(self.free - needed, 0)

    @contextmanager
    def keeping(self, amount: int) -> Iterator[None]:
        """Take `amount` bytes for caches and scratch memory; no work is under way when this begins or ends."""
        self._outside += amount
        self._needed_anyway += amount
        try:
            yield
        finally:
            self._outside -= amount
            self._needed_anyway -= amount

    def check(self, amount: float, what: str) -> int:
        """Bytes to reserve for `amount` bytes of arrays; `OptionError` where they never fit."""
        needed = int(_SLACK * amount)
        if self._needed_anyway + needed > self._total:
            raise OptionError(
                f"{format_memory(self._total)} of memory ({self._source}) is too little for "
                f"{what}; {format_memory((self._needed_anyway + needed) * 1.05)} would do."
            )
        return needed

    @contextmanager
    def reserve(self, amount: float, what: str) -> Iterator[None]:
        """Wait until `amount` bytes of arrays fit, and hold them; `OptionError` where they never can.

        What earlier work has left with the allocators serves later work, so a piece that fits without it may begin
        where no other is under way.
        """
        needed = self.check(amount, what)
        with self._changed:
            self._changed.wait_for(lambda: not self._reserved or self._reserved + needed <= self.free)
            self._reserved += needed
        if resident() + amount > self._total:  # what fits is quicker with memory that the process has already
            give_back_freed_memory()
        try:
            yield
        finally:
            with self._changed:
                self._reserved -= needed
                self._changed.notify_all()
