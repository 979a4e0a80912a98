"""A workspace's fused cloud → its points piece by piece, in 64-bit floats, with the images that see them."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, NoResultError, reason_of, shell_word
from colmap_sph.project.cloud_reader import PlyLayout, read_layout
from colmap_sph.project.cloud_tiles import index_of
from colmap_sph.project.files import open_regular
from colmap_sph.project.map_coordinates import is_plausible
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)

POINTS_AT_A_TIME = 1 << 18
UNKNOWN = -1.0
"""Deviation of a point that fewer than two maps show."""
_COLOURS = ("red", "green", "blue")
_NORMALS = ("nx", "ny", "nz")
_WORDS_AT_A_TIME = 1 << 20
# More see no point.
_MOST_IMAGES = 1 << 20


@dataclass(frozen=True, eq=False)
class CloudPiece:
    """Some points of a cloud, one after the other.

    Attributes
    ----------
    xyz : (n, 3) float64 ndarray
        The model's coordinates.
    normals : (n, 3) float32 ndarray or None
        Unit vectors; None where the cloud has none.
    rgb : (n, 3) uint8 ndarray or None
    counts : (n,) uint32 ndarray or None
        Number of images that see each point; None where that is not known.
    images : (sum of counts,) uint32 ndarray or None
        Places of these in the list of the model's registered images, those of one point after the other.
    deviation : (n,) float32 ndarray or None
        Standard deviation of what the images' maps say of the surface, model units; `UNKNOWN` where they do not.
    """

    xyz: NDArray[np.float64]
    normals: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None
    counts: NDArray[np.uint32] | None
    images: NDArray[np.uint32] | None
    deviation: NDArray[np.float32] | None = None

    def only(self, kept: NDArray[np.bool_]) -> "CloudPiece":
        """The points of a mask."""
        if kept.all():
            return self
        seen = None if self.counts is None else np.repeat(kept, self.counts)
        return CloudPiece(
            self.xyz[kept],
            None if self.normals is None else self.normals[kept],
            None if self.rgb is None else self.rgb[kept],
            None if self.counts is None else self.counts[kept],
            None if self.images is None or seen is None else self.images[seen],
        )


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud in one or more files; may be larger than memory.

    Attributes
    ----------
    paths : tuple of Path
        PLY files of the same layout.
    count : int
        Points of all files.
    kind : numpy dtype
        Of a point in them.
    has_images : bool
        Whether it is known which images see each point.
    measure : callable or None
        Finds the deviation of a piece's points.
    """

    paths: tuple[Path, ...]
    count: int
    kind: np.dtype[np.void]
    has_images: bool
    measure: Callable[[CloudPiece], NDArray[np.float32]] | None = None

    @property
    def has_normals(self) -> bool:
        """Whether points have normals."""
        return set(_NORMALS) <= set(self.kind.names or ())

    @property
    def has_colours(self) -> bool:
        """Whether points have colours of 8 bits."""
        names = self.kind.names or ()
        return all(name in names and self.kind[name] == np.uint8 for name in _COLOURS)

    def pieces(self) -> Iterator[CloudPiece]:
        """All points that are finite and not absurdly far, in the order of the files.

        Raises
        ------
        InputError
            A file cannot be read, or has changed.
        """
        for path in self.paths:
            try:
                yield from self._pieces_of(path)
            except OSError as error:
                raise InputError(f"The cloud {path} cannot be read ({reason_of(error)}); fuse again.") from error

    def measured_pieces(self) -> Iterator[CloudPiece]:
        """The same, with their deviation where it can be measured."""
        for piece in self.pieces():
            yield piece if self.measure is None else replace(piece, deviation=self.measure(piece))

    def _pieces_of(self, path: Path) -> Iterator[CloudPiece]:
        with ExitStack() as opened:
            file = opened.enter_context(open_regular(path))
            layout = read_layout(path, file)
            if layout.kind != self.kind:
                raise InputError(f"{path} has other properties than the files beside it; fuse again.")
            visibility = None
            if self.has_images:
                visibility = _Visibility(opened.enter_context(open_regular(_visibility_path(path))), path)
            file.seek(layout.begin)
            for first in range(0, layout.count, POINTS_AT_A_TIME):
                number = min(POINTS_AT_A_TIME, layout.count - first)
                data = file.read(number * self.kind.itemsize)
                if len(data) < number * self.kind.itemsize:
                    raise InputError(f"{path} is cut off; fuse again.")
                seen = (None, None) if visibility is None else visibility.take(number)
                piece = self._piece(np.frombuffer(data, self.kind), *seen)
                yield piece.only(is_plausible(piece.xyz))
            if visibility is not None:
                visibility.check_end()

    def _piece(
        self, points: NDArray[np.void], counts: NDArray[np.uint32] | None, images: NDArray[np.uint32] | None
    ) -> CloudPiece:
        return CloudPiece(
            np.column_stack([points[name].astype(np.float64) for name in "xyz"]),
            np.column_stack([points[name].astype(np.float32) for name in _NORMALS]) if self.has_normals else None,
            np.column_stack([points[name] for name in _COLOURS]) if self.has_colours else None,
            counts,
            images,
        )


