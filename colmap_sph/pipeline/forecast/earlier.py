"""What a run chose for its time, kept in the workspace: the same command once more goes on with it."""

from collections.abc import Collection, Sequence
from dataclasses import asdict, astuple
from typing import Annotated

import msgspec
from msgspec import Meta

from colmap_sph.pipeline.forecast.ladder import Settings
from colmap_sph.project.files import atomic_file
from colmap_sph.project.state.records import read_json
from colmap_sph.project.workspace import Workspace


class Earlier(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was asked for, and the best that was chosen for it.

    Attributes
    ----------
    seconds : float
        See `TimeLimit`.
    kept : tuple of str
        Sorted, see `TimeLimit`.
    sampling, partners, rounds, radius
        See `Settings`.
    """

    seconds: float
    kept: Annotated[tuple[str, ...], Meta(max_length=10)]
    sampling: Annotated[float, Meta(gt=0)]
    partners: Annotated[int, Meta(ge=1)]
    rounds: Annotated[int, Meta(ge=0)]
    radius: Annotated[int, Meta(ge=1)]


def keep_choice(workspace: Workspace, seconds: float, kept: Collection[str], settings: Settings) -> None:
    """Write down what was chosen for a time; `OutputError` where that is impossible."""
    choice = Earlier(seconds, tuple(sorted(kept)), **asdict(settings))
    with atomic_file(workspace.within_path) as file:
        file.write(msgspec.json.encode(choice))


def not_beyond(
    workspace: Workspace, seconds: float, kept: Collection[str], ladder: Sequence[Settings]
) -> Sequence[Settings]:
    """The part of a ladder that a run may choose from.

    Where an earlier run was given the same time, that is what it chose and less of the same sampling: what it
    finished is kept, and where it came to its end there is nothing to do.
    """
    earlier = read_json(workspace.within_path, Earlier)
    if earlier is None or (earlier.seconds, set(earlier.kept)) != (seconds, set(kept)):
        return ladder
    most = Settings(earlier.sampling, earlier.partners, earlier.rounds, earlier.radius)
    less = (
        Settings(most.sampling, *map(min, astuple(each)[1:], astuple(most)[1:]))
        for each in ladder
        if each.sampling == most.sampling
    )
    steps = list(dict.fromkeys(less))
    return list(dict.fromkeys([*steps, most])) if steps else ladder
