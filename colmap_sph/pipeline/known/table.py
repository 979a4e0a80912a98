"""Results that were found up to date, kept in one file for each stage: the next run asks the file system alone.

To find out under which key a result would be made today takes milliseconds for each, and to look into its files as
many; with a hundred thousand of them that is an hour before a run knows that there is nothing to do. So a stage
writes down what it found: for each item its key, its facts, and a stamp of its files, as git keeps an index of a
working tree. All of it counts only for the very same input to the stage, which is digested as a whole.
"""

import os
import stat
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path

import msgspec
import xxhash

from colmap_sph.pipeline.digests import stamp_of
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.project.files import atomic_file, folder_locked, make_dir
from colmap_sph.project.state.records import read_json
from colmap_sph.project.state.typed import from_json

_MAX_BYTES = 1 << 31


class Known(msgspec.Struct, frozen=True, array_like=True):
    """Of a result that was up to date: its key, the stamp of its files, and its facts."""

    key: str
    stamp: str
    facts: Facts


class _TableFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table on disk: the key of the stage's input, a digest of it and of the rest, and `Known` by item."""

    key: str
    check: str
    results: msgspec.Raw


class ResultTable:
    """What is known of the results of a stage; may be read by several threads.

    Parameters
    ----------
    path : Path
        File of the table; need not exist.
    key : str
        Digest of all that goes into the stage. What was written down under another one does not count.
    """

    def __init__(self, path: Path, key: str) -> None:
        self._path = path
        self._key = key

    @cached_property
    def _known(self) -> dict[str, Known]:
        file = read_json(self._path, _TableFile, max_bytes=_MAX_BYTES)
        if file is None or file.key != self._key or file.check != _check(file.key, file.results):
            return {}
        try:
            return from_json(file.results, dict[str, Known])
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return {}

    def find(self, item: str, files: Iterable[str]) -> Known | None:
        """What is known of an item, whose files are as they were then; None where that is nothing."""
        known = self._known.get(item)
        return known if known is not None and known.stamp == stamp_of_files(files) else None

    def add(self, results: Mapping[str, Known]) -> None:
        """Keep what is known of more items, or anew; those without a stamp are left out."""
        kept = {item: known for item, known in results.items() if known.stamp}
        if all(self._known.get(item) == known for item, known in kept.items()):
            return
        make_dir(self._path.parent)
        with folder_locked(self._path.parent):
            # Jobs that share the workspace add theirs. What is lost where there are no locks is found out again.
            there = ResultTable(self._path, self._key)._known
            content = msgspec.Raw(msgspec.json.encode(there | kept))
            with atomic_file(self._path, sync=False) as file:  # it can be found out again
                file.write(msgspec.json.encode(_TableFile(self._key, _check(self._key, content), content)))


def stamp_of_files(paths: Iterable[str]) -> str:
    """What changes whenever the content of one of some files may have; empty where one is no regular file.

    That is their sizes, their places on the disk, and the times of the last changes of content, and of size or
    times. Not the number of the disk, which each machine that shares it gives it.
    """
    words: list[int] = []
    for path in paths:
        try:
            status = os.stat(path)  # noqa: PTH116 - of very many
        except OSError:
            return ""
        if not stat.S_ISREG(status.st_mode):
            return ""
        words += stamp_of(status)
    return xxhash.xxh3_64_hexdigest(repr(words).encode())


def _check(key: str, content: msgspec.Raw) -> str:
    return xxhash.xxh3_128_hexdigest(key.encode() + bytes(content))
