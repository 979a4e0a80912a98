"""End a run between two of its file operations, or let one of them fail; run again; compare with a run left alone.

    python scripts/check_interruptions.py --output /tmp/interruptions
    python scripts/check_interruptions.py --model sparse/0 --max-image-size 400 --output /tmp/interruptions

Without --model it renders a small block. A shim that the system's compiler `cc` makes counts the file operations
of a run below its workspace, and at the chosen one sends SIGKILL or SIGTERM, or has it fail. The moments are
spread over undistortion, moving the workspace into place, matching, depth maps and fusion, of new runs, of runs
with --overwrite and of runs with --workspace. The same command, without --overwrite, must then end with exit code
0 and the same maps and cloud to the bit; after a signal it must not make again what was finished. Exit code 1:
something was not so.
"""

import errno
import shutil
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from hostile.faults import ERRORS
from hostile.grounds import make_grounds
from hostile.runs import Outcome, Surroundings, end_group, run
from hostile.shim import KINDS, Control, Fault, Operation, load_shim
from hostile.verdicts import differences

import colmap_sph.app.cli  # noqa: F401  # loaded before any fork
from colmap_sph.app.run_command import PARTIAL_EXIT_CODE

STAGES = ("undistortion", "publishing", "matching", "depth", "fusion")
_FOR_GOOD = 1 << 62


@dataclass(frozen=True)
class Check:
    """End a run between two of its file operations, run again, and compare with a run that was left alone."""

    output: Path
    """Folder for the workspaces; what an earlier check left there is removed."""
    model: Path | None = None
    """Sparse model, with its images where `colmap_sph run` finds them. Default: a small rendered block."""
    max_image_size: int = -1
    """As for `colmap_sph run`."""
    threads: int = 2
    """Worker threads."""
    signals: int = 60
    """Runs that are ended: half of them by SIGKILL, half by SIGTERM."""
    errors: int = 60
    """Runs of which an operation fails, for a moment or from then on."""
    seed: int = 0
    """Of the moments."""


@dataclass(frozen=True)
class Way:
    """A way to run.

    Attributes
    ----------
    name : str
    start : Path or None
        Workspace to begin with a copy of.
    arguments, again : tuple of str
        Of the run, and of the run that follows, less the workspace itself.
    whole : Path
        Workspace of a run left alone.
    """

    name: str
    start: Path | None
    arguments: tuple[str, ...]
    again: tuple[str, ...]
    whole: Path


@dataclass(frozen=True)
class Disturbance:
    """One run that was disturbed, and what came of it.

    Attributes
    ----------
    words : str
        Way, stage, and fault.
    hit : Operation or None
        The first operation that was disturbed; None: the run had ended before.
    first, second : Outcome
        Of the run, and of the one that followed.
    wrong : str
        What is then not as in a run left alone; and after a signal, what was finished and has been made again.
    """

    words: str
    hit: Operation | None
    first: Outcome
    second: Outcome
    wrong: str

    @property
    def is_right(self) -> bool:
        """Whether nothing was lost and nothing went wrong."""
        quiet = "Traceback" not in self.first.stderr + self.second.stderr
        honest = self.first.code in (0, 2, 3, 4, PARTIAL_EXIT_CODE, 6, 143, None) and not self.first.timed_out
        died = self.first.signal in (0, signal.SIGKILL, signal.SIGTERM)
        finished = self.second.code in (0, PARTIAL_EXIT_CODE) and not self.wrong
        return quiet and honest and died and finished


def main(check: Check) -> int:
    """Run, print a line per disturbance, return the exit code."""
    load_shim(check.output)
    output = check.output.resolve()
    ways = make_ways(check, output)
    done = []
    for number, disturbance in enumerate(disturb(check, ways, output), start=1):
        hit = "not reached" if disturbance.hit is None else f"{disturbance.hit.kind} {disturbance.hit.path}"
        print(
            f"{number:4d}  {disturbance.words}: {hit}; {_end(disturbance.first)}, then {_end(disturbance.second)}"
        )
        if not disturbance.is_right:
            print(f"      WRONG: {disturbance.wrong}")
            print(f"      {disturbance.first}\n      {disturbance.second}", flush=True)
        sys.stdout.flush()
        done.append(disturbance)
    for what, part in (("signals", done[: check.signals]), ("errors", done[check.signals :])):
        print(f"{len(part)} {what}: {sum(each.is_right for each in part)} finished, identical, nothing made again")
    return int(not all(each.is_right for each in done))


