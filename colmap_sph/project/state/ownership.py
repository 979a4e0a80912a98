"""Which files of a workspace are ours, and what becomes of others in their places: nobody loses anything.

A file is ours where a record says so. Arrays in files of our own are ours by their first bytes.
"""

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from colmap_sph.errors import InputError, counted
from colmap_sph.platforms.files import is_link
from colmap_sph.platforms.locks import remove_lock
from colmap_sph.project.cloud_files import remove_local_workspace
from colmap_sph.project.cloud_tiles import INDEX, damaged_tiles, read_index, retire_tiles
from colmap_sph.project.files import remove, set_aside, whole_digest
from colmap_sph.project.state.array_file import OLD_SUFFIX, SUFFIX, is_array_file, is_whole
from colmap_sph.project.state.records import (
    altered_files,
    invalidate,
    read_record,
)
from colmap_sph.project.workspace import MapKind, Workspace, checked_name

logger = logging.getLogger(__name__)

_NAMED_FILES = 3
_UNDISTORTED = ".undistorted.json"
_RANGE = ".range.json"


@dataclass(frozen=True)
class Place:
    """Files that are made together, and the record that says whose they are."""

    record: Path
    files: tuple[Path, ...]

    @property
    def foreign(self) -> list[Path]:
        """Files that are there, though no record knows of them."""
        return [] if os.path.lexists(self.record) else altered_files(None, self.files)


def map_place(workspace: Workspace, name: str, kind: MapKind) -> Place:
    """The depth and the normal map of an image."""
    files = (workspace.depth_map_path(name, kind), workspace.normal_map_path(name, kind))
    return Place(workspace.records_dir / f"{name}.{kind}.json", files)


def estimate_path(workspace: Workspace, name: str) -> Path:
    """Where the photometric depth of an image is, with its standard deviation and support."""
    return workspace.photometric_dir / f"{name}{SUFFIX}"


def range_place(workspace: Workspace, original: str) -> Place:
    """The range map of a wide image."""
    return Place(workspace.records_dir / f"{original}{_RANGE}", (workspace.range_map_path(original),))


def cloud_place(workspace: Workspace, *, local: bool) -> Place:
    """The cloud and its visibility, and for a model in map coordinates (`local`) the cloud near its origin."""
    near = (Workspace(workspace.local_dir).fused_path,) if local else ()
    return Place(workspace.cloud_record_path, (*workspace.cloud_paths, *near))


def tiles_place(workspace: Workspace) -> Place:
    """The index of a cloud in tiles, which vouches for these."""
    return Place(workspace.tiles_record_path, (workspace.tiles_dir / INDEX,))


def fusion_cfg_place(workspace: Workspace) -> Place:
    """The list of images that were fused."""
    return Place(workspace.fusion_cfg_record_path, (workspace.fusion_cfg_path,))


def undistorted_place(workspace: Workspace, name: str) -> Place:
    """An undistorted image, and its mask where it has one."""
    files = (workspace.image_path(name), workspace.made_mask_path(name))
    return Place(workspace.records_dir / f"{name}{_UNDISTORTED}", files)


def undistorted_places(workspace: Workspace) -> Iterator[Place]:
    """All undistorted images that have a record."""
    for name in _recorded_names(workspace, _UNDISTORTED):
        yield undistorted_place(workspace, name)


def _recorded_names(workspace: Workspace, ending: str) -> Iterator[str]:
    for path in sorted(workspace.records_dir.rglob(f"*{ending}")):
        name = path.relative_to(workspace.records_dir).as_posix().removesuffix(ending)
        with suppress(InputError):  # no name of an image
            yield checked_name(name)


def recorded_places(workspace: Workspace) -> Iterator[Place]:
    """All places of a workspace that have a record."""
    for kind in get_args(MapKind):
        for name in _recorded_names(workspace, f".{kind}.json"):
            yield map_place(workspace, name, kind)
    for name in _recorded_names(workspace, _RANGE):
        yield range_place(workspace, name)
    cloud = read_record(workspace.cloud_record_path)
    if cloud is not None:
        yield cloud_place(workspace, local=len(cloud.stamps) != len(workspace.cloud_paths))
    if read_record(workspace.tiles_record_path) is not None:
        yield tiles_place(workspace)
    if read_record(workspace.fusion_cfg_record_path) is not None:
        yield fusion_cfg_place(workspace)


def array_files(workspace: Workspace, suffix: str = SUFFIX) -> list[Path]:
    """Disparity maps and photometric estimates of ours; with `OLD_SUFFIX` those of earlier versions."""
    folders = (workspace.pairs_dir, workspace.photometric_dir)
    return sorted(path for folder in folders for path in folder.rglob(f"*{suffix}") if is_array_file(path))


def foreign_files(places: Sequence[Place], *, overwrite: bool) -> list[Path]:
    """Find files of others in places that a run will write to.

    Parameters
    ----------
    places : sequence of Place
    overwrite : bool
        Whether such files may be set aside.

    Returns
    -------
    list of Path

    Raises
    ------
    InputError
        There are some, and they may not.
    """
    foreign = [path for place in places for path in place.foreign]
    if foreign and not overwrite:
        raise InputError(
            f"{foreign[0]}{_and_more(foreign, 1)} {_were(foreign)} not made by this program, which would write "
            "there; move that away, or give `run` --overwrite, which keeps it under another name (.backup)."
        )
    return foreign


