"""Originals → what undistortion will make of them: the scene, and the space on the disk."""

from collections.abc import Collection, Iterable
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import OutputError
from colmap_sph.project.cameras import change_camera
from colmap_sph.project.files import free_space
from colmap_sph.project.lens.straight import straight_camera
from colmap_sph.project.scene_reader import scene_of_model
from colmap_sph.project.sparse_model import cameras_of_images, model_files, submodel
from colmap_sph.project.undistortion.model import model_with_views, moved_pixels
from colmap_sph.project.undistortion.options import UndistortionOptions
from colmap_sph.project.undistortion.originals import Originals
from colmap_sph.scene import Scene

# Space that undistortion is given, relative to the files it starts from; JPEGs come out up to 1.6 times larger.
_SPACE_FACTOR = 2
# Of a pixel of a view that is cut from a wide image, at most; half of it, as that factor is for all.
_VIEW_BYTES = 1


def foreseen_scene(originals: Originals, names: Collection[str], options: UndistortionOptions) -> Scene:
    """Return the scene of the undistorted images `names`, before they are there."""
    if originals.cuts.views:
        model = model_with_views(originals.model, originals.cuts, names, originals.fields, options)
        return scene_of_model(model, originals.model_dir, originals.cuts.views)
    model = submodel(originals.model, set(names))
    for camera_id, camera in model.cameras.items():
        change_camera(camera, straight_camera(camera, options.for_colmap(), originals.fields.get(camera_id)))

    def moved(image: pycolmap.Image, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        i = image.camera_id
        return moved_pixels(originals.model.camera(i), pixels, originals.fields.get(i), model.camera(i))

    return scene_of_model(model, originals.model_dir, moved=moved)


def check_space(originals: Originals, names: Iterable[str], output: Path, options: UndistortionOptions) -> None:
    """Raise `OutputError` unless the undistorted images `names` will fit: COLMAP may not notice a full disk."""
    needed = sum(path.stat().st_size for path in model_files(originals.model_dir))
    cameras = cameras_of_images(originals.model)
    limit = options.max_image_size
    for name in names:
        if name in originals.cuts.views:
            face = originals.cuts.views[name].face
            needed += _VIEW_BYTES * face.width * face.height
            continue
        longest = max(cameras[name].width, cameras[name].height)
        scale = min(1.0, limit / longest) if limit > 0 else 1.0
        needed += int(scale**2 * (originals.image_dir / name).stat().st_size)
    needed *= _SPACE_FACTOR
    free = free_space(output)
    if free < needed:
        raise OutputError(
            f"The undistorted images need about {needed / 1e6:.0f} MB, but on the disk of {output} only "
            f"{free / 1e6:.0f} MB are free; free some space or choose another --output."
        )
