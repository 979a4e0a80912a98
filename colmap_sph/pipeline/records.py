"""What was made from what: content digests, and records that vouch for finished files.

A *key* is a digest of everything a result depends on: the program, options, cameras, and the keys or contents of
what it was made from. A result with the key that it would get today is not made again. Time stamps play no part.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.pipeline.digests import digest, new_digest
from colmap_sph.project.files import atomic_file, make_dir, open_regular

_STAMP_BLOCKS = 16
_BLOCK_BYTES = 4096


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

    Parameters
    ----------
    record, key, files
        As for `vouch`.

    Returns
    -------
    dict or None
    """
    try:
        with open_regular(record) as file:
            content = json.loads(file.read())
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
        raise OutputError(f"{record} cannot be removed ({reason_of(error)}); check permissions.") from error


def _stamp(path: Path) -> str:
    """Size, and digest of evenly spread blocks: reading all of the maps again would take minutes."""
    state = new_digest()
    try:
        with open_regular(path) as file:
            size = path.stat().st_size
            last = max(0, size - _BLOCK_BYTES)
            for index in range(_STAMP_BLOCKS):
                file.seek(last * index // (_STAMP_BLOCKS - 1))
                state.update(file.read(_BLOCK_BYTES))
    except OSError as error:
        raise OutputError(f"{path} cannot be read back ({reason_of(error)}); run again.") from error
    return f"{size} {state.hexdigest()}"
