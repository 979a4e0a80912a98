"""The command line: subcommands, progress, messages; nothing else."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import cv2
import rich.logging
import rich.progress
import tyro
from rich.console import Console
from rich.filesize import decimal
from rich.table import Table

import colmap_sph
from colmap_sph.app.demo import run_demo
from colmap_sph.app.evaluate_command import EvaluateCommand, evaluate_command
from colmap_sph.app.interruption import Interrupted, stop_on_signals
from colmap_sph.app.log_file import workspace_log
from colmap_sph.errors import ColmapSphError, OutOfMemoryError, OutputError, reason_of
from colmap_sph.evaluation import format_clouds, format_depth_maps
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import Plan, make_plan
from colmap_sph.pipeline.reconstruct import run
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.workers import is_memory_error
from colmap_sph.project.project import Project
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.stereo.confirm import ConfirmOptions
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.normals import NormalOptions
from colmap_sph.stereo.pairs import PairOptions
from colmap_sph.stereo.rectification import RectificationOptions
from colmap_sph.stereo.refinement import RefinementOptions
from colmap_sph.stereo.vote import VoteOptions

logger = logging.getLogger(__name__)

PARTIAL_EXIT_CODE = 5
"""The run finished, but some images of the model have no depth map, or are not in the cloud."""

_MAX_LISTED_IMAGES = 60


@dataclass(frozen=True)
class RunCommand:
    """From a COLMAP sparse model to depth maps, normal maps and a fused cloud, without a GPU.

    Give --model after standard structure from motion, or --workspace for a dense workspace that COLMAP's
    image_undistorter made. The result is an ordinary COLMAP dense workspace with fused.ply in it.
    """

    model: Path | None = None
    """Sparse model (binary or text), such as sparse/0. Its images are undistorted into --output."""
    images: Path | None = None
    """Original images. Default: the folder `images` beside or above the model."""
    masks: Path | None = None
    """Masks: NAME.png for image NAME with its folders, black = ignored. Of the original images, or with
    --workspace of the undistorted ones."""
    output: Path | None = None
    """Dense workspace to create. Default: the folder `dense` beside the model's `sparse`."""
    workspace: Path | None = None
    """Existing dense workspace, instead of --model, --images and --output."""
    threads: int = 0
    """Worker threads; 0: all cores."""
    memory: str = ""
    """Memory to use at most, such as 6GiB. Default: a safe share of what is free."""
    fusion_input: MapKind = "geometric"
    """Maps to fuse: those confirmed by other views, or the unchecked ones."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only say what is to do, and about how much time, memory and disk it takes; write nothing."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Do everything again, also what an earlier run in this workspace has finished."""
    undistortion: Annotated[UndistortionOptions, tyro.conf.arg(name="")] = field(
        default_factory=UndistortionOptions
    )
    pairs: Annotated[PairOptions, tyro.conf.arg(name="")] = field(default_factory=PairOptions)
    rectification: Annotated[RectificationOptions, tyro.conf.arg(name="")] = field(
        default_factory=RectificationOptions
    )
    matching: Annotated[MatchingOptions, tyro.conf.FlagConversionOff] = field(default_factory=MatchingOptions)
    vote: VoteOptions = field(default_factory=VoteOptions)
    confirm: ConfirmOptions = field(default_factory=ConfirmOptions)
    normals: NormalOptions = field(default_factory=NormalOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)
    fusion: Annotated[FusionOptions, tyro.conf.FlagConversionOff] = field(default_factory=FusionOptions)

    def options(self) -> RunOptions:
        """The options of all stages."""
        return RunOptions(**{name: getattr(self, name) for name in RunOptions.__dataclass_fields__})

    def sources(self) -> dict[str, Any]:
        """What `run` and `make_plan` are to work on, by the names of their arguments."""
        names = ("model", "images", "masks", "output", "workspace", "overwrite")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class DemoCommand:
    """Render a small aerial block, reconstruct it, and compare the result with its exact depth."""

    output: Path = Path("demo")
    """Folder for the block and its dense workspace."""
    threads: int = 0
    """Worker threads; 0: all cores."""


def main(arguments: list[str] | None = None) -> int:
    """Entry point of the `colmap_sph` command; returns the exit code."""
    console = Console(stderr=True)
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments and arguments[0] in ("--version", "-V"):
        print(f"colmap_sph {colmap_sph.__version__}")
        return 0
    command = tyro.extras.subcommand_cli_from_dict(
        # `run` alone has flags without a value, among its own options.
        {"run": RunCommand, "demo": DemoCommand, "evaluate": tyro.conf.FlagConversionOff[EvaluateCommand]},
        prog="colmap_sph",
        description="Dense reconstruction for COLMAP without a GPU.",
        args=arguments,
        config=(tyro.conf.AvoidSubcommands,),
    )

    def last_words(_: Interrupted) -> None:
        logger.info("Interrupted")
        console.show_cursor()
        _print_interrupted(command, console)

    with _console_logging(console):
        try:
            with stop_on_signals(last_words):
                if isinstance(command, RunCommand):
                    return run_command(command, console)
                if isinstance(command, DemoCommand):
                    return demo_command(command, console)
                return evaluate_command(command, console)
        except Interrupted as stop:
            _print_interrupted(command, console)
            return stop.exit_code
        except ColmapSphError as error:
            return _print_error(error, console)
        except (MemoryError, cv2.error) as error:
            if not is_memory_error(error):
                raise
            return _print_error(OutOfMemoryError(), console)
        except OSError as error:
            if error.errno is None or isinstance(error, BrokenPipeError):
                raise
            what = f"{error.filename} cannot be used" if error.filename else "A file cannot be written"
            return _print_error(OutputError(f"{what} ({reason_of(error)}); check space and permissions."), console)