def _end(outcome: Outcome) -> str:
    return f"signal {outcome.signal}" if outcome.signal else f"code {outcome.code}"


# ---- what is disturbed --------------------------------------------------------------------------------------


def make_ways(check: Check, output: Path) -> list[Way]:
    """Make a workspace that was left alone, and say in which ways one can be made."""
    model = check.model
    if model is None:
        model = make_grounds(output / "grounds").project("curved") / "sparse" / "0"
    options = ("--threads", str(check.threads))
    by_model = ("--model", str(model.resolve()), "--max-image-size", str(check.max_image_size), *options)
    whole = output / "whole"
    _run_whole([*by_model, "--output", str(whole)], output)
    prepared = output / "prepared"
    shutil.copytree(whole, prepared, ignore=shutil.ignore_patterns("colmap_sph", "fused*", "*.bin.*"))
    for path in prepared.glob("stereo/*_maps/**/*.bin"):
        path.unlink()
    adopted = output / "adopted"
    shutil.copytree(prepared, adopted)
    _run_whole(["--workspace", str(adopted), *options], output)
    return [
        Way("new", None, (*by_model, "--output"), (*by_model, "--output"), whole),
        Way("overwrite", whole, (*by_model, "--overwrite", "--output"), (*by_model, "--output"), whole),
        Way("workspace", prepared, (*options, "--workspace"), (*options, "--workspace"), adopted),
    ]


def _run_whole(arguments: list[str], output: Path) -> None:
    around = output / "alone"
    around.mkdir(exist_ok=True)
    done = run(["run", *arguments], Surroundings(around, seconds=36_000))
    # Images of the model that have no depth map are no fault of the interruptions.
    if done.code not in (0, PARTIAL_EXIT_CODE):
        raise RuntimeError(f"a run left alone failed: {done}\n{done.stderr}")


