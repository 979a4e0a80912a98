"""A run on a cluster: the same bytes as on one machine, whoever is killed, and one sentence where it cannot be."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from conftest import IMAGES, copy_block
from distributed import Client, LocalCluster
from projects import results

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.errors import LostWorkersError
from colmap_sph.pipeline import execute as execution
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.engine import cluster as engine
from colmap_sph.pipeline.engine import connection
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import RunReport, Silent
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Job, Stage
from colmap_sph.project.claim import claimed
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import NO_SCENE
from colmap_sph.synthetic import DemoBlock

MORE_IMAGES = [*IMAGES, "N_1_0.jpg", "N_1_1.jpg", "N_1_2.jpg"]

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalCluster]:
    """Two processes with one thread each, of a user."""
    folder = tmp_path_factory.mktemp("dask")
    with LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", local_directory=str(folder), silence_logs=True
    ) as made:
        yield made


@pytest.fixture
def cluster(processes: LocalCluster) -> LocalCluster:
    """Both of them, also where a test before has killed one: on a busy machine it is a while until it is back."""
    with Client(processes) as client:
        client.wait_for_workers(2, timeout=120)
    return processes


@dataclass(frozen=True)
class Whole:
    """A sparse model, what one process makes of it, and what it says."""

    model: Path
    dense: Path
    report: RunReport


@pytest.fixture(scope="module")
def whole(block: DemoBlock, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """Six images of the block; not to be changed."""
    folder = tmp_path_factory.mktemp("whole")
    copy_block(block, folder, MORE_IMAGES)
    model, dense = folder / "sparse/0", folder / "dense"
    return Whole(model, dense, colmap_sph.run(model, output=dense))


def leftovers(dense: Path) -> list[Path]:
    return list(dense.rglob("*.tmp"))


def command(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    code = cli.main(["run", *arguments])
    captured = capsys.readouterr()
    return code, captured.out + captured.err


# ---- the same results --------------------------------------------------------------------------------------


class Watch(Silent):
    """What a run tells."""

    def __init__(self) -> None:
        self.threads = 0
        self.words: list[str] = []
        self.steps: dict[str, int] = {}
        self.totals: dict[str, int] = {}
        self._stage = ""

    def engage(self, threads: int, words: str) -> None:
        self.threads = threads
        self.words += [words] if words else []

    def start(self, stage: str, total: int) -> None:
        self._stage = stage
        self.totals[stage] = total
        self.steps[stage] = 0

    def advance(self, seconds: float = 0.0) -> None:
        self.steps[self._stage] += 1


def test_workers_make_the_same(
    whole: Whole,
    cluster: LocalCluster,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To the byte; and a run on one machine takes them for its own. Paths are relative to the driver's folder."""
    monkeypatch.chdir(tmp_path)
    options = RunOptions(threads=2, scheduler=cluster.scheduler_address)
    watch = Watch()
    report = colmap_sph.run(os.path.relpath(whole.model), output="dense", options=options, progress=watch)
    dense = tmp_path / "dense"
    assert results(dense) == results(whole.dense)
    assert len(results(dense)) > 30
    assert (report.made, report.coverage, report.points) == (
        whole.report.made,
        whole.report.coverage,
        whole.report.points,
    )
    assert leftovers(dense) == []
    assert watch.steps == watch.totals
    assert watch.threads == 2
    (words,) = watch.words
    assert re.fullmatch(r"2 workers with 2 threads; their dashboard: http://\S+", words)
    again = colmap_sph.run(whole.model, output=dense, options=RunOptions(threads=2))
    assert not any(again.made.values())
    assert not any(colmap_sph.run(whole.model, output=dense, options=options).made.values())


class Killer(Silent):
    """Kills a worker after some steps of each stage."""

    def __init__(self, cluster: LocalCluster) -> None:
        self._cluster = cluster
        self._left = 0
        self.killed = 0

    def start(self, stage: str, total: int) -> None:
        self._left = total // 3 if stage in ("match pairs", "vote on depth", "confirm depth", "fuse") else 0

    def advance(self, seconds: float = 0.0) -> None:
        self._left -= 1
        if self._left == 0:
            nanny = list(self._cluster.workers.values())[self.killed % 2]
            if nanny.process is not None and nanny.process.pid:
                os.kill(nanny.process.pid, signal.SIGKILL)
                self.killed += 1


