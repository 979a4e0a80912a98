"""The partners of all images as they were chosen, kept for the next run with the same scene and options."""

from math import isnan, nan
from pathlib import Path
from typing import Any

import msgspec
import xxhash

from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.state.records import read_json
from colmap_sph.project.state.typed import from_json
from colmap_sph.stereo.partners.pairs import PairSelection, PairSource, Partner

_MAX_BYTES = 1 << 31


class _SelectionFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A selection on disk: what it was chosen from, a digest of that and of the rest, and its content."""

    key: str
    check: str
    content: msgspec.Raw


class _Selection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    source: PairSource
    partners: dict[str, list[tuple[str, int, float | None]]]


def read_selection(path: Path, key: str) -> PairSelection | None:
    """Read what `write_selection` wrote under this key; None where the file holds anything else."""
    file = read_json(path, _SelectionFile, max_bytes=_MAX_BYTES)
    if file is None or file.key != key or file.check != _check(key, file.content):
        return None
    try:
        found = from_json(file.content, _Selection)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    partners = {
        name: tuple(Partner(other, shared, nan if angle is None else angle) for other, shared, angle in others)
        for name, others in found.partners.items()
    }
    return PairSelection(partners, found.source)


def write_selection(path: Path, key: str, selection: PairSelection) -> None:
    """Keep a selection; `OutputError` where that fails."""
    partners: dict[str, Any] = {
        name: [(each.name, each.shared_points, None if isnan(each.angle) else each.angle) for each in others]
        for name, others in selection.partners.items()
    }
    content = msgspec.Raw(msgspec.json.encode(_Selection(selection.source, partners)))
    make_dir(path.parent)
    with atomic_file(path, sync=False) as file:  # it can be chosen again
        file.write(msgspec.json.encode(_SelectionFile(key, _check(key, content), content)))


def _check(key: str, content: msgspec.Raw) -> str:
    return xxhash.xxh3_128_hexdigest(key.encode() + bytes(content))
