"""Digests tell different content apart, and records vouch only for what they were written for."""

import errno
import hashlib
import json
import os
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import xxhash
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import Meta

from colmap_sph.errors import InputError, OutputError
from colmap_sph.pipeline.digests import digest, file_digest
from colmap_sph.pipeline.program import program_digest
from colmap_sph.project.files import atomic_file, whole_digest
from colmap_sph.project.state.records import begin, invalidate, vouch, vouched_facts, whole_digests

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


# ---- records -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Facts:
    coverage: Annotated[float, Meta(ge=0, le=1)] = 1 / 3
    advice: str = "ä"


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    paths = [tmp_path / "map.bin", tmp_path / "empty.bin"]
    paths[0].write_bytes(np.random.default_rng(0).bytes(1_000_000))
    paths[1].write_bytes(b"")
    return paths


def vouch_for(record: Path, files: list[Path], facts: Facts | None = None) -> None:
    vouch(record, "key", {path: whole_digest(path) for path in files}, facts or Facts())


def facts_of(record: Path, files: list[Path], key: str = "key") -> Facts | None:
    return vouched_facts(record, key, files, Facts)


def test_a_record_vouches_for_its_files_under_its_key(files: list[Path], tmp_path: Path) -> None:
    record = tmp_path / "folder" / "a.json"
    assert facts_of(record, files) is None
    vouch_for(record, files)
    assert facts_of(record, files) == Facts()
    assert facts_of(record, files, "other key") is None
    assert facts_of(record, files[::-1]) is None
    assert facts_of(record, files[:1]) is None
    assert whole_digests(record, 2) == tuple(map(whole_digest, files))
    assert whole_digests(tmp_path / "none.json", 2) is None


def test_the_digest_of_a_whole_file_is_that_of_the_library(files: list[Path], tmp_path: Path) -> None:
    with atomic_file(tmp_path / "new") as file:
        for part in (b"abc", memoryview(b"defg")):
            file.write(part)
        digest_of_new = file.digest
    assert digest_of_new == whole_digest(tmp_path / "new") == xxhash.xxh3_128_hexdigest(b"abcdefg")
    assert whole_digest(files[0]) == xxhash.xxh3_128_hexdigest(files[0].read_bytes())


def test_files_of_other_sizes_or_content_are_noticed(files: list[Path], tmp_path: Path) -> None:
    record = tmp_path / "a.json"
    content = files[0].read_bytes()
    vouch_for(record, files)
    for changed in (content[:-1], content + b"1", bytes(len(content)), content[:-1] + b"!", b""):
        assert changed != content
        files[0].write_bytes(changed)
        assert facts_of(record, files) is None
    files[0].write_bytes(content)
    assert facts_of(record, files) == Facts()
    files[1].unlink()
    assert facts_of(record, files) is None


def test_every_byte_of_a_small_file_is_looked_at(tmp_path: Path) -> None:
    path, record = tmp_path / "small", tmp_path / "a.json"
    content = np.random.default_rng(0).bytes(60_000)
    path.write_bytes(content)
    vouch_for(record, [path])
    for place in range(0, len(content), 997):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert facts_of(record, [path]) is None, place


def test_any_altered_byte_of_a_record_is_noticed(files: list[Path], tmp_path: Path) -> None:
    """But for white space, which says nothing."""
    record = tmp_path / "a.json"
    vouch_for(record, files)
    content = record.read_bytes()
    for place in range(len(content)):
        if not content[place : place + 1].isspace():
            record.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
            assert facts_of(record, files) is None, place


# ---- whose files they are ----------------------------------------------------------------------------------


def test_files_without_a_record_are_set_aside(files: list[Path], tmp_path: Path) -> None:
    content = files[0].read_bytes()
    begin(tmp_path / "a.json", files)
    assert [path.exists() for path in files] == [False, False]
    assert files[0].with_name("map.bin.backup").read_bytes() == content


