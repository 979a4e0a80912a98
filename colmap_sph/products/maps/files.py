"""Depth maps → EXR, 16-bit PNG and NPZ files, and a list of the cameras that see them."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO
from numpy.typing import NDArray

from colmap_sph.platforms.files import write_text
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.maps.reading import DepthAtCentres, MappedScene
from colmap_sph.products.publishing import published_folder
from colmap_sph.project.files import make_dir
from colmap_sph.project.images.decoding import check_end
from colmap_sph.project.workspace import checked_name
from colmap_sph.scene import View

_CAMERAS = "cameras.json"
_MOST_STEPS = 65535
_STEPS = (1, 2, 5, 10)
_TYPES = {np.dtype(np.float32): OpenImageIO.FLOAT, np.dtype(np.uint16): OpenImageIO.UINT16}


def write_exr(scene: MappedScene, georeference: Georeference, folder: Path) -> None:
    """Write a folder of depth maps as EXR: channel Z, 32-bit floats, model units, 0 = none."""
    with published_folder(folder) as made:
        files = _written(scene, made, ".exr", lambda path, maps: write_image(path, maps.depth, ["Z"]))
        _write_cameras(made / _CAMERAS, scene, georeference, files, 1.0)


def write_png(scene: MappedScene, georeference: Georeference, folder: Path) -> None:
    """Write a folder of depth maps as PNG: 16 bits, in steps that `cameras.json` names, 0 = none."""
    with published_folder(folder) as made:
        step = depth_step(max(float(maps.depth.max()) for maps in scene.maps()))

        def write(path: Path, maps: DepthAtCentres) -> None:
            write_image(path, _in_steps(maps.depth, step), ["Y"])

        files = _written(scene, made, ".png", write)
        _write_cameras(made / _CAMERAS, scene, georeference, files, step)


def write_npz(scene: MappedScene, georeference: Georeference, folder: Path) -> None:
    """Write a folder of NPZ files: depth, normals, and the camera K, R, t of `View`, in the model's frame."""

    def write(path: Path, maps: DepthAtCentres) -> None:
        view = maps.view
        t = view.t - view.R @ scene.scene.origin
        np.savez_compressed(path, depth=maps.depth, normals=maps.normals, K=view.K, R=view.R, t=t)

    with published_folder(folder) as made:
        files = _written(scene, made, ".npz", write)
        _write_cameras(made / _CAMERAS, scene, georeference, files, 1.0)


def depth_step(farthest: float) -> float:
    """The finest step 1, 2 or 5 times a power of ten in which 16 bits reach so far.

    Examples
    --------
    >>> depth_step(65.0), depth_step(300.0), depth_step(1.2)
    (0.001, 0.005, 2e-05)
    """
    needed = farthest / _MOST_STEPS
    power = math.floor(math.log10(needed))
    return next(step for each in _STEPS if (step := float(f"{each}e{power}")) >= needed)


def _in_steps(depth: NDArray[np.float32], step: float) -> NDArray[np.uint16]:
    steps = np.rint(depth / step)
    # What is nearer than half a step would be none.
    return np.where(depth > 0, np.clip(steps, 1, _MOST_STEPS), 0).astype(np.uint16)


def _written(
    scene: MappedScene, folder: Path, ending: str, write: Callable[[Path, DepthAtCentres], None]
) -> dict[str, str]:
    """Write each view's maps; return the file's name, relative to the folder, by the image's."""
    files = {}
    for maps in scene.maps():
        name = f"{checked_name(maps.view.name)}{ending}"
        make_dir((folder / name).parent)
        write(folder / name, maps)
        files[maps.view.name] = name
    return files


def _write_cameras(
    path: Path, scene: MappedScene, georeference: Georeference, files: dict[str, str], step: float
) -> None:
    content = {
        "depth": "z along the optical axis, at the centres of the pixels; 0 = none",
        "model_units_per_step": step,
        "map_units_per_model_unit": georeference.scale,
        "crs": georeference.crs,
        "images": [
            {"name": view.name, "depth": files[view.name], **camera_values(view, scene.scene.origin)}
            for view in scene.scene.views
        ],
    }
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False))


def camera_values(view: View, origin: NDArray[np.float64]) -> dict[str, Any]:
    """Size, calibration and pose of a view as plain values, in the model's frame."""
    t = view.t - view.R @ origin
    return {
        "width": view.width,
        "height": view.height,
        "K": view.K.tolist(),
        "cam_from_world": np.hstack([view.R, t[:, None]]).tolist(),
    }


def write_image(path: Path, pixels: NDArray[Any], channels: list[str]) -> None:
    """Write an image of one channel; `OSError` where that fails."""
    spec = OpenImageIO.ImageSpec(pixels.shape[1], pixels.shape[0], 1, _TYPES[pixels.dtype])
    spec.channelnames = channels
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # else that of writing: the same maps make the same bytes
    output = OpenImageIO.ImageOutput.create(str(path))
    if output is None or not output.open(str(path), spec):
        raise OSError(OpenImageIO.geterror() if output is None else output.geterror())
    is_whole = output.write_image(np.ascontiguousarray(pixels[..., None]))
    problem = output.geterror()
    if not (output.close() and is_whole):
        raise OSError(problem or output.geterror())
    check_end(path)
