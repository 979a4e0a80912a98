"""The memory budget: amounts as people write them, and the gate that work waits at."""

import threading
import time
from pathlib import Path

import pytest

from colmap_sph.errors import OptionError
from colmap_sph.pipeline import memory
from colmap_sph.pipeline.memory import MemoryGate, budget, format_memory, parse_memory, resident

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


@pytest.mark.parametrize("amount", [1, 1 << 20, 700 << 20, 3 * GIB, 100 * GIB])
def test_a_written_amount_is_enough(amount):
    assert amount <= parse_memory(format_memory(amount)) <= amount + max(1 << 20, amount // 8)


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
