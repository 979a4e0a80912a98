"""What is fused of a view, read from its workspace."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import DamageError, InputError
from colmap_sph.project.images.reading import fitted, read_colours
from colmap_sph.project.map_files import check_map, find_flaw, read_depth_map, read_normal_planes
from colmap_sph.project.masks import read_view_mask
from colmap_sph.project.state.records import invalidate
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.fusion import ViewMaps
from colmap_sph.stereo.map_sizes import reduced_maps
from colmap_sph.stereo.photographs.owners import owned_pixels


@dataclass(frozen=True, eq=False)
class MapSources:
    """Where what is fused of a view lies.

    Attributes
    ----------
    view : View
        With as many pixels as are fused; the image is reduced to them.
    index : int
        Its place among the images of the model: what ``fused.ply.vis`` calls it by.
    depth, normals, image : Path
        Its maps, and its undistorted image for the colours.
    mask : Path or None
        Where its mask would be, black = excluded.
    digests : tuple of str, optional
        Of the whole files of both maps, as they must be.
    record : Path, optional
        What vouches for the maps, and shall not any more where they are found to be damaged.
    map_view : View, optional
        With as many pixels as the maps have, where these are more.
    beside : tuple of View
        The other views of its photograph that are fused, see `owned_pixels`.
    """

    view: View
    index: int
    depth: Path
    normals: Path
    image: Path
    mask: Path | None
    digests: tuple[str, ...] | None = None
    record: Path | None = None
    map_view: View | None = None
    beside: tuple[View, ...] = ()


def views_beside(scene: Scene, name: str) -> tuple[View, ...]:
    """The other views of a scene that were cut from the same photograph as one of it."""
    return tuple(view.without_points() for view in scene.photograph(name).views if view.name != name)


def read_view_maps(sources: MapSources) -> ViewMaps:
    """Read what is fused of a view.

    Raises
    ------
    InputError
        A map, the image or the mask is missing, damaged or not of the camera's size.
    """
    view = sources.view
    # Before the maps, beside which there would be no room to decode it.
    image = read_colours(sources.image)
    width, height = view.file_size
    if image.shape[:2] != (height, width):
        raise InputError(f"The image {sources.image} is not of its camera's {width} x {height} pixels.")
    image = fitted(image, (view.width, view.height))
    mask = None if sources.mask is None else read_view_mask(sources.mask, view)
    depth, normals = read_sound_maps(sources)
    if sources.map_view is not None:
        depth, normals = reduced_maps(depth, normals, sources.map_view, view)
    if mask is not None:
        depth[mask == 0] = 0
    if sources.beside:
        depth[~owned_pixels(view, sources.beside)] = 0
    return ViewMaps(view, sources.index, depth, normals, image)


def read_sound_maps(sources: MapSources) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Read both maps of a view, (H, W) and (3, H, W), and check every byte and value.

    Raises
    ------
    InputError
        A map is missing, damaged, not of its view's size, or holds what no map may hold. Where it was damaged
        after it was written, its record vouches for it no more, so that the next run makes it anew.
    """
    view = sources.map_view or sources.view
    shape = (view.height, view.width)
    check_map(sources.depth, shape)
    check_map(sources.normals, (*shape, 3))
    try:
        depth_digest, normals_digest = sources.digests or (None, None)
        depth = read_depth_map(sources.depth, depth_digest)
        normals = read_normal_planes(sources.normals, normals_digest)
        flaw = find_flaw(depth, normals)
        if flaw is not None:
            raise DamageError(
                f"The maps {sources.depth} and {sources.normals} have {flaw}; run again, to make them anew."
            )
    except DamageError:
        if sources.record is not None:
            invalidate(sources.record, "doubtful")
        raise
    return depth, normals
