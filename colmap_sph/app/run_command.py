"""`colmap_sph run`: its options, its help, the plan of a dry run, and the closing summary."""

import io
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal, Optional

import tyro
from rich.console import Console
from rich.filesize import decimal

import colmap_sph
from colmap_sph.app.display import Display, duration
from colmap_sph.app.events import Events
from colmap_sph.app.given_options import given_places
from colmap_sph.app.log_file import workspace_log
from colmap_sph.app.option_list import option_groups, print_options
from colmap_sph.app.shell_words import to_repeat
from colmap_sph.app.spelling import EVERYDAY
from colmap_sph.app.terminal import Terminal
from colmap_sph.errors import counted, percent, shell_word
from colmap_sph.pipeline.forecast.time_limit import DIALS, TimeLimit, changed_dials, format_time, parse_time
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import Plan, make_plan
from colmap_sph.pipeline.presets import Quality
from colmap_sph.pipeline.reconstruct import check_input, run_project
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.shards.part import StageName
from colmap_sph.project.project import Project
from colmap_sph.project.wide.naming import by_originals
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)

PARTIAL_EXIT_CODE = 5
"""The run finished, but some images of the model have no depth map, or are not in the cloud."""

_MAX_LISTED_IMAGES = 60
# Times what was asked for.
_LATE = 1.05


