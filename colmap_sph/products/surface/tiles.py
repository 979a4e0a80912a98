"""A raster and a memory budget → tiles, and the views with something in each."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import OptionError
from colmap_sph.products.surface.seen import Box, SeenView
from colmap_sph.stereo.surface.raster import Raster

# Fine cells along a tile's side, the more the fewer views are read again.
_SIDES = (2048, 1536, 1024, 768, 512, 256)
# Bytes: of a fine cell for each view that sees it, and besides; of a pixel of a view while its maps and image are
# read; of the program itself.
_CELL_VIEW = 4.5
_CELL = 170.0
_PIXEL = 48.0
_PROGRAM = 350e6


@dataclass(frozen=True)
class Tile:
    """A part of a raster, without its margin."""

    row: int
    column: int
    height: int
    width: int


class Sightings:
    """Where each view sees something of a raster, by its samples."""

    def __init__(self, seen: Sequence[SeenView], raster: Raster) -> None:
        self._seen = seen
        self._cells = []
        self._reach = []
        for each in seen:
            cells = raster.to_cells(each.points.astype(np.float64))[:, :2].astype(np.float32)
            self._cells.append(cells)
            # From sample to sample, along slopes, too.
            spacing = float(np.percentile(each.footprint, 90)) * raster.scale / raster.cell * each.step
            self._reach.append(2.0 * spacing + 1.0)
        self._boxes = [(cells.min(axis=0), cells.max(axis=0)) for cells in self._cells]

    def inside(self, index: int, tile: Tile, margin: int) -> NDArray[np.bool_]:
        """(n,) which samples of a view lie in a tile and its margin, or may have something beside them there."""
        reach = self._reach[index] + margin
        low = np.array([tile.column, tile.row]) - reach
        high = np.array([tile.column + tile.width, tile.row + tile.height]) + reach
        least, most = self._boxes[index]
        cells = self._cells[index]
        if (most < low).any() or (least > high).any():
            return np.zeros(len(cells), bool)
        return np.asarray(((cells >= low) & (cells <= high)).all(axis=1))

    def in_tile(self, tile: Tile, margin: int) -> Iterator[tuple[int, Box]]:
        """Each view with something in a tile, and the part of it that shows this."""
        for index, each in enumerate(self._seen):
            is_inside = self.inside(index, tile, margin)
            if is_inside.any():
                pixels = each.pixels[is_inside]
                left, top = (pixels.min(axis=0) - 2 * each.step).clip(0).tolist()
                right, bottom = (pixels.max(axis=0) + 2 * each.step + 1).tolist()
                yield index, (left, top, min(right, each.view.width), min(bottom, each.view.height))


def tiles_of(raster: Raster, side: int) -> list[Tile]:
    """All tiles, in rows that go to and fro, so that neighbours follow each other."""
    tiles = []
    for number, row in enumerate(range(0, raster.height, side)):
        line = [
            Tile(row, column, min(side, raster.height - row), min(side, raster.width - column))
            for column in range(0, raster.width, side)
        ]
        tiles += line[::-1] if number % 2 else line
    return tiles


def choose_side(
    raster: Raster, sightings: Sightings, seen: Sequence[SeenView], margin: int, factor: int, memory: int
) -> tuple[int, int]:
    """Largest side of tiles that fits into the memory, and the bytes left for images that are kept.

    A cell is drawn as `factor` × `factor` fine ones.

    Raises
    ------
    OptionError
        Not even the smallest tiles fit.
    """
    largest = max(each.view.width * each.view.height for each in seen)
    file_pixels = max(each.view.file_size[0] * each.view.file_size[1] for each in seen)
    fixed = _PROGRAM + 20.0 * largest + 14.0 * file_pixels
    needed = 0.0
    for fine_side in _SIDES:
        side = fine_side // factor
        most = max(
            (tile.height + 2 * margin)
            * (tile.width + 2 * margin)
            * factor**2
            * (_CELL + _CELL_VIEW * _views_in(sightings, seen, tile, margin))
            for tile in tiles_of(raster, side)
        )
        needed = fixed + most
        if needed <= memory:
            return side, int(memory - needed)
    wanted = int(needed / (1 << 20)) + 1
    raise OptionError(f"memory is too little for these maps: {wanted}MiB would do.", "memory")


def _views_in(sightings: Sightings, seen: Sequence[SeenView], tile: Tile, margin: int) -> int:
    return sum(bool(sightings.inside(index, tile, margin).any()) for index in range(len(seen)))
