"""Dense workspace → fused cloud, by COLMAP's own fusion of the depth and normal maps.

COLMAP's default gates suit its own patch match; ours keep one point per surface element instead of merging
neighbours two pixels away, which thins a cloud several times. COLMAP computes with 32-bit floats, so a model in
map coordinates is moved near its origin before, and the cloud back afterwards.
"""

import errno
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.colmap_log import quiet_colmap
from colmap_sph.errors import InputError, OptionError, OutputError
from colmap_sph.map_coordinates import local_origin, move_cloud, move_model
from colmap_sph.scene import cameras_of_images, load_model
from colmap_sph.staging import scratch_folder
from colmap_sph.workspace import MapKind, Workspace, check_map, make_dir

# COLMAP derives the name of the visibility file from the cloud's.
_CLOUD_FILES = ("fused.ply", "fused.ply.vis")
# COLMAP's cloud: position and normal in 32-bit floats, and a colour.
_PLY_END = b"end_header\n"
_PLY_POINT_BYTES = 6 * 4 + 3


@dataclass(frozen=True)
class FusionOptions:
    """COLMAP's fusion options, under COLMAP's names, with defaults for our maps."""

    min_num_pixels: int = 2
    """Pixels, of different images, that must agree on a point (COLMAP: 5)."""
    max_num_pixels: int = 10000
    """Most pixels to merge into one point."""
    max_traversal_depth: int = 100
    """Longest chain of pixels, from image to image, that makes one point."""
    max_reproj_error: float = 0.5
    """Pixels within this distance of a point's projection are merged into it (COLMAP: 2)."""
    max_depth_error: float = 0.01
    """Largest relative difference of depths that agree."""
    max_normal_error: float = 30.0
    """Largest angle, degrees, of normals that agree (COLMAP: 10)."""
    check_num_images: int = 50
    """Overlapping images to look for agreement in."""
    mask_path: Path | None = None
    """Folder of NAME.png masks in undistorted geometry, black = excluded."""
    use_cache: bool = False
    """Keep only part of the maps in memory, `cache_size` of them."""
    cache_size: float = 32.0
    """Gigabytes of maps to keep in memory with `use_cache`."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name in ("min_num_pixels", "max_num_pixels", "max_traversal_depth", "check_num_images"):
            if getattr(self, name) < 1:
                raise OptionError(f"fusion {name} must be at least 1, not {getattr(self, name)}.")
        if self.max_num_pixels < self.min_num_pixels:
            raise OptionError(
                f"fusion max_num_pixels ({self.max_num_pixels}) must not be less than "
                f"min_num_pixels ({self.min_num_pixels})."
            )
        for name in ("max_reproj_error", "max_depth_error", "max_normal_error", "cache_size"):
            if not getattr(self, name) > 0:
                raise OptionError(f"fusion {name} must be positive, not {getattr(self, name)}.")
        if self.mask_path is not None and not self.mask_path.is_dir():
            raise OptionError(f"the fusion mask folder {self.mask_path} does not exist.")


def fuse(
    workspace: Workspace,
    options: FusionOptions,
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
    options : FusionOptions
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
    options.check()
    _check_places(workspace)
    model, colmap_options = _check_maps(workspace, kind), _colmap_options(options, threads)
    origin = local_origin(model)
    scratch = workspace.state_dir / "fusion"
    with scratch_folder(scratch):
        try:
            source = workspace.root
            if partners is not None or origin.any():
                source = _link_workspace(workspace, model, partners, origin, scratch)
            with quiet_colmap():
                cloud = pycolmap.stereo_fusion(
                    scratch / "fused.ply", source, input_type=kind, options=colmap_options, output_type="PLY"
                )
            _check_written(scratch / "fused.ply", scratch / "fused.ply.vis", cloud.num_points3D())
            _move_into_place(scratch, workspace, origin)
        except (OSError, RuntimeError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(
                f"COLMAP's fusion cannot write {workspace.fused_path} ({reason}); check space and permissions."
            ) from error
    return int(cloud.num_points3D())


def _check_places(workspace: Workspace) -> None:
    """Raise `OutputError` where a folder is in the cloud's place."""
    for name in _CLOUD_FILES:
        if (workspace.root / name).is_dir():
            raise OutputError(f"{workspace.root / name} is a folder; remove it, the cloud goes there.")


