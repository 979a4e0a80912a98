"""What was made from what: content digests, and records that vouch for finished files.

A *key* is a digest of everything a result depends on: the program, options, cameras, and the keys or contents of
what it was made from. A result with the key that it would get today is not made again. Time stamps play no part.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

import colmap_sph
from colmap_sph import _native
from colmap_sph.errors import InputError, OutputError
from colmap_sph.workspace import atomic_file, make_dir

_DIGEST_BYTES = 16
_STAMP_BLOCKS = 16
_BLOCK_BYTES = 4096


def digest(*parts: object) -> str:
    """Digest of plain values, paths, arrays, dataclasses, and sequences and mappings of these.

    Returns
    -------
    str
        32 hexadecimal digits; different for any difference in type, shape or value.
    """
    state = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    _feed(state, parts)
    return state.hexdigest()


def _feed(state: "hashlib.blake2b", value: object) -> None:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray):
        state.update(f"array {value.dtype.str} {value.shape} ".encode())
        state.update(np.ascontiguousarray(value).data)
    elif is_dataclass(value):
        _feed(state, {field.name: getattr(value, field.name) for field in fields(value)})
    elif isinstance(value, Mapping):
        state.update(b"mapping ")
        _feed(state, sorted(value.items()))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        state.update(f"sequence {len(value)} ".encode())
        for part in value:
            _feed(state, part)
    elif value is None or isinstance(value, (bool, int, float, str, Path)):
        text = f"{type(value).__name__} {value!r}".encode()
        state.update(f"{len(text)} ".encode() + text)
    else:
        raise TypeError(f"a {type(value).__name__} has no digest")


def file_digest(path: Path) -> str:
    """Digest of a file's content; `InputError` where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=_DIGEST_BYTES)).hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}); check its permissions.") from error


def program_digest() -> str:
    """Digest of this package's code and of the libraries that compute: a changed program makes everything anew.

    A hand-kept version would be forgotten, and a result of yesterday's kernels taken for today's.
    """
    files = [*sorted(Path(colmap_sph.__file__).parent.glob("*.py")), Path(_native.__file__)]
    libraries = [library.__version__ for library in (cv2, np, pycolmap)]
    return digest([file_digest(path) for path in files], libraries)


# ---- records -----------------------------------------------------------------------------------------------


def vouch(record: Path, key: str, files: Sequence[Path], **facts: Any) -> None:
    """Write a record: `files` are complete, were made under `key`, and `facts` are known of them.

    Parameters
    ----------
    record : Path
        JSON file to write; its folder is created.
    key : str
    files : sequence of Path
        Their sizes and samples of their content are recorded.
    **facts
        Plain values that a later run wants without reading the files.
    """
    content = {"key": key, "stamps": [_stamp(path) for path in files], "facts": facts}
    make_dir(record.parent)
    with atomic_file(record) as file:
        file.write(json.dumps(content | {"check": digest(content)}, indent=1).encode())


def vouched_facts(record: Path, key: str, files: Sequence[Path]) -> dict[str, Any] | None:
    """Return what `vouch` recorded, or None where the files must be made.

    They must be made where the record is missing, damaged or of another key, and where a file is missing, cut
    off or was written by another program. Every block of a small file is looked at, but only some of a large one.
    """
    try:
        content = json.loads(record.read_bytes())
        check = content.pop("check")
        facts = content["facts"]
        known = content["key"] == key and check == digest(content)
        known = known and content["stamps"] == [_stamp(path) for path in files]
    # What reading and taking apart of garbage can raise.
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, OutputError):
        return None
    return facts if known and isinstance(facts, dict) else None


def forget(record: Path) -> None:
    """Remove a record, before its files are made anew."""
    try:
        with suppress(FileNotFoundError):
            record.unlink()
    except OSError as error:
        raise OutputError(f"{record} cannot be removed ({error.strerror or error}); check permissions.") from error


def _stamp(path: Path) -> str:
    """Size, and digest of evenly spread blocks: reading all of the maps again would take minutes."""
    state = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            last = max(0, size - _BLOCK_BYTES)
            for index in range(_STAMP_BLOCKS):
                file.seek(last * index // (_STAMP_BLOCKS - 1))
                state.update(file.read(_BLOCK_BYTES))
    except OSError as error:
        raise OutputError(f"{path} cannot be read back ({error.strerror or error}); run again.") from error
    return f"{size} {state.hexdigest()}"
