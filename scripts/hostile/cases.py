"""A case: a world on disk made hostile, the command to try in it, and what may come of it."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from hostile.grounds import NAMES, Grounds, run_arguments
from hostile.runs import Outcome
from hostile.shim import Fault

Random = np.random.Generator
Value = TypeVar("Value")

# What a run may end with; 1 is an error of the program itself.
CODES = frozenset({0, 2, 3, 4, 5, 6})
GIB = 1 << 30


@dataclass(frozen=True)
class Case:
    """A command in a hostile world.

    Attributes
    ----------
    what : str
        What is hostile, in words.
    arguments : tuple of str
        Of the command.
    workspace : Path or None
        Folder below which the command may write; None: nowhere.
    protected : tuple of Path
        Files below the workspace that are the user's.
    project : str
        Whose truth the results are held against.
    names : mapping
        Image of the model → image of the project, of those that are to be compared with the truth.
    whole : bool
        The input says the same as the project's own: with exit code 0 the maps must also be as full.
    codes : frozenset of int
        Exit codes that are right.
    scale : float
        Of the model, relative to the project's.
    same_as : Path or None
        Workspace whose maps and cloud must come out to the bit, wherever the exit code is 0.
    same_at_once : bool
        So it must be after the first run; else it may be only after those that follow.
    again : tuple of str
        Arguments of a run without fault afterwards, which must end with 0 and such maps; empty: none.
    attempts : int
        Runs that this may take.
    fault : Fault, optional
        Of the file operations of the first run below the world.
    in_place : bool
        The model lies where the project's does.
    as_user : bool
        The command has no superuser's rights to files.
    checks : tuple of callable
        Further conditions: outcome → what is wrong, or nothing.
    """

    what: str
    arguments: tuple[str, ...]
    workspace: Path | None = None
    protected: tuple[Path, ...] = ()
    project: str = "plain"
    names: Mapping[str, str] = field(default_factory=dict)
    whole: bool = False
    codes: frozenset[int] = CODES
    scale: float = 1.0
    same_as: Path | None = None
    same_at_once: bool = True
    again: tuple[str, ...] = ()
    attempts: int = 1
    fault: Fault | None = None
    in_place: bool = True
    as_user: bool = False
    checks: tuple[Callable[[Outcome], str | None], ...] = ()


@dataclass(frozen=True)
class Stage:
    """Where a case is set up: dice, what there is to start from, and an empty folder that is watched."""

    rng: Random
    grounds: Grounds
    world: Path

    def pick(self, *choices: Value) -> Value:
        """Return one of the choices."""
        return choices[int(self.rng.integers(len(choices)))]

    def chance(self, share: float) -> bool:
        """Whether something that happens so often happens."""
        return bool(self.rng.random() < share)

    def copy_project(self, name: str = "plain", *, finished: bool = False) -> Path:
        """Copy a project into the world; returns its folder."""
        root = self.world / "project"
        without = shutil.ignore_patterns() if finished else shutil.ignore_patterns("dense")
        shutil.copytree(self.grounds.project(name), root, ignore=without)
        return root

    def copy_workspace(self, source: Path) -> Path:
        """Copy a workspace into the world; returns its folder."""
        return Path(shutil.copytree(source, self.world / "dense"))


def model_run(root: Path, *more: str) -> tuple[str, ...]:
    """Arguments of a run on the model of a project."""
    return tuple(run_arguments("--model", str(root / "sparse" / "0"), *more))


def workspace_run(dense: Path, *more: str) -> tuple[str, ...]:
    """Arguments of a run on a workspace."""
    return tuple(run_arguments("--workspace", str(dense), *more))


def all_names() -> dict[str, str]:
    """Every image is called as in the project."""
    return {name: name for name in NAMES}


def files_below(folder: Path, *patterns: str) -> list[Path]:
    """Regular files below a folder, in order."""
    found = {path for pattern in patterns or ("*",) for path in folder.rglob(pattern)}
    return sorted(path for path in found if path.is_file() and not path.is_symlink())
