"""What a person sees while a command works: progress bars, and warnings of the package."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

import rich.logging
import rich.progress
from rich.console import Console


class Display:
    """Progress bars with time left, one per stage."""

    def __init__(self, console: Console) -> None:
        self._bars = rich.progress.Progress(
            rich.progress.TextColumn("{task.description:<18}"),
            rich.progress.BarColumn(),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left"),
            rich.progress.TimeRemainingColumn(),
            console=console,
            # Drawing holds up the workers; into a file only what the end is like is written.
            refresh_per_second=2,
            auto_refresh=console.is_terminal,
        )
        self._task: rich.progress.TaskID | None = None

    def __enter__(self) -> "Display":
        return self

    def __exit__(self, *_: object) -> None:
        if self._task is not None:
            self._bars.stop()

    def start(self, stage: str, total: int) -> None:
        """See `Progress`."""
        self._bars.start()  # not before there is a bar: without any an empty line would be drawn
        self._task = self._bars.add_task(stage, total=total)

    def advance(self) -> None:
        """See `Progress`."""
        if self._task is not None:
            self._bars.advance(self._task)


def escaped(text: object) -> str:
    """Text that rich prints as it is."""
    return str(text).replace("[", r"\[")


@contextmanager
def console_logging(console: Console) -> Iterator[None]:
    """Warnings of the package on the console."""
    package = logging.getLogger("colmap_sph")
    handler = rich.logging.RichHandler(logging.WARNING, console, show_time=False, show_path=False, markup=False)
    level = package.level
    package.setLevel(logging.INFO)
    package.addHandler(handler)
    try:
        yield
    finally:
        package.removeHandler(handler)
        package.setLevel(level)
