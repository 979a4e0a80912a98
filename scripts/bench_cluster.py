"""Runs on a cluster of this machine's processes: are they as one process's, whoever is killed, and how fast.

    python scripts/bench_cluster.py --output /tmp/cluster
    python scripts/bench_cluster.py --model sparse/0 --max-image-size 800 --workers 3 --output /tmp/cluster

Starts a scheduler and workers of one thread each, as a user does. Without --model the demo's block is rendered. A
run by one process is what all others must equal, to the byte: one on the cluster; one of whose workers each
--worker-kills in turn is ended by SIGKILL, chosen at random; one whose driver is ended --driver-kills times and
begun again. What was finished at a kill must not be made again. Then the time of a run by as many threads as there
are workers, and of one by the workers; for that nothing else may be at work. Exit code 1: something was not so.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import tyro
from benchmarking import machine, table
from check_interruptions import files_made_again, finished_files, leftovers
from hostile.verdicts import differences

from colmap_sph.synthetic import BlockOptions, make_demo_block

_POLL_SECONDS = 0.02


@dataclass(frozen=True)
class Bench:
    """Compare runs on a cluster with runs by one process."""

    output: Path
    """Folder for the workspaces; what an earlier run left there is removed."""
    model: Path | None = None
    """Sparse model, with its images where `colmap_sph run` finds them. Default: the demo's."""
    images: Path | None = None
    """As for `colmap_sph run`."""
    max_image_size: int = -1
    """As for `colmap_sph run`."""
    workers: int = 3
    """Processes of one thread each."""
    worker_kills: int = 10
    """Workers that are killed in one run."""
    driver_kills: int = 5
    """Times that a run is killed."""
    timed_workers: int = 2
    """Workers, and threads, of the runs that are timed; 0: none."""
    seed: int = 0
    """Of who is killed, and when."""


