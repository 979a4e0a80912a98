"""`colmap_sph report` and `colmap_sph view`: the page of a workspace, made again, or shown in the browser."""

import os
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from colmap_sph.app.display import Display
from colmap_sph.app.terminal import Terminal, print_result
from colmap_sph.errors import InputError
from colmap_sph.pages import write_page
from colmap_sph.project.claim import check_links
from colmap_sph.project.workspace import Workspace

# Without one of these, Linux has no window to show a page in; a browser for the terminal cannot draw it.
_WINDOWS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")


@dataclass(frozen=True)
class ReportCommand:
    """Make the page of a dense workspace again, colmap_sph/report.html in it.

    Every run ends with it. It tells of what is there: also of a run that was ended before its end, and of maps and
    clouds that COLMAP's own programs made.
    """

    workspace: Annotated[Path, tyro.conf.Positional]
    """Dense workspace, such as dense."""


@dataclass(frozen=True)
class ViewCommand:
    """Show the page of a dense workspace in the browser; it is made where there is none."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Dense workspace, such as dense."""


def report_command(command: ReportCommand, terminal: Terminal) -> int:
    """`colmap_sph report`: the page's path on the standard output."""
    workspace = opened(command.workspace)
    _make(workspace, terminal)
    print_result(str(workspace.page_path))
    return 0


def view_command(command: ViewCommand, terminal: Terminal) -> int:
    """`colmap_sph view`: the page's path on the standard output, the page in the browser."""
    workspace = opened(command.workspace)
    if not workspace.page_path.is_file():
        _make(workspace, terminal)
    print_result(str(workspace.page_path))
    page = workspace.page_path.absolute()
    has_windows = sys.platform == "darwin" or any(os.environ.get(name) for name in _WINDOWS)
    if not has_windows or not webbrowser.open(page.as_uri()):
        raise InputError(
            f"No browser can be opened here; open {page} in one, or copy it to a machine with a screen: it is one "
            "file."
        )
    return 0


def opened(folder: Path) -> Workspace:
    """The workspace in a folder; `InputError` where it is none, `OutputError` where links lead out of it."""
    workspace = Workspace(folder)
    if not folder.is_dir():
        wrong = "is a file" if folder.is_file() else "does not exist"
        raise InputError(f"The workspace {folder} {wrong}; give a dense workspace, such as dense.")
    if not workspace.sparse_dir.is_dir() or not workspace.images_dir.is_dir():
        inside = folder / "dense"
        hint = (
            f"did you mean {inside}?" if inside.is_dir() else "give a folder that a run has made, such as dense."
        )
        raise InputError(f"{folder} is not a dense workspace, it has no images or no sparse folder; {hint}")
    check_links(workspace, is_given=True)
    return workspace


def _make(workspace: Workspace, terminal: Terminal) -> None:
    with Display(terminal) as display:
        missing = write_page(workspace, display)
    if missing:
        terminal.say(f"{missing}.", label="not finished:", style="yellow")
