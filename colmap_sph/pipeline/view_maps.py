"""What is fused of a view, read from its workspace."""

from pathlib import Path

import cv2

from colmap_sph.errors import InputError
from colmap_sph.project.images import read_undistorted
from colmap_sph.project.map_files import read_depth_map, read_normal_planes
from colmap_sph.project.masks import read_mask
from colmap_sph.project.workspace import MapKind, Workspace, mask_path
from colmap_sph.scene import View
from colmap_sph.stereo.fusion import ViewMaps


def read_view_maps(workspace: Workspace, view: View, index: int, kind: MapKind, masks: Path | None) -> ViewMaps:
    """Read what is fused of a view; see `ViewMaps`.

    Parameters
    ----------
    workspace : Workspace
    view : View
    index : int
    kind : {"geometric", "photometric"}
    masks : Path, optional
        Folder of ``NAME.png`` masks of the undistorted images, black = excluded.

    Raises
    ------
    InputError
        A map, the image or the mask is missing, damaged or not of the camera's size.
    """
    depth = read_depth_map(workspace.depth_map_path(view.name, kind))
    normals = read_normal_planes(workspace.normal_map_path(view.name, kind))
    image = read_undistorted(workspace.image_path(view.name), cv2.IMREAD_COLOR)
    shape = (view.height, view.width)
    if depth.shape != shape or normals.shape[1:] != shape or image.shape[:2] != shape:
        raise InputError(
            f"The maps or the image of {view.name} are not of its camera's {shape[1]} x {shape[0]} pixels; "
            "delete the maps and compute them again."
        )
    mask = None if masks is None else read_mask(mask_path(masks, view.name), view.width, view.height)
    if mask is not None:
        depth[mask == 0] = 0
    return ViewMaps(view, index, depth, normals, image)
