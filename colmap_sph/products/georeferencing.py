"""What a user says of map coordinates (`--crs`, `--align`) → the georeference of a workspace, kept in it."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OptionError, counted
from colmap_sph.products.alignment.aligning import align_by_points, align_by_positions, positions_of_photographs
from colmap_sph.products.alignment.tables import Positions, read_table
from colmap_sph.products.crs import from_gps, is_in_area, read_crs, utm_zone_of, wkt_of
from colmap_sph.products.georeference import Georeference, Residual, read_georeference, write_georeference
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene

if TYPE_CHECKING:
    import pyproj

logger = logging.getLogger(__name__)

_SHOWN = 12
# Images look up, or are upside down, where the mean of their axes points so far from the right side.
_MOSTLY = 0.5


@dataclass(frozen=True)
class GeoreferenceOptions:
    """Where the model lies on the map: kept in the workspace, and used from then on."""

    crs: str | None = None
    """Coordinate system of the map, such as EPSG:25832. Without --align it is that of the model's own
    coordinates."""
    align: Path | None = None
    """For a model in a frame of its own: a folder of photographs with GPS positions in their Exif data, a CSV with
    camera positions (image,x,y,z or image,latitude,longitude,height), or one with control points
    (point,x,y,z,image,column,row, and maybe role: control or check). The model stays as it is."""
    marked_in: Path | None = None
    """For control points: sparse model of the images in which they were marked, sparse/0 for the original
    photographs, dense/sparse for the undistorted images."""


def georeferenced(workspace: Workspace, options: GeoreferenceOptions) -> Georeference:
    """Find out, or read, where a workspace's model lies on the map, and keep it there.

    Raises
    ------
    InputError, OptionError
        What is given does not tell, or contradicts what is kept.
    OutputError
        The workspace cannot be written.
    """
    if options.align is None:
        if options.marked_in is not None:
            raise OptionError(
                "marked_in goes with control points, which align gives; give both.", "marked_in", "align"
            )
        found = _in_own_coordinates(workspace, options.crs)
    else:
        found = _aligned(workspace, options, options.align)
    if options.crs is not None or options.align is not None:
        write_georeference(workspace, found)
    return found


def _in_own_coordinates(workspace: Workspace, name: str | None) -> Georeference:
    """What is kept, or a system for the model's own coordinates."""
    if name is None:
        return read_georeference(workspace)
    crs = read_crs(name)
    try:
        kept = read_georeference(workspace)
    except InputError:  # of another model, or damaged: it is written anew
        kept = Georeference()
    if kept.aligned_by:
        if kept.wkt == wkt_of(crs):
            return kept
        raise OptionError(
            f"crs {name} is not {kept.crs or 'the unnamed system'}, to which {workspace.root} was aligned; give "
            "align again, too.",
            "crs",
            "align",
        )
    scene = read_scene(workspace.sparse_dir)
    found = Georeference(crs=name, wkt=wkt_of(crs))
    if far := _far_place(scene, found, crs):
        raise InputError(
            f"The cameras of {workspace.sparse_dir} are at {far}; check --crs, or give --align if the model is in "
            "a frame of its own."
        )
    return found


def _far_place(scene: Scene, found: Georeference, crs: "pyproj.CRS") -> str:
    """Where a scene's cameras would be, in words, if a coordinate system is not used there; empty if it is."""
    x, y, z = middle = found.to_map(np.median([view.center for view in scene.views], axis=0) + scene.origin)
    if is_in_area(crs, middle):
        return ""
    return f"{x:.6g}, {y:.6g}, {z:.6g}, which is far from where {found.crs} ({crs.name}) is used"


