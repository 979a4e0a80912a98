"""Options, scene and samples of maps → the raster that products are drawn into."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, OptionError
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.surface.options import SurfaceOptions
from colmap_sph.products.surface.seen import SeenView
from colmap_sph.scene import Scene
from colmap_sph.stereo.region.map_axes import map_axes
from colmap_sph.stereo.region.vertical import east_north_up, upwards
from colmap_sph.stereo.surface.raster import Raster

# An axis of the model is up where the found direction is as near to it: as near as images tell.
_OWN_AXIS = math.cos(math.radians(3.0))
# What lies beyond these percentiles by more than this part of what lies between them comes from wrong depths.
_INNER = (0.5, 99.5)
_BEYOND = 0.25
# More cells on a side, or in all, than any program of maps takes in a day.
_MOST_ON_A_SIDE = 200_000
_MOST_CELLS = 20_000_000_000
_SLAB = 0.1
# Of a cell each way: with more, nothing changes.
_MOST_PARTS = 8


@dataclass(frozen=True, eq=False)
class Placement:
    """The raster, and what its places mean.

    Attributes
    ----------
    raster : Raster
        Scene → cells.
    crs : str
        WKT of the map's coordinate system; empty where it has none that is known.
    gsd : float
        What a pixel covers, the median over all maps, in units of the raster.
    slab : (float, float)
        Heights that count.
    factor : int
        A cell is drawn in so many parts each way, about as large as a pixel.
    model_to_places : (3, 4) float64 ndarray
        From coordinates of the model as it is in its files to places of the raster and heights.
    """

    raster: Raster
    crs: str
    gsd: float
    slab: tuple[float, float]
    factor: int
    model_to_places: NDArray[np.float64]


def place(
    scene: Scene, seen: Sequence[SeenView], georeference: Georeference, options: SurfaceOptions
) -> Placement:
    """Choose axes, cells and extent of the raster.

    Raises
    ------
    OptionError
        The raster would have too many cells, or `up` is given for a model whose up is known.
    NoResultError
        Nothing is seen of the plane.
    """
    linear, offset, crs = _axes(scene, seen, georeference, options)
    scale = float(np.cbrt(np.linalg.det(linear)))
    gsd = float(np.median(np.concatenate([each.footprint for each in seen]))) * scale
    cell = options.cell or _rounded(gsd)
    slab = (-math.inf, math.inf)
    corners = options.plane_corners()
    if corners is None:
        places = np.concatenate([each.points @ linear[:2].T + offset[:2] for each in seen])
        least, most = _extent(places)
        first = np.floor(least / cell) * cell
        columns, rows = np.maximum(np.ceil((most - first) / cell), 1)
        if cell > max(most - least):
            raise OptionError(
                f"a cell of {cell:g} is larger than all that is seen, {max(most - least):g}; give a smaller cell.",
                "cell",
            )
    else:
        first = np.zeros(2)
        size = _sides(corners)
        columns, rows = np.maximum(np.ceil(size / cell - 1e-6), 1)
        depth = options.plane_depth or _SLAB * float(size[0])
        slab = (-depth, depth)
    _check_size(columns, rows, cell)
    raster = Raster(linear, offset, float(first[0]), float(first[1] + rows * cell), cell, int(columns), int(rows))
    if not any(_is_met(raster, each, slab) for each in seen):
        raise NoResultError(
            "No depth map sees anything of the plane; check the corners of --plane, and its depth."
        )
    shift = offset - linear @ scene.origin
    factor = int(np.clip(round(cell / gsd), 1, _MOST_PARTS))
    return Placement(raster, crs, gsd, slab, factor, np.column_stack([linear, shift]))


def _axes(
    scene: Scene, seen: Sequence[SeenView], georeference: Georeference, options: SurfaceOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64], str]:
    """(3, 3) scene → places, (3,) place of the scene's origin, and the coordinate system's WKT."""
    linear = georeference.scale * georeference.rotation
    offset = georeference.to_map(scene.origin)
    corners = options.plane_corners()
    if corners is not None:
        right = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        top = corners[2] - corners[0]
        top = top - (top @ right) * right
        top = top / np.linalg.norm(top)
        turn = np.array([right, top, np.cross(right, top)])
        return turn @ linear, turn @ (offset - corners[0]), ""
    is_on_map = bool(georeference.crs) or not georeference.is_identity or bool(scene.origin.any())
    up = options.up_axis()
    if is_on_map:
        if up is not None:
            raise OptionError(
                "up is given, but the model is in map coordinates, which tell it; leave it out.", "up"
            )
        axes = axes_on_map(scene, seen, georeference)
        if (axes == np.eye(3)).all():
            return linear, offset, georeference.wkt
        # Geocentric: heights from the Earth's middle would lose their digits.
        return axes @ linear, np.zeros(3), ""
    turn = level_axes(scene, seen, up)
    return turn, turn @ offset, ""


def axes_on_map(scene: Scene, seen: Sequence[SeenView], georeference: Georeference) -> NDArray[np.float64]:
    """(3, 3) east, north and up along the axes of the map, of a scene that is on one."""
    points = np.concatenate([each.points for each in seen]).astype(np.float64)
    up = georeference.rotation @ upwards(scene.views, points)
    return east_north_up(georeference.to_map(scene.origin), up)


def level_axes(
    scene: Scene, seen: Sequence[SeenView], up: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """(3, 3) axes of a local model: its own ones where one of them is up, else across along its longer side."""
    points = np.concatenate([each.points for each in seen]).astype(np.float64)
    axes = map_axes(scene.views, points, up=up)
    nearest = int(np.argmax(np.abs(axes[2])))
    if abs(axes[2, nearest]) < _OWN_AXIS:
        return axes
    # Rows: the two axes after the one that is up, and that.
    own = np.array([np.eye(3)[(nearest + 1) % 3], np.eye(3)[(nearest + 2) % 3], np.eye(3)[nearest]])
    return own if axes[2, nearest] > 0 else np.array([own[1], own[0], -own[2]])


def _sides(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Width and height of a plane's rectangle."""
    right = corners[1] - corners[0]
    width = float(np.linalg.norm(right))
    return np.array([width, float(np.linalg.norm(np.cross(right, corners[2] - corners[0]))) / width])


def _extent(places: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and largest places, but for outliers."""
    low, high = np.percentile(places, _INNER, axis=0)
    reach = _BEYOND * np.maximum(high - low, 1e-12)
    return np.maximum(places.min(axis=0), low - reach), np.minimum(places.max(axis=0), high + reach)


def _rounded(size: float) -> float:
    """Two digits of a size, rounded up."""
    step = 10.0 ** (math.floor(math.log10(size)) - 1)
    return float(f"{math.ceil(size / step - 1e-9) * step:.12g}")


def _check_size(columns: float, rows: float, cell: float) -> None:
    if max(columns, rows) > _MOST_ON_A_SIDE or columns * rows > _MOST_CELLS:
        raise OptionError(
            f"a cell of {cell:g} makes a raster of {columns:,.0f} x {rows:,.0f} cells; give a larger cell.", "cell"
        )


def _is_met(raster: Raster, seen: SeenView, slab: tuple[float, float]) -> bool:
    cells = raster.to_cells(seen.points.astype(np.float64))
    inside = (cells[:, :2] > -1).all(axis=1) & (cells[:, 0] < raster.width) & (cells[:, 1] < raster.height)
    return bool((inside & (cells[:, 2] > slab[0]) & (cells[:, 2] < slab[1])).any())
