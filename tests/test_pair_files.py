"""Disparity maps on disk: what is read is what was written, and damage is said in one sentence."""

import json
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from colmap_sph.errors import InputError, OutputError
from colmap_sph.pipeline.stages.pair_files import read_pair, write_pair
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
    write_pair(tmp_path / "pair.npz", written)
    read = read_pair(tmp_path / "pair.npz")
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
    assert [path.name for path in tmp_path.iterdir()] == ["pair.npz"]


def test_pair_without_any_disparity(tmp_path: Path) -> None:
    empty = np.full((HEIGHT, WIDTH), np.nan)
    empty[2, 3] = np.inf
    write_pair(tmp_path / "pair.npz", make_pair(empty))
    assert np.isnan(read_pair(tmp_path / "pair.npz").disparity).all()


@pytest.mark.parametrize("damage", ["missing", "empty", "cut off", "garbage", "flipped bits", "other content"])
def test_damaged_file(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "pair.npz"
    write_pair(path, make_pair(random_disparity(0, 50)))
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "other content":
        np.savez(path, depth=np.zeros(3))
    else:
        middle = bytes(byte ^ 0x5A for byte in data[len(data) // 3 : 2 * len(data) // 3])
        path.write_bytes(
            {
                "empty": b"",
                "cut off": data[: len(data) // 2],
                "garbage": b"not a zip archive",
                "flipped bits": data[: len(data) // 3] + middle + data[2 * len(data) // 3 :],
            }[damage]
        )
    with pytest.raises(InputError, match=re.escape(str(path))):
        read_pair(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda metadata: "nonsense",
        lambda metadata: "[]",
        lambda metadata: "{}",
        lambda metadata: "[" * 100_000,
        lambda metadata: json.dumps(metadata | {"scale": [1.0]}),
        lambda metadata: json.dumps(metadata | {"scale": [None, 1.0]}),
        lambda metadata: json.dumps(metadata | {"geometry": []}),
        lambda metadata: json.dumps(metadata | {"geometry": metadata["geometry"] | {"more": 1}}),
        lambda metadata: json.dumps(metadata | {"geometry": metadata["geometry"] | {"rectified_from_world": "x"}}),
    ],
)
def test_metadata_of_no_pair_is_refused_and_removed(tmp_path: Path, change: Callable[[Any], str]) -> None:
    path = tmp_path / "pair.npz"
    write_pair(path, make_pair(random_disparity(0, 50)))
    with np.load(path) as data:
        content = dict(data)
    np.savez(path, **(content | {"metadata": change(json.loads(str(content["metadata"])))}))
    with pytest.raises(InputError, match="does not describe a pair"):
        read_pair(path)
    assert not path.exists()


def test_any_single_damaged_byte_is_harmless(tmp_path: Path) -> None:
    """A flipped byte anywhere either leaves the content as it was or raises an `InputError`."""
    path = tmp_path / "pair.npz"
    write_pair(path, make_pair(random_disparity(0, 50)))
    data = path.read_bytes()
    before = read_pair(path)
    for place in range(0, len(data), 7):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        try:
            after = read_pair(path)
        except InputError:
            continue
        np.testing.assert_array_equal(after.disparity, before.disparity)
        assert after.geometry.baseline == before.geometry.baseline


def test_unwritable_file(tmp_path: Path) -> None:
    (tmp_path / "pair.npz").mkdir()
    with pytest.raises(OutputError, match="pair"):
        write_pair(tmp_path / "pair.npz", make_pair(random_disparity(0, 50)))
    assert [path.name for path in tmp_path.iterdir()] == ["pair.npz"]
