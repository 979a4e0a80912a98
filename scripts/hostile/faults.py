"""Errors of the machine in the middle of a run: at one file operation, for a moment or for good."""

import errno
import pickle
import shutil
from dataclasses import dataclass
from pathlib import Path

from hostile.cases import CODES, Case, Stage, model_run, workspace_run
from hostile.grounds import Grounds, read_depth
from hostile.runs import Surroundings, run
from hostile.shim import Control, Fault, Operation

ERRORS = {
    "open": (errno.EIO, errno.EACCES, errno.ENOSPC, errno.EMFILE, errno.ESTALE),
    "read": (errno.EIO, errno.ESTALE, 0),
    "write": (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, 0),
    "close": (errno.EIO, errno.ENOSPC, errno.EDQUOT),
    "sync": (errno.EIO, errno.ENOSPC, errno.EDQUOT),
    "rename": (errno.EIO, errno.EACCES, errno.ENOSPC, errno.EXDEV),
    "remove": (errno.EIO, errno.EACCES, errno.EBUSY),
    "make": (errno.EIO, errno.EACCES, errno.ENOSPC),
    "resize": (errno.EIO, errno.ENOSPC, errno.EFBIG),
    "map": (errno.EIO, errno.ENOMEM, errno.EACCES),
    "list": (errno.EIO, errno.EACCES),
}
# What cannot be written is no mistake in the input.
_WRITING = ("write", "sync", "rename", "make", "resize")
_FOREVER = 1 << 62


@dataclass(frozen=True)
class Scenario:
    """A run in a world, to be disturbed; what makes it whole again; and where its results are right.

    Attributes
    ----------
    root : Path
        The project or the workspace.
    arguments, again : tuple of str
    dense : Path
    same_as : Path
    """

    root: Path
    arguments: tuple[str, ...]
    again: tuple[str, ...]
    dense: Path
    same_as: Path


SCENARIOS = ("new", "new curved", "adopted", "overwritten", "overwritten adopted", "resumed", "finished")


def set_up(stage: Stage, name: str) -> Scenario:
    """Copy what a scenario needs into the world."""
    grounds = stage.grounds
    if "adopted" in name:
        dense = stage.copy_workspace(grounds.prepared if name == "adopted" else grounds.adopted)
        again = workspace_run(dense)
        more = ("--overwrite",) if name != "adopted" else ()
        return Scenario(dense, (*again, *more), again, dense, grounds.adopted)
    project = "curved" if name == "new curved" else "plain"
    root = stage.copy_project(project, finished=not name.startswith("new"))
    dense = root / "dense"
    if name == "resumed":
        shutil.rmtree(dense / "colmap_sph" / "photometric")
        min((dense / "colmap_sph" / "pairs").rglob("*.sph")).unlink()
        (dense / "fused.ply").unlink()
        for path in dense.glob("stereo/depth_maps/*.bin"):
            path.unlink()
    again = model_run(root)
    more = ("--overwrite",) if name == "overwritten" else ()
    return Scenario(root, (*again, *more), again, dense, grounds.project(project) / "dense")


def make(stage: Stage) -> Case:
    """Disturb one operation of a scenario, or all from one on."""
    rng = stage.rng
    name = str(stage.pick(*SCENARIOS))
    scenario = set_up(stage, name)
    counted = operations_of(stage.grounds, name)
    # Kinds are drawn first: most operations are reads, and few are renames.
    kind = str(stage.pick(*sorted({operation.kind for operation in counted})))
    number = sum(operation.kind == kind for operation in counted)
    first = int(rng.integers(1, number + 1))
    codes = ERRORS[kind]
    code = codes[int(rng.integers(len(codes)))]
    last = (
        first
        if code == 0 or stage.chance(0.6)
        else _FOREVER
        if stage.chance(0.7)
        else first + int(rng.integers(1, 20))
    )
    fault = Fault((kind,), first, last, code)
    return Case(
        f"{name}: {fault}",
        scenario.arguments,
        scenario.dense,
        codes=frozenset({0, 3, 5} if kind in _WRITING else CODES),
        same_as=scenario.same_as,
        again=scenario.again,
        fault=fault,
    )


def operations_of(grounds: Grounds, name: str) -> list[Operation]:
    """The file operations of a scenario that is left alone, in their order."""
    path = grounds.folder / f"operations-{name.replace(' ', '-')}.pickle"
    operations: list[Operation] = pickle.loads(path.read_bytes())
    return operations


def count_operations(stage: Stage, name: str, around: Path) -> None:
    """Run a scenario undisturbed, and keep what was counted for `operations_of`."""
    scenario = set_up(stage, name)
    control = Control(around / "control", stage.world, None)
    done = run(list(scenario.arguments), Surroundings(around, control=control))
    operations = control.operations
    if done.code != 0 or not operations:
        raise RuntimeError(f"{name}: {len(operations)} operations counted: {done}\n{done.stderr}")
    read_depth(next(scenario.dense.glob("stereo/depth_maps/*.geometric.bin")))
    path = stage.grounds.folder / f"operations-{name.replace(' ', '-')}.pickle"
    path.write_bytes(pickle.dumps(operations))