def _aligned(workspace: Workspace, options: GeoreferenceOptions, source: Path) -> Georeference:
    crs = None if options.crs is None else read_crs(options.crs)
    scene = read_scene(workspace.sparse_dir)
    table = positions_of_photographs(source, scene) if source.is_dir() else read_table(source)
    if isinstance(table, Positions):
        name, crs, places = _on_map(table, options.crs, crs)
        found = align_by_positions(scene, places, source)
    else:
        if options.marked_in is None:
            raise OptionError(
                f"{source} has control points, and marked_in is missing: give the model of the images in which "
                "they were marked, sparse/0 for the original photographs.",
                "marked_in",
            )
        name = options.crs or ""
        found = align_by_points(workspace, table, options.marked_in, source)
    found = replace(found, crs=name, wkt="" if crs is None else wkt_of(crs))
    if crs is not None and (far := _far_place(scene, found, crs)):
        raise InputError(
            f"By {source} the cameras are at {far}; check --crs, or leave it out for a site grid without a name."
        )
    if crs is None or not crs.is_geocentric:  # whose third axis is not upright
        _tell_head_stand(scene, found, source)
    return found


def _tell_head_stand(scene: Scene, found: Georeference, source: Path) -> None:
    """Warn where images look up, or are upside down: places in one plane fit as well with x and y exchanged."""
    looking = float(np.mean([found.rotation[2] @ view.R[2] for view in scene.views]))
    upright = float(np.mean([found.rotation[2] @ -view.R[1] for view in scene.views]))
    if looking > _MOSTLY or upright < -_MOSTLY:
        logger.warning(
            "By %s the model stands on its head: its images %s. Are x and y, or the sign of z, exchanged there?",
            source,
            "look up" if looking > _MOSTLY else "are upside down",
        )


def _on_map(
    positions: Positions, name: str | None, crs: "pyproj.CRS | None"
) -> tuple[str, "pyproj.CRS | None", dict[str, NDArray[np.float64]]]:
    """Camera positions in a coordinate system; without one, in the UTM zone of their middle."""
    places = np.array(list(positions.places.values())).reshape(-1, 3)
    if positions.is_geographic:
        if crs is None:
            name = utm_zone_of(float(np.median(places[:, 0])), _middle_longitude(places[:, 1]))
            crs = read_crs(name)
            logger.info("Map coordinates in %s (%s)", crs.name, name)
        places = from_gps(crs, places)
    return name or "", crs, dict(zip(positions.places, places, strict=True))


def _middle_longitude(longitudes: NDArray[np.float64]) -> float:
    """Median of (n,) longitudes, degrees, which may lie on both sides of the 180th meridian."""
    mean = np.degrees(np.angle(np.exp(1j * np.radians(longitudes)).mean()))
    return float(np.median(longitudes - 360 * np.round((longitudes - mean) / 360)))


def report_lines(georeference: Georeference) -> Iterator[str]:
    """What is left of an alignment, for people: a summary, and the largest residuals."""
    if not georeference.aligned_by:
        return
    what = "camera positions" if georeference.aligned_by == "positions" else "control points"
    used = [each for each in georeference.residuals if not each.is_check]
    others = [each for each in georeference.residuals if each.is_check]
    where = georeference.crs or "map coordinates"
    yield f"aligned to {where} by {len(used)} {what}: scale {georeference.scale:.8g}, {_summary(used)}"
    if others:
        is_of_points = georeference.aligned_by == "points"
        told = counted(len(others), "check point" if is_of_points else "gross error")
        yield f"{told}{'' if is_of_points else ', left out'}: {_summary(others)}"
    if len(used) == 3:
        yield "three places determine a similarity: what is left at them says little of how right it is"
    unused = "left out" if georeference.aligned_by == "positions" else "check"
    largest = sorted(georeference.residuals, key=lambda each: -each.length)[:_SHOWN]
    yield f"{'largest residuals':<32}{'dx':>10}{'dy':>10}{'dz':>10}"
    for each in largest:
        marks = "" if each.pixels is None else f"  {each.pixels:.2f} px"
        note = f"  {unused}" if each.is_check else ""
        yield f"{each.name[-32:]:<32}" + "".join(f"{value:>10.3f}" for value in each.difference) + marks + note


def _summary(residuals: list[Residual]) -> str:
    squares = np.array([each.difference for each in residuals]) ** 2
    plan = np.sqrt(squares[:, :2].sum(axis=1).mean())
    height = np.sqrt(squares[:, 2].mean())
    return f"root mean square {plan:.3f} in plan, {height:.3f} in height"
