"""What a run tells of itself when it is done: `report.json`, with the command to repeat it, and the page."""

import json
import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import msgspec

from colmap_sph.errors import OutputError, reason_of, shell_word
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.digests import digest, file_digest
from colmap_sph.pipeline.known.table import stamp_of_files
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.program import program_digest, versions
from colmap_sph.platforms.memory import most_resident
from colmap_sph.project.files import atomic_file, make_dir, remove
from colmap_sph.project.project import Project
from colmap_sph.project.region_file import AUTO
from colmap_sph.project.state.records import read_json
from colmap_sph.stereo.kernels import backend

logger = logging.getLogger(__name__)

# What of a report differs from run to run with the same results.
_OF_THE_RUN = {"made", "reused", "seconds", "total_seconds", "peak_memory"}
# Bytes per pixel of an image while the page looks at it.
_PAGE_BYTES = 8


def command_of(project: Project, options: RunOptions) -> str:
    """Return the command line of a run: its paths, and the options that are not at their defaults.

    Paths are absolute, so that it can be typed anywhere.

    Examples
    --------
    >>> options = RunOptions(threads=2)
    >>> command_of(Project(model=Path("/block 7/sparse/0")), options)
    "colmap_sph run --model '/block 7/sparse/0' --threads 2"
    """
    words = ["colmap_sph", "run"]
    for each in fields(project):
        path = getattr(project, each.name)
        if path is not None:
            words += [f"--{each.name}", str(Path(path).absolute())]
    if options.region not in ("", AUTO) and Path(options.region).exists():
        options = replace(options, region=str(Path(options.region).absolute()))
    words += _changed(asdict(options), asdict(RunOptions()), "--")
    return " ".join(map(shell_word, words))


def write_report(context: Context) -> None:
    """Write `report.json`: versions, options, and what the run tells of itself."""
    report = context.report
    report.total_seconds = time.monotonic() - report.started
    report.peak_memory = max(report.peak_memory, most_resident())
    with atomic_file(context.workspace.report_path) as file:
        file.write(json.dumps(_content(context), indent=1, default=str).encode())


def _content(context: Context) -> dict[str, Any]:
    told = asdict(context.report)
    del told["started"]
    return {
        "versions": versions(),
        "kernels": backend(),
        "options": asdict(context.options),
        **told,
    }


def keep_or_make_page(context: Context) -> None:
    """Make the page of a run that is done, unless nothing was made and the page that is there says the same."""
    workspace = context.workspace
    key = _page_key(context)
    path = workspace.known_path("page")
    if not any(context.report.made.values()):
        known = read_json(path, _KnownPage)
        if known is not None and known == _KnownPage(key, stamp_of_files([str(workspace.page_path)])):
            workspace.page_path.touch()  # it is of this report
            _know_page(path, key, workspace.page_path)
            return
    make_page(context)
    if workspace.page_path.exists():
        _know_page(path, key, workspace.page_path)


class _KnownPage(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of the page: digest of what it was made from, and the stamp of its file."""

    key: str
    stamp: str


def _know_page(path: Path, key: str, page: Path) -> None:
    make_dir(path.parent)
    with atomic_file(path, sync=False) as file:
        file.write(msgspec.json.encode(_KnownPage(key, stamp_of_files([str(page)]))))


def _page_key(context: Context) -> str:
    """Digest of what a page is made from, of maps and a cloud that are as they were; less times and numbers."""
    content = {name: value for name, value in _content(context).items() if name not in _OF_THE_RUN}
    files = sorted(path for path in (Path(__file__).parents[1] / "pages").rglob("*.*") if path.is_file())
    templates = [file_digest(path) for path in files if path.suffix != ".pyc"]
    return digest(program_digest("colmap_sph.pages.page"), templates, json.dumps(content, default=str))


def make_page(context: Context) -> None:
    """Make the page of a run that is done; where that fails, the run has not."""
    workspace = context.workspace
    start = time.perf_counter()
    try:
        from colmap_sph.pages import write_page  # which takes a while to load, and not all runs make a page

        write_page(workspace, context.progress, threads=_page_threads(context))
    except Exception as error:
        with suppress(OutputError):
            remove(workspace.page_path)  # one of an earlier run says what is not so any more
        logger.warning(
            "%s could not be made (%s); everything else is there, `colmap_sph report %s` tries it again.",
            workspace.page_path,
            reason_of(error),
            shell_word(workspace.root),
        )
        logger.info("Why there is no page", exc_info=True)
    else:
        logger.info("Report: %.1f s", time.perf_counter() - start)


def _page_threads(context: Context) -> int:
    """As many images as the page may look at at a time, each decoded at its full size."""
    largest = max((view.width * view.height for view in context.scene.views), default=1)
    options = context.options
    return max(1, min(options.num_threads, options.memory_budget // (_PAGE_BYTES * largest)))


def _changed(chosen: Mapping[str, Any], usual: Mapping[str, Any], prefix: str) -> Iterator[str]:
    """Words for the options that differ, those of a stage behind its name."""
    for name, value in chosen.items():
        flag = f"{prefix}{name.replace('_', '-')}"
        if isinstance(value, dict):
            yield from _changed(value, usual[name], f"{flag}.")
        elif value != usual[name] and value is not None:
            values = value if isinstance(value, tuple | list) else [value]
            yield from [flag, *(str(each.absolute()) if isinstance(each, Path) else str(each) for each in values)]
