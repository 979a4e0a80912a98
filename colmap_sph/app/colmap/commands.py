"""COLMAP's commands on our command line: done here, or handed over to COLMAP."""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.console import Console

from colmap_sph.app.colmap.fusion import make_cloud
from colmap_sph.app.colmap.names import OWN, hand_over
from colmap_sph.app.colmap.options import COMMANDS, ColmapCommand, ColmapOption
from colmap_sph.app.colmap.parser import Given, parse
from colmap_sph.app.colmap.patch_match import make_maps
from colmap_sph.app.display import Display
from colmap_sph.app.log_file import workspace_log
from colmap_sph.app.option_list import print_explained
from colmap_sph.app.run_command import PARTIAL_EXIT_CODE, header, print_summary
from colmap_sph.app.shell_words import to_repeat
from colmap_sph.app.standard_streams import standard_output
from colmap_sph.app.terminal import Terminal
from colmap_sph.errors import counted
from colmap_sph.pipeline.report import RunReport
from colmap_sph.project.project import check_open
from colmap_sph.project.workspace import Workspace


def answer(arguments: Sequence[str], terminal: Terminal, started: float) -> int:
    """Do what a command of COLMAP does; returns the exit code.

    Parameters
    ----------
    arguments : sequence of str
        The command's name, for which `names.is_colmap_command` holds, and its options.
    terminal : Terminal
    started : float
        When the program began, as `time.monotonic` tells.
    """
    name, *options = arguments
    if name not in OWN:
        hand_over(arguments)
    command = COMMANDS[name]
    given = parse(command, options)
    if given is None:
        _print_help(command)
        return 0
    _tell_idle(given, terminal)
    workspace = Workspace(Path(str(given.plain["workspace_path"])))
    check_open(workspace.root)
    with workspace_log(workspace, header(arguments)), Display(terminal) as display:
        make = partial(make_maps, started=started) if name == "patch_match_stereo" else make_cloud
        report = make(given.plain, given.sectioned, command=to_repeat(arguments), progress=display)
    _print_end(given, report, workspace, terminal, started)
    return PARTIAL_EXIT_CODE if report.incomplete else 0


def _tell_idle(given: Given, terminal: Terminal) -> None:
    """Name the options that have no effect, in one notice."""
    if given.idle:
        terminal.note(", ".join(f"--{flag}" for flag in given.idle), label="without effect here:", style="yellow")


def _print_end(given: Given, report: RunReport, workspace: Workspace, terminal: Terminal, started: float) -> None:
    if "output_path" not in given.plain:
        print_summary(report, workspace, terminal)
        return
    seconds = time.monotonic() - started
    cloud = (
        f"{counted(report.points, 'point')} of {counted(report.images, 'image')} in {given.plain['output_path']}"
    )
    terminal.facts([("cloud", cloud), ("seconds", f"{seconds:.1f}")])
    for name, reason in (*report.skipped_images.items(), *report.incomplete.items()):
        terminal.say(f"{name}: {reason}", label="incomplete:", style="yellow")


def _print_help(command: ColmapCommand) -> None:
    """The options, what they do here, and those that do nothing."""
    flags = command.flags()
    with standard_output():
        console = Console(highlight=False, markup=False)
        console.print(f"usage: colmap_sph {command.name} [options]\n")
        console.print("COLMAP's options, on the command line or in a project file:\n")
        acting = {flag: option for flag, option in flags.items() if option.acts}
        print_explained(_explained({"project_path": _PROJECT, **acting}), console)
        console.print("\nAccepted, but without effect here:\n")
        idle = {flag: option for flag, option in flags.items() if not option.acts}
        print_explained(_explained(idle), console)


_PROJECT = ColmapOption("project_path", "", "file of options, as COLMAP writes it; the command line goes first")


def _explained(flags: dict[str, ColmapOption]) -> list[tuple[str, str]]:
    """Each option with its default as COLMAP has it, and what it does here."""
    defaults = {flag: "" if option.default == "" else f" (={_word(option)})" for flag, option in flags.items()}
    return [(f"  --{flag}{defaults[flag]}", option.text) for flag, option in flags.items()]


def _word(option: ColmapOption) -> str:
    """A default as COLMAP writes it."""
    return str(int(option.default)) if isinstance(option.default, bool) else str(option.default)
