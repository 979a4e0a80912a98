"""The time that a run is given: how it is written, how much of it is left, and which options it may not touch."""

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from colmap_sph.errors import OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.platforms.memory import process_start_time

_FORM = re.compile(r"(?:(\d+(?:\.\d+)?)\s*h)?\s*(?:(\d+(?:\.\d+)?)\s*(?:min|m))?\s*(?:(\d+(?:\.\d+)?)\s*s)?")
_LONGEST = 1e7
"""Seconds; nearly four months."""

SIZE = "undistortion.max_image_size"
DIALS = ("rectification.sampling", "pairs.num_pairs", "refinement.rounds", "normals.radius", SIZE)
"""Options that are chosen to keep to a time, by their place in the records."""


@dataclass(frozen=True)
class TimeLimit:
    """The time that a run is given.

    Attributes
    ----------
    seconds : float
        Within which the run is to end.
    kept : frozenset of str
        Those of `DIALS` that the user chose: they stay as they are.
    started : float
        When it began, as `clock` tells.
    clock : callable
        Returns seconds.
    """

    seconds: float
    kept: frozenset[str] = frozenset()
    started: float = field(default_factory=time.monotonic)
    clock: Callable[[], float] = time.monotonic

    def check(self, options: RunOptions) -> None:
        """Raise `OptionError` where it is no time, or other options leave nothing to choose."""
        if not 0 < self.seconds <= _LONGEST:
            raise OptionError(
                f"within must be more than 0 and at most {_LONGEST:.0f} seconds, not {self.seconds}.", "within"
            )
        if self.kept.issuperset(DIALS[:3]):
            raise OptionError(
                "within has nothing to choose, as pairs.num_pairs, rectification.sampling and refinement.rounds "
                "are all given; leave out one of the four.",
                "within",
                *DIALS[:3],
            )
        if options.polish.is_wanted:
            raise OptionError(
                "--polish-poses takes a time that is not known before, and --within must know it: polish in a run "
                "of its own, and give its dense workspace as --workspace together with --within."
            )

    @property
    def elapsed(self) -> float:
        """Seconds since the run began."""
        return self.clock() - self.started

    @property
    def left(self) -> float:
        """Seconds that are left of it."""
        return self.seconds - self.elapsed

    def begun(self, seconds: float) -> "TimeLimit":
        """The same for a run that is only planned, of which so many seconds are spoken for."""
        moment = self.clock()
        return replace(self, started=moment - seconds, clock=lambda: moment)


def time_limit(within: str | float, options: RunOptions) -> TimeLimit:
    """The time limit of a run that begins now; options that are not at their defaults stay as they are.

    Parameters
    ----------
    within : str or float
        Such as "20min", see `parse_time`; or seconds.
    options : RunOptions
    """
    seconds = parse_time(within) if isinstance(within, str) else float(within)
    return TimeLimit(seconds, changed_dials(options))


def changed_dials(options: RunOptions) -> frozenset[str]:
    """Those of `DIALS` that are not at their defaults."""
    usual = RunOptions()
    return frozenset(dial for dial in DIALS if _value(options, dial) != _value(usual, dial))


def _value(options: RunOptions, dial: str) -> object:
    stage, name = dial.split(".")
    return getattr(getattr(options, stage), name)


def process_start() -> float:
    """When this process was started, as `time.monotonic` tells: its imports are a part of the time, too."""
    started = process_start_time()
    return time.monotonic() - (0.0 if started is None else max(time.time() - started, 0.0))


def parse_time(text: str) -> float:
    """Seconds of a time such as "90s", "20min", "1.5h" or "1h30min".

    Raises
    ------
    OptionError
        It is none.

    Examples
    --------
    >>> parse_time("1h30min")
    5400.0
    """
    match = _FORM.fullmatch(text.strip().lower()) if len(text) <= 40 and text.isascii() else None
    numbers = match.groups() if match else ()
    seconds = sum(float(number) * unit for number, unit in zip(numbers, (3600, 60, 1), strict=False) if number)
    if not 0 < seconds <= _LONGEST or not math.isfinite(seconds):
        shown = text if len(text) <= 40 else f"{text[:40]}…"
        raise OptionError(f"within must be a time such as 90s, 20min, 1.5h or 1h30min, not {shown!r}.", "within")
    return float(seconds)


def format_time(seconds: float) -> str:
    """A time as `parse_time` reads it, in whole seconds, or minutes where there are many.

    Examples
    --------
    >>> format_time(5400), format_time(95)
    ('1h30min', '95s')
    """
    if seconds < 120 and seconds % 60:
        return f"{seconds:.0f}s"
    if seconds < 3600:
        minutes, rest = divmod(round(seconds), 60)
        return f"{minutes}min" + (f"{rest}s" if rest and minutes < 10 else "")
    hours, rest = divmod(round(seconds / 60), 60)
    return f"{hours}h" + (f"{rest}min" if rest else "")
