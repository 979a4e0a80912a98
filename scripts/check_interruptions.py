"""Kill a run at random moments, go on, and compare with a run that was left alone.

    python scripts/check_interruptions.py --output /tmp/interruptions
    python scripts/check_interruptions.py --model sparse/0 --max-image-size 400 --output /tmp/interruptions

Without --model it renders the demo's block. Every kill is a SIGKILL. Maps and cloud must come out the same to the
bit, and what was finished at a kill must not be done again. A workspace that gets finished in spite of the kills
is compared, and a new one is begun. Exit code 1: something was not as it must be.
"""

import filecmp
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro
from compare_workspaces import result_files

from colmap_sph.app.run_command import PARTIAL_EXIT_CODE
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import make_demo_block


@dataclass(frozen=True)
class Check:
    """Kill a run at random moments, go on, and compare with a run that was left alone."""

    output: Path
    """Folder for the workspaces; must not exist."""
    model: Path | None = None
    """Sparse model, with its images where `colmap_sph run` finds them. Default: the demo's block."""
    max_image_size: int = -1
    """As for `colmap_sph run`."""
    threads: int = 2
    """Worker threads."""
    kills: int = 20
    """Number of kills."""
    seed: int = 0
    """Of the random moments."""


@dataclass(frozen=True)
class Kill:
    """One kill and what came of it.

    Attributes
    ----------
    moment : float
        Seconds from the start of the process.
    finished : dict
        Files of finished work at that moment, by kind.
    remade : int
        Files of it that the next run wrote again: must be 0.
    different : int or None
        Where the workspace was then finished: maps and files of the cloud that differ from those of a run left
        alone. Must be 0.
    """

    moment: float
    finished: dict[str, int]
    remade: int
    different: int | None


def main(check: Check) -> int:
    """Run, print a line per kill, return the exit code."""
    check.output.mkdir(parents=True)
    model = check.model
    if model is None:
        model = make_demo_block(check.output / "block", threads=check.threads).sparse_dir
    arguments = [
        "--model",
        str(model),
        "--threads",
        str(check.threads),
        "--max-image-size",
        str(check.max_image_size),
    ]
    print("kill  after s  pairs  votes  maps  cloud  made again  files that differ", flush=True)
    kills = []
    for number, kill in enumerate(kill_and_resume(arguments, check.output, check.kills, check.seed), start=1):
        counts = "".join(f"{kill.finished[kind]:7d}" for kind in ("pairs", "votes", "maps", "cloud"))
        different = "-" if kill.different is None else str(kill.different)
        print(f"{number:4d}{kill.moment:9.2f}{counts}{kill.remade:12d}{different:>19}", flush=True)
        kills.append(kill)
    wrong = sum(kill.remade + (kill.different or 0) for kill in kills)
    print(f"{len(kills)} kills, {wrong} files made again or different")
    return int(wrong > 0)


def kill_and_resume(arguments: list[str], output: Path, num_kills: int, seed: int) -> Iterator[Kill]:
    """Kill runs in workspaces below `output`, each at a random moment of the time that a whole run takes."""
    whole, killed = output / "whole", output / "killed"
    start = time.monotonic()
    run(arguments, whole)
    duration = time.monotonic() - start
    random_moments = random.Random(seed)
    pending: tuple[float, dict[Path, int]] | None = None
    for _ in range(num_kills):
        while True:
            moment = random_moments.uniform(0.1, 1) * duration
            complete = run(arguments, killed, kill_after=moment)
            if pending is not None:
                yield judge(*pending, killed, whole if complete else None)
            pending = None
            if not complete:
                break
            shutil.rmtree(killed)
        pending = (moment, finished_files(killed))
    run(arguments, killed)
    if pending is not None:
        yield judge(*pending, killed, whole)


def run(arguments: list[str], workspace: Path, *, kill_after: float | None = None) -> bool:
    """Run the command; return whether it came to its end, which without a kill it must."""
    command = [sys.executable, "-P", "-m", "colmap_sph", "run", *arguments, "--output", str(workspace)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            said, _ = process.communicate(timeout=kill_after)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            return False
    # Images of the model that have no depth map are no fault of the kills.
    if process.returncode not in (0, PARTIAL_EXIT_CODE):
        raise RuntimeError(f"exit code {process.returncode}:\n{said}")
    return True


def judge(moment: float, finished: dict[Path, int], workspace: Path, whole: Path | None) -> Kill:
    """Look at a workspace after the run that followed a kill; `whole` only if that run came to its end."""
    kinds = [kind_of(path, workspace) for path in finished]
    return Kill(
        moment,
        {kind: kinds.count(kind) for kind in ("pairs", "votes", "maps", "cloud")},
        sum(not path.exists() or path.stat().st_mtime_ns != stamp for path, stamp in finished.items()),
        None if whole is None else num_different(workspace, whole),
    )


def finished_files(workspace: Path) -> dict[Path, int]:
    """Time stamps of the results that are complete: of maps and cloud those which a record vouches for."""
    state = workspace / "colmap_sph"
    stereo = workspace / "stereo"
    files = [*state.glob("pairs/*.sph"), *state.glob("photometric/**/*.sph")]
    for record in filter(is_done, state.glob("state/**/*.json")):
        name = record.relative_to(state / "state").with_suffix(".bin")
        files += [stereo / "depth_maps" / name, stereo / "normal_maps" / name]
    if is_done(state / "cloud.json"):
        files += Workspace(workspace).cloud_paths
    return {path: path.stat().st_mtime_ns for path in files}


def is_done(record: Path) -> bool:
    """Whether a record vouches for complete files: it is there while they are made, too."""
    return record.exists() and json.loads(record.read_bytes())["state"] == "done"


def kind_of(path: Path, workspace: Path) -> str:
    """Kind of a result file."""
    first, second = path.relative_to(workspace).parts[0], path.relative_to(workspace).parts[1:2]
    kinds = {"pairs": "pairs", "photometric": "votes"}
    return "cloud" if not second else kinds.get(second[0], "maps") if first == "colmap_sph" else "maps"


def num_different(workspace: Path, whole: Path) -> int:
    """Maps and clouds that differ, or that only one of two workspaces has; and leftovers of killed runs."""
    files = [result_files(root) for root in (workspace, whole)]
    missing = {path.relative_to(whole) for path in Workspace(whole).cloud_paths} - files[1]
    assert not missing, f"{whole} has no {missing}"
    same = [filecmp.cmp(workspace / name, whole / name, shallow=False) for name in files[0] & files[1]]
    leftovers = [*workspace.rglob(".*.tmp"), *workspace.glob("colmap_sph/fusion")]
    return len(files[0] ^ files[1]) + same.count(False) + len(leftovers)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Check)))
