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
from colmap_sph.pipeline.known.kept import read_kept, write_kept
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.project.files import folder_locked, make_dir


class KnownResult(msgspec.Struct, frozen=True, array_like=True):
    """Of a result that was up to date: its key, the stamp of its files, and its facts."""

    key: str
    stamp: str
    facts: Facts


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
    def _known(self) -> dict[str, KnownResult]:
        return read_kept(self._path, self._key, dict[str, KnownResult]) or {}

    def find(self, item: str, files: Iterable[str]) -> KnownResult | None:
        """What is known of an item, whose files are as they were then; None where that is nothing."""
        known = self._known.get(item)
        return known if known is not None and known.stamp == stamp_of_files(files) else None

    def add(self, results: Mapping[str, KnownResult]) -> None:
        """Keep what is known of more items, or anew; those without a stamp are left out."""
        kept = {item: known for item, known in results.items() if known.stamp}
        if all(self._known.get(item) == known for item, known in kept.items()):
            return
        make_dir(self._path.parent)
        with folder_locked(self._path.parent):
            # Jobs that share the workspace add theirs. What is lost where there are no locks is found out again.
            there = ResultTable(self._path, self._key)._known
            write_kept(self._path, self._key, there | kept)


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
