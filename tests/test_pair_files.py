"""Disparity maps on disk: what is read is what was written, and damage is said in one sentence."""

import os
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from colmap_sph.errors import DamageError, InputError, OutputError
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.pair_files import (
    facts_of_estimate,
    facts_of_pair,
    read_estimate,
    read_pair,
    write_estimate,
    write_pair,
)
from colmap_sph.project.state import array_file
from colmap_sph.project.state.array_file import Head, read_head, write_arrays
from colmap_sph.scene import View
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.poses.ties import MAX_TIES
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair

HEIGHT, WIDTH = 6, 9


def make_pair(disparity: np.ndarray) -> PairDisparity:
    """A pair of rather ugly numbers, which must survive to the last bit."""
    geometry = RectifiedPair(
        surface="spherical",
        rectified_from_world=np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0],
        baseline=np.pi * 1e5,
        columns_per_radian=1 / 3,
        rows_per_radian=2 / 7,
        row_origin=-1e9 / 3,
        left_origin=0.1,
        right_origin=-0.2,
        height=HEIGHT,
        left_width=WIDTH,
        right_width=WIDTH + 1,
        min_disparity=-1.7,
        max_disparity=321.9,
    )
    return PairDisparity("camera 1/ä.jpg", "b.jpg", geometry, disparity.astype(np.float32))


def random_disparity(low: float, high: float) -> np.ndarray:
    """Values all over the range, both ends included, and some pixels without."""
    rng = np.random.default_rng(1)
    disparity = rng.uniform(low, high, (HEIGHT, WIDTH))
    disparity[0, 0], disparity[0, 1] = low, high
    disparity[rng.random((HEIGHT, WIDTH)) < 0.3] = np.nan
    disparity[0, :3] = low, high, np.nan
    return disparity


@pytest.mark.parametrize(
    ("low", "high", "step"),
    [
        (-3.0, 40.0, 1 / 64),
        (-1000.0, 20.0, 1 / 64),
        (700.0, 700.0, 1 / 64),
        # Ranges that 65,534 steps of 1/64 do not hold.
        (0.0, 2048.0, 2048 / 65534),
        (-30000.0, 30000.0, 60000 / 65534),
    ],
)
def test_round_trip(tmp_path: Path, low: float, high: float, step: float) -> None:
    written = make_pair(random_disparity(low, high))
    write_pair(tmp_path / "pair.sph", written)
    read = read_pair(tmp_path / "pair.sph")
    assert read.disparity.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(read.disparity), np.isnan(written.disparity))
    # Half a step, and the rounding of float32 at such numbers.
    rounding = 2 * np.spacing(np.float32(max(abs(low), abs(high))))
    np.testing.assert_allclose(read.disparity, written.disparity, rtol=0, atol=step / 2 + rounding)
    assert (read.left, read.right) == (written.left, written.right)
    for field in fields(RectifiedPair):
        kept, original = getattr(read.geometry, field.name), getattr(written.geometry, field.name)
        assert np.array_equal(kept, original), field.name
        assert type(kept) is type(original), field.name
    assert [path.name for path in tmp_path.iterdir()] == ["pair.sph"]


def test_pair_without_any_disparity(tmp_path: Path) -> None:
    empty = np.full((HEIGHT, WIDTH), np.nan)
    empty[2, 3] = np.inf
    write_pair(tmp_path / "pair.sph", make_pair(empty))
    assert np.isnan(read_pair(tmp_path / "pair.sph").disparity).all()


