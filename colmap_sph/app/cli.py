"""The command line: which command is meant, and its end, good or bad, in words and an exit code."""

import logging
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import tyro

from colmap_sph.app.colmap.names import is_colmap_command
from colmap_sph.app.colmap.spelling import spelling_of
from colmap_sph.app.display import Display
from colmap_sph.app.events import Events
from colmap_sph.app.given_options import all_arguments
from colmap_sph.app.interruption import Interrupted, stop_on_signals
from colmap_sph.app.log_file import workspace_log
from colmap_sph.app.option_list import help_of
from colmap_sph.app.part_command import part_command
from colmap_sph.app.refusals import refusals_in_words, refuse_empty_paths
from colmap_sph.app.report_command import ReportCommand, ViewCommand, report_command, view_command
from colmap_sph.app.run_command import RunCommand, header, help_text, print_summary, run_command
from colmap_sph.app.spelling import flag_of, short_completion, with_dashed_values
from colmap_sph.app.standard_streams import standard_output
from colmap_sph.app.terminal import Terminal, print_result, warnings_shown
from colmap_sph.errors import ColmapSphError, InputError, OptionError, OutputError, reason_of
from colmap_sph.pipeline.forecast.time_limit import process_start
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.workers import refusal_of
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class DemoCommand:
    """Render a small aerial block, reconstruct it, and compare the result with its exact depth."""

    output: Path = Path("demo")
    """Folder for the block and its dense workspace."""
    threads: int = 0
    """Worker threads; 0: as many as the process may use cores."""


# Those that load what a run needs anyway.
_RUNS: dict[str, Any] = {"run": RunCommand, "demo": DemoCommand}
Command = Any
"""The record of a command's options."""


