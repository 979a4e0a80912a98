"""A workspace → a COLMAP project whose points are a thinned dense cloud with tracks: for Gaussian splatting.

::

    images/               the undistorted images
    sparse/0/             cameras, images, and points3D.bin: a point of each voxel, with the images that see it

Programs for splats read models in 32-bit floats: one in map coordinates is moved near its origin.
"""

from pathlib import Path

import numpy as np

from colmap_sph.errors import InputError
from colmap_sph.platforms.files import write_text
from colmap_sph.products.clouds.ply import write_points
from colmap_sph.products.clouds.thinning import ThinCloud
from colmap_sph.products.publishing import published_folder, scratch_beside
from colmap_sph.products.scenes.links import check_images, link_images
from colmap_sph.project.cloud_output import cloud_as_model
from colmap_sph.project.map_coordinates import local_origin, move_model
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.sparse_model import load_model, write_model
from colmap_sph.project.workspace import Workspace

_POINT = np.dtype(
    [
        *((name, "<f8") for name in ("x", "y", "z")),
        *((name, "<f4") for name in ("nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
    ]
)
_ORIGIN = "origin.txt"


def write_splats(workspace: Workspace, cloud: ThinCloud, folder: Path) -> None:
    """Write a project for Gaussian splatting.

    Parameters
    ----------
    workspace : Workspace
    cloud : ThinCloud
    folder : Path

    Raises
    ------
    InputError
        It is not known which images see the points, or an image is not whole.
    OutputError
        The folder cannot be written.
    """
    if not cloud.counts.all():
        raise InputError(
            f"It is not known which images see the points of {workspace.fused_path}, whose file "
            f"{workspace.fused_path.name}.vis is missing; fuse again."
        )
    if len(cloud.images) and cloud.images.max() >= load_model(workspace.sparse_dir).num_reg_images():
        raise InputError(
            f"The images that see the points of {workspace.fused_path} are more than {workspace.sparse_dir} has; "
            "fuse again."
        )
    check_images(workspace, read_scene(workspace.sparse_dir).views)
    with published_folder(folder) as made:
        link_images(workspace, made, folder)
        with scratch_beside(made / "cloud") as scratch:
            files = (scratch / "cloud.ply", scratch / "cloud.ply.vis")
            write_points(files[0], _as_points(cloud))
            files[1].write_bytes(_as_visibility(cloud))
            model = cloud_as_model(files, workspace.sparse_dir, np.zeros(3))
        origin = local_origin(model)
        if origin.any():
            move_model(model, origin)
            write_text(made / _ORIGIN, " ".join(map(repr, origin.tolist())) + "\n")
        write_model(model, made / "sparse" / "0")


def _as_points(cloud: ThinCloud) -> np.ndarray:
    points = np.zeros(len(cloud.xyz), _POINT)
    columns = [*cloud.xyz.T, *cloud.normals.T, *cloud.rgb.T]
    for name, values in zip(_POINT.names or (), columns, strict=True):
        points[name] = values
    return points


def _as_visibility(cloud: ThinCloud) -> bytes:
    """COLMAP's ``.vis``: the number of points, and of each the number of images and these."""
    places = np.cumsum(cloud.counts, dtype=np.int64) - cloud.counts
    words = np.insert(cloud.images, places, cloud.counts)
    return np.array(len(cloud.counts), "<u8").tobytes() + words.astype("<u4").tobytes()
