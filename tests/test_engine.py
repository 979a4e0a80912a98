"""What a cluster's workers do, without a cluster: groups, what is found, what is waited for, and who may write."""

import logging
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from projects import FOUR_NAMES, copy_four_images, prepare

from colmap_sph.errors import InputError, OptionError, OutputError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.engine.division import MOST_ITEMS, Asked, Division
from colmap_sph.pipeline.engine.group import Group, Piece, RunSeen, folders_of
from colmap_sph.pipeline.engine.lag import made_with_patience
from colmap_sph.pipeline.engine.worker import Workplace, budget_of
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.keys import Keys, program_digests
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.memory import resident
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.program import versions
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Stage
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.project.files import atomic_file, remove_temporary_files
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.records import invalidate
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import NO_SCENE
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.partners.pairs import select_pairs

GIB = 1 << 30
_cache: LoadCache[bytes] = LoadCache(len)


class FilesStage(Stage[int, tuple[Path, int]]):
    """Writes numbers into files; odd ones are there already, and multiples of five cannot be done."""

    name = "files"
    caches = (_cache,)
    begun = threading.Event()
    go_on = threading.Event()

    def job(self, item: int) -> Job[tuple[Path, int]]:
        if item % 5 == 0:
            raise InputError(f"{item} cannot be done")
        return Job(str(item), Facts() if item % 2 else None, Cost(1.0, 100.0, 1.0), (Path(str(item)), item))

    @staticmethod
    def make(task: tuple[Path, int]) -> Facts:
        path, number = task
        if number < 0:
            raise InputError(f"{path} is damaged")
        with atomic_file(path) as file:
            file.write(_cache.get("number", str(number).encode))
            if number == 99:
                FilesStage.begun.set()
                FilesStage.go_on.wait(10)
        return Facts(points=number)

    @staticmethod
    def found(task: tuple[Path, int]) -> Facts | None:
        return Facts(points=-task[1]) if task[0].exists() else None


@pytest.fixture
def run(tmp_path: Path) -> RunSeen:
    (tmp_path / "token").write_text("one")
    return RunSeen("one", tmp_path / "token", program_digests(), versions())


@pytest.fixture
def place(run: RunSeen) -> Iterator[Workplace]:
    made = Workplace(resident() + GIB, 2)
    yield made
    made.rest(run)


def group_of(run: RunSeen, *numbers: int, stage: int = 1, memory: float = 1e3, cache: int = 100) -> Group[Any]:
    pieces = [
        Piece((run.path.with_name(f"{number}.txt"), number), f"number {number}", memory) for number in numbers
    ]
    return Group(run, FilesStage, stage, Kept(cache=cache, caches=1), {}, pieces)


# ---- groups ------------------------------------------------------------------------------------------------


def divided(count: int, threads: int) -> tuple[list[list[int]], list[Asked[Any, Any]]]:
    workspace = Workspace(Path("nowhere"))
    options = RunOptions(threads=2)
    stage = FilesStage(Context(workspace, NO_SCENE, options, Keys(workspace, options)), range(count))
    told: list[Asked[Any, Any]] = []
    groups = [[each.item for each in group] for group in Division(stage, told.append).groups(lambda: threads)]
    return groups, told


def test_groups_are_of_neighbours_and_end_small() -> None:
    groups, told = divided(3000, threads=4)
    wanted = [item for item in range(3000) if item % 2 == 0 and item % 5]
    assert [item for group in groups for item in group] == wanted
    sizes = [len(group) for group in groups]
    assert max(sizes) == MOST_ITEMS
    assert max(sizes[:10]) >= 16 and sizes[-1] == 1
    # No group at the end keeps one thread busy for longer than all of them need for what is left.
    for index, size in enumerate(sizes):
        assert size <= max(sum(sizes[index:]) / 3 + 1, 1)
    assert sorted(each.item for each in told) == sorted({*range(3000)} - {*wanted})
    assert {each.failure for each in told if each.item % 5 == 0} == {
        f"{n} cannot be done" for n in range(0, 3000, 5)
    }


@pytest.mark.parametrize("count", [0, 1, 3, 40])
def test_few_items_are_enough_for_all(count: int) -> None:
    groups, _ = divided(count, threads=16)
    assert all(len(group) == 1 for group in groups)


def test_folders_of_a_task(tmp_path: Path) -> None:
    piece = Piece((tmp_path / "a/b", [tmp_path / "c/d"], "e/f"), "x", 1.0)
    assert folders_of(piece) == {tmp_path / "a", tmp_path / "c"}


# ---- making ------------------------------------------------------------------------------------------------


def test_what_a_lost_worker_has_made_is_found(run: RunSeen, place: Workplace) -> None:
    first = place.work(group_of(run, 1, 2))
    assert [outcome.facts for outcome in first.outcomes] == [Facts(points=1), Facts(points=2)]
    again = place.work(group_of(run, 1, 2, 3))
    assert [outcome.facts for outcome in again.outcomes] == [Facts(points=-1), Facts(points=-2), Facts(points=3)]


