"""What a person is told, on a terminal or in a file: the one place through which all messages go.

On a terminal messages have colours and tables have lines. Anywhere else, where programs and other people read
them later, they are plain lines, and what happens while a command works has its time before it. Texts may hold
names that strangers chose; none of them reaches the terminal otherwise than through `printable`.
"""

import logging
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from datetime import datetime

import rich.progress
from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.table import Table
from rich.text import Text

from colmap_sph.app.standard_streams import standard_output
from colmap_sph.errors import printable

# Columns that bars and tables need; a narrower terminal, or one that hides its width, gets plain lines.
_LEAST_WIDTH = 40
# Columns of a table's rules and spaces, for each of its columns; one more closes it.
_RULES = 3


class Terminal:
    """The standard error stream, a terminal or not.

    Attributes
    ----------
    spell : callable
        What is said → the same in other words, before it is made printable.
    """

    def __init__(self) -> None:
        self.spell: Callable[[str], str] = str
        self._stream = sys.stderr
        self._console = Console(file=self._stream, highlight=False)
        self._bars: rich.progress.Progress | None = None
        self._has_drawn = False

    @property
    def is_interactive(self) -> bool:
        """Whether somebody looks at it now, and there is room for lines that are drawn again."""
        has_room = self._console.width >= _LEAST_WIDTH
        return self._stream.isatty() and has_room and not self._console.is_dumb_terminal

    @property
    def width(self) -> int | None:
        """Columns, where somebody looks at it."""
        return self._console.width if self.is_interactive else None

    def say(self, text: object, *, label: str = "", style: str = "") -> None:
        """Say something in one line, behind a label of that style."""
        line = Text.assemble((f"{label} " if label else "", style), printable(self.spell(str(text))))
        if self.is_interactive:
            self._console.print(line, soft_wrap=True)
        else:
            self._write(line.plain)

    def say_lines(self, text: str) -> None:
        """Say what is in lines already, such as a table."""
        for line in text.split("\n"):
            self.say(line)

    def note(self, text: object, *, label: str = "", style: str = "") -> None:
        """Say what happens now; off a terminal with the time."""
        time = "" if self.is_interactive else f"{datetime.now():%Y-%m-%d %H:%M:%S} "  # noqa: DTZ005
        self.say(text, label=f"{time}{label}".rstrip(), style=style)

    def facts(self, rows: Sequence[tuple[str, str]]) -> None:
        """Show names and what is known of them, one a line."""
        rows = [(name, self.spell(value)) for name, value in rows]
        if self.is_interactive:
            self._print_facts(rows)
        else:
            self._write_columns(rows)

    def table(self, title: str, header: Sequence[str], rows: Sequence[Sequence[str]], caption: str = "") -> None:
        """Show a table."""
        if self.is_interactive:
            table = Table(*header, title=title, title_justify="left", caption=caption or None)
            widths = [max(map(cell_len, map(printable, column))) for column in zip(header, *rows, strict=True)]
            # Names are in the first column; the others are short.
            room = self._console.width - sum(widths[1:]) - _RULES * len(widths) - 1
            for name, *others in rows:
                table.add_row(shortened(printable(name), room), *map(_cell, others))
            self._console.print(table)
        else:
            self._write(title)
            self._write_columns([header, *rows])
            if caption:
                self._write(caption)

    @contextmanager
    def status(self, text: object) -> Iterator[None]:
        """Show for a time what is worked at, where somebody looks."""
        with self._console.status(_cell(text)) if self.is_interactive else nullcontext():
            yield

    def start_bars(self, bars: rich.progress.Progress) -> None:
        """Draw progress bars until `settle`."""
        self._bars = bars
        self._has_drawn = True
        bars.start()

    def new_bars(self, *columns: rich.progress.ProgressColumn) -> rich.progress.Progress:
        """Make progress bars for `start_bars`."""
        # Drawing holds up the workers.
        return rich.progress.Progress(*columns, console=self._console, refresh_per_second=2)

    def settle(self) -> None:
        """Let go of what is drawn again and again: the next message has a line of its own below it."""
        if self._bars is not None:
            self._bars.stop()
            self._bars = None

    def after_interruption(self) -> None:
        """Begin a line of its own where the terminal shows ^C, which bars draw over."""
        had_bars = self._has_drawn
        self.settle()
        if self.is_interactive:
            self._console.show_cursor()
            if not had_bars:
                self._write("")

    def _print_facts(self, rows: Sequence[tuple[str, str]]) -> None:
        indent = max((cell_len(printable(name)) for name, _ in rows), default=0) + 2
        for name, value in rows:
            first, *more = wrapped(printable(value), self._console.width - indent)
            lines = [set_cell_size(printable(name), indent) + first, *(" " * indent + line for line in more)]
            self._console.print(Text("\n".join(lines)), soft_wrap=True)

    def _write(self, line: str) -> None:
        self._stream.write(f"{line}\n")
        self._stream.flush()

    def _write_columns(self, rows: Sequence[Sequence[str]]) -> None:
        cells = [[printable(cell) for cell in row] for row in rows]
        widths = [max(map(cell_len, column)) for column in zip(*cells, strict=True)]
        for row in cells:
            self._write("  ".join(map(set_cell_size, row, widths)).rstrip())


def _cell(text: object) -> Text:
    return Text(printable(text))


def wrapped(text: str, width: int) -> list[str]:
    """Lines of a text, broken between the parts of a list, or where these are too long between words.

    A word that is longer, such as a path, stays whole: the terminal breaks it, and it can be copied.
    """
    parts: list[str] = []
    for part in re.split(r"(?<=[,;]) ", text):
        parts += [part] if cell_len(part) <= width else part.split(" ")
    lines = [parts[0]]
    for part in parts[1:]:
        if cell_len(f"{lines[-1]} {part}") <= width:
            lines[-1] += f" {part}"
        else:
            lines.append(part)
    return lines


def shortened(name: str, width: int) -> Text:
    """A name, or where it is wider its beginning and its end, which tells images apart."""
    if cell_len(name) <= width:
        return Text(name)
    end = max((width - 1) * 2 // 3, 1)
    start = max(width - 1 - end, 1)
    tail = name
    while cell_len(tail) > end:
        tail = tail[1:]
    return Text(f"{set_cell_size(name, start).rstrip()}…{tail}", no_wrap=True)


def output_width() -> int | None:
    """Columns of the standard output, where that is a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def print_result(text: str) -> None:
    """Print on the standard output what was asked for; see `standard_output`."""
    with standard_output():
        print("\n".join(map(printable, text.split("\n"))), flush=True)


class _Warnings(logging.Handler):
    """Warnings of the package, as messages."""

    def __init__(self, terminal: Terminal) -> None:
        super().__init__(logging.WARNING)
        self._terminal = terminal

    def emit(self, record: logging.LogRecord) -> None:
        """Say it."""
        self._terminal.note(record.getMessage(), label="warning:", style="yellow")


@contextmanager
def warnings_shown(terminal: Terminal) -> Iterator[None]:
    """Show warnings of the package."""
    package = logging.getLogger("colmap_sph")
    handler = _Warnings(terminal)
    level = package.level
    package.setLevel(logging.INFO)
    package.addHandler(handler)
    try:
        yield
    finally:
        package.removeHandler(handler)
        package.setLevel(level)