def _colmap_options(options: FusionOptions, threads: int) -> pycolmap.StereoFusionOptions:
    """Our options as COLMAP's."""
    colmap_options = pycolmap.StereoFusionOptions()
    for name in FusionOptions.__dataclass_fields__:
        value = getattr(options, name)
        if name != "mask_path" or value is not None:
            setattr(colmap_options, name, value)
    colmap_options.num_threads = threads
    return colmap_options


def _move_into_place(scratch: Path, workspace: Workspace, origin: NDArray[np.float64]) -> None:
    """Move the cloud that was fused in `scratch` to its place, in the coordinates of the workspace's model."""
    shutil.rmtree(workspace.local_dir, ignore_errors=True)
    if origin.any():
        _keep_local_workspace(workspace.local_dir, scratch, origin)
    # A kill in between must not leave a cloud beside the visibility of another.
    (workspace.root / _CLOUD_FILES[1]).unlink(missing_ok=True)
    for name in _CLOUD_FILES:
        (scratch / name).replace(workspace.root / name)


def _check_written(cloud: Path, visibility: Path, num_points: int) -> None:
    """Raise `OSError` for files that are cut off: COLMAP does not notice a full disk."""
    with cloud.open("rb") as file:
        header_bytes = file.read(1000).find(_PLY_END) + len(_PLY_END)
    is_whole = cloud.stat().st_size == header_bytes + _PLY_POINT_BYTES * num_points
    # Behind their number, each point has its number of images, and then these.
    words, position = np.fromfile(visibility, dtype="<u4").data, 2
    try:
        for _ in range(num_points):
            position += 1 + words[position]
    except IndexError:
        is_whole = False
    if not is_whole or position != len(words):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _check_maps(workspace: Workspace, kind: MapKind) -> pycolmap.Reconstruction:
    """Return the model; `InputError` unless it has every image of ``fusion.cfg``, and these whole maps."""
    try:
        names = workspace.fusion_cfg_path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{workspace.fusion_cfg_path} cannot be read ({error}); list the images in it."
        ) from error
    model = load_model(workspace.sparse_dir)
    cameras = cameras_of_images(model)
    for name in filter(None, map(str.strip, names)):
        if name not in cameras:
            raise InputError(f"{workspace.fusion_cfg_path} names {name!r}, which is not in the model; remove it.")
        for path in (workspace.depth_map_path(name, kind), workspace.normal_map_path(name, kind)):
            if not path.is_file():
                raise InputError(f"The map {path} is missing; compute it, or remove {name!r} from fusion.cfg.")
        shape = (cameras[name].height, cameras[name].width)
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


def _link_workspace(
    workspace: Workspace,
    model: pycolmap.Reconstruction,
    partners: Mapping[str, Sequence[str]] | None,
    origin: NDArray[np.float64],
    folder: Path,
) -> Path:
    """Make `folder` a workspace of links, but for its model, which is moved to `origin`; return it."""
    linked = Workspace(folder)
    make_dir(linked.sparse_dir)
    if partners is not None:
        model = _with_tracks(model, partners)
    if origin.any():
        move_model(model, origin)
    model.write_binary(linked.sparse_dir)
    for link, target in ((linked.images_dir, workspace.images_dir), (linked.stereo_dir, workspace.stereo_dir)):
        # Relative, so that the workspace can be moved as a whole.
        link.symlink_to(os.path.relpath(target.resolve(), folder.resolve()))
    return folder


def _keep_local_workspace(local: Path, scratch: Path, origin: NDArray[np.float64]) -> None:
    """Keep what was fused near the origin as `local`, and leave the cloud in map coordinates in `scratch`."""
    local.mkdir()
    for name in ("fused.ply", "images", "stereo", "sparse"):
        (scratch / name).rename(local / name)
    (local / "fused.ply.vis").symlink_to(Path("..", "..", "fused.ply.vis"))
    (local / "origin.txt").write_text(" ".join(map(repr, origin.tolist())) + "\n")
    move_cloud(local / "fused.ply", scratch / "fused.ply", origin)