def run_command(command: RunCommand, console: Console) -> int:
    """`colmap_sph run`."""
    project = Project(command.model, command.images, command.masks, command.output, command.workspace)
    project.check()
    root, options = project.root, command.options()
    options.check()
    if command.dry_run:
        print_plan(make_plan(options=options, **command.sources()), Workspace(root), console)
        return 0
    with workspace_log(Workspace(root), _header(command)), _Display(console) as display:
        report = run(options=options, progress=display, **command.sources())
    print_summary(report, Workspace(root), console)
    return PARTIAL_EXIT_CODE if report.skipped_images else 0


def print_plan(plan: Plan, workspace: Workspace, console: Console) -> None:
    """What a run would do and need."""
    facts = Table.grid(padding=(0, 2))
    facts.add_row("undistort", "to do" if plan.undistort else "done")
    for what, number, done in (
        ("pairs", plan.pairs, plan.pairs_done),
        ("images", plan.images, plan.images_done),
        ("cloud", 1, int(not plan.fuse)),
    ):
        facts.add_row(what, f"{number - done} to do, {done} done")
    facts.add_row("time", f"about {_duration(plan.seconds)}")
    facts.add_row("memory", f"about {decimal(round(plan.memory))}")
    facts.add_row("disk", f"about {decimal(round(plan.disk))} more, of {decimal(plan.free_disk)} free")
    console.print(facts, highlight=False)
    console.print(
        "Time, memory and disk are estimates from the numbers of pixels, good to a factor of two or so; "
        f"nothing was written to {_escaped(workspace.root)}.",
        highlight=False,
        soft_wrap=True,
    )


def _duration(seconds: float) -> str:
    """Such as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def print_summary(report: RunReport, workspace: Workspace, console: Console) -> None:
    """The closing summary of a run."""
    listed = sorted(report.coverage.items(), key=lambda item: item[1])
    table = Table("image", "coverage", title="Depth maps", title_justify="left")
    for name, share in sorted(listed[:_MAX_LISTED_IMAGES]):
        table.add_row(_escaped(name), f"{share:.1%}")
    if len(listed) > _MAX_LISTED_IMAGES:
        table.caption = f"the {_MAX_LISTED_IMAGES} least covered of {len(listed)} images"
    console.print(table)
    mean = sum(report.coverage.values()) / max(len(report.coverage), 1)
    facts = Table.grid(padding=(0, 2))
    facts.add_row("images", f"{report.images} with depth maps, mean coverage {mean:.1%}")
    facts.add_row("pairs", f"{report.pairs} matched ({report.pair_source})")
    facts.add_row("cloud", f"{report.points:,} points in {_escaped(workspace.fused_path)}")
    if any(report.reused.values()):
        kept = ", ".join(f"{stage} {number}" for stage, number in report.reused.items() if number)
        facts.add_row("up to date", kept)
    times = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in report.seconds.items())
    facts.add_row("seconds", f"{sum(report.seconds.values()):.1f} ({times})")
    facts.add_row("peak memory", f"{report.peak_memory / 2**30:.2f} GiB")
    console.print(facts, highlight=False)
    for what, skipped in (("image", report.skipped_images), ("pair", report.skipped_pairs)):
        for name, reason in skipped.items():
            console.print(f"[yellow]{what} skipped:[/] {_escaped(name)}: {_escaped(reason)}", soft_wrap=True)
    if report.advice:
        console.print(f"[yellow]few points:[/] {_escaped(report.advice)}", soft_wrap=True)


def demo_command(command: DemoCommand, console: Console) -> int:
    """`colmap_sph demo`."""
    with workspace_log(Workspace(command.output / "dense"), _header(command)), _Display(console) as display:
        result = run_demo(command.output, options=RunOptions(threads=command.threads), progress=display)
    print_summary(result.report, result.workspace, console)
    console.print("\n[bold]Against exact depth[/], in pixels on the ground (GSD)", highlight=False)
    console.print(format_depth_maps(result.depth_maps), highlight=False, soft_wrap=True)
    console.print(format_clouds([result.cloud]), highlight=False, soft_wrap=True)
    return 0


class _Display:
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

    def __enter__(self) -> "_Display":
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def start(self, stage: str, total: int) -> None:
        self._task = self._bars.add_task(stage, total=total)

    def advance(self) -> None:
        if self._task is not None:
            self._bars.advance(self._task)


def _print_error(error: ColmapSphError, console: Console) -> int:
    console.print(f"[bold red]error:[/] {_escaped(error)}", highlight=False, soft_wrap=True)
    return error.exit_code


def _print_interrupted(command: object, console: Console) -> None:
    remedy = "; what is finished is kept, run the same command again to go on"
    words = remedy if isinstance(command, RunCommand) else ""
    console.print(f"[bold red]interrupted[/]{words}", highlight=False, soft_wrap=True)


def _header(command: object) -> str:
    return f"colmap_sph {colmap_sph.__version__}: {command}"


def _escaped(text: object) -> str:
    return str(text).replace("[", r"\[")


@contextmanager
def _console_logging(console: Console) -> Iterator[None]:
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
