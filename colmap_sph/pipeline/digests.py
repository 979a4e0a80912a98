"""Digests of contents: of plain values, arrays and records, and of files."""

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import open_regular

_DIGEST_BYTES = 16
_PLAIN = {bool, int, float, str, type(None)}


def new_digest() -> "hashlib.blake2b":
    """Return an empty digest, to be fed with bytes."""
    return hashlib.blake2b(digest_size=_DIGEST_BYTES)


def digest(*parts: object) -> str:
    """Digest of plain values, paths, arrays, dataclasses, and sequences and mappings of these.

    Returns
    -------
    str
        32 hexadecimal digits; different for any difference in type, shape or value.
    """
    state = new_digest()
    _feed(state, parts)
    return state.hexdigest()


def stamp_of(status: os.stat_result) -> tuple[int, ...]:
    """What changes whenever a file's content may have: also the time of the last change of its size or times.

    Not the number of its disk, which each machine that shares it gives it.
    """
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


def _feed(state: "hashlib.blake2b", value: object) -> None:
    kind = type(value)
    if kind in _PLAIN:  # most are: the rest asks many questions
        text = f"{kind.__name__} {value!r}".encode()
        state.update(b"%d %b" % (len(text), text))
        return
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
        with open_regular(path) as file:
            return hashlib.file_digest(file, new_digest).hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); check the file.") from error