def disturb(check: Check, ways: list[Way], output: Path) -> Iterator[Disturbance]:
    """Disturb runs, first by signals, then by errors."""
    rng = np.random.default_rng(check.seed)
    counted = {way.name: _count(way, output) for way in ways}
    for number in range(check.signals + check.errors):
        way = ways[number % len(ways)]
        stages = stages_of(counted[way.name])
        # All stages in turn, of all ways.
        present = [stage for stage in STAGES if stages[stage]]
        stage = present[number // len(ways) % len(present)]
        place = int(rng.choice(stages[stage]))
        if number < check.signals:
            stop = (signal.SIGKILL, signal.SIGTERM)[number % 2]
            fault = Fault(KINDS, place + 1, place + 1, stop=stop)
        else:
            fault = _error_at(counted[way.name], place, rng)
        yield _disturb_one(way, stage, fault, output, only_main=bool(rng.random() < 0.5))


def stages_of(operations: list[Operation]) -> dict[str, list[int]]:
    """Places of the operations of each stage; publishing are those next to a renaming before matching."""
    starts = [
        _first(operations, *marks) for marks in (("/pairs/",), ("/photometric/",), ("fused.ply", "/.fusion.tmp/"))
    ]
    bounds = [0, *starts, len(operations)]
    names = ("undistortion", "matching", "depth", "fusion")
    found = {name: list(range(*bounds[n : n + 2])) for n, name in enumerate(names)}
    renamed = [place for place in found["undistortion"] if operations[place].kind == "rename"]
    found["publishing"] = [place for place in (*renamed, *(place + 1 for place in renamed)) if place < starts[0]]
    return found


def _first(operations: list[Operation], *marks: str) -> int:
    """Place of the first operation in which something with such a path is made."""
    making = ("write", "rename", "make")
    hits = (n for n, each in enumerate(operations) if each.kind in making and any(m in each.path for m in marks))
    return next(hits, len(operations))


def _error_at(operations: list[Operation], place: int, rng: np.random.Generator) -> Fault:
    """The operation at a place fails, or all of its kind from then on."""
    kind = operations[place].kind
    first = 1 + sum(each.kind == kind for each in operations[:place])
    code = int(rng.choice([code for code in ERRORS[kind] if code not in (0, errno.EMFILE)]))
    return Fault((kind,), first, first if rng.random() < 0.5 else _FOR_GOOD, code)


# ---- one disturbance ----------------------------------------------------------------------------------------


def _count(way: Way, output: Path) -> list[Operation]:
    workspace = _begin(way, output)
    around = _surroundings(output / "first")
    control = Control(output / "control", workspace, None)
    done = run(["run", *way.arguments, str(workspace)], Surroundings(around, seconds=36_000, control=control))
    if done.code not in (0, PARTIAL_EXIT_CODE) or differences(workspace, way.whole):
        raise RuntimeError(f"{way.name}: a run left alone failed, or is not repeated to the bit: {done}")
    return control.operations


def _begin(way: Way, output: Path) -> Path:
    workspace = output / "disturbed" / "dense"
    shutil.rmtree(workspace.parent, ignore_errors=True)
    workspace.parent.mkdir()
    if way.start is not None:
        shutil.copytree(way.start, workspace)
    return workspace


def _surroundings(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def _disturb_one(way: Way, stage: str, fault: Fault, output: Path, *, only_main: bool) -> Disturbance:
    """Disturb one run, and let another go on; a signal goes to the program alone, or to all it has started."""
    workspace = _begin(way, output)
    control = Control(output / "control", workspace, fault, only_main=only_main)
    around = Surroundings(_surroundings(output / "first"), control=control, seconds=3600)
    first = run(["run", *way.arguments, str(workspace)], around)
    finished = finished_files(workspace)
    second = run(["run", *way.again, str(workspace)], Surroundings(_surroundings(output / "second"), seconds=3600))
    end_group(around)
    remade = files_made_again(finished) if fault.stop else []
    wrong = [*differences(workspace, way.whole), *leftovers(workspace)]
    hit = next(iter(control.operations), None)
    wrong += [f"{len(remade)} files made again, such as {remade[0].relative_to(workspace)}"] if remade else []
    return Disturbance(f"{way.name}, {stage}, {fault}", hit, first, second, "; ".join(wrong))


def finished_files(workspace: Path) -> dict[Path, int]:
    """Time stamps of the results that are complete: of maps and cloud those which a record vouches for."""
    state = workspace / "colmap_sph"
    files = [path for part in ("pairs", "photometric") for path in (state / part).rglob("[!.]*") if path.is_file()]
    for record in filter(_vouches, state.glob("state/**/[!.]*.json")):
        name = record.relative_to(state / "state").with_suffix("")
        if name.suffix == ".undistorted":
            files.append(workspace / "images" / name.with_suffix(""))
        else:
            files += [workspace / "stereo" / folder / f"{name}.bin" for folder in ("depth_maps", "normal_maps")]
    if _vouches(state / "cloud.json"):
        files += [workspace / "fused.ply", workspace / "fused.ply.vis"]
    # What a record tells of may have been removed after it.
    return {path: path.stat().st_mtime_ns for path in files if path.exists()}


def _vouches(record: Path) -> bool:
    """Whether a record is there and says that its files are complete."""
    return record.exists() and b'"state": "done"' in record.read_bytes()


def files_made_again(finished: dict[Path, int]) -> list[Path]:
    """The files that are not there any more, or were written since their time stamps were taken."""
    return [path for path, stamp in finished.items() if not path.exists() or path.stat().st_mtime_ns != stamp]


def leftovers(workspace: Path) -> list[str]:
    """What a run that was ended has left behind, and the one after it has not removed; in one sentence if any."""
    found = [path for path in workspace.rglob("*") if path.name.endswith(".tmp")]
    return [f"left behind: {', '.join(sorted(path.name for path in found))}"] if found else []


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Check)))
