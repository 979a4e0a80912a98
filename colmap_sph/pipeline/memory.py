"""The memory budget of a run: what is left of it, and a gate that work passes only with its share."""

import re
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from colmap_sph.errors import OptionError

_UNITS = {"": 0, "K": 1, "M": 2, "G": 3, "T": 4}
# Of the memory that is free when a run starts, what it takes by itself.
_SAFE_SHARE = 0.7
# What the allocators and the interpreter keep beyond the arrays that are counted.
_SLACK = 1.15


def parse_memory(text: str) -> int:
    """Bytes of an amount such as "6GiB", "1500 MB" or "2G" (binary, as "2GiB"); 0 for an empty text.

    Raises
    ------
    OptionError
        Not an amount.
    """
    if not text:
        return 0
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([KMGT]?)(i?B)?\s*", text, re.IGNORECASE)
    if not match:
        raise OptionError(f"memory must be an amount such as 6GiB or 1500MB, not {text!r}.", "memory")
    number, unit, suffix = match.groups()
    base = 1000 if suffix is not None and suffix.upper() == "B" else 1024
    return int(float(number) * base ** _UNITS[unit.upper()])


def format_memory(amount: float) -> str:
    """Amount in MiB or GiB, rounded up, as `parse_memory` reads it."""
    mebibytes = int(-(-amount // (1 << 20)))
    return f"{mebibytes}MiB" if mebibytes < 10240 else f"{-(-mebibytes // 1024)}GiB"


def budget(wanted: int) -> int:
    """Bytes a run may use: what is `wanted`, or (0) a safe share of what the machine has free."""
    return wanted or int(_SAFE_SHARE * _free()) + resident()


def resident() -> int:
    """Bytes of memory this process has in use."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except (OSError, ValueError, IndexError):
        return 200 << 20


def _free() -> int:
    """Bytes free on the machine and in this process's control group."""
    free = [4 << 30]
    try:
        text = Path("/proc/meminfo").read_text()
        free = [int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith("MemAvailable:")]
        group = Path("/sys/fs/cgroup")
        limit, used = ((group / f"memory.{name}").read_text().strip() for name in ("max", "current"))
        if limit != "max":
            free.append(int(limit) - int(used))
    except (OSError, ValueError):
        pass
    return max(min(free, default=4 << 30), 256 << 20)


class MemoryGate:
    """Lets work begin when its share of a budget is free.

    Parameters
    ----------
    total : int
        Bytes of the whole run, what the process has in use already among them.
    """

    def __init__(self, total: int) -> None:
        self._total, self._outside = total, resident()
        self._reserved = 0
        self._changed = threading.Condition()

    @property
    def free(self) -> int:
        """Bytes of the budget that neither the process has in use nor caches keep."""
        return max(self._total - self._outside, 0)

    def spare(self, needed: float) -> float:
        """Bytes for caches: of what is free, what the largest piece of work, of `needed` bytes, leaves."""
        return max(self.free - needed, 0)

    def keep(self, amount: int) -> None:
        """Take `amount` bytes for caches and scratch memory, for good; before any work begins."""
        self._outside += amount

    @contextmanager
    def reserve(self, amount: float, what: str) -> Iterator[None]:
        """Wait until `amount` bytes of arrays fit, and hold them; `OptionError` where they never can."""
        needed = int(_SLACK * amount)
        if needed > self.free:
            raise OptionError(
                f"--memory {format_memory(self._total)} is too little for {what}; "
                f"{format_memory((self._outside + needed) * 1.05)} would do."
            )
        with self._changed:
            self._changed.wait_for(lambda: self._reserved + needed <= self.free)
            self._reserved += needed
        try:
            yield
        finally:
            with self._changed:
                self._reserved -= needed
                self._changed.notify_all()
