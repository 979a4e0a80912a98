"""A tile and the maps of the views that see it → its surface and its orthophoto."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.products.surface.filling import filled
from colmap_sph.products.surface.options import SurfaceOptions
from colmap_sph.products.surface.pictures import Pictures
from colmap_sph.products.surface.placing import Placement
from colmap_sph.products.surface.seen import Box, Part, SeenView, read_part
from colmap_sph.products.surface.tiles import Sightings, Tile
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.surface.coarser import coarser_colours, coarser_surface
from colmap_sph.stereo.surface.heights import Surface, highest_surface, hillshade
from colmap_sph.stereo.surface.mosaic import SEAM_RADIUS, Mosaic
from colmap_sph.stereo.surface.patches import draw_heights
from colmap_sph.stereo.surface.raster import Raster
from colmap_sph.stereo.surface.visibility import sight_of

# Heights of one surface, as views see it, differ by no more than this many pixels on it.
_TOLERANCE = 3.0


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is written of a tile.

    Attributes
    ----------
    surface : Surface
        A count of 0 where the height is filled in.
    shade : (h, w) uint8 ndarray
        Hillshade, 0 = none.
    colours : (h, w, 3) uint8 ndarray
    source : (h, w) uint16 ndarray
        Number of the image, from 1; 0 = none.
    """

    surface: Surface
    shade: NDArray[np.uint8]
    colours: NDArray[np.uint8]
    source: NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class Drawing:
    """All that tiles are drawn from."""

    workspace: Workspace
    seen: Sequence[SeenView]
    placement: Placement
    sightings: Sightings
    options: SurfaceOptions
    pictures: Pictures | None

    def draw(self, tile: Tile) -> Drawn:
        """Draw a tile."""
        factor = self.placement.factor
        margin = margin_of(self.options, factor)
        window = self.placement.raster.window(
            tile.row - margin, tile.column - margin, tile.height + 2 * margin, tile.width + 2 * margin
        )
        views = list(self.sightings.in_tile(tile, margin))
        fine_window = window.finer(factor)
        fine = self._surface(fine_window, views)
        surface, chosen = coarser_surface(fine, factor)
        surface = filled(surface, self.options.fill, window.cell, self._tolerance)
        shade = hillshade(surface.height, window.cell)
        colours, source = self._orthophoto(fine_window, views, _with_filled(fine, surface, factor))
        colours, source = coarser_colours(colours, source, factor, chosen)
        inner = (slice(margin, margin + tile.height), slice(margin, margin + tile.width))
        return Drawn(
            Surface(surface.height[inner], surface.deviation[inner], surface.count[inner]),
            shade[inner],
            colours[inner],
            source[inner],
        )

    @property
    def _tolerance(self) -> float:
        """Units of the raster."""
        return _TOLERANCE * self.placement.gsd

    def _surface(self, window: Raster, views: Sequence[tuple[int, Box]]) -> Surface:
        heights = np.empty((len(views), *window.shape), np.float32)
        for place, (index, box) in enumerate(views):
            part = self._part(index, box, window)
            heights[place] = draw_heights(part.view, part.depth, part.normals, window)
        return highest_surface(heights, self._tolerance, self.options.min_images)

    def _part(self, index: int, box: Box, window: Raster) -> Part:
        """A part of a view, without depths that do not count."""
        part = read_part(self.workspace, self.seen[index].view, box)
        low, high = self.placement.slab
        if np.isfinite(low) or np.isfinite(high):
            height = _heights(part, window)
            part.depth[~((height >= low) & (height <= high))] = 0
        return part

    def _orthophoto(
        self, window: Raster, views: Sequence[tuple[int, Box]], surface: Surface
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """(h, w, 3) colours, and (h, w) numbers of the images that they are from."""
        pictures = self.pictures
        if pictures is None or not np.isfinite(surface.height).any():
            return np.zeros((*window.shape, 3), np.uint8), np.zeros(window.shape, np.uint16)
        is_filled = np.isfinite(surface.height) & (surface.count == 0)
        mosaic = Mosaic(surface.height, is_filled, self._tolerance)
        tolerance = 2 * self._tolerance / window.scale
        for index, box in views:
            view = self.seen[index].view
            part = read_part(self.workspace, view, box, with_normals=False)
            sight = sight_of(part.view, view, part.depth, surface.height, window, tolerance)
            mosaic.add(sight, box[:2], index + 1)
        numbers = np.array([0, *(each.index + 1 for each in self.seen)], np.uint16)
        return mosaic.colours(lambda number: pictures.of(number - 1)), numbers[mosaic.source]


def margin_of(options: SurfaceOptions, factor: int) -> int:
    """Cells around a tile that its own depend on, where each has `factor` × `factor` fine ones."""
    # What is filled depends on rims, and which of these count on others, as far away again.
    return max(-(-4 * SEAM_RADIUS // factor) if options.orthophoto else 1, 2 * options.fill + 2)


def _with_filled(fine: Surface, surface: Surface, factor: int) -> Surface:
    """The fine surface, with what was filled in of the coarse one."""
    is_filled = np.isfinite(surface.height) & (surface.count == 0)
    if not is_filled.any():
        return fine
    added = np.where(is_filled, surface.height, np.float32(np.nan)).repeat(factor, axis=0).repeat(factor, axis=1)
    return Surface(np.where(np.isfinite(fine.height), fine.height, added), fine.deviation, fine.count)


def _heights(part: Part, window: Raster) -> NDArray[np.float64]:
    """(h, w) height in the raster of each pixel with a depth."""
    matrix, shift = window.cells_from_camera(part.view)
    along = matrix[2] @ np.linalg.inv(part.view.K)
    column = np.arange(part.view.width)
    row = np.arange(part.view.height)[:, None]
    return np.asarray((along[0] * column + along[1] * row + along[2]) * part.depth + shift[2])