def test_a_result_half_done_is_not_begun_anew(tmp_path: Path) -> None:
    """Who knows nothing but the task finds the result of a pair or an image, and an estimate without its maps."""
    copy_four_images(tmp_path)
    workspace = prepare(tmp_path / "sparse/0", tmp_path / "dense")
    workspace.create_stereo_dirs(FOUR_NAMES)
    options = RunOptions(threads=2, fusion=FusionOptions(input="photometric"))
    scene = anchored(read_scene(workspace.sparse_dir))
    context = with_good_images(Context(workspace, scene, options, Keys(workspace, options)), execute)
    pairs = select_pairs(scene, options.pairs).unique_pairs()
    matching = MatchStage(context, pairs)
    with matching.opened():
        pair = matching.job(pairs[0]).task
        assert MatchStage.found(pair) is None
        assert MatchStage.make(pair) == MatchStage.found(pair)
    voting = VoteStage(context, execute(matching))
    with voting.opened():
        image = voting.job(FOUR_NAMES[0]).task
        assert VoteStage.found(image) is None
        facts = VoteStage.make(image)
        assert VoteStage.found(image) == facts
        made = image.estimate.stat().st_mtime_ns
        invalidate(image.maps.record)
        assert VoteStage.found(image) is None
        assert VoteStage.make(image) == facts
    assert image.estimate.stat().st_mtime_ns == made


def test_one_failure_costs_one_item(run: RunSeen, place: Workplace) -> None:
    answer = place.work(group_of(run, 1, -2, 3))
    failure = f"{run.path.with_name('-2.txt')} is damaged"
    assert [outcome.failure for outcome in answer.outcomes] == ["", failure, ""]
    assert answer.peak_memory > 10e6


def test_a_worker_that_does_not_see_the_images(run: RunSeen, place: Workplace) -> None:
    """It sees the run, and what it misses is there for others."""
    folder = run.path.with_name("images")
    answer = place.work(Group(run, FilesStage, 1, Kept(), {}, [Piece((folder / "a.jpg", -1), "a.jpg", 1e3)]))
    assert f"does not see {folder}; images and workspace must lie on a disk" in answer.outcomes[0].failure


