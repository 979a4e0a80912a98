"""`colmap_sph run --stage`: one job of a cluster's array, and what it says at its end."""

import logging
from collections.abc import Sequence

from colmap_sph.app.events import Events
from colmap_sph.app.log_file import workspace_log
from colmap_sph.app.run_command import PARTIAL_EXIT_CODE, RunCommand, header, progress_of
from colmap_sph.app.terminal import Terminal
from colmap_sph.errors import OptionError, counted
from colmap_sph.pipeline.reconstruct import check_input
from colmap_sph.pipeline.shards.part import Part, StageName, check_part
from colmap_sph.pipeline.shards.run_part import PartReport, run_part
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)

_NEXT = {
    "prepare": "--stage match, with --shard 1/N to N/N in as many jobs",
    "match": "when all shards are done: --stage vote",
    "vote": "when all shards are done: --stage confirm",
    "confirm": "when all shards are done: the same once without --stage and --shard, which fuses and reports",
}


def part_command(command: RunCommand, terminal: Terminal, arguments: Sequence[str], events: Events) -> int:
    """`colmap_sph run --stage`, as it was typed; the last event is the caller's."""
    project, options, stage = (command.project, command.options, command.stage)
    events.begin(arguments, project.root if project.is_named else None, options.num_threads)
    part = check_part(stage, command.shard)
    assert stage is not None
    for name, is_given in (("--dry-run", command.dry_run), ("--within", bool(command.within))):
        if is_given:
            raise OptionError(f"{name} is for whole runs; leave out it or --stage.")
    check_input(project, options)
    log = "" if stage == "prepare" else f"{stage}-{part.number}-of-{part.parts}"
    with (
        workspace_log(Workspace(project.root), header(arguments), log),
        progress_of(command, terminal, events) as progress,
    ):
        logger.info("Options: %s", command)
        report = run_part(
            project,
            options,
            stage,
            part,
            progress=progress,
            overwrite=command.overwrite,
            verify=command.verify,
        )
    _print_part(report, stage, part, terminal)
    return PARTIAL_EXIT_CODE if report.failed else 0


def _print_part(report: PartReport, stage: StageName, part: Part, terminal: Terminal) -> None:
    if stage == "prepare":
        facts = [("prepared", f"{counted(report.total, 'image')}, {counted(report.pairs, 'pair')} to match")]
    else:
        which = f", shard {part}" if part.parts > 1 else ""
        share = f"{report.items} of {report.total} {report.what}"
        facts = [(stage + which, f"{share}: {report.made} made, {report.reused} up to date")]
    facts.append(("next", _NEXT[stage]))
    terminal.facts(facts)
    for name, reason in report.failed.items():
        terminal.say(f"{name}: {reason}", label="not done:", style="yellow")
