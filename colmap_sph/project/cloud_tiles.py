"""A cloud that is too large for one file: tiles, each of the points of neighbouring images, and an index of them.

::

    fused_tiles/index.json       number of points, and of each tile its file, number, box, and digests
    fused_tiles/0000.ply         as fused.ply, and 0000.ply.vis beside it where that is wanted
"""

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.platforms.files import move_into_place
from colmap_sph.project.cloud_files import ply_header, remove_local_workspace
from colmap_sph.project.files import atomic_file, make_dir, remove, set_aside, whole_digest
from colmap_sph.project.map_coordinates import move_cloud
from colmap_sph.project.state.records import altered_files, begin, read_json, read_record
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import POINT

logger = logging.getLogger(__name__)

INDEX = "index.json"
_MAX_BYTES = 1 << 28
_POINTS_AT_A_TIME = 1 << 20
_WORDS_AT_A_TIME = 1 << 22

Place = tuple[float, float, float]


class Tile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file of a tiled cloud.

    Attributes
    ----------
    file : str
        Its name, beside the index.
    points : int
    box : pair of (float, float, float), or None
        Least and largest coordinates; None of a tile without points.
    digests : dict of str to str
        File name → digest of every byte, of the tile and of its visibility, if it has one.
    """

    file: Annotated[str, Meta(pattern=r"^\d{4,9}\.ply$")]
    points: Annotated[int, Meta(ge=0)]
    box: tuple[Place, Place] | None
    digests: dict[Annotated[str, Meta(pattern=r"^\d{4,9}\.ply(\.vis)?$")], str]


class TileIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What there is of a tiled cloud: all its points, and its tiles in their order."""

    format: Literal["colmap_sph tiles 1"]
    points: Annotated[int, Meta(ge=0)]
    tiles: tuple[Tile, ...]


def read_index(folder: Path) -> TileIndex | None:
    """Read the index of a tiled cloud; None where there is none that can be read."""
    return read_json(folder / INDEX, TileIndex, max_bytes=_MAX_BYTES)


def index_of(workspace: Workspace) -> TileIndex | None:
    """The index of a workspace's cloud where that is in tiles, and not in one file."""
    return None if workspace.fused_path.exists() else read_index(workspace.tiles_dir)


@dataclass(frozen=True)
class Part:
    """A part of a cloud as `write_part` left it: its path less suffixes, and its number of points."""

    stem: Path
    points: int


