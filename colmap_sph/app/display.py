"""How far a command is: bars on a terminal, and off it a line now and then."""

import time
from collections.abc import Sequence

import rich.progress
from rich.text import Text

from colmap_sph.app.terminal import Terminal
from colmap_sph.pipeline.forecast.time_left import TimeLeft
from colmap_sph.pipeline.options import num_cores
from colmap_sph.pipeline.report import Left, Progress, Silent, StageEstimate

# Off a terminal a line is written when this share of a stage and this many seconds have passed since the last one.
_SHARE = 0.1
_SECONDS = 30.0


class Display:
    """Progress of the stages, each with the time left, and with that of the whole run.

    Parameters
    ----------
    terminal : Terminal
    workers : int, optional
        Items that are worked at side by side.
    """

    def __init__(self, terminal: Terminal, workers: int | None = None) -> None:
        self._terminal = terminal
        time_left = TimeLeft(workers or num_cores())
        self._time_left = time_left
        self._shown: Progress = (
            _Bars(terminal, time_left) if terminal.is_interactive else _Lines(terminal, time_left)
        )

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *_: object) -> None:
        self._terminal.settle()

    def engage(self, threads: int, words: str) -> None:
        """See `Progress`."""
        self._time_left.engage(threads, words)
        if words:
            self._terminal.note(words, label="cluster:")

    def foresee(self, stages: Sequence[StageEstimate]) -> None:
        """See `Progress`."""
        self._time_left.foresee(stages)

    def start(self, stage: str, total: int) -> None:
        """See `Progress`."""
        self._time_left.start(stage, total)
        self._shown.start(stage, total)

    def advance(self, seconds: float = 0.0) -> None:
        """See `Progress`."""
        self._time_left.advance(seconds)
        self._shown.advance()

    def leave_out(self, what: Left, name: str, reason: str) -> None:
        """See `Progress`; warnings tell it."""


class _WholeRun(rich.progress.ProgressColumn):
    """The time left of the whole run, beside the bar that is last."""

    max_refresh = 0.5

    def __init__(self, time_left: TimeLeft) -> None:
        super().__init__()
        self._time_left = time_left

    def render(self, task: rich.progress.Task) -> Text:
        """See `ProgressColumn`."""
        seconds = self._time_left.seconds()
        is_told = seconds is not None and task.fields["is_current"]
        return Text(f"run {duration(seconds or 0.0)} left" if is_told else "", "cyan", no_wrap=True)


class _Bars(Silent):
    """A bar for each stage."""

    def __init__(self, terminal: Terminal, time_left: TimeLeft) -> None:
        self._terminal = terminal
        self._bars = terminal.new_bars(
            rich.progress.TextColumn("{task.description:<18}", markup=False),
            rich.progress.BarColumn(24),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left"),
            rich.progress.TimeRemainingColumn(),
            _WholeRun(time_left),
        )
        self._task: rich.progress.TaskID | None = None

    def start(self, stage: str, total: int) -> None:
        self._terminal.start_bars(self._bars)  # not before there is one: without any an empty line would be drawn
        if self._task is not None:
            self._bars.update(self._task, is_current=False)
        self._task = self._bars.add_task(stage, total=total, is_current=True)

    def advance(self, seconds: float = 0.0) -> None:
        if self._task is not None:
            self._bars.advance(self._task)


class _Lines(Silent):
    """A line at the start of each stage, and a few while it lasts."""

    def __init__(self, terminal: Terminal, time_left: TimeLeft) -> None:
        self._terminal = terminal
        self._time_left = time_left
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

    def advance(self, seconds: float = 0.0) -> None:
        self._done += 1
        steps = self._done - self._said_done
        taken = time.monotonic() - self._said_at
        if taken < _SECONDS or steps < _SHARE * self._total or self._done == self._total:
            return
        # The latest speed: what earlier runs left ready takes no time, and comes first.
        left = duration(taken / steps * (self._total - self._done))
        whole = self._time_left.seconds()
        of_run = "" if whole is None else f", {duration(whole)} of the run"
        self._terminal.note(f"{self._stage}: {self._done} of {self._total}, about {left} left{of_run}")
        self._said_done = self._done
        self._said_at = time.monotonic()


def duration(seconds: float) -> str:
    """Such as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