def take_places(places: Sequence[Place], *, overwrite: bool) -> None:
    """Make room in places before anything is written there: what others made gets another name.

    What is there later is ours from the moment that a record says so (see `records.begin`), and no sooner: after
    a run that was ended, another program may have put its own there.

    Parameters
    ----------
    places, overwrite
        As for `foreign_files`, which this raises as.
    """
    foreign = foreign_files(places, overwrite=overwrite)
    backups = [set_aside(path) for path in foreign]
    if foreign:
        logger.warning(
            "%s %s not made by this program; renamed to %s",
            named(foreign),
            _were(foreign),
            ", ".join(path.name for path in backups[:_NAMED_FILES]) + _and_more(backups, _NAMED_FILES),
        )


def named(paths: Sequence[Path]) -> str:
    """A few of the files, and how many more there are."""
    return ", ".join(map(str, paths[:_NAMED_FILES])) + _and_more(paths, _NAMED_FILES)


def _and_more(paths: Sequence[Path], shown: int) -> str:
    return f" and {counted(len(paths) - shown, 'more file')}" if len(paths) > shown else ""


def _were(paths: Sequence[Path]) -> str:
    return "was" if len(paths) == 1 else "were"


def discard_results(workspace: Workspace) -> None:
    """Make a run in a workspace forget what earlier ones computed there; maps and cloud stay until replaced.

    Raises
    ------
    OutputError
        A record cannot be written, or a file cannot be removed.
    """
    # The records first: nothing may vouch for what is no longer whole.
    for place in recorded_places(workspace):
        invalidate(place.record)
    remove_array_files(workspace, SUFFIX, OLD_SUFFIX)


def remove_array_files(workspace: Workspace, *suffixes: str) -> None:
    """Remove disparity maps and photometric estimates of ours, by the endings of their names; other files stay."""
    for suffix in suffixes:
        for path in array_files(workspace, suffix):
            remove(path)


def remove_flat_pairs(workspace: Workspace) -> None:
    """Remove disparity maps of an earlier version, which had all of them in one folder."""
    for path in sorted(workspace.pairs_dir.glob(f"*{SUFFIX}")):
        if is_array_file(path):
            remove(path)


def remove_recorded(workspace: Workspace) -> list[Path]:
    """Remove maps, cloud and intermediate results of ours, and their records.

    Returns
    -------
    list of Path
        Files that stay, as they are not as this program left them.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    retire_tiles(workspace)
    altered = _remove(recorded_places(workspace))
    remove_array_files(workspace, SUFFIX, OLD_SUFFIX)
    remove_local_workspace(workspace)
    for path in workspace.known_paths:
        remove(path)
    folders = (workspace.records_dir, workspace.pairs_dir, workspace.photometric_dir, workspace.known_dir)
    remove_lock(workspace.known_dir)
    remove_empty_folders(*folders)
    return altered


def remove_undistorted(workspace: Workspace) -> None:
    """Remove undistorted images and masks of ours, and their records; `OutputError` where that is impossible."""
    _remove(undistorted_places(workspace))


def remove_image(workspace: Workspace, name: str) -> None:
    """Remove an undistorted image, its mask, maps and estimate of ours; `OutputError` where that is impossible."""
    _remove(
        [undistorted_place(workspace, name), *(map_place(workspace, name, kind) for kind in get_args(MapKind))]
    )
    estimate = estimate_path(workspace, name)
    if is_array_file(estimate):
        remove(estimate)


def _remove(places: Iterable[Place]) -> list[Path]:
    """Remove files that are as we left them; return the others."""
    return [path for place in places for path in remove_place(place)]


def remove_place(place: Place) -> list[Path]:
    """Remove files of a place that are as we left them, and their record; return the others."""
    others = altered_files(read_record(place.record), place.files, every_byte=True)
    for path in place.files:
        if path not in others and (path.is_file() or is_link(path)):
            remove(path)
    # Last, as only it says whose they are; it stays where some of them do.
    if not others:
        remove(place.record)
    return others


def remove_empty_folders(*roots: Path) -> None:
    """Remove folders, and those inside of them, where there is no file in them."""
    for root in roots:
        folders = [path for path in root.rglob("*") if path.is_dir() and not is_link(path)]
        for folder in [*sorted(folders, reverse=True), root]:
            with suppress(OSError):  # not empty, or not there
                folder.rmdir()


def results_of(workspace: Workspace) -> Iterator[Place | Path]:
    """All results of ours in a workspace: places with a record, and arrays in files of our own."""
    yield from recorded_places(workspace)
    yield from array_files(workspace)


def damaged_files(result: Place | Path) -> list[Path]:
    """Look at every byte of a result; what is damaged will be made again by the stage that makes it.

    Returns
    -------
    list of Path
        Files that are damaged.

    Raises
    ------
    OutputError
        A file that is damaged cannot be removed, or its record not be written.
    """
    if isinstance(result, Path):
        if is_whole(result):
            return []
        remove(result)
        return [result]
    known = read_record(result.record)
    if known is None or known.state != "done":
        return []
    # What is missing is made again without more ado.
    there = [(path, digest) for path, digest in zip(result.files, known.digests, strict=False) if path.exists()]
    damaged = [path for path, digest in there if not _has_digest(path, digest)]
    for path in result.files:
        index = read_index(path.parent) if path.name == INDEX and not damaged else None
        if index is not None:
            damaged += damaged_tiles(path.parent, index)
    if damaged:
        invalidate(result.record, "doubtful")
    return damaged


def _has_digest(path: Path, digest: str) -> bool:
    with suppress(InputError):  # the disk cannot read it
        return whole_digest(path) == digest
    return False