def write_tiles(
    parts: Sequence[Part],
    folder: Path,
    most: int,
    origin: NDArray[np.float64],
    *,
    with_visibility: bool,
) -> TileIndex:
    """Join parts of a cloud to tiles, and remove them one by one: the disk never holds more than one part twice.

    Parameters
    ----------
    parts : sequence of Part
        In the order in which they are joined; neighbours should lie beside each other.
    folder : Path
        Where tiles and index go; is created.
    most : int
        Points of a tile at most, but that a part is never divided.
    origin : (3,) float64 ndarray
        Added to the points, which are 64-bit floats then; zero: they stay as they are.
    with_visibility : bool
        Whether each tile gets its ``.vis``.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    make_dir(folder)
    tiles = [
        _write_tile(some, folder / f"{number:04d}.ply", origin, with_visibility=with_visibility)
        for number, some in enumerate(_divided(parts, most))
    ]
    index = TileIndex("colmap_sph tiles 1", sum(part.points for part in parts), tuple(tiles))
    with atomic_file(folder / INDEX) as file:
        file.write(msgspec.json.format(msgspec.json.encode(index), indent=1))
    return index


def _divided(parts: Sequence[Part], most: int) -> Iterator[list[Part]]:
    some: list[Part] = []
    for part in parts:
        if some and sum(each.points for each in some) + part.points > most:
            yield some
            some = []
        some.append(part)
    if some:
        yield some


def _write_tile(parts: Sequence[Part], path: Path, origin: NDArray[np.float64], *, with_visibility: bool) -> Tile:
    count = sum(part.points for part in parts)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    near = path.with_suffix(".near") if origin.any() else path
    with atomic_file(near) as file:
        file.write(ply_header(count))
        for part in parts:
            points = part.stem.with_suffix(".points")
            for block in _blocks(points, POINT, _POINTS_AT_A_TIME):
                low = np.minimum(low, block["xyz"].min(axis=0))
                high = np.maximum(high, block["xyz"].max(axis=0))
                file.write(block.tobytes())
            points.unlink()
    if origin.any():
        move_cloud(near, path, origin)
        near.unlink()
    files = [path]
    visibility = path.with_name(f"{path.name}.vis")
    if with_visibility:
        files.append(visibility)
        with atomic_file(visibility) as file:
            file.write(np.array(count, "<u8").tobytes())
            for part in parts:
                for words in _blocks(part.stem.with_suffix(".vis"), np.dtype("<u4"), _WORDS_AT_A_TIME):
                    file.write(words.tobytes())
    for part in parts:
        part.stem.with_suffix(".vis").unlink(missing_ok=True)
    box = (_place(low + origin), _place(high + origin)) if count else None
    return Tile(path.name, count, box, {each.name: whole_digest(each) for each in files})


def _place(values: NDArray[np.float64]) -> Place:
    x, y, z = values.tolist()
    return x, y, z


def _blocks(path: Path, kind: np.dtype[Any], size: int) -> Iterator[NDArray[Any]]:
    with path.open("rb") as file:
        while len(block := np.fromfile(file, kind, size)):
            yield block


def missing_tiles(folder: Path, index: TileIndex) -> list[Path]:
    """Files of an index that are not there."""
    paths = (folder / name for tile in index.tiles for name in tile.digests)
    return [path for path in paths if not path.is_file()]


def damaged_tiles(folder: Path, index: TileIndex) -> list[Path]:
    """Look at every byte of the files of an index; return those that are there, and not as they were written."""
    digests = {folder / name: digest for tile in index.tiles for name, digest in tile.digests.items()}
    return [path for path, digest in digests.items() if path.exists() and not _is(path, digest)]


def publish_tiles(made: Path, workspace: Workspace) -> None:
    """Put a folder of tiles into its place, for good once the record of its index says so.

    What was there before goes, see `retire_tiles`, and so does a cloud of ours in one file.
    """
    retire_tiles(workspace)
    _retire_single(workspace)
    begin(workspace.tiles_record_path, [workspace.tiles_dir / INDEX])
    move_into_place(made, workspace.tiles_dir)


def retire_tiles(workspace: Workspace) -> None:
    """Remove a cloud in tiles that is as this program left it; what is not ours there gets another name."""
    folder = workspace.tiles_dir
    record = workspace.tiles_record_path
    known = read_record(record)
    index = read_index(folder)
    if known is not None and index is not None and not altered_files(known, [folder / INDEX]):
        altered = set(damaged_tiles(folder, index))
        for name in (name for tile in index.tiles for name in tile.digests):
            if folder / name not in altered:
                remove(folder / name)
        remove(folder / INDEX)
    with suppress(OSError):  # not there, or with files of others
        folder.rmdir()
    if os.path.lexists(folder):
        backup = set_aside(folder)
        logger.warning("%s has files that this program did not write there; it is now %s", folder, backup.name)
    remove(record)


def _retire_single(workspace: Workspace) -> None:
    """The same for a cloud in one file, with all that goes with it."""
    known = read_record(workspace.cloud_record_path)
    local = Workspace(workspace.local_dir)
    files = (*workspace.cloud_paths, local.fused_path)
    altered = altered_files(known, files, every_byte=True)
    for path in files:
        if path in altered:
            logger.warning("%s is not what this program wrote there; it is now %s", path, set_aside(path).name)
        else:
            remove(path)
    remove_local_workspace(workspace)
    remove(workspace.cloud_record_path)


def _is(path: Path, digest: str) -> bool:
    try:
        return whole_digest(path) == digest
    except InputError:
        return False