@dataclass(frozen=True)
class RunCommand:
    """From a COLMAP sparse model to depth maps, normal maps and a fused cloud, without a GPU.

    Give --model after standard structure from motion, or --workspace for a dense workspace that COLMAP's
    image_undistorter made. The result is an ordinary COLMAP dense workspace with fused.ply in it.
    """

    project: Annotated[Project, tyro.conf.arg(name="")] = field(default_factory=Project)
    options: Annotated[RunOptions, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = field(
        default_factory=RunOptions
    )
    quality: Quality = "normal"
    """Preview takes about 0.4 times as long as normal, best 1.5 times. Options given beside it win."""
    within: str = ""
    """Time to end within, such as 20min: it chooses size and settings accordingly."""
    stage: StageName | None = None
    """Make the results of one stage alone, as the jobs of a cluster's arrays do: prepare, then match, vote and
    confirm, and at last all that is left without this option."""
    # Not `str | None`, of which the command line's parser would load a library to check the default.
    shard: Optional[str] = None  # noqa: UP045
    """Part of the stage, I/N: of so many jobs this one, counted from 1, such as 3/16."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Write nothing: say what is to do, and about how much time, memory and disk it takes."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Do everything again, also what an earlier run has finished. Maps and clouds that other programs made are
    kept under another name."""
    verify: tyro.conf.FlagCreatePairsOff[bool] = False
    """Look at every byte of earlier results first, and make again what is damaged."""
    config: Optional[Path] = None  # noqa: UP045
    """File with options, which those typed here win over: TOML, or the report.json of an earlier run."""
    progress: Literal["auto", "json", "none"] = "auto"
    """How the run tells how far it is: bars, or lines off a terminal; events as lines of JSON on the standard
    output; or not at all."""


def run_command(
    command: RunCommand,
    terminal: Terminal,
    arguments: Sequence[str] = (),
    events: Events | None = None,
    started: float | None = None,
) -> int:
    """`colmap_sph run`, as it was typed; the last event is the caller's.

    `started` is when the program began, as `time.monotonic` tells; without it, it is now.
    """
    events = Events(None) if events is None else events
    project = command.project
    options = command.options
    events.begin(arguments, project.root if project.is_named else None, options.num_threads)
    started = time.monotonic() if started is None else started
    limit = _limit(command, arguments, started)
    check_input(project, options, limit)
    workspace = Workspace(project.root)
    if command.dry_run:
        plan = make_plan(project, options, overwrite=command.overwrite, limit=limit)
        events.plan(plan)
        print_plan(plan, workspace, terminal)
        return 0
    with workspace_log(workspace, header(arguments)), progress_of(command, terminal, events) as progress:
        logger.info("Options: %s", command)
        report = run_project(
            project,
            options,
            progress=progress,
            overwrite=command.overwrite,
            verify=command.verify,
            limit=limit,
            started=started,
        )
    events.note(report)
    print_summary(report, workspace, terminal)
    if limit is not None:
        _print_arrival(limit, terminal)
    return PARTIAL_EXIT_CODE if report.skipped_images or report.incomplete else 0


def _limit(command: RunCommand, arguments: Sequence[str], started: float) -> TimeLimit | None:
    """The time limit, if there is one; what was typed stays, also where it is the default."""
    if not command.within:
        return None
    typed = given_places(arguments[1:], RunCommand)
    return TimeLimit(
        parse_time(command.within),
        changed_dials(command.options) | typed.intersection(DIALS),
        started,
    )


def _print_arrival(limit: TimeLimit, terminal: Terminal) -> None:
    taken = f"{format_time(limit.elapsed)} of {format_time(limit.seconds)}"
    if limit.elapsed > _LATE * limit.seconds:
        terminal.say(f"it took {taken}", label="late:", style="yellow")
    else:
        terminal.say(f"it took {taken}", label="in time:")


@contextmanager
def progress_of(command: RunCommand, terminal: Terminal, events: Events) -> Iterator[Progress]:
    """How a run tells how far it is, as the command asks for."""
    if command.progress == "json":
        yield events
    elif command.progress == "none":
        yield Silent()
    else:
        with Display(terminal, command.options.num_threads) as display:
            yield display


def header(arguments: Sequence[str]) -> str:
    """First line of a command in the workspace's log: how to repeat it."""
    return f"colmap_sph {colmap_sph.__version__}: {to_repeat(arguments)}"


# ---- help --------------------------------------------------------------------------------------------------


def help_text(*, everything: bool) -> str:
    """The everyday options of `run` for one screen, or all of them."""
    text = io.StringIO()
    _print_help(Console(file=text), everything=everything)
    return text.getvalue().rstrip()


def _print_help(console: Console, *, everything: bool) -> None:
    plain, *stages = option_groups(RunCommand)
    console.print("usage: colmap_sph run --model SPARSE [OPTIONS]", highlight=False, markup=False)
    console.print("       colmap_sph run --workspace DENSE [OPTIONS]\n", highlight=False, markup=False)
    console.print(plain.text, highlight=False, markup=False)
    known = {option.flag: option for group in (plain, *stages) for option in group.options}
    others = [option for option in plain.options if option.flag not in EVERYDAY] if everything else []
    print_options([*(known[flag] for flag in EVERYDAY), *others], console)
    if not everything:
        console.print(
            "\nAll other options, stage by stage: colmap_sph run --help-all", highlight=False, markup=False
        )
        return
    for group in stages:
        rest = [option for option in group.options if option.flag not in EVERYDAY]
        if rest:
            console.print(f"\n{group.name}: {group.text}", highlight=False, markup=False)
            print_options(rest, console)


# ---- plan and summary --------------------------------------------------------------------------------------


def print_plan(plan: Plan, workspace: Workspace, terminal: Terminal) -> None:
    """Print what a run would do and need.

    Parameters
    ----------
    plan : Plan
    workspace : Workspace
        To which nothing was written.
    terminal : Terminal
    """
    facts = [("region", plan.region)] if plan.region else []
    facts.append(("undistort", "to do" if plan.undistort else "done"))
    for what, number, done in (
        ("pairs", plan.pairs, plan.pairs_done),
        ("images", plan.images, plan.images_done),
        ("cloud", 1, int(not plan.fuse)),
    ):
        facts.append((what, f"{number - done} to do, {done} done"))
    facts.append(("time", f"about {duration(plan.seconds)}"))
    if plan.choice:
        facts.append(("within", plan.choice))
    facts.append(("memory", f"about {decimal(round(plan.memory))}"))
    facts.append(("disk", f"about {decimal(round(plan.disk))} more, of {decimal(plan.free_disk)} free"))
    terminal.facts(facts)
    terminal.say(
        "Time, memory and disk are estimates from the numbers of pixels; the time is that of a 2.5 GHz server. "
        f"Nothing was written to {workspace.root}."
    )


def _share(value: float | None) -> str:
    return "" if value is None else percent(value)


def _agreement(report: RunReport) -> str:
    """How far the depth maps agree with the sparse points."""
    if report.overall_agreement is None:
        return "no sparse points to check against"
    return f"{percent(report.overall_agreement)} of the sparse points agree with the depth maps"


def print_summary(report: RunReport, workspace: Workspace, terminal: Terminal) -> None:
    """Print the closing summary of a run.

    Parameters
    ----------
    report : RunReport
    workspace : Workspace
        With the results.
    terminal : Terminal
    """
    listed = sorted(report.coverage.items(), key=lambda item: item[1])
    rows = [
        (name, percent(share), _share(report.agreement.get(name)))
        for name, share in sorted(listed[:_MAX_LISTED_IMAGES])
    ]
    caption = f"the {_MAX_LISTED_IMAGES} least covered of {len(listed)} images" if len(listed) > len(rows) else ""
    terminal.table("Depth maps", ["image", "coverage", "agreement"], rows, caption)
    terminal.facts(list(_facts(report, workspace)))
    images = by_originals(report.skipped_images, report.views)
    for what, skipped in (("image", images), ("pair", report.skipped_pairs)):
        _print_causes(skipped, f"{what} skipped:", terminal)
    _print_causes(by_originals(report.incomplete, report.views), "incomplete:", terminal)
    for label, text in (
        ("imprecise:", report.imprecision),
        ("ignored:", report.still),
        ("disagreement:", report.doubts),
        ("few points:", report.advice),
    ):
        if text:
            terminal.say(text, label=label, style="yellow")


def _facts(report: RunReport, workspace: Workspace) -> Iterator[tuple[str, str]]:
    """What a run did, with the names by which the summary calls it."""
    mean = sum(report.coverage.values()) / max(len(report.coverage), 1)
    yield "images", f"{report.images} with depth maps, mean coverage {percent(mean)}"
    if report.originals:
        mean = sum(report.originals.values()) / len(report.originals)
        yield "originals", f"{len(report.originals)} of which these are views, mean coverage {percent(mean)}"
    if report.region is not None:
        left = f"; {len(report.out_of_region)} left out that see too little of it" if report.out_of_region else ""
        yield "region", f"in {counted(len(report.coverage), 'image')}, of whose pixels in it coverage is{left}"
    if report.drawn_region:
        yield "drawn", report.drawn_region
    if report.stretched:
        yield "values", report.stretched
    yield "agreement", _agreement(report)
    yield "pairs", f"{report.pairs} matched ({report.pair_source})"
    if report.within:
        yield "within", report.within
    if report.polishing:
        yield "poses", report.polishing
    if report.points:  # there are none where only maps were asked for
        where = (
            f"{counted(report.tiles, 'tile')} in {workspace.tiles_dir}"
            if report.tiles
            else str(workspace.fused_path)
        )
        yield "cloud", f"{counted(report.points, 'point')} in {where}"
    if any(report.reused.values()):
        yield "up to date", ", ".join(f"{stage} {number}" for stage, number in report.reused.items() if number)
    times = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in report.seconds.items())
    yield "seconds", f"{report.total_seconds:.1f} ({times})"
    yield "peak memory", f"{report.peak_memory / 2**30:.2f} GiB"
    if workspace.page_path.is_file():
        shown = shell_word(workspace.root)
        yield "look at", f"{workspace.page_path}, in a browser: colmap_sph view {shown}"


def _print_causes(causes: Mapping[str, str], label: str, terminal: Terminal) -> None:
    """Say what became of images or pairs, of many of the first ones."""
    for name, reason in islice(causes.items(), _MAX_LISTED_IMAGES):
        terminal.say(f"{name}: {reason}", label=label, style="yellow")
    if len(causes) > _MAX_LISTED_IMAGES:
        terminal.say(f"{len(causes) - _MAX_LISTED_IMAGES} more, see report.json", label=label, style="yellow")
