"""A run's project and options → what to type to do the same again."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.project import Project


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
    if options.region and Path(options.region).exists():
        options = replace(options, region=str(Path(options.region).absolute()))
    words += _changed(asdict(options), asdict(RunOptions()), "--")
    return shlex.join(words)


def _changed(chosen: Mapping[str, Any], usual: Mapping[str, Any], prefix: str) -> Iterator[str]:
    """Words for the options that differ, those of a stage behind its name."""
    for name, value in chosen.items():
        flag = f"{prefix}{name.replace('_', '-')}"
        if isinstance(value, dict):
            yield from _changed(value, usual[name], f"{flag}.")
        elif value != usual[name] and value is not None:
            values = value if isinstance(value, tuple | list) else [value]
            yield from [flag, *(str(each.absolute()) if isinstance(each, Path) else str(each) for each in values)]