def commands(wanted: str | None = None) -> dict[str, Any]:
    """Return the commands' records of options by their names: of all, or of some among which is the wanted one."""
    if wanted in _RUNS:
        return _RUNS
    # Not before: runs would load for a tenth of a second what they do not need.
    from colmap_sph.app.evaluate_command import EvaluateCommand
    from colmap_sph.app.products.commands import PRODUCTS

    products = {name: options for name, (options, _) in PRODUCTS.items()}
    return _RUNS | {"evaluate": EvaluateCommand, "report": ReportCommand, "view": ViewCommand} | products


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the `colmap_sph` command; returns the exit code."""
    terminal = Terminal()
    started = process_start() if arguments is None else time.monotonic()
    arguments = sys.argv[1:] if arguments is None else arguments
    # OpenCV and its readers print names of files as they are; what is wrong with a file, our own messages say.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    with warnings_shown(terminal):
        try:
            return _answer(arguments, terminal, started)
        except Exception as error:
            told = _in_words(error)
            if told is None:
                raise
            terminal.settle()
            terminal.say(told, label="error:", style="bold red")
            return told.exit_code


def _in_words(error: BaseException) -> ColmapSphError | None:
    """What a user is told of an error, with options as they are typed; None for one of the program itself."""
    if isinstance(error, OptionError):
        return error.spelled(flag_of)
    if isinstance(error, ColmapSphError):
        return error
    if (refused := refusal_of(error)) is not None:
        return refused
    if isinstance(error, OSError) and error.errno is not None and not isinstance(error, BrokenPipeError):
        what = f"{error.filename} cannot be used" if error.filename else "A file cannot be written"
        return OutputError(f"{what} ({reason_of(error)}); check space and permissions.")
    return None


def _answer(arguments: Sequence[str], terminal: Terminal, started: float) -> int:
    if arguments and is_colmap_command(arguments[0]):
        return _answer_as_colmap(arguments, terminal, started)
    if (asked := _help_asked_for(arguments)) is not None:
        print_result(asked)
        return 0
    command = _parsed(arguments)
    events = _events_of(command)

    def last_words(stop: Interrupted) -> None:
        logger.info("Interrupted")
        _print_interrupted(command, terminal)
        events.end(stop.exit_code, "interrupted")

    try:
        with stop_on_signals(last_words):
            code = _do(command, arguments, terminal, events, started)
    except Interrupted as stop:
        _print_interrupted(command, terminal)
        events.end(stop.exit_code, "interrupted")
        return stop.exit_code
    except Exception as error:
        told = _in_words(error)
        events.end(*((1, f"{type(error).__name__}: {error}") if told is None else (told.exit_code, str(told))))
        raise
    events.end(code)
    return code


def _help_asked_for(arguments: Sequence[str]) -> str | None:
    """The help of a command, where that is asked for; None: the parser has that of all."""
    command, *typed = arguments or ("",)
    everything = not {"--help-all", "--help_all"}.isdisjoint(typed)
    if not (everything or not {"-h", "--help"}.isdisjoint(typed)) or command not in (known := commands(command)):
        return None
    return help_text(everything=everything) if command == "run" else help_of(command, known[command])


def _events_of(command: Command) -> Events:
    is_wanted = isinstance(command, RunCommand) and command.progress == "json"
    return Events(sys.stdout if is_wanted else None)


def _answer_as_colmap(arguments: Sequence[str], terminal: Terminal, started: float) -> int:
    def last_words(_: Interrupted) -> None:
        logger.info("Interrupted")
        _print_interrupted(None, terminal)

    from colmap_sph.app.colmap.commands import answer as colmap_answer

    terminal.spell = spelling_of(arguments[0])
    try:
        with stop_on_signals(last_words):
            return colmap_answer(arguments, terminal, started)
    except Interrupted as stop:
        _print_interrupted(None, terminal)
        return stop.exit_code


def _parsed(arguments: Sequence[str]) -> Command:
    typed = with_dashed_values(arguments)
    arguments = ["run", *all_arguments(typed[1:], RunCommand)] if typed[:1] == ["run"] else typed
    known = commands(arguments[0] if arguments else None)
    if arguments and arguments[0] in known:
        refuse_empty_paths(arguments[1:], known[arguments[0]])
    with standard_output(), refusals_in_words(typed, known), short_completion(arguments):
        command: Command = tyro.extras.subcommand_cli_from_dict(
            known,
            prog="colmap_sph",
            description="Dense reconstruction for COLMAP without a GPU. COLMAP's own commands are taken, too: "
            "patch_match_stereo and stereo_fusion are done here, all others by COLMAP.",
            args=arguments,
            config=(tyro.conf.AvoidSubcommands,),
        )
    return command


def _do(command: Command, arguments: Sequence[str], terminal: Terminal, events: Events, started: float) -> int:
    try:
        Path.cwd()
    except OSError as error:
        raise InputError(f"The current folder cannot be used ({reason_of(error)}); change to another.") from error
    if isinstance(command, RunCommand):
        if command.stage is not None or command.shard is not None:
            return part_command(command, terminal, arguments, events)
        return run_command(command, terminal, arguments, events, started)
    if isinstance(command, DemoCommand):
        return demo_command(command, terminal, arguments)
    if isinstance(command, ReportCommand):
        return report_command(command, terminal)
    if isinstance(command, ViewCommand):
        return view_command(command, terminal)
    from colmap_sph.app.evaluate_command import EvaluateCommand, evaluate_command
    from colmap_sph.app.products.commands import PRODUCTS

    if isinstance(command, EvaluateCommand):
        return evaluate_command(command, terminal)
    return next(answer for options, answer in PRODUCTS.values() if isinstance(command, options))(command, terminal)


def demo_command(command: DemoCommand, terminal: Terminal, arguments: Sequence[str]) -> int:
    """`colmap_sph demo`."""
    options = RunOptions(threads=command.threads)
    options.check()
    log = workspace_log(Workspace(command.output / "dense"), header(arguments))
    with log, Display(terminal, options.num_threads) as display:
        # Not before: no other command renders anything.
        from colmap_sph.app.demo import run_demo
        from colmap_sph.evaluation import format_clouds, format_depth_maps

        result = run_demo(command.output, options=options, progress=display)
    print_summary(result.report, result.workspace, terminal)
    terminal.say("")
    terminal.say("in pixels on the ground (GSD)", label="Against exact depth,", style="bold")
    terminal.say_lines(format_depth_maps(result.depth_maps, terminal.width))
    terminal.say_lines(format_clouds([result.cloud], terminal.width))
    return 0


def _print_interrupted(command: Command | None, terminal: Terminal) -> None:
    words = (
        "what is finished is kept, run the same command again to go on" if isinstance(command, RunCommand) else ""
    )
    terminal.after_interruption()
    terminal.say(words, label="interrupted;" if words else "interrupted", style="bold red")