def test_workers_may_be_killed(whole: Whole, cluster: LocalCluster, tmp_path: Path) -> None:
    killer = Killer(cluster)
    options = RunOptions(threads=2, scheduler=cluster.scheduler_address)
    report = colmap_sph.run(whole.model, output=tmp_path / "dense", options=options, progress=killer)
    assert killer.killed >= 3
    assert results(tmp_path / "dense") == results(whole.dense)
    assert not report.skipped_images and not report.skipped_pairs and not report.incomplete
    assert leftovers(tmp_path / "dense") == []


@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_a_driver_that_died_goes_on(
    number: signal.Signals,
    code: int,
    whole: Whole,
    cluster: LocalCluster,
    tmp_path: Path,
) -> None:
    dense = tmp_path / "dense"
    arguments = ["--model", str(whole.model), "--output", str(dense)]
    typed = [sys.executable, "-P", "-m", "colmap_sph", "run", *arguments, "--scheduler", cluster.scheduler_address]
    with subprocess.Popen(
        typed,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        limit = time.monotonic() + 60
        while len(list(dense.glob("colmap_sph/pairs/**/*.sph"))) < 3:
            assert process.poll() is None and time.monotonic() < limit, process.communicate()[1]
            time.sleep(0.005)
        process.send_signal(number)
        said = process.communicate(timeout=30)[1]
    assert process.returncode == code, said
    assert "Traceback" not in said
    assert not (dense / "fused.ply").exists()
    kept = {path: path.stat().st_mtime_ns for path in dense.glob("colmap_sph/pairs/**/*.sph")}
    options = RunOptions(threads=2, scheduler=cluster.scheduler_address)
    report = colmap_sph.run(whole.model, output=dense, options=options)
    assert report.reused["match pairs"] >= 3
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert results(dense) == results(whole.dense)
    assert leftovers(dense) == []


def test_events_tell_of_the_cluster(
    small: Path, cluster: LocalCluster, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = command(
        capsys, "--model", "sparse/0", "--progress", "json", "--scheduler", cluster.scheduler_address
    )
    assert code == 0
    events = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    told = [each for each in events if each["event"] == "cluster"]
    assert told and all(each["threads"] == 2 for each in told)
    assert "dashboard" in told[0]["words"]


# ---- what cannot be ----------------------------------------------------------------------------------------


def refusal(capsys: pytest.CaptureFixture[str], scheduler: str, *options: str) -> tuple[int, str]:
    """Exit code and sentence of a run, which leaves nothing behind."""
    code, said = command(capsys, "--model", "sparse/0", "--scheduler", scheduler, *options)
    assert "Traceback" not in said
    lines = [line for line in said.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, said
    assert said.splitlines()[-1] == lines[0]
    return code, lines[0].removeprefix("error: ")


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is waited for."""
    monkeypatch.setattr(connection, "START_SECONDS", 1.0)
    monkeypatch.setattr(engine, "PATIENCE", 0.5)


def test_without_a_scheduler(small: Path, hasty: None, capsys: pytest.CaptureFixture[str]) -> None:
    Path("other.json").write_text('{"workers": 3}')
    Path("binary.json").write_bytes(b"\xff\xfe\0")
    for scheduler, words in (
        ("none.json", "--scheduler: none.json cannot be read (No such file or directory); start the scheduler"),
        ("other.json", "--scheduler: other.json was not written by dask scheduler"),
        ("binary.json", "--scheduler: binary.json was not written by dask scheduler"),
        (".", "--scheduler: . cannot be read ("),
        ("tcp://127.0.0.1:9", "--scheduler: no Dask scheduler answers at tcp://127.0.0.1:9 ("),
        ("what://127.0.0.1:9", "--scheduler: no Dask scheduler answers at what://127.0.0.1:9 ("),
    ):
        code, sentence = refusal(capsys, scheduler)
        assert sentence.startswith(words), sentence
        assert code == 2
        assert not Path("dense/sparse").exists()


def test_without_dask(small: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(execution, "find_spec", lambda _: None)
    code, sentence = refusal(capsys, "tcp://127.0.0.1:9")
    assert (code, sentence.partition(";")[0]) == (2, "--scheduler needs Dask, which is not installed")


def test_dask_is_no_part_of_the_default_installation() -> None:
    """Neither its metadata nor a run without a scheduler asks for it."""
    asked = [each for each in metadata.requires("colmap_sph") or [] if "extra ==" not in each]
    assert len(asked) > 5
    assert not [each for each in asked if re.match("dask|distributed", each)]
    program = "import sys, colmap_sph.app.cli, colmap_sph.pipeline.reconstruct; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert not {"dask", "distributed"} & {*loaded.stdout.split()}


def test_a_time_limit_is_for_one_machine(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, sentence = refusal(capsys, "tcp://127.0.0.1:9", "--within", "1h")
    assert (code, sentence) == (2, "--within knows this machine alone; leave out it or --scheduler.")


def test_workers_with_another_program(
    small: Path, cluster: LocalCluster, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "program_digests", lambda: {"pair": "another"})
    code, sentence = refusal(capsys, cluster.scheduler_address)
    assert code == 2
    assert re.match(
        r"The worker on \S+ has the same version with another code or other kernels; install", sentence
    )
    monkeypatch.setattr(engine, "versions", lambda: {"colmap_sph": "0.0.1"})
    code, sentence = refusal(capsys, cluster.scheduler_address)
    version = re.escape(colmap_sph.__version__)
    assert re.match(rf"The worker on \S+ has colmap_sph {version}, not 0\.0\.1; install the same", sentence)
    assert not (small / "dense/sparse").exists()


def test_a_scheduler_of_another_version(
    small: Path, cluster: LocalCluster, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(colmap_sph, "__version__", "0.0.1")
    code, sentence = refusal(capsys, cluster.scheduler_address)
    assert code == 2
    assert re.match(r"The scheduler at tcp://\S+ runs with colmap_sph \S+, not 0\.0\.1; start it and", sentence)


def test_workers_without_the_folder(
    small: Path,
    hasty: None,
    cluster: LocalCluster,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """They look for the run's token, which the driver has written somewhere else."""
    write = engine.atomic_file
    monkeypatch.setattr(engine, "atomic_file", lambda path, **how: write(small / "token", **how))
    code, sentence = refusal(capsys, cluster.scheduler_address)
    assert code == 2
    folder = re.escape(str(small / "dense/colmap_sph"))
    assert re.match(rf"The worker at tcp://\S+ and 1 other do not see {folder}; images and workspace", sentence)
    assert not (small / "dense/sparse").exists()


class NumbersStage(Stage[int, tuple[Path, int]]):
    """Writes numbers into files; worker processes die of one of them."""

    name = "numbers"
    deadly = 3

    def job(self, item: int) -> Job[tuple[Path, int]]:
        return Job(str(item), None, Cost(0.1, 1e3, 1e3), (self.context.workspace.root / str(item), item))

    @staticmethod
    def make(task: tuple[Path, int]) -> Facts:
        path, number = task
        if number == NumbersStage.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        path.write_text(str(number))
        return Facts(points=number)

    def label(self, item: int) -> str:
        return f"number {item}"


def context_of(root: Path, **how: Any) -> Context:
    workspace = Workspace(root)
    options = RunOptions(threads=1)
    return Context(workspace, NO_SCENE, options, Keys(workspace, options), **how)


def test_an_item_that_workers_die_of_is_named(
    cluster: LocalCluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All others are made."""
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)
    context = context_of(tmp_path)
    stage = NumbersStage(context, range(9))
    with (
        claimed(context.workspace),
        pytest.raises(LostWorkersError, match="made number 3, perhaps for lack of memory") as lost,
        engine.on_cluster(cluster.scheduler_address, context.workspace) as executor,
    ):
        executor(stage)
    assert lost.value.exit_code == 6
    assert {int(path.name) for path in tmp_path.glob("[0-9]")} == {*range(9)} - {3}


def test_results_come_in_the_order_of_the_items(cluster: LocalCluster, tmp_path: Path) -> None:
    context = context_of(tmp_path)
    items = [7, 1, 30, 2]
    with (
        claimed(context.workspace),
        engine.on_cluster(cluster.scheduler_address, context.workspace) as executor,
    ):
        found = executor(UnharmedStage(context, items))
        assert context.workspace.token_path.exists()
    assert [(item, result.facts.points, result.made) for item, result in found.items()] == [
        (item, item, True) for item in items
    ]
    assert not context.workspace.token_path.exists()


class UnharmedStage(NumbersStage):
    @staticmethod
    def make(task: tuple[Path, int]) -> Facts:
        return Facts(points=task[1])
