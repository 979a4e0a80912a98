"""Digests tell different content apart, and records vouch only for what they were written for."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from colmap_sph.pipeline.records import forget, vouch, vouched_facts
from hypothesis import given
from hypothesis import strategies as st

from colmap_sph.errors import InputError
from colmap_sph.pipeline.digests import digest, file_digest
from colmap_sph.pipeline.program import program_digest

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@dataclass(frozen=True)
class Options:
    first: int = 1
    second: float = 2.0


def test_equal_content_has_equal_digests() -> None:
    array = np.arange(12.0).reshape(3, 4)
    assert digest(array, Options()) == digest(np.asfortranarray(array), Options())
    assert digest(array[:, ::2]) == digest(array[:, ::2].copy())
    assert digest(np.float64(0.1), np.int32(3)) == digest(0.1, 3)
    assert digest({"a": 1, "b": 2}) == digest({"b": 2, "a": 1})
    assert digest((1, 2)) == digest([1, 2])


DIFFERENT = [
    1,
    1.0,
    True,
    "1",
    None,
    [1],
    [[1]],
    [],
    [[]],
    {"a": 1},
    {"a": "1"},
    ["ab", "c"],
    ["a", "bc"],
    ["a", ["bc"]],
    Path("1"),
    np.array([1]),
    np.array([[1]]),
    np.array([1], np.float32),
    np.array([1], np.int32),
    Options(),
    Options(second=np.nextafter(2.0, 3.0)),
    np.nextafter(1.0, 2.0),
    0.0,
    -0.0,
]


def test_different_content_has_different_digests() -> None:
    assert len({digest(value) for value in DIFFERENT}) == len(DIFFERENT)
    assert digest("a", "b") != digest(["a", "b"])


@given(PLAIN, PLAIN)
def test_digests_are_equal_only_for_the_same_text(one: object, other: object) -> None:
    same = json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)
    assert (digest(one) == digest(other)) == same


@given(PLAIN)
def test_digests_survive_json(value: object) -> None:
    assert digest(json.loads(json.dumps(value))) == digest(value)


def test_what_has_no_digest_is_refused() -> None:
    with pytest.raises(TypeError, match="object"):
        digest([object()])


def test_the_digest_of_a_file_is_that_of_its_content(tmp_path: Path) -> None:
    for name, content in (("a", b"same"), ("b", b"same"), ("c", b"other")):
        (tmp_path / name).write_bytes(content)
    assert file_digest(tmp_path / "a") == file_digest(tmp_path / "b") != file_digest(tmp_path / "c")
    with pytest.raises(InputError, match="missing"):
        file_digest(tmp_path / "missing")


def test_the_program_is_the_same_twice() -> None:
    assert program_digest("colmap_sph.pipeline.reconstruct") == program_digest("colmap_sph.pipeline.reconstruct")


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / "map.bin", tmp_path / "empty.bin"]
    paths[0].write_bytes(np.random.default_rng(0).bytes(1_000_000))
    paths[1].write_bytes(b"")
    return paths


def test_a_record_vouches_for_its_files_under_its_key(files: list[Path], tmp_path: Path) -> None:
    record = tmp_path / "folder" / "a.json"
    assert vouched_facts(record, "key", files) is None
    vouch(record, "key", files, coverage=1 / 3, advice="ä")
    assert vouched_facts(record, "key", files) == {"coverage": 1 / 3, "advice": "ä"}
    assert vouched_facts(record, "other key", files) is None
    assert vouched_facts(record, "key", files[::-1]) is None
    assert vouched_facts(record, "key", files[:1]) is None
    forget(record)
    assert vouched_facts(record, "key", files) is None
    forget(record)


def test_files_of_other_sizes_or_content_are_noticed(files: list[Path], tmp_path: Path) -> None:
    record = tmp_path / "a.json"
    content = files[0].read_bytes()
    vouch(record, "key", files)
    for changed in (content[:-1], content + b"1", bytes(len(content)), content[:-1] + b"!", b""):
        assert changed != content
        files[0].write_bytes(changed)
        assert vouched_facts(record, "key", files) is None
    files[0].write_bytes(content)
    assert vouched_facts(record, "key", files) == {}
    files[1].unlink()
    assert vouched_facts(record, "key", files) is None


def test_every_byte_of_a_small_file_is_looked_at(tmp_path: Path) -> None:
    path, record = tmp_path / "small", tmp_path / "a.json"
    content = np.random.default_rng(0).bytes(60_000)
    path.write_bytes(content)
    vouch(record, "key", [path])
    for place in range(0, len(content), 997):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert vouched_facts(record, "key", [path]) is None, place


def test_any_altered_byte_of_a_record_is_noticed(files: list[Path], tmp_path: Path) -> None:
    """But for white space, which says nothing."""
    record = tmp_path / "a.json"
    vouch(record, "key", files, coverage=0.25)
    content = record.read_bytes()
    for place in range(len(content)):
        if not content[place : place + 1].isspace():
            record.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
            assert vouched_facts(record, "key", files) is None, place
