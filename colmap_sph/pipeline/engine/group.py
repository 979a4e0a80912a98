"""What is sent to a worker and what it answers: neighbouring tasks of one stage, as plain data."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Kept, Stage

Task = TypeVar("Task")


@dataclass(frozen=True)
class RunSeen:
    """A run, as workers see it.

    Attributes
    ----------
    token : str
        Nobody else's.
    path : Path
        File that holds the token as long as the run lasts, on the disk that all machines share.
    digests : mapping of str to str
        Of the code that makes each kind of result, see `program_digests`.
    versions : mapping of str to str
        See `program.versions`.
    """

    token: str
    path: Path
    digests: Mapping[str, str]
    versions: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class Piece(Generic[Task]):
    """One item's task, what the item is called in messages, and the bytes that it is to reserve."""

    task: Task
    label: str
    memory: float


@dataclass(frozen=True, eq=False)
class Group(Generic[Task]):
    """Neighbouring items of a stage, made by one worker one after the other.

    Attributes
    ----------
    run : RunSeen
    stage : type of Stage
        Whose `make` makes them.
    number : int
        Which stage of the run it is.
    kept : Kept
        What a worker keeps from item to item, as long as it works at this stage.
    neighbours : mapping of str to int
        How many workers there are on each machine, by its address.
    pieces : sequence of Piece
    """

    run: RunSeen
    stage: type[Stage[Any, Task]]
    number: int
    kept: Kept
    neighbours: Mapping[str, int]
    pieces: Sequence[Piece[Task]]


@dataclass(frozen=True)
class Outcome:
    """What became of an item: what is known of its result, or why there is none; and the seconds that it took."""

    facts: Facts | None
    failure: str = ""
    taken: float = 0.0


@dataclass(frozen=True)
class Answer:
    """What became of a group.

    Attributes
    ----------
    outcomes : sequence of Outcome
        As many as the group has pieces.
    words : sequence of (int, str)
        Warnings on the way: level of the log, and message.
    peak_memory : int
        Largest resident set of the worker so far, bytes.
    """

    outcomes: Sequence[Outcome]
    words: Sequence[tuple[int, str]]
    peak_memory: int


def folders_of(task: object) -> set[Path]:
    """Folders of all files that a task names, in the records and sequences that it is made of."""
    return {path.parent for path in _paths_in(task)}


def _paths_in(value: object) -> Iterator[Path]:
    if isinstance(value, Path):
        yield value
    elif isinstance(value, tuple | list):
        for each in value:
            yield from _paths_in(each)
    elif is_dataclass(value):
        for field in fields(value):
            yield from _paths_in(getattr(value, field.name))
