"""A workspace → ``transforms.json`` of nerfstudio, with depth maps and points to begin with [1]_.

Cameras are in OpenGL's convention: x right, y up, looking along -z; ``transform_matrix`` leads from the camera to
the world. Depth is z-depth at the centres of pixels, in files that nerfstudio multiplies by 0.001.

References
----------
.. [1] nerfstudio documentation, *Data conventions*, https://docs.nerf.studio/quickstart/data_conventions.html.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from colmap_sph.platforms.files import write_text
from colmap_sph.products.clouds.ply import write_ply
from colmap_sph.products.clouds.thinning import ThinCloud
from colmap_sph.products.maps.reading import MappedScene
from colmap_sph.products.publishing import published_folder
from colmap_sph.products.scenes.links import check_images, link_images
from colmap_sph.project.files import make_dir
from colmap_sph.project.workspace import checked_name
from colmap_sph.scene import View

# By which nerfstudio multiplies depth unless it is told otherwise.
_UNIT = 1e-3
_OPENGL = np.diag([1.0, -1.0, -1.0])


def write_nerfstudio(scene: MappedScene, cloud: ThinCloud, folder: Path) -> None:
    """Write a folder for nerfstudio.

    Parameters
    ----------
    scene : MappedScene
    cloud : ThinCloud
        Points to begin with.
    folder : Path

    Raises
    ------
    InputError
        A map or an image is damaged.
    OutputError
        The folder cannot be written.
    """
    origin = scene.scene.origin
    check_images(scene.workspace, scene.scene.views)
    with published_folder(folder) as made:
        link_images(scene.workspace, made, folder)
        frames = []
        for maps in scene.maps():
            name = f"depths/{checked_name(maps.view.name)}.npy"
            make_dir((made / name).parent)
            np.save(made / name, maps.depth / np.float32(_UNIT))
            frames.append(_frame(maps.view.resized(*maps.view.file_size), name))
        write_ply(made / "points.ply", cloud.xyz - origin, cloud.rgb)
        content = {
            "camera_model": "OPENCV",
            "frames": frames,
            "ply_file_path": "points.ply",
            # nerfstudio works in 32-bit floats; ours, it looks at what it knows alone.
            "model_coordinates_of_origin": origin.tolist(),
        }
        write_text(made / "transforms.json", json.dumps(content, indent=1, ensure_ascii=False))


def _frame(view: View, depth: str) -> dict[str, Any]:
    matrix = np.eye(4)
    matrix[:3, :3] = view.R.T @ _OPENGL
    matrix[:3, 3] = view.center
    return {
        "file_path": f"images/{view.name}",
        "depth_file_path": depth,
        "w": view.width,
        "h": view.height,
        "fl_x": view.K[0, 0],
        "fl_y": view.K[1, 1],
        "cx": view.K[0, 2],
        "cy": view.K[1, 2],
        "transform_matrix": matrix.tolist(),
    }
