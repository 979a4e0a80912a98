"""Records: which files in COLMAP's formats are ours, what they were made from, and whether they are whole.

A record is a small JSON file. Whatever else is found in its place vouches for nothing.
"""

import hashlib
import json
import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import msgspec
import xxhash
from msgspec import Meta

from colmap_sph.errors import InputError, OutputError, reason_of, unwritable
from colmap_sph.platforms.files import is_link, sync_file, sync_folder
from colmap_sph.project.files import (
    atomic_file,
    make_dir,
    open_regular,
    read_small,
    set_aside,
    whole_digest,
)
from colmap_sph.project.state import background
from colmap_sph.project.state.typed import from_json, from_plain

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

logger = logging.getLogger(__name__)

T = TypeVar("T")

_STAMP_BLOCKS = 16
_BLOCK_BYTES = 4096
_MAX_BYTES = 1 << 24  # of a cloud of all images that a model can have

Word = Annotated[str, Meta(max_length=100)]


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a record says.

    Attributes
    ----------
    key : str
        Digest of what the files were made from.
    stamps : tuple of str
        Size, and digest of some blocks, of each file as it was when the record was written.
    digests : tuple of str
        Digest of every byte of each file; earlier versions had none.
    facts : dict
        What a later run wants to know of the files without reading them.
    state : {"done", "void", "doubtful", "making"}
        Whether the files are complete; to be made again; damaged somewhere, and to be made again; or just being
        written, so that their content is unknown. In each of these states they are ours.
    """

    key: Word = ""
    stamps: Annotated[tuple[Word, ...], Meta(max_length=10)] = ()
    digests: Annotated[tuple[Word, ...], Meta(max_length=10)] = ()
    facts: dict[str, Any] = {}
    state: Literal["done", "void", "doubtful", "making"] = "done"


_UNREADABLE = Record(state="void")


def read_json(path: Path, kind: type[T], *, max_bytes: int = _MAX_BYTES) -> T | None:
    """Read a JSON file of ours.

    Parameters
    ----------
    path : Path
    kind : type
        What it must hold: a plain type, dataclass or `msgspec.Struct`, whose fields' types are checked.
    max_bytes : int
        A longer file is not ours.

    Returns
    -------
    object or None
        Of type `kind`. None where the file is missing, cannot be read, or holds anything else.
    """
    try:
        return from_json(read_small(path, max_bytes, follow=False), kind)
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def read_record(path: Path) -> Record | None:
    """Read a record; None where there is none, and one that knows nothing of its files where it is damaged."""
    if not os.path.lexists(path):
        return None
    content = read_json(path, dict[str, Any])
    if content is None:
        return _UNREADABLE
    check = content.pop("check", None)
    try:
        # Those of earlier versions had other checks. They vouch for nothing any more, but say what is ours.
        if "digests" in content and check != _check(content):
            return _UNREADABLE
        return from_plain(content, Record)
    except (msgspec.MsgspecError, RecursionError):
        return _UNREADABLE


def _check(content: Mapping[str, Any]) -> str:
    return xxhash.xxh3_128_hexdigest(json.dumps(content, sort_keys=True).encode())


def _write(path: Path, record: Record, *, sync: bool = True) -> None:
    content = msgspec.to_builtins(record)
    make_dir(path.parent)
    with atomic_file(path, sync=sync) as file:
        file.write(json.dumps(content | {"check": _check(content)}, indent=1).encode())


def begin(record: Path, files: Sequence[Path], *, sync: bool = True) -> None:
    """Say that `files` are about to be written: from here on their content is unknown, but ours.

    Nothing of others is lost: a file that is not as the record knows it, or of which no record knows, is set aside
    under another name, with a warning.

    Parameters
    ----------
    record : Path
    files : sequence of Path
        The same, in the same order, as for `vouch`.
    sync : bool
        Whether to wait until the disk has it, also where it has a record of these files already.

    Raises
    ------
    OutputError
        The record cannot be written, or a file cannot be set aside.
    """
    known = read_record(record)
    if known is not None and known.state == "making":
        return
    for path in altered_files(known, files, every_byte=True):
        backup = set_aside(path)
        logger.warning("%s is not what this program wrote there; it is now %s", path, backup.name)
    # What has no record yet must have one before it is there: without, it is nobody's after a power cut.
    _write(record, Record(state="making"), sync=sync or known is None)


def claim(record: Path, files: Sequence[Path]) -> None:
    """Take files of which no record knows for ours: as they are now, they may be replaced.

    Parameters
    ----------
    record : Path
    files : sequence of Path
        The first of those of `begin`; need not be there.
    """
    _write(record, Record(stamps=tuple(_stamp_if_readable(path) or "" for path in files), state="void"))


def vouch(
    record: Path,
    key: str,
    files: Mapping[Path, str],
    facts: "DataclassInstance | None" = None,
    *,
    state: Literal["done", "void"] = "done",
    read_back: bool = False,
) -> None:
    """Write a record: `files` are complete, and were made under `key`.

    Parameters
    ----------
    record : Path
        JSON file to write; its folder is created.
    key : str
    files : mapping of Path to str
        With the digest of every byte, see `files.whole_digest`; empty for one that is not wanted.
    facts : dataclass, optional
        What a later run wants to know without reading the files.
    state : {"done", "void"}
        "void": they are not what they should be, and only ours.
    read_back : bool
        Whether to make sure that they are what was written: not where no other job can write them.

    Raises
    ------
    OutputError
        A file cannot be read back, or is another job's by now, and nothing vouches for it; or the record cannot be
        written.
    """
    stamps = []
    for path, digest in files.items():
        try:
            stamps.append(_stamp(path) if digest else "")
        except OSError as error:
            raise OutputError(f"{path} cannot be read back ({reason_of(error)}); run again.") from error
        # After the stamp: so both are of one content, whatever others write meanwhile.
        if read_back and digest and _digest(path) != digest:
            _write(record, Record(state="making"))
            raise OutputError(
                f"{path} was written by another job at the same time, with other options; run again, and give all "
                "jobs of a workspace the same options."
            )
    plain = {} if facts is None else asdict(facts)
    _write(record, Record(key, tuple(stamps), tuple(files.values()), plain, state))


def vouch_when_on_disk(
    record: Path,
    key: str,
    files: Mapping[Path, str],
    facts: "DataclassInstance | None" = None,
    *,
    state: Literal["done", "void"] = "done",
) -> None:
    """Do what `vouch` does, once the disk has the files; in `vouching_in_background` without waiting for that."""
    if not background.submit(_sync_and_vouch, record, key, files, facts, state):
        _sync_and_vouch(record, key, files, facts, state)


def _sync_and_vouch(
    record: Path,
    key: str,
    files: Mapping[Path, str],
    facts: "DataclassInstance | None",
    state: Literal["done", "void"],
) -> None:
    written = [path for path, digest in files.items() if digest]
    try:
        for path in written:
            sync_file(path)
        for folder in {path.parent for path in written}:
            sync_folder(folder)
    except OSError as error:
        raise unwritable(next(iter(files)), error) from error
    vouch(record, key, files, facts, state=state, read_back=True)


def vouched_facts(record: Path, key: str, files: Sequence[Path], kind: type[T]) -> T | None:
    """Return what `vouch` recorded, or None where the files must be made.

    They must be made where the record is missing, damaged or of another key, and where a file is missing, cut
    off or was written by another program. Every block of a small file is looked at, but only some of a large one.

    Parameters
    ----------
    record, key, files
        As for `vouch`.
    kind : type
        Dataclass of the facts.

    Returns
    -------
    object of that type, or None
    """
    known = read_record(record)
    if known is None or known.state != "done" or known.key != key or len(known.digests) != len(files):
        return None
    wanted = [path for path, digest in zip(files, known.digests, strict=True) if digest]
    if altered_files(known, files) or not all(path.is_file() for path in wanted):
        return None
    return _facts_of(known, kind)


def recorded_facts(record: Path, kind: type[T], files: Sequence[Path] = ()) -> T | None:
    """Return what a record says of files of ours, whatever key they were made under; None where that is nothing.

    Parameters
    ----------
    record, files
        As for `vouch`; of the files those that must be as the record knows them.
    kind : type
        Dataclass of the facts.
    """
    known = read_record(record)
    if known is None or known.state == "making" or altered_files(known, files):
        return None
    return _facts_of(known, kind)


def _facts_of(known: Record, kind: type[T]) -> T | None:
    try:
        return from_plain(known.facts, kind)
    except (msgspec.MsgspecError, RecursionError):
        return None


def whole_digests(record: Path, number: int) -> tuple[str, ...] | None:
    """Digests of every byte of the files of a record that vouches for so many.

    Empty words, which no digest equals, where it vouches for nothing; None where there is no record.
    """
    known = read_record(record)
    if known is None:
        return None
    if known.state != "done" or len(known.digests) != number:
        return ("",) * number
    return known.digests


def invalidate(record: Path, state: Literal["void", "doubtful"] = "void") -> None:
    """Make a record vouch no more: its files are to be made again, and are still ours.

    Parameters
    ----------
    record : Path
    state : {"void", "doubtful"}
        "doubtful": one of the files is damaged in a place that a stamp need not show.
    """
    known = read_record(record)
    if known is not None and known.state in ("done", "void"):
        _write(record, msgspec.structs.replace(known, state=state))


def altered_files(known: Record | None, files: Sequence[Path], *, every_byte: bool = False) -> list[Path]:
    """Those of `files` which are there, but not as a record of ours left them; no folders, which writing refuses.

    Parameters
    ----------
    known : Record or None
        None: there is no record of them.
    files : sequence of Path
    every_byte : bool
        Whether to look at all of a large file, too: before it is replaced or removed.
    """
    there = [path for path in files if os.path.lexists(path) and (is_link(path) or not path.is_dir())]
    if known is None or not there:
        return there
    if known.state == "making":
        return []
    stamps = dict(zip(files, known.stamps, strict=False))
    altered = [path for path in there if _stamp_if_readable(path) != stamps.get(path)]
    if known.digests and (every_byte or known.state == "doubtful"):
        digests = dict(zip(files, known.digests, strict=False))
        altered += [path for path in there if path not in altered and _digest(path) != digests.get(path)]
    return altered


def _digest(path: Path) -> str | None:
    with suppress(InputError):
        return whole_digest(path)
    return None


def content_stamp(path: Path) -> str:
    """What tells a file from others without reading all of it; empty for one that cannot be read."""
    return _stamp_if_readable(path) or ""


def _stamp_if_readable(path: Path) -> str | None:
    with suppress(OSError):
        return _stamp(path)
    return None


def _stamp(path: Path) -> str:
    """Size, and digest of evenly spread blocks: reading all of the maps again would take minutes."""
    state = hashlib.blake2b(digest_size=16)
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        last = max(0, size - _BLOCK_BYTES)
        for index in range(_STAMP_BLOCKS):
            file.seek(last * index // (_STAMP_BLOCKS - 1))
            state.update(file.read(_BLOCK_BYTES))
    return f"{size} {state.hexdigest()}"
