"""Dense workspace → fused cloud, by COLMAP's own fusion of the depth and normal maps.

COLMAP computes with 32-bit floats, so a model in map coordinates is moved near its origin before, and the cloud
back afterwards.
"""

import errno
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.platforms.links import link
from colmap_sph.project.cloud_files import check_places, link_workspace, move_cloud_into_place
from colmap_sph.project.colmap_library import quiet_colmap
from colmap_sph.project.files import make_dir, scratch_folder
from colmap_sph.project.images.reading import image_problem
from colmap_sph.project.map_coordinates import local_origin
from colmap_sph.project.map_files import check_map, is_map_there
from colmap_sph.project.masks import read_mask
from colmap_sph.project.pair_lists import read_lines
from colmap_sph.project.sparse_model import cameras_of_images, is_text, load_model, model_files
from colmap_sph.project.workspace import MapKind, Workspace, mask_path
from colmap_sph.scene import POINT

_PLY_END = b"end_header\n"


def fuse_by_colmap(
    workspace: Workspace,
    options: Mapping[str, Any],
    *,
    threads: int = -1,
    kind: MapKind = "geometric",
    partners: Mapping[str, Sequence[str]] | None = None,
) -> int:
    """Fuse the workspace's maps with COLMAP's `stereo_fusion` into ``fused.ply`` and ``fused.ply.vis``.

    The cloud of a model in map coordinates has 64-bit coordinates. What COLMAP's other programs, which compute
    with 32-bit floats, need to go on is left in ``colmap_sph/local``: a workspace of links with the model and the
    cloud near their origin, and that origin's map coordinates in ``origin.txt``.

    Parameters
    ----------
    workspace : Workspace
        With images, model, maps and ``fusion.cfg``.
    options : mapping of str to any
        COLMAP's own options of `stereo_fusion`, by name.
    threads : int
        Threads of COLMAP's fusion; -1: all cores.
    kind : {"geometric", "photometric"}
        Which maps to fuse.
    partners : mapping of str to sequence of str, optional
        For each image the images to look for agreement in; without it those that share tracks with it, as in
        COLMAP, where a model without tracks fuses to nothing.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    InputError
        A map is missing, or ``fusion.cfg`` is missing or names images that the model does not have.
    OutputError
        The cloud cannot be written.
    """
    check_places(workspace)
    model = _check_maps(workspace, kind)
    colmap_options = _colmap_options(options, threads)
    origin = local_origin(model)
    scratch = workspace.fusion_scratch_dir
    with scratch_folder(scratch):
        try:
            source = workspace.root
            # What is read here may be more than COLMAP itself would read of a text model.
            if partners is not None or origin.any() or is_text(model_files(workspace.sparse_dir)):
                linked = model if partners is None else _with_tracks(model, partners)
                link_workspace(workspace, linked, origin, scratch)
                source = scratch
            made = Workspace(scratch)
            if colmap_options.mask_path != Path():
                _link_masks(Path(colmap_options.mask_path), cameras_of_images(model), made.masks_dir)
                colmap_options.mask_path = made.masks_dir
            with quiet_colmap():
                cloud = pycolmap.stereo_fusion(
                    made.fused_path, source, input_type=kind, options=colmap_options, output_type="PLY"
                )
            _check_written(made, cloud.num_points3D())
            move_cloud_into_place(scratch, workspace, origin)
        except (OSError, RuntimeError, ValueError) as error:
            raise OutputError(
                f"COLMAP's fusion cannot write {workspace.fused_path} ({reason_of(error)}); "
                "check space and permissions."
            ) from error
    return int(cloud.num_points3D())


def _colmap_options(options: Mapping[str, Any], threads: int) -> pycolmap.StereoFusionOptions:
    colmap_options = pycolmap.StereoFusionOptions()
    for name, value in options.items():
        setattr(colmap_options, name, value)
    colmap_options.num_threads = threads
    return colmap_options


def _link_masks(folder: Path, cameras: Mapping[str, pycolmap.Camera], links: Path) -> None:
    """Check the masks of images, and let COLMAP's fusion find them; it takes damaged ones without a word."""
    for name, camera in cameras.items():
        mask = mask_path(folder, name)
        if read_mask(mask, camera.width, camera.height) is not None:
            place = links / f"{name}.png"
            make_dir(place.parent)
            link(place, mask)


def _check_written(made: Workspace, num_points: int) -> None:
    """Raise `OSError` for a cloud that is cut off: COLMAP does not notice a full disk."""
    with made.fused_path.open("rb") as file:
        header_bytes = file.read(1000).find(_PLY_END) + len(_PLY_END)
    is_whole = made.fused_path.stat().st_size == header_bytes + POINT.itemsize * num_points
    words = np.fromfile(made.visibility_path, dtype="<u4").data
    # Behind their number, each point has its number of images, and then these.
    position = 2
    try:
        for _ in range(num_points):
            position += 1 + words[position]
    except IndexError:
        is_whole = False
    if not is_whole or position != len(words):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _check_maps(workspace: Workspace, kind: MapKind) -> pycolmap.Reconstruction:
    """Return the model; `InputError` unless it has every image of ``fusion.cfg``, whole, and whole maps of it."""
    names = read_lines(workspace.fusion_cfg_path, "list the images in it")
    model = load_model(workspace.sparse_dir)
    cameras = cameras_of_images(model)
    for name in filter(None, names):
        if name not in cameras:
            raise InputError(f"{workspace.fusion_cfg_path} names {name!r}, which is not in the model; remove it.")
        for path in (workspace.depth_map_path(name, kind), workspace.normal_map_path(name, kind)):
            if not is_map_there(path):
                raise InputError(f"The map {path} is missing; compute it, or remove {name!r} from fusion.cfg.")
        shape = (cameras[name].height, cameras[name].width)
        # COLMAP leaves out an image that it cannot find, without a word to its caller.
        problem = image_problem(workspace.image_path(name), shape[1], shape[0])
        if problem is not None:
            raise InputError(f"{workspace.image_path(name)} {problem}; mend it and run again.")
        check_map(workspace.depth_map_path(name, kind), shape)
        check_map(workspace.normal_map_path(name, kind), (*shape, 3))
    return model


def _with_tracks(
    source: pycolmap.Reconstruction, partners: Mapping[str, Sequence[str]]
) -> pycolmap.Reconstruction:
    """Copy a model, with one track for every pair of `partners` and no others.

    COLMAP's fusion asks the tracks alone which images overlap, and nothing else.
    """
    model = pycolmap.Reconstruction()
    pairs = sorted({(min(a, b), max(a, b)) for a, others in partners.items() for b in others})
    tracks = [pycolmap.Track() for _ in pairs]
    for camera in source.cameras.values():
        model.add_camera_with_trivial_rig(camera)
    for image in (source.image(image_id) for image_id in sorted(source.reg_image_ids())):
        mine = [track for pair, track in zip(pairs, tracks, strict=True) if image.name in pair]
        for place, track in enumerate(mine):
            track.add_element(image.image_id, place)
        keypoints = np.zeros((len(mine), 2))
        copy = pycolmap.Image(image.name, keypoints, image.camera_id, image.image_id)
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for track in tracks:
        first, second = (model.image(element.image_id) for element in track.elements)
        # Between the two centres, where a triangulation angle is defined.
        middle = (first.projection_center() + second.projection_center()) / 2
        model.add_point3D(middle, track, np.zeros(3, dtype=np.uint8))
    return model
