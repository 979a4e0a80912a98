"""What was found out for one key → a JSON file that counts for that key alone, and can be found out again."""

from pathlib import Path
from typing import Any, TypeVar

import msgspec
import xxhash

from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.state.records import read_json
from colmap_sph.project.state.typed import from_json

T = TypeVar("T")

_MAX_BYTES = 1 << 31


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The key, a digest of it and of the content, and the content."""

    key: str
    check: str
    content: msgspec.Raw


def read_kept(path: Path, key: str, kind: type[T]) -> T | None:
    """Read what `write_kept` wrote under this key, of type `kind`; None where the file holds anything else."""
    file = read_json(path, _File, max_bytes=_MAX_BYTES)
    if file is None or file.key != key or file.check != _check(key, file.content):
        return None
    try:
        return from_json(file.content, kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


def write_kept(path: Path, key: str, content: Any, *, sync: bool = False) -> None:
    """Keep what was found out under a key; `OutputError` where that fails. Synced where a loss would matter."""
    raw = msgspec.Raw(msgspec.json.encode(content))
    make_dir(path.parent)
    with atomic_file(path, sync=sync) as file:
        file.write(msgspec.json.encode(_File(key, _check(key, raw), raw)))


def _check(key: str, content: msgspec.Raw) -> str:
    return xxhash.xxh3_128_hexdigest(key.encode() + bytes(content))
