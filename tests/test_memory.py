"""The memory budget: amounts as people write them, and the gate that work waits at."""

import platform
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from projects import make_context, prepare
from test_undistortion import NAMES, make_project

from colmap_sph.errors import OptionError
from colmap_sph.pipeline import memory
from colmap_sph.pipeline.forecast.survey import Survey
from colmap_sph.pipeline.memory import MemoryGate, budget, format_memory, parse_memory, resident
from colmap_sph.pipeline.stages.match import MatchStage, _scratches
from colmap_sph.pipeline.workers import room_for_workers
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.matching import MatchingOptions, match_pair

GIB = 1 << 30


@pytest.mark.parametrize(
    ("text", "amount"),
    [
        ("", 0),
        ("6GiB", 6 * GIB),
        ("6 gib", 6 * GIB),
        ("6G", 6 * GIB),
        ("1.5GiB", 3 * GIB // 2),
        ("1500MB", 1_500_000_000),
        ("512M", 512 << 20),
        ("1000000", 1_000_000),
        ("2TB", 2 * 10**12),
    ],
)
def test_amounts_are_read(text, amount):
    assert parse_memory(text) == amount


@pytest.mark.parametrize("text", ["much", "-1GiB", "6 apples", "GiB", "1e9", "6GiBs", ".", "9" * 400])
def test_what_is_no_amount_is_refused(text):
    with pytest.raises(OptionError, match="such as 6GiB") as refused:
        parse_memory(text)
    assert len(str(refused.value)) < 120


@pytest.mark.parametrize("text", ["0", "0GiB", "0.0 MB", "0.2"])
def test_nothing_is_refused(text):
    with pytest.raises(OptionError, match="memory must be more than"):
        parse_memory(text)


@pytest.mark.parametrize("amount", [1, 1000, 1500, 1 << 20, 700 << 20, 3 * GIB, 100 * GIB])
def test_a_written_amount_is_enough(amount):
    assert amount <= parse_memory(format_memory(amount)) <= amount + max(1 << 20, amount // 8)


@pytest.mark.parametrize("text", ["7B", "1KiB", "900KiB", "1MiB", "6144MiB", "12GiB"])
def test_an_amount_is_told_as_it_was_given(text):
    assert format_memory(parse_memory(text)) == text


def test_the_default_leaves_something_to_others():
    total = int(Path("/proc/meminfo").read_text().split()[1]) * 1024
    assert resident() < budget(0) < total + resident()
    assert budget(7 * GIB) == 7 * GIB


def test_work_waits_for_its_share():
    """Twelve pieces of work that need a third of the budget each: three at a time, never four."""
    gate = MemoryGate(resident() + 4 * GIB)
    lock = threading.Lock()
    running, most = 0, 0

    def work():
        nonlocal running, most
        with gate.reserve(GIB, "it"):
            with lock:
                running += 1
                most = max(most, running)
            time.sleep(0.01)
            with lock:
                running -= 1

    threads = [threading.Thread(target=work) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 3 and running == 0


def test_work_that_can_never_fit_is_refused_with_a_budget_that_would_do():
    gate = MemoryGate(resident() + GIB)
    with (
        pytest.raises(OptionError, match=r"too little for the pair a - b; (\w+) would do") as refused,
        gate.reserve(3 * GIB, "the pair a - b"),
    ):
        pass
    enough = parse_memory(str(refused.value).split("; ")[1].split()[0])
    with MemoryGate(enough).reserve(3 * GIB, "the pair a - b"):
        pass


def test_what_earlier_work_has_left_behind_refuses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run refuses what a dry run refuses, which has made nothing yet; beside other work it waits."""
    monkeypatch.setattr(memory, "_at_start", lambda: GIB)
    monkeypatch.setattr(memory, "resident", lambda: 3 * GIB)
    gate = MemoryGate(4 * GIB)
    assert gate.free == GIB
    with gate.reserve(2 * GIB, "the pair a - b"):
        began = threading.Event()

        def work() -> None:
            with gate.reserve(GIB / 2, "the pair c - d"):
                began.set()

        other = threading.Thread(target=work)
        other.start()
        assert not began.wait(0.1)
    other.join()
    assert began.is_set()
    with pytest.raises(OptionError, match=r"4096MiB .* is too little for the pair e - f; 4\d{3}MiB would do"):
        gate.check(3 * GIB, "the pair e - f")


def test_a_pair_has_memory_for_two_images_that_are_read_at_once(tmp_path: Path) -> None:
    """As a thread that is idle reads one of them; a single thread reads one after the other."""
    context = make_context(prepare(make_project(tmp_path), tmp_path / "dense"))
    pair = (NAMES[0], NAMES[1])

    def needed(threads: int) -> float:
        soft = replace(
            context, details=dict.fromkeys(NAMES, 0.3), options=replace(context.options, threads=threads)
        )
        return MatchStage(soft, [pair]).job(pair).cost.memory

    # While one is read: its colours, whole grey values and what corners are found by.
    pixels = context.scene.view(NAMES[0]).num_pixels
    assert 10 * pixels < needed(2) - needed(1) < 13 * pixels


def test_a_dry_run_refuses_no_images_that_it_has_not_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Soft ones are matched in less memory than sharp ones: a run that sees them goes through."""
    monkeypatch.setattr(memory, "_at_start", lambda: 0)
    monkeypatch.setattr(memory, "resident", lambda: 0)
    context = make_context(prepare(make_project(tmp_path), tmp_path / "dense"))
    pair = (NAMES[0], NAMES[1])

    def needed(detail: float | None) -> float:
        details = {} if detail is None else dict.fromkeys(NAMES, detail)
        return MatchStage(replace(context, details=details), [pair]).job(pair).cost.memory

    assert needed(0.3) < 0.7 * needed(None) and needed(1.0) == pytest.approx(needed(None), rel=1e-6)
    small = replace(context, options=replace(context.options, memory=str(int(0.9 * needed(None))), threads=1))
    survey = Survey(is_bounded=True)
    assert len(survey(MatchStage(replace(small, details=dict.fromkeys(NAMES, 0.3)), [pair]))) == 1
    assert caplog.text == ""
    with pytest.raises(OptionError, match="is too little for the pair"):
        survey(MatchStage(replace(small, details=dict.fromkeys(NAMES, 1.0)), [pair]))
    assert len(survey(MatchStage(small, [pair]))) == 1
    assert "is too little for the pair" in caplog.text and "This is for sharp images; soft ones" in caplog.text


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="keeps freed memory in another way")
@pytest.mark.parametrize("in_bands", [False, True])
def test_what_small_arrays_have_left_goes_back_before_a_large_level_begins(in_bands: bool) -> None:
    """It lies between memory in use, and arrays of a large image find no room there; small ones take it again."""
    image = RectifiedImage(np.zeros((160, 200), np.float32), np.full((160, 200), 255, np.uint8))
    with room_for_workers():
        small = [np.ones(1 << 20, np.uint8) for _ in range(128)]
        del small[::2]
        left = resident() - 64 * (1 << 20)  # once the rest is given back
        match_pair(image, image, 0, 10, MatchingOptions(), _scratches(1 << 20 if in_bands else 1 << 28))
        assert (resident() < left + (32 << 20)) == in_bands
        del small


@pytest.mark.parametrize(("left", "gives_back"), [(GIB, 0), (3 * GIB, 1)])
def test_work_that_does_not_fit_beside_what_was_freed_has_it_given_back(
    left: int, gives_back: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And only that: others are quicker with memory that the process has already."""
    gate = MemoryGate(4 * GIB, in_use=GIB)
    given: list[int] = []
    monkeypatch.setattr(memory, "resident", lambda: left)
    monkeypatch.setattr(memory, "give_back_freed_memory", lambda: given.append(1))
    with gate.reserve(2 * GIB, "it"):
        assert len(given) == gives_back