@dataclass
class Cluster:
    """A scheduler and its workers, each below a process that starts it again."""

    folder: Path
    nannies: list[psutil.Process]

    @property
    def scheduler(self) -> Path:
        """The file in which its address stands."""
        return self.folder / "scheduler.json"

    def kill_a_worker(self, choose: random.Random) -> bool:
        """Kill one at random; False where all are being started."""
        workers = [
            child for nanny in self.nannies for child in nanny.children() if "spawn" in str(child.cmdline())
        ]
        if not workers:
            return False
        choose.choice(workers).kill()
        return True


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[Cluster]:
    """Start a scheduler and workers, and end them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    dask = [sys.executable, "-m", "dask"]
    file = ["--scheduler-file", str(folder / "scheduler.json")]
    local = ["--local-directory", str(folder), "--nthreads", "1", "--no-dashboard"]
    commands = [[*dask, "scheduler", *file, "--host", "127.0.0.1", "--port", "0", "--dashboard-address", ":0"]]
    commands += [[*dask, "worker", *file, *local]] * workers
    with (folder / "log.txt").open("wb") as log:
        processes = [subprocess.Popen(command, stdout=log, stderr=log) for command in commands]
        try:
            yield Cluster(folder, [psutil.Process(process.pid) for process in processes[1:]])
        finally:
            for process in reversed(processes):
                process.terminate()
            for process in processes:
                process.wait()


def run_command(bench: Bench, model: Path, output: Path, *options: object) -> list[str]:
    """A command that reconstructs the model."""
    images = [] if bench.images is None else ["--images", bench.images]
    size = ["--max-image-size", bench.max_image_size]
    words = ["run", "--model", model, *images, "--output", output, *size, "--progress", "none", *options]
    return [sys.executable, "-P", "-m", "colmap_sph", *map(str, words)]


def timed(command: Sequence[str]) -> float:
    """Seconds that a run takes, which must come to its end."""
    start = time.perf_counter()
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, 5):
        sys.exit(f"{' '.join(command)}\n{done.stderr}")
    return time.perf_counter() - start


def verdict(workspace: Path, expected: Path, finished: Sequence[dict[Path, int]]) -> str:
    """What is wrong with a workspace, in a few words; "identical" where nothing is."""
    again = sorted({path for each in finished for path in files_made_again(each)})
    wrong = [*differences(workspace, expected), *leftovers(workspace)]
    wrong += [f"{len(again)} files made again, such as {again[0]}"] if again else []
    return "; ".join(wrong) or "identical"


def with_killed_workers(
    bench: Bench, command: Sequence[str], workspace: Path, there: Cluster, seconds: float
) -> tuple[int, list[dict[Path, int]]]:
    """Run while workers are killed; return how many were, and what was finished at each time."""
    choose = random.Random(bench.seed)
    finished: list[dict[Path, int]] = []
    killed = 0
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    pause = seconds / (bench.worker_kills + 1)
    due = time.monotonic() + pause
    while process.poll() is None:
        time.sleep(_POLL_SECONDS)
        if killed < bench.worker_kills and time.monotonic() >= due and there.kill_a_worker(choose):
            killed += 1
            finished.append(finished_files(workspace))
            due = time.monotonic() + pause * choose.uniform(0.5, 1.5)
    if process.returncode not in (0, 5):
        sys.exit(f"the run with killed workers ended with exit code {process.returncode}")
    return killed, finished


def with_killed_drivers(
    bench: Bench, command: Sequence[str], workspace: Path, seconds: float
) -> tuple[int, list[dict[Path, int]]]:
    """Kill the run at random times and begin it again; return how often, and what was finished at each time."""
    choose = random.Random(bench.seed)
    finished: list[dict[Path, int]] = []
    killed = 0
    for _ in range(bench.driver_kills):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            process.wait(seconds / bench.driver_kills * choose.uniform(0.5, 1.5))
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            killed += 1
        finished.append(finished_files(workspace))
    timed(command)
    return killed, finished


def main() -> int:
    """Run all comparisons and print them; return the exit code."""
    bench = tyro.cli(Bench, description=__doc__)
    bench.output.mkdir(parents=True, exist_ok=True)
    model = bench.model
    if model is None:
        root = bench.output / "block"
        shutil.rmtree(root, ignore_errors=True)
        model = make_demo_block(root, BlockOptions(), threads=len(os.sched_getaffinity(0))).sparse_dir
    places = {name: bench.output / name for name in ("one", "cluster", "workers-killed", "driver-killed")}
    for place in places.values():
        shutil.rmtree(place, ignore_errors=True)
    rows = [
        ("one process, 1 thread", f"{timed(run_command(bench, model, places['one'], '--threads', 1)):.1f}", "")
    ]
    with cluster(bench.output / "dask", bench.workers) as there:
        scheduler = ("--threads", 1, "--scheduler", there.scheduler)
        commands = {name: run_command(bench, model, place, *scheduler) for name, place in places.items()}
        seconds = timed(commands["cluster"])
        words = verdict(places["cluster"], places["one"], [])
        rows.append((f"{bench.workers} workers", f"{seconds:.1f}", words))
        place = places["workers-killed"]
        killed, finished = with_killed_workers(bench, commands["workers-killed"], place, there, seconds)
        rows.append((f"… {killed} of them killed", "", verdict(place, places["one"], finished)))
        place = places["driver-killed"]
        killed, finished = with_killed_drivers(bench, commands["driver-killed"], place, seconds)
        rows.append((f"… {killed} times the driver", "", verdict(place, places["one"], finished)))
    rows += timings(bench, model)
    print(f"{machine()}\n\n{table(('run', 'seconds', 'results'), rows)}")
    return int(any(words not in ("", "identical") for _, _, words in rows))


def timings(bench: Bench, model: Path) -> list[tuple[str, str, str]]:
    """Seconds of as many threads as workers, and of the workers, which have worked before."""
    number = bench.timed_workers
    if number == 0:
        return []
    places = [bench.output / "threads", bench.output / "timed", bench.output / "warm"]
    for place in places:
        shutil.rmtree(place, ignore_errors=True)
    threads = timed(run_command(bench, model, places[0], "--threads", number))
    with cluster(bench.output / "dask", number) as there:
        timed(run_command(bench, model, places[2], "--threads", 1, "--scheduler", there.scheduler))
        workers = timed(run_command(bench, model, places[1], "--threads", 1, "--scheduler", there.scheduler))
    return [
        (f"one process, {number} threads", f"{threads:.1f}", ""),
        (f"{number} workers", f"{workers:.1f}, {workers / threads:.2f} ×", verdict(places[1], places[0], [])),
    ]


if __name__ == "__main__":
    sys.exit(main())