def open_cloud(workspace: Workspace) -> Cloud:
    """Find the fused cloud of a workspace, in one file or in tiles.

    Raises
    ------
    InputError
        There is none, or it cannot be read.
    NoResultError
        It has no points.
    """
    index = index_of(workspace)
    if index is not None:
        paths = tuple(workspace.tiles_dir / tile.file for tile in index.tiles if tile.points)
    elif workspace.fused_path.exists():
        paths = (workspace.fused_path,)
    else:
        raise InputError(
            f"{workspace.root} has no fused cloud; run `colmap_sph run --workspace {shell_word(workspace.root)}` "
            "first."
        )
    layouts = [_layout(path) for path in paths]
    count = sum(layout.count for layout in layouts)
    if not count:
        raise NoResultError(f"The cloud in {workspace.root} has no points; there is nothing to hand over.")
    cloud = Cloud(paths, count, layouts[0].kind, _have_visibility(paths, layouts))
    if not cloud.has_colours:
        logger.warning(
            "%s has no colours as this program reads them (red, green and blue of type uchar); none are taken",
            paths[0],
        )
    return cloud


def _layout(path: Path) -> PlyLayout:
    try:
        with open_regular(path) as file:
            return read_layout(path, file)
    except OSError as error:
        raise InputError(f"The cloud {path} cannot be read ({reason_of(error)}); fuse again.") from error


def _visibility_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.vis")


def _have_visibility(paths: Sequence[Path], layouts: Sequence[PlyLayout]) -> bool:
    """Whether all files have the visibility of as many points beside them."""
    for path, layout in zip(paths, layouts, strict=True):
        try:
            with open_regular(_visibility_path(path)) as file:
                count = int.from_bytes(file.read(8), "little")
        except OSError:
            return False
        if count != layout.count:
            logger.warning(
                "%s is not of this cloud; which images see a point is not known", _visibility_path(path)
            )
            return False
    return True


class _Visibility:
    """COLMAP's ``.vis``, read along with the points: of each the number of images, and these."""

    def __init__(self, file: BufferedReader, path: Path) -> None:
        self._file = file
        self._path = path
        self._words = np.empty(0, np.uint32)
        file.seek(8)

    def take(self, number: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """Counts of the next points, and their images."""
        starts = np.empty(number, np.int64)
        position = 0
        words = self._words.data
        for index in range(number):
            while position >= len(words) or position + words[position] >= len(words):
                if position < len(words) and words[position] > _MOST_IMAGES:
                    raise self._told("damaged")
                self._read_on()
                words = self._words.data
            starts[index] = position
            position += 1 + words[position]
        taken = self._words[:position]
        self._words = self._words[position:]
        return taken[starts], np.delete(taken, starts)

    def _read_on(self) -> None:
        more = self._file.read(4 * _WORDS_AT_A_TIME)
        if not more or len(more) % 4:
            raise self._told("cut off")
        self._words = np.concatenate([self._words, np.frombuffer(more, "<u4")])

    def check_end(self) -> None:
        """Raise `InputError` where there is more than of all points: then some counts are wrong."""
        if len(self._words) or self._file.read(1):
            raise self._told("damaged")

    def _told(self, what: str) -> InputError:
        return InputError(f"{_visibility_path(self._path)} is {what}; fuse again, or remove that file.")
