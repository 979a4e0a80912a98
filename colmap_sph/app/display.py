"""How far a command is: bars on a terminal, and off it a line now and then."""

import time

import rich.progress

from colmap_sph.app.terminal import Terminal
from colmap_sph.pipeline.report import Progress

# Off a terminal a line is written when this share of a stage and this many seconds have passed since the last one.
_SHARE = 0.1
_SECONDS = 30.0


class Display:
    """Progress of the stages, each with the time left.

    Parameters
    ----------
    terminal : Terminal
    """

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal
        self._shown: Progress = _Bars(terminal) if terminal.is_interactive else _Lines(terminal)

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *_: object) -> None:
        self._terminal.settle()

    def start(self, stage: str, total: int) -> None:
        """See `Progress`."""
        self._shown.start(stage, total)

    def advance(self) -> None:
        """See `Progress`."""
        self._shown.advance()


class _Bars:
    """A bar for each stage."""

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal
        self._bars = terminal.new_bars(
            rich.progress.TextColumn("{task.description:<18}", markup=False),
            rich.progress.BarColumn(),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left"),
            rich.progress.TimeRemainingColumn(),
        )
        self._task: rich.progress.TaskID | None = None

    def start(self, stage: str, total: int) -> None:
        self._terminal.start_bars(self._bars)  # not before there is one: without any an empty line would be drawn
        self._task = self._bars.add_task(stage, total=total)

    def advance(self) -> None:
        if self._task is not None:
            self._bars.advance(self._task)


class _Lines:
    """A line at the start of each stage, and a few while it lasts."""

    def __init__(self, terminal: Terminal) -> None:
        self._terminal = terminal
        self._stage = ""
        self._total = 0
        self._done = 0
        self._said_done = 0
        self._said_at = 0.0

    def start(self, stage: str, total: int) -> None:
        self._stage = stage
        self._total = total
        self._done = 0
        self._said_done = 0
        self._said_at = time.monotonic()
        self._terminal.note(f"{stage} ({total})")

    def advance(self) -> None:
        self._done += 1
        steps = self._done - self._said_done
        seconds = time.monotonic() - self._said_at
        if seconds < _SECONDS or steps < _SHARE * self._total or self._done == self._total:
            return
        # The latest speed: what earlier runs left ready takes no time, and comes first.
        left = duration(seconds / steps * (self._total - self._done))
        self._terminal.note(f"{self._stage}: {self._done} of {self._total}, about {left} left")
        self._said_done = self._done
        self._said_at = time.monotonic()


def duration(seconds: float) -> str:
    """Such as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