def test_files_that_a_record_knows_are_replaced_while_they_are_as_it_knows_them(
    files: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    record = tmp_path / "a.json"
    vouch_for(record, files)
    begin(record, files)
    assert all(path.exists() for path in files)
    # Killed while they are made: still ours, whatever they hold, and nothing vouches for them.
    files[0].write_bytes(b"half of another result")
    assert facts_of(record, files) is None
    begin(record, files)
    assert all(path.exists() for path in files)
    assert caplog.text == ""
    vouch_for(record, files)
    for number in ("", "2", "3"):
        files[0].write_bytes(f"of COLMAP {number}".encode())
        begin(record, files)
        assert files[0].with_name(f"map.bin.backup{number}").read_bytes() == f"of COLMAP {number}".encode()
        assert str(files[0]) in caplog.text
        files[0].write_bytes(b"ours")
        vouch_for(record, files)


@pytest.mark.parametrize("state", ["void", "doubtful"])
def test_damage_between_the_samples_is_seen_where_a_file_is_in_doubt(
    files: list[Path], tmp_path: Path, state: Any
) -> None:
    record = tmp_path / "a.json"
    vouch_for(record, files)
    data = bytearray(files[0].read_bytes())
    data[10_000] ^= 1
    files[0].write_bytes(data)
    assert facts_of(record, files) is not None
    invalidate(record, state)
    assert facts_of(record, files) is None
    assert whole_digests(record, 2) == ("", "")
    begin(record, files)  # before anything is replaced every byte counts
    assert not files[0].exists()
    assert files[1].exists()


def test_records_of_earlier_versions_say_whose_files_they_are(files: list[Path], tmp_path: Path) -> None:
    """As version 0.1.0 wrote them: no digests, and another check."""
    record = tmp_path / "a.json"
    stamps = []
    for path in files:
        data = path.read_bytes()
        last = max(0, len(data) - 4096)
        blocks = [data[last * index // 15 :][:4096] for index in range(16)]
        stamps.append(f"{len(data)} {hashlib.blake2b(b''.join(blocks), digest_size=16).hexdigest()}")
    content = {"key": "key", "stamps": stamps, "facts": {"coverage": 0.5}, "check": "0" * 32}
    record.write_text(json.dumps(content))
    assert facts_of(record, files) is None
    begin(record, files)
    assert all(path.exists() for path in files)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    st.dictionaries(st.sampled_from(["key", "stamps", "digests", "facts", "state", "more"]), JSON)
    | st.fixed_dictionaries({"facts": st.fixed_dictionaries({"coverage": JSON, "advice": JSON})})
)
def test_records_with_a_valid_check_and_any_content(tmp_path: Path, change: dict[str, Any]) -> None:
    """They vouch for nothing, unless they say what a record of ours would."""
    path, record = tmp_path / "map.bin", tmp_path / "a.json"
    path.write_bytes(b"1")
    vouch_for(record, [path])
    original = json.loads(record.read_bytes())
    del original["check"]
    content = original | change
    check = xxhash.xxh3_128_hexdigest(json.dumps(content, sort_keys=True).encode())
    record.write_text(json.dumps(content | {"check": check}))
    found = facts_of(record, [path])
    same = {name: content.get(name) for name in original if name != "facts"}
    if found is None:
        begin(record, [path])
        assert record.exists()
    else:
        assert same == {name: value for name, value in original.items() if name != "facts"}
        assert "more" not in content
        assert isinstance(found.coverage, float) and 0 <= found.coverage <= 1
        assert isinstance(found.advice, str)


@pytest.mark.parametrize("what", ["deep", "long", "pipe", "folder", "link", "many digits", "not UTF-8"])
def test_what_is_no_record_vouches_for_nothing(what: str, files: list[Path], tmp_path: Path) -> None:
    record = tmp_path / "a.json"
    if what == "pipe":
        os.mkfifo(record)
    elif what == "folder":
        record.mkdir()
    elif what == "link":
        record.symlink_to("/dev/zero")
    else:
        contents = {
            "deep": b'{"facts":' + b"[" * 100_000,
            "long": b'{"key": "' + bytes(1 << 21) + b'"}',
            "many digits": b'{"key": ' + b"9" * 10_000 + b"}",
            "not UTF-8": b'{"key": "\xff"}',
        }
        record.write_bytes(contents[what])
    assert facts_of(record, files) is None
    assert whole_digests(record, 2) == ("", "")
    if what != "folder":
        begin(record, files)  # and is replaced
        vouch(record, "key", {})
        assert vouched_facts(record, "key", [], dict) == {}


# ---- the disk ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "is_error"), [(errno.EINVAL, False), (errno.ENOTSUP, False), (errno.EIO, True)]
)
def test_disks_that_cannot_sync_or_fail_at_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, is_error: bool
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"before")

    def fail(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with (
        pytest.raises(OutputError, match="Input/output error") if is_error else nullcontext(),
        atomic_file(path) as f,
    ):
        f.write(b"after")
    assert path.read_bytes() == (b"before" if is_error else b"after")
    assert [each.name for each in tmp_path.iterdir()] == ["a"]
