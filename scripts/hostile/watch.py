"""A folder and all in it, before and after: what a run has made, changed and removed."""

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

# Larger files are known by their size and time stamp.
_DIGESTED = 64 << 20

Snapshot = dict[Path, tuple[object, ...]]


@dataclass(frozen=True)
class Change:
    """A path that is not as before: "made", "changed" or "removed"."""

    path: Path
    what: str

    def __str__(self) -> str:
        return f"{self.path} was {self.what}"


def snapshot(folder: Path) -> Snapshot:
    """Kind, rights, size, time and content of all below a folder; links are not followed."""
    return {path: _state(path) for path in _below(folder)}


def changes(before: Snapshot, after: Snapshot) -> list[Change]:
    """What differs between two snapshots."""
    found = [Change(path, "removed") for path in before.keys() - after.keys()]
    found += [Change(path, "made") for path in after.keys() - before.keys()]
    found += [Change(path, "changed") for path in before.keys() & after.keys() if before[path] != after[path]]
    return sorted(found, key=lambda change: change.path)


def outside(found: Iterable[Change], workspace: Path | None, protected: Iterable[Path]) -> list[Change]:
    """The changes that nobody has allowed: beside the workspace, and of protected files in it."""
    kept = set(protected)
    wrong = []
    for change in found:
        inside = workspace is not None and (change.path == workspace or workspace in change.path.parents)
        # The folders that lead to a new workspace come into being with it.
        leads_there = workspace is not None and change.path in workspace.parents and change.what == "made"
        if change.path in kept or not (inside or leads_there):
            wrong.append(change)
    return wrong


def content_of(entry: tuple[object, ...]) -> object:
    """What a path of a snapshot holds, whatever its time stamp."""
    return entry[-1]


def _below(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            yield Path(root, name)


def _state(path: Path) -> tuple[object, ...]:
    found = path.lstat()
    kind = stat.S_IFMT(found.st_mode)
    rights = stat.S_IMODE(found.st_mode)
    if stat.S_ISDIR(found.st_mode):
        return kind, rights
    if stat.S_ISLNK(found.st_mode):
        return kind, str(path.readlink())
    if not stat.S_ISREG(found.st_mode):
        return kind, found.st_rdev
    if found.st_size > _DIGESTED:
        return kind, rights, found.st_mtime_ns, found.st_size
    return kind, rights, found.st_mtime_ns, hashlib.blake2b(path.read_bytes()).hexdigest()