@pytest.mark.parametrize("damage", ["missing", "empty", "cut off", "longer", "garbage", "flipped bits", "archive"])
def test_damaged_file(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "pair.sph"
    write_pair(path, make_pair(random_disparity(0, 50)), "key")
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "archive":
        with path.open("wb") as file:
            np.savez(file, depth=np.zeros(3))
    else:
        middle = bytes(byte ^ 0x5A for byte in data[len(data) // 3 : 2 * len(data) // 3])
        path.write_bytes(
            {
                "empty": b"",
                "cut off": data[:-1],
                "longer": data + b"1",
                "garbage": b"not of this program",
                "flipped bits": data[: len(data) // 3] + middle + data[2 * len(data) // 3 :],
            }[damage]
        )
    assert not is_there(path)
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_pair(path)
    assert not path.exists()


def is_there(path: Path) -> bool:
    pair = make_pair(np.zeros((HEIGHT, WIDTH)))
    return facts_of_pair(path, "key", pair.left, pair.right, pair.geometry) is not None


def test_a_pair_is_there_under_its_key_with_its_geometry(tmp_path: Path) -> None:
    path = tmp_path / "pair.sph"
    pair = make_pair(random_disparity(0, 50))
    write_pair(path, pair, "key")
    names = (pair.left, pair.right)
    assert facts_of_pair(path, "key", *names, pair.geometry)
    assert not facts_of_pair(path, "other", *names, pair.geometry)
    assert not facts_of_pair(path, "key", *names[::-1], pair.geometry)
    for field in fields(RectifiedPair):
        value = getattr(pair.geometry, field.name)
        other: dict[str, Any] = {field.name: "frame" if field.name == "surface" else value + 1}
        assert not facts_of_pair(path, "key", *names, replace(pair.geometry, **other)), field.name


@pytest.mark.parametrize("what", ["pipe", "device", "link", "folder"])
def test_only_regular_files_are_read(tmp_path: Path, what: str) -> None:
    """A pipe would hang, a device never end; a link may lead anywhere."""
    path = tmp_path / "pair.sph"
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    else:
        write_pair(tmp_path / "elsewhere", make_pair(random_disparity(0, 50)), "key")
        path.symlink_to("/dev/zero" if what == "device" else tmp_path / "elsewhere")
    assert not is_there(path)
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_pair(path)


def peak_of(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def refuse(path: Path) -> None:
    assert not is_there(path)
    with pytest.raises(DamageError, match="was removed, run again"):
        read_pair(path)
    assert not path.exists()


def test_every_byte_of_the_head_is_checked_before_anything_is_allocated(tmp_path: Path) -> None:
    path = tmp_path / "pair.sph"
    write_pair(path, make_pair(random_disparity(0, 50)), "key")
    data = path.read_bytes()
    head = len(data) - 2 * HEIGHT * WIDTH
    assert head < 500
    for place in range(head):
        for bits in (0x01, 0x80, 0xFF):
            path.write_bytes(data[:place] + bytes([data[place] ^ bits]) + data[place + 1 :])
            assert peak_of(lambda: refuse(path)) < 200_000, place


def numbers_with(changes: dict[int, float]) -> list[float]:
    """Scale, rotation and the other numbers of the geometry, some of them changed."""
    geometry = vars(make_pair(np.zeros((HEIGHT, WIDTH))).geometry)
    others = [value for value in geometry.values() if isinstance(value, (int, float))]
    numbers = [0.0, 1 / 64, 1.0, 0.3, *geometry["rectified_from_world"].ravel(), *map(float, others)]
    for place, value in changes.items():
        numbers[place] = value
    return numbers


def written(
    path: Path,
    *,
    kind: str = "pair",
    codes: np.ndarray | None = None,
    ties: np.ndarray | None = None,
    **changes: Any,
) -> None:
    """Write a file with checksums that hold, whatever it says."""
    pair = make_pair(np.zeros((HEIGHT, WIDTH)))
    texts = [pair.left, pair.right, pair.geometry.surface]
    content: dict[str, Any] = {"texts": texts, "numbers": numbers_with({})}
    codes = np.zeros((HEIGHT, WIDTH), np.uint16) if codes is None else codes
    arrays = [codes] if ties is None else [codes, ties]
    write_arrays(path, kind, "key", arrays, **(content | changes))


@pytest.mark.parametrize(
    "content",
    [
        {"kind": "estimate"},
        {"kind": ""},
        {"texts": []},
        {"texts": ["a", "b", "cylinder"]},
        {"texts": ["a", "b", "frame", "c"]},
        {"numbers": []},
        {"numbers": numbers_with({0: np.nan})},
        {"numbers": numbers_with({1: 0.0})},
        {"numbers": numbers_with({1: -1.0})},
        {"numbers": numbers_with({2: 0.0})},
        {"numbers": numbers_with({2: 1.5})},
        {"numbers": numbers_with({3: np.nan})},
        {"numbers": numbers_with({3: -0.5})},
        {"numbers": numbers_with({3: 1e9})},
        {"numbers": numbers_with({13: np.inf})},
        {"numbers": numbers_with({19: HEIGHT + 1.0})},
        {"numbers": numbers_with({20: 1e300})},
        {"numbers": numbers_with({20: -WIDTH})},
        {"codes": np.zeros((HEIGHT, WIDTH), np.float32)},
        {"codes": np.zeros((WIDTH, HEIGHT), np.uint16)},
        {"codes": np.zeros((HEIGHT, WIDTH, 2), np.uint16)},
        {"codes": np.zeros((0, WIDTH), np.uint16)},
        {"ties": np.zeros((3, 4), np.float32)},
        {"ties": np.zeros((MAX_TIES + 1, 5), np.float32)},
        {"ties": np.zeros((3, 5), np.uint16)},
        {"ties": np.zeros(15, np.float32)},
    ],
)
def test_content_of_no_pair_is_refused(tmp_path: Path, content: dict[str, Any]) -> None:
    """Checksums hold, as in a file that someone made to do harm."""
    path = tmp_path / "pair.sph"
    written(path)
    assert np.isnan(read_pair(path).disparity).all()
    written(path, **content)
    refuse(path)


def test_arrays_of_another_size_are_not_allocated(tmp_path: Path) -> None:
    """A file of 4 GB, all holes, whose head is right."""
    path = tmp_path / "estimate.sph"
    view = View(1, "a.jpg", 9, 6, np.eye(3), np.eye(3), np.zeros(3), np.zeros(0, np.int64))
    zeros = np.zeros((6, 9), np.float32)
    estimate = DepthEstimate(zeros, zeros, zeros.astype(np.uint8))
    facts = Facts(coverage=0.25, in_region=0.5)
    write_estimate(path, estimate, "key", facts)
    assert facts_of_estimate(path, "key", view) == facts
    assert facts_of_estimate(path, "other", view) is None
    assert read_estimate(path, view).support.shape == (6, 9)
    with path.open("r+b") as file:
        bomb = [(np.dtype(kind), (20000, 20000)) for kind in ("<f4", "<f4", "<u1")]
        head = Head("estimate", "key", (), (), tuple(bomb), bytes(16))
        size = file.write(array_file._packed(head))
        file.truncate(size + 9 * 20000**2)
    assert read_head(path) is not None
    assert facts_of_estimate(path, "key", view) is None

    def read() -> None:
        with pytest.raises(DamageError, match="of the size expected"):
            read_estimate(path, view)

    assert peak_of(read) < 200_000


def test_any_single_damaged_byte_is_harmless(tmp_path: Path) -> None:
    """A flipped byte anywhere raises an `InputError`."""
    path = tmp_path / "pair.sph"
    write_pair(path, make_pair(random_disparity(0, 50)))
    data = path.read_bytes()
    for place in range(len(data)):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        with pytest.raises(DamageError):
            read_pair(path)


def test_unwritable_file(tmp_path: Path) -> None:
    (tmp_path / "pair.sph").mkdir()
    with pytest.raises(OutputError, match="pair"):
        write_pair(tmp_path / "pair.sph", make_pair(random_disparity(0, 50)))
    assert [path.name for path in tmp_path.iterdir()] == ["pair.sph"]
