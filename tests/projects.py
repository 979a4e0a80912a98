"""Projects on disk made of a rendered block's pictures, seen by whatever cameras, formats and names."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pycolmap
from conftest import SMALL_BLOCK, keep_images

from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.synthetic import DemoBlock, make_demo_block

Writer = Callable[[Path, np.ndarray], None]


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write a (H, W, 3) BGR picture by the ending of its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # OpenCV itself does not mind other letters in a name; quotes and all go through bytes.
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def pinhole_pixels(block: DemoBlock, name: str, camera: pycolmap.Camera, origin: float) -> np.ndarray:
    """(H, W, 2) coordinates in the block's picture of what `camera` in its place sees at (col, row) + origin."""
    x, y = np.meshgrid(np.arange(camera.width) + origin, np.arange(camera.height) + origin)
    rays = np.asarray(camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)), dtype=np.float64)
    K = block.cameras[block.names.index(name)].K
    pixels = (np.column_stack([rays, np.ones(len(rays))]) @ K.T)[:, :2]
    return pixels.reshape(camera.height, camera.width, 2)


def read_picture(path: Path, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """A picture that must be there, as OpenCV reads it."""
    picture = cv2.imread(str(path), flags)
    assert picture is not None, path
    return picture


def picture_of(block: DemoBlock, name: str, camera: pycolmap.Camera) -> np.ndarray:
    """The block's picture as another camera in the same place and pose takes it."""
    picture = read_picture(block.images_dir / name)
    pixels = (pinhole_pixels(block, name, camera, 0.5) - 0.5).astype(np.float32)
    return cv2.remap(picture, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def truth_of(block: DemoBlock, name: str, camera: pycolmap.Camera) -> np.ndarray:
    """Exact depth at (col, row) of another camera in the same place and pose, to half a pixel; 0 = unknown."""
    depth, _ = block.truth(name)
    pixels = pinhole_pixels(block, name, camera, 0.0).astype(np.float32)
    return cv2.remap(depth, pixels[..., 0], pixels[..., 1], cv2.INTER_NEAREST, borderValue=0)


def block_camera(block: DemoBlock, name: str) -> pycolmap.Camera:
    """The camera that took a picture of the block."""
    camera = block.cameras[block.names.index(name)]
    K = camera.K
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=params)


def make_block_project(
    root: Path,
    block: DemoBlock,
    cameras: Mapping[str, pycolmap.Camera],
    *,
    names: Mapping[str, str] | None = None,
    writers: Mapping[str, Writer] | None = None,
) -> Path:
    """Write pictures and model of some of the block's images; returns the model.

    `cameras` has the camera of each image, `names` what it is called if not as in the block, `writers` what writes
    its picture if not `write_picture`.
    """
    source = pycolmap.Reconstruction(block.sparse_dir)
    by_name = {image.name: image for image in source.images.values()}
    model = pycolmap.Reconstruction()
    rows: dict[tuple[int, int], int] = {}
    for number, (name, camera) in enumerate(cameras.items(), start=1):
        image = by_name[name]
        called = (names or {}).get(name, name)
        camera = pycolmap.Camera(
            camera_id=number, model=camera.model, width=camera.width, height=camera.height, params=camera.params
        )
        model.add_camera_with_trivial_rig(camera)
        ids = [p.point3D_id for p in image.points2D if p.has_point3D()]
        pose = image.cam_from_world()
        in_camera = np.array([pose * source.point3D(i).xyz for i in ids])
        keypoints = [camera.img_from_cam(point) for point in in_camera]
        seen = [(i, xy) for i, xy in zip(ids, keypoints, strict=True) if xy is not None]
        rows |= {(number, i): place for place, (i, _) in enumerate(seen)}
        copy = pycolmap.Image(called, np.array([xy for _, xy in seen]).reshape(-1, 2), number, number)
        model.add_image_with_trivial_frame(copy, pose)
        write = (writers or {}).get(name, write_picture)
        path = root / "images" / called
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, picture_of(block, name, camera))
    for point_id, point in source.points3D.items():
        elements = [pycolmap.TrackElement(i, place) for (i, p), place in rows.items() if p == point_id]
        if len(elements) >= 2:
            model.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    (root / "sparse" / "0").mkdir(parents=True)
    model.write_binary(root / "sparse" / "0")
    return root / "sparse" / "0"


def prepare(
    model: Path,
    output: Path,
    options: UndistortionOptions | None = None,
    *,
    masks: Path | None = None,
    overwrite: bool = False,
) -> Workspace:
    """The workspace of a model's undistorted images, which are found."""
    preparation = Preparation(
        Project(model, masks=masks, output=output),
        RunOptions(undistortion=options or UndistortionOptions()),
        overwrite=overwrite,
    )
    preparation.run(execute)
    return preparation.workspace


def make_context(workspace: Workspace) -> Context:
    """A run in a workspace, whose images are not checked yet."""
    options = RunOptions()
    return Context(workspace, read_scene(workspace.sparse_dir), options, Keys(workspace, options))


def results(dense: Path) -> dict[str, bytes]:
    """Maps, clouds and intermediate results of a workspace, by their paths in it."""
    files = [*dense.glob("stereo/*_maps/*.bin"), *dense.glob("fused*"), *dense.glob("colmap_sph/p*/**/*.sph")]
    return {str(path.relative_to(dense)): path.read_bytes() for path in files}


FOUR_NAMES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"]
FOUR_SIZE = (160, 120)


@cache
def _four_images() -> TemporaryDirectory[str]:
    """Rendered once for all tests of a process; goes with it."""
    folder = TemporaryDirectory()
    width, height = FOUR_SIZE
    small = replace(SMALL_BLOCK, width=width, height=height, nadir_gsd=0.4, oblique_gsd=0.44)
    make_demo_block(Path(folder.name), small, threads=2)
    keep_images(Path(folder.name), FOUR_NAMES)
    return folder


def copy_four_images(folder: Path) -> None:
    """Small pictures of one strip, and their model: all six pairs among them can be matched."""
    shutil.copytree(_four_images().name, folder, dirs_exist_ok=True)
