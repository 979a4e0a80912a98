"""`colmap_sph report` and `colmap_sph view`: the page of a workspace, made again, or shown in the browser."""

import signal
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from colmap_sph.app.display import Display
from colmap_sph.app.terminal import Terminal, print_result
from colmap_sph.errors import InputError, OptionError, OutputError
from colmap_sph.platforms.surroundings import has_screen
from colmap_sph.project.claim import check_links
from colmap_sph.project.project import check_open
from colmap_sph.project.sparse_model import has_model
from colmap_sph.project.workspace import Workspace


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
    """Show the page of a dense workspace in the browser; it is made where there is none, or an old one."""

    workspace: Annotated[Path, tyro.conf.Positional]
    """Dense workspace, such as dense."""
    full: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show the whole cloud instead, the more of it the nearer one looks: served to this machine alone, until
    Ctrl-C."""
    port: int = 0
    """Port of this machine for --full, such as one that ssh -L brings to another; 0: any that is free."""


def report_command(command: ReportCommand, terminal: Terminal) -> int:
    """`colmap_sph report`: the page's path on the standard output."""
    workspace = opened(command.workspace)
    _make(workspace, terminal)
    print_result(str(workspace.page_path))
    return 0


def view_command(command: ViewCommand, terminal: Terminal) -> int:
    """`colmap_sph view`: the page's path on the standard output, the page in the browser."""
    workspace = opened(command.workspace)
    if command.full:
        return _serve_cloud(workspace, command.port, terminal)
    if command.port:
        raise OptionError("--port is for --full, which is missing; the page alone needs none.", "port")
    _bring_up_to_date(workspace, terminal)
    print_result(str(workspace.page_path))
    page = workspace.page_path.absolute()
    if not _is_shown(page.as_uri()):
        raise InputError(
            f"No browser can be opened here; open {page} in one, or copy it to a machine with a screen: it is one "
            "file."
        )
    return 0


def _is_shown(address: str) -> bool:
    """Show an address in the browser, where there is one."""
    return has_screen() and webbrowser.open(address)


def _serve_cloud(workspace: Workspace, port: int, terminal: Terminal) -> int:
    """Serve the whole cloud until Ctrl-C; its address on the standard output."""
    with Display(terminal) as display:
        is_begun = False

        def looked_at(blocks: int) -> None:
            nonlocal is_begun
            if not is_begun:
                display.start("look at the cloud", blocks)
                is_begun = True
            display.advance()

        from colmap_sph.pages.whole_cloud import CloudServer  # which no other command needs

        server = CloudServer(workspace, port=port, looked_at=looked_at)
    try:
        print_result(server.address)
        is_shown = _is_shown(server.address)
        where = "shown in the browser" if is_shown else "open the address above in a browser on this machine"
        terminal.say(f"The whole cloud is served to this machine alone: {where}. Ctrl-C ends it.")
        server.run()
    except KeyboardInterrupt as stop:
        if getattr(stop, "signal_number", signal.SIGINT) != signal.SIGINT:
            raise
    finally:
        server.close()
    return 0


def opened(folder: Path) -> Workspace:
    """The workspace in a folder; `InputError` where it is none, `OutputError` where links lead out of it."""
    workspace = Workspace(folder)
    check_open(folder)
    if not folder.is_dir():
        wrong = "is a file" if folder.is_file() else "does not exist"
        raise InputError(f"The workspace {folder} {wrong}; give a dense workspace, such as dense.")
    inside = folder / "dense"
    is_project = inside.is_dir() and not has_model(workspace.sparse_dir)
    if is_project or not workspace.sparse_dir.is_dir() or not workspace.images_dir.is_dir():
        hint = (
            f"did you mean {inside}?" if inside.is_dir() else "give a folder that a run has made, such as dense."
        )
        raise InputError(f"{folder} is not a dense workspace, it has no images or no model in sparse; {hint}")
    check_links(workspace, is_given=True)
    return workspace


def _bring_up_to_date(workspace: Workspace, terminal: Terminal) -> None:
    """Make the page where there is none, or where a run or a fusion has changed something since."""
    if not workspace.page_path.is_file():
        _make(workspace, terminal)
    elif _is_old(workspace):
        try:
            _make(workspace, terminal)
        except OutputError as error:
            terminal.say(f"the page is older than what it shows. {error}", label="out of date:", style="yellow")


def _is_old(workspace: Workspace) -> bool:
    """Whether report, cloud, maps or products were written after the page, as far as times of files tell."""
    maps = workspace.depth_map_path("any", "geometric").parent
    shown = (workspace.report_path, workspace.fused_path, workspace.tiles_dir, maps, *workspace.product_dirs)
    made = workspace.page_path.stat().st_mtime_ns
    return any(path.stat().st_mtime_ns > made for path in shown if path.exists())


def _make(workspace: Workspace, terminal: Terminal) -> None:
    from colmap_sph.pages import write_page  # see `make_page`

    with Display(terminal) as display:
        missing = write_page(workspace, display)
    if missing:
        terminal.say(f"{missing}.", label="not finished:", style="yellow")
