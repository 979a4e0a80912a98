"""What is fused of a view, read from its workspace."""

from dataclasses import dataclass
from pathlib import Path

from colmap_sph.errors import InputError
from colmap_sph.project.images.reading import read_colours
from colmap_sph.project.map_files import read_depth_map, read_normal_planes
from colmap_sph.project.masks import read_mask
from colmap_sph.scene import View
from colmap_sph.stereo.fusion import ViewMaps


@dataclass(frozen=True, eq=False)
class MapSources:
    """Where what is fused of a view lies.

    Attributes
    ----------
    view : View
    index : int
        Its place among the images of the model: what ``fused.ply.vis`` calls it by.
    depth, normals, image : Path
        Its maps, and its undistorted image for the colours.
    mask : Path or None
        Where its mask would be, black = excluded.
    """

    view: View
    index: int
    depth: Path
    normals: Path
    image: Path
    mask: Path | None


def read_view_maps(sources: MapSources) -> ViewMaps:
    """Read what is fused of a view.

    Raises
    ------
    InputError
        A map, the image or the mask is missing, damaged or not of the camera's size.
    """
    view = sources.view
    depth = read_depth_map(sources.depth)
    normals = read_normal_planes(sources.normals)
    image = read_colours(sources.image)
    shape = (view.height, view.width)
    if depth.shape != shape or normals.shape[1:] != shape or image.shape[:2] != shape:
        raise InputError(
            f"The maps or the image of {view.name} are not of its camera's {shape[1]} x {shape[0]} pixels; "
            "delete the maps and compute them again."
        )
    mask = None if sources.mask is None else read_mask(sources.mask, view.width, view.height)
    if mask is not None:
        depth[mask == 0] = 0
    return ViewMaps(view, sources.index, depth, normals, image)
