"""A workspace with depth maps → DSM, hillshade, orthophoto and index, as GeoTIFFs in a folder."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, OutputError
from colmap_sph.platforms.files import move_into_place, sync_file
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.places import check_places
from colmap_sph.products.publishing import alone_in, told
from colmap_sph.products.surface.drawing import Drawing, Drawn, margin_of
from colmap_sph.products.surface.geotiff import NO_HEIGHT, Layer, LayerFiles, gdal
from colmap_sph.products.surface.options import SurfaceOptions
from colmap_sph.products.surface.pictures import pictures_of
from colmap_sph.products.surface.placing import Placement, place
from colmap_sph.products.surface.previews import PREVIEWS, write_previews
from colmap_sph.products.surface.seen import SeenView, seen_views
from colmap_sph.products.surface.tiles import Sightings, Tile, choose_side, tiles_of
from colmap_sph.project.files import atomic_file, free_space, remove, scratch_folder
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene

logger = logging.getLogger(__name__)

_LAYERS = {
    "dsm": Layer("dsm.tif", "float32", ("height", "standard deviation", "images"), NO_HEIGHT, "AVERAGE"),
    "shade": Layer("hillshade.tif", "uint8", ("hillshade",), 0, "AVERAGE"),
    "colours": Layer("orthophoto.tif", "uint8", ("red", "green", "blue", "alpha"), None, "AVERAGE"),
    "source": Layer("orthophoto_images.tif", "uint16", ("number of the image",), 0, "NEAREST"),
}
_OF_ORTHOPHOTO = ("colours", "source")
_SUMMARY = "surface.json"
_CELL_BYTES = 4 * 3 + 1 + 4 + 2


class Summary(msgspec.Struct, frozen=True):
    """What stands in ``surface.json`` beside the files.

    Attributes
    ----------
    cell, gsd : float
        Side of a cell, and what a pixel of the images covers in the middle.
    model_to_raster : list of list of float
        (3, 4): coordinates of the model → x and y of the raster, and height.
    images : list of str
        Of the numbers in ``orthophoto_images.tif``, 1 is the first.
    covered : float
        Share of all cells with a measured height.
    filled : float
        Share of all cells whose height was filled in.
    """

    cell: float
    gsd: float
    crs: str
    width: int
    height: int
    model_to_raster: list[list[float]]
    images: list[str]
    covered: float
    filled: float


@dataclass(frozen=True, eq=False)
class SurfaceRequest:
    """What is to be made of a workspace, and where.

    Attributes
    ----------
    memory : int
        Bytes that the process may use.
    overwrite : bool
        Whether files that are there already are replaced.
    """

    workspace: Workspace
    georeference: Georeference
    options: SurfaceOptions
    folder: Path
    memory: int
    overwrite: bool = False


Start = Callable[[str, int], None]
Advance = Callable[[], None]


def make_surface(request: SurfaceRequest, start: Start, advance: Advance) -> tuple[list[Path], Summary]:
    """Draw all tiles, and publish the files when all are complete.

    Parameters
    ----------
    request : SurfaceRequest
    start, advance : callable
        Told that so many steps of something begin, and that one is done.

    Returns
    -------
    paths : list of Path
        What was made.
    summary : Summary

    Raises
    ------
    InputError, NoResultError, OptionError
        GDAL or maps are missing or damaged, an option does not fit.
    OutputError
        The files cannot be written.
    """
    request.options.check()
    gdal()
    layers = {
        key: each for key, each in _LAYERS.items() if request.options.orthophoto or key not in _OF_ORTHOPHOTO
    }
    names = [*(layer.name for layer in layers.values()), _SUMMARY, *PREVIEWS]
    check_places(request.workspace, request.folder, names, overwrite=request.overwrite)
    scene, seen = seen_views(request.workspace)
    placement = place(scene, seen, request.georeference, request.options)
    drawing, tiles = _prepared(request, scene, seen, placement)
    scratch = request.folder / ".surface.tmp"
    with alone_in(request.folder), scratch_folder(scratch):
        _check_space(request.folder, placement)  # without what a process that was killed has left
        counts = np.zeros(2, np.int64)
        with LayerFiles(scratch, layers, placement.raster, placement.crs, _tags(placement)) as files:
            start("surface", len(tiles))
            for tile in tiles:
                counts += _write(files, layers, tile, drawing.draw(tile))
                advance()
            if not counts.sum():
                raise NoResultError(
                    "No cell of the raster is seen by any depth map: choose larger cells or a plane nearby, or "
                    "make maps anew whose normals do not face their cameras."
                )
            made = files.finish()
            made += write_previews(made)
        summary = _summary(scene, placement, counts)
        path = request.folder / _SUMMARY
        paths = _publish(made, path)
        with atomic_file(path) as file:
            file.write(msgspec.json.format(msgspec.json.encode(summary), indent=1))
    return [*paths, path], summary


def _prepared(
    request: SurfaceRequest, scene: Scene, seen: list[SeenView], placement: Placement
) -> tuple[Drawing, list[Tile]]:
    options = request.options
    sightings = Sightings(seen, placement.raster)
    margin = margin_of(options, placement.factor)
    side, spare = choose_side(placement.raster, sightings, seen, margin, placement.factor, request.memory)
    pictures = None
    if options.orthophoto:
        pictures = pictures_of(request.workspace, scene, seen, balance=options.balance, memory=spare)
    drawing = Drawing(request.workspace, seen, placement, sightings, options, pictures)
    return drawing, tiles_of(placement.raster, side)


def _tags(placement: Placement) -> dict[str, str]:
    matrix = ";".join(",".join(f"{value:.17g}" for value in row) for row in placement.model_to_places)
    return {"MODEL_TO_RASTER": matrix}


def _write(files: LayerFiles, layers: Iterable[str], tile: Tile, drawn: Drawn) -> NDArray[np.int64]:
    """Write a tile; returns its numbers of measured and of filled cells."""
    surface = drawn.surface
    has_colour = drawn.source > 0
    bands: dict[str, list[NDArray[Any]]] = {
        "dsm": [
            np.nan_to_num(surface.height, nan=NO_HEIGHT),
            np.nan_to_num(surface.deviation, nan=NO_HEIGHT),
            np.where(np.isfinite(surface.height), surface.count, np.float32(NO_HEIGHT)).astype(np.float32),
        ],
        "shade": [drawn.shade],
        "colours": [*np.moveaxis(drawn.colours, 2, 0), np.where(has_colour, np.uint8(255), np.uint8(0))],
        "source": [drawn.source],
    }
    for key in layers:
        files.write(key, tile, bands[key])
    is_measured = surface.count > 0
    return np.array([is_measured.sum(), (np.isfinite(surface.height) & ~is_measured).sum()])


def _check_space(folder: Path, placement: Placement) -> None:
    cells = placement.raster.width * placement.raster.height
    needed = int(1.7 * _CELL_BYTES * cells)  # as drawn, and once more compressed
    free = free_space(folder)
    if needed > free:
        raise OutputError(
            f"{folder} has room for {free >> 20} MiB, and may need {(needed >> 20) + 1} MiB; make room, choose "
            "another --output, or a larger --cell."
        )


def _summary(scene: Scene, placement: Placement, counts: NDArray[np.int64]) -> Summary:
    raster = placement.raster
    shares = counts / (raster.width * raster.height)
    return Summary(
        cell=raster.cell,
        gsd=placement.gsd,
        crs=placement.crs,
        width=raster.width,
        height=raster.height,
        model_to_raster=placement.model_to_places.tolist(),
        images=[view.name for view in scene.views],
        covered=float(shares[0]),
        filled=float(shares[1]),
    )


def _publish(made: list[Path], summary: Path) -> list[Path]:
    """Move complete files to their places, beside each other: to wait for the disk takes long, and comes before.

    The summary of earlier ones is gone before the first is there: it tells of no others, should this be ended.
    """
    for path in made:
        with told(summary.with_name(path.name)):
            sync_file(path)
    remove(summary)
    paths = []
    for path in made:
        target = summary.with_name(path.name)
        with told(target):
            move_into_place(path, target)
        paths.append(target)
    return paths