def test_warnings_come_with_the_answer(run: RunSeen, place: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    logger = logging.getLogger("colmap_sph.test")

    def make(task: tuple[Path, int]) -> Facts:
        logger.info("not this")
        logger.warning("%d is strange", task[1])
        return Facts()

    monkeypatch.setattr(FilesStage, "make", staticmethod(make))
    assert place.work(group_of(run, 4)).words == [(logging.WARNING, "4 is strange")]


def test_a_run_that_has_ended_gets_nothing_more(run: RunSeen, place: Workplace) -> None:
    """Not even what was begun before, which another run may make otherwise now."""
    with ThreadPoolExecutor(1) as pool:
        FilesStage.begun.clear()
        FilesStage.go_on.clear()
        made = pool.submit(place.work, group_of(run, 99, 100), 0.0)
        assert FilesStage.begun.wait(10)
        run.path.write_text("two")
        FilesStage.go_on.set()
        with pytest.raises(OutputError, match="is not this run's any more"):
            made.result()
    assert sorted(path.name for path in run.path.parent.iterdir()) == ["token"]
    with pytest.raises(InputError, match=r"does not see .*; images and workspace must lie on a disk"):
        place.work(group_of(run, 5), 0.0)


def test_too_little_memory_is_refused(run: RunSeen) -> None:
    place = Workplace(resident() + (1 << 20), 1)
    words = r"of memory \(70 % of the worker's memory limit, .*\) is too little for number 1; \w+ would do"
    with pytest.raises(OptionError, match=words):
        place.work(group_of(run, 1, memory=1e9, cache=0))


def test_another_stage_waits_and_finds_empty_caches(run: RunSeen, place: Workplace) -> None:
    """What is cached of a file may be what was in it before the stage."""
    with ThreadPoolExecutor(2) as pool:
        FilesStage.begun.clear()
        FilesStage.go_on.clear()
        first = pool.submit(place.work, group_of(run, 99))
        assert FilesStage.begun.wait(10)
        second = pool.submit(place.work, group_of(run, 7, stage=2))
        time.sleep(0.1)
        assert not second.done()
        FilesStage.go_on.set()
        first.result()
        second.result()
    assert run.path.with_name("99.txt").read_text() == "99"
    assert run.path.with_name("7.txt").read_text() == "7"
    place.work(group_of(run, 8, stage=2))
    assert run.path.with_name("8.txt").read_text() == "7"  # of the same stage: cached
    place.rest(run)
    place.work(group_of(run, 9, stage=2))
    assert run.path.with_name("9.txt").read_text() == "9"


def test_a_worker_with_another_program_refuses(run: RunSeen, place: Workplace) -> None:
    """Also one that joins when the run has begun."""
    other = RunSeen(run.token, run.path, {**run.digests, "pair": "0"}, {**run.versions, "OpenCV": "1.2"})
    with pytest.raises(InputError, match=r"has OpenCV \S+, not 1\.2; install the same on all machines"):
        place.work(group_of(other, 1))


def test_budgets_of_neighbours_fit_into_a_machine() -> None:
    assert budget_of(10 * GIB, 64 * GIB, 2) == int(0.7 * 10 * GIB)
    assert budget_of(None, 64 * GIB, 1) == int(0.7 * 64 * GIB)
    for number in (1, 2, 7):
        # Dask gives each worker without a limit of its own a share by its threads, or all.
        for limit in (None, 64 * GIB, 20 * GIB):
            assert number * budget_of(limit, 64 * GIB, number) <= 0.7 * 64 * GIB


# ---- network file systems ----------------------------------------------------------------------------------


def late_file(path: Path, seconds: float) -> threading.Timer:
    timer = threading.Timer(seconds, path.write_text, ["there"])
    timer.start()
    return timer


def reader_of(path: Path) -> Callable[[], Facts]:
    def read() -> Facts:
        try:
            return Facts(points=len(path.read_text()))
        except OSError as error:
            raise InputError(f"{path} cannot be read") from error

    return read


def test_a_file_that_comes_late_is_waited_for(tmp_path: Path) -> None:
    late_file(tmp_path / "a", 0.4)
    assert made_with_patience(reader_of(tmp_path / "a"), [tmp_path]).points == 5


def test_what_could_not_be_read_is_read_again(tmp_path: Path) -> None:
    late_file(tmp_path / "a", 0.4)

    def fuse() -> Facts:
        there = (tmp_path / "a").exists()
        return Facts(unread={} if there else {"a.jpg": "it is missing"})

    assert not made_with_patience(fuse, [tmp_path]).unread


def test_patience_has_an_end_and_other_faults_none(tmp_path: Path) -> None:
    calls = []

    def damaged() -> Facts:
        calls.append(1)
        raise InputError("damaged")

    with pytest.raises(InputError, match="damaged"):
        made_with_patience(damaged, [tmp_path])
    assert len(calls) == 1
    start = time.monotonic()
    with pytest.raises(InputError, match="cannot be read"):
        made_with_patience(reader_of(tmp_path / "a"), [tmp_path], 0.3)
    assert 0.1 <= time.monotonic() - start < 2


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr("socket.gethostname", lambda: "node-7.example é")
    yield "node-7_example__"


def test_temporary_files_carry_the_host(tmp_path: Path, host: str) -> None:
    """And two that one thread writes at a time are two."""
    with atomic_file(tmp_path / "a") as first, atomic_file(tmp_path / "b") as second:
        first.write(b"1")
        second.write(b"2")
        names = sorted(path.name for path in tmp_path.iterdir())
        assert len(names) == 2
        assert all(name.startswith(f".{host}-{os.getpid()}-") and name.endswith(".tmp") for name in names)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a": b"1", "b": b"2"}
    for name in (f".{host}-12-3.tmp", ".12-3456.tmp", "x.tmp", ".mine.tmp", ".n-1.tmp"):
        (tmp_path / name).touch()
    remove_temporary_files(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b", "x.tmp", ".mine.tmp", ".n-1.tmp"}


_ALLOCATES = """
import sys
import numpy as np
from colmap_sph.pipeline.engine.worker import Workplace
if sys.argv[1] == "worker":
    Workplace(1 << 33, 1)
place = np.ones(1 << 20).ctypes.data
heap = [line.split()[0].split("-") for line in open("/proc/self/maps") if line.rstrip().endswith("[heap]")]
print(any(int(first, 16) <= place < int(end, 16) for first, end in heap))
"""


_LEAVES = """
from pathlib import Path
import numpy as np
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Job, Stage
from colmap_sph.pipeline.workers import room_for_workers
from colmap_sph.platforms.memory import resident
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import NO_SCENE

held = []

class Leaving(Stage):
    name = "leaving"

    def job(self, item):
        return Job(str(item), None, Cost(1.0, 1.0, 1.0), item)

    @staticmethod
    def make(task):
        before = resident()
        arrays = [np.ones(1 << size) for _ in range(400) for size in (17, 10)]
        held.append(arrays[1::2])
        return Facts(points=before >> 20)

with room_for_workers():
    workspace, options = Workspace(Path("nowhere")), RunOptions(threads=1)
    context = Context(workspace, NO_SCENE, options, Keys(workspace, options))
    first, second = (execute(Leaving(context, [0]))[0].facts.points for _ in range(2))
    print(second - first)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_no_stage_begins_with_what_another_has_freed() -> None:
    """What of 400 MiB is still held takes 3 MiB; what lies between would be missing from a budget."""
    said = subprocess.run([sys.executable, "-P", "-c", _LEAVES], capture_output=True, check=True, text=True).stdout
    assert int(said) < 40


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_workers_keep_freed_memory() -> None:
    """As glibc does without what Dask tells it: 8 MB come from the heap, and not from the system each time."""

    def is_in_heap(who: str) -> bool:
        environment = {**os.environ, "MALLOC_TRIM_THRESHOLD_": "65536"}
        command = [sys.executable, "-c", _ALLOCATES, who]
        said = subprocess.run(command, env=environment, capture_output=True, check=True, text=True).stdout
        return said.strip() == "True"

    assert is_in_heap("worker")
    assert not is_in_heap("other")
