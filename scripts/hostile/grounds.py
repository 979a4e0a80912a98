"""What all cases start from: tiny rendered projects with exact depth, and finished workspaces of them.

`plain` has pinhole cameras, `curved` distorted ones; both see the same four pictures of a rendered village, one of
them in a folder. A workspace lies at ``PROJECT/dense``; `prepared` is one that COLMAP alone has undistorted.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph import synthetic as syn
from hostile.runs import Surroundings, apart, run

PROJECTS = ("plain", "curved")
# What an image is called in the projects, and in the rendered block.
BLOCK_NAMES = {
    "N_0_0.png": "N_0_0.jpg",
    "N_0_1.png": "N_0_1.jpg",
    "N_0_2.png": "N_0_2.jpg",
    "cam/x.png": "N_1_1.jpg",
}
NAMES = tuple(BLOCK_NAMES)

_WIDTH, _HEIGHT = 120, 90
_BLOCK = syn.BlockOptions(
    width=_WIDTH, height=_HEIGHT, nadir_gsd=0.5, oblique_gsd=0.55, strip_images=3, oblique_images=0, points=800
)
_DISTORTION = -0.03
# A depth off by more than this share of it is bad: the ground's relief is 22 m below cameras at 100 m.
_BAD = 0.02


@dataclass(frozen=True)
class Score:
    """Share of an image's pixels that have a depth, and share of these whose depth is wrong."""

    coverage: float
    bad: float


@dataclass(frozen=True)
class Grounds:
    """Projects on disk, not to be changed, and what is known of them.

    Attributes
    ----------
    folder : Path
        Has a folder for each project.
    truth : mapping
        (project, image) → exact depth (H, W) at COLMAP's pixel origin.
    looks : mapping
        (project, image) → projection matrix (3, 4) of the undistorted image.
    scores : mapping
        (project, image) → score of the geometric depth map of a run left alone.
    """

    folder: Path
    truth: Mapping[tuple[str, str], NDArray[np.float32]]
    looks: Mapping[tuple[str, str], NDArray[np.float64]]
    scores: Mapping[tuple[str, str], Score] = field(default_factory=dict)

    def project(self, name: str) -> Path:
        """Folder with ``images``, ``sparse/0``, ``text`` and the finished ``dense``."""
        return self.folder / name

    @property
    def prepared(self) -> Path:
        """Workspace of `plain` that COLMAP made, in which nothing has run."""
        return self.folder / "prepared"

    @property
    def adopted(self) -> Path:
        """A copy of `prepared` with a finished run in it."""
        return self.folder / "adopted"


def make_grounds(folder: Path) -> Grounds:
    """Render and reconstruct everything below a new folder."""
    folder.mkdir(parents=True)
    truth, looks = apart(lambda: _write_projects(folder))
    for project in PROJECTS:
        _run_cleanly(["--model", str(folder / project / "sparse" / "0")], folder)
    shutil.copytree(folder / "prepared", folder / "adopted")
    _run_cleanly(["--workspace", str(folder / "adopted")], folder)
    scores = {
        (project, name): score_of(read_depth(depth_path(folder / project / "dense", name)), truth[project, name])
        for project, name in truth
    }
    for place, score in scores.items():
        if score.coverage < 0.3 or score.bad > 0.06:
            raise RuntimeError(f"the rendered scene is not reconstructed well: {place} {score}")
    return Grounds(folder, truth, looks, scores)


def run_arguments(*arguments: str) -> list[str]:
    """The arguments of a run on so small images."""
    return ["run", *arguments, "--threads", "1"]


def depth_path(dense: Path, name: str) -> Path:
    """The geometric depth map of an image."""
    return dense / "stereo" / "depth_maps" / f"{name}.geometric.bin"


def read_depth(path: Path) -> NDArray[np.float32]:
    """Read a depth map by COLMAP's definition of its format."""
    width, height, channels, data = path.read_bytes().split(b"&", 3)
    if channels != b"1":
        raise ValueError(f"{path} has {channels!r} channels")
    return np.frombuffer(data, "<f4").reshape(int(height), int(width))


def score_of(depth: NDArray[np.float32], truth: NDArray[np.float32]) -> Score:
    """Compare a depth map with exact depth; one of another size with the nearest exact pixel."""
    if depth.shape != truth.shape:
        truth = cv2.resize(truth, depth.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(np.float32)
    found = depth != 0
    both = found & (truth > 0)
    if not both.any():
        return Score(float(found.mean()), 0.0)
    error = np.abs(depth[both].astype(np.float64) - truth[both])
    # Not a number is wrong, too.
    right = np.count_nonzero(error <= _BAD * truth[both])
    return Score(float(found.mean()), float(1 - right / np.count_nonzero(both)))


def _run_cleanly(arguments: list[str], folder: Path) -> None:
    (folder / "clean").mkdir(exist_ok=True)
    done = run(run_arguments(*arguments), Surroundings(folder / "clean"))
    if done.code != 0:
        raise RuntimeError(f"a run on sound input failed: {done}\n{done.stderr}")


def _write_projects(
    folder: Path,
) -> tuple[dict[tuple[str, str], NDArray[np.float32]], dict[tuple[str, str], NDArray[np.float64]]]:
    cv2.setNumThreads(1)
    block = syn.make_demo_block(folder / "block", _BLOCK)
    cameras = dict(zip(block.names, block.cameras, strict=True))
    source = pycolmap.Reconstruction(block.sparse_dir)
    truth = {}
    looks = {}
    for project in PROJECTS:
        for name, camera in _write_project(folder / project, source, block, distorted=project == "curved").items():
            seen = cameras[BLOCK_NAMES[name]]
            K = camera.calibration_matrix()
            view = syn.Camera(K, seen.R, seen.t, int(camera.width), int(camera.height))
            depth, _, _ = syn.exact_geometry(block.village.surfaces, view, origin=0.0)
            truth[project, name] = depth.astype(np.float32)
            looks[project, name] = np.asarray(K) @ np.column_stack([seen.R, seen.t])
    plain = folder / "plain"
    pycolmap.undistort_images(folder / "prepared", plain / "sparse" / "0", plain / "images")
    return truth, looks


def _write_project(
    root: Path, source: pycolmap.Reconstruction, block: syn.DemoBlock, *, distorted: bool
) -> dict[str, pycolmap.Camera]:
    """Write images and model; returns the cameras of the undistorted images."""
    model = pycolmap.Reconstruction()
    by_name = {image.name: image for image in source.images.values()}
    places: dict[tuple[int, int], int] = {}
    for number, (name, called) in enumerate(BLOCK_NAMES.items(), start=1):
        image = by_name[called]
        camera = _camera(source.camera(image.camera_id), number, distorted=distorted)
        model.add_camera_with_trivial_rig(camera)
        picture = _picture(block.images_dir / called, source.camera(image.camera_id), camera)
        path = root / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture)
        ids = [point.point3D_id for point in image.points2D if point.has_point3D()]
        pose = image.cam_from_world()
        pixels = [(i, camera.img_from_cam(pose * source.point3D(i).xyz)) for i in ids]
        keypoints = [(i, pixel) for i, pixel in pixels if pixel is not None]
        places |= {(i, number): place for place, (i, _) in enumerate(keypoints)}
        copy = pycolmap.Image(name, np.array([pixel for _, pixel in keypoints]), number, number)
        model.add_image_with_trivial_frame(copy, pose)
    for i, point in source.points3D.items():
        track = [pycolmap.TrackElement(n, places[i, n]) for n in range(1, len(NAMES) + 1) if (i, n) in places]
        if len(track) >= 2:
            model.add_point3D(point.xyz, pycolmap.Track(track), point.color)
    for folder, write in (("sparse/0", model.write_binary), ("text", model.write_text)):
        (root / folder).mkdir(parents=True)
        write(root / folder)
    cameras = {image.name: model.camera(image.camera_id) for image in model.images.values()}
    return {name: _undistorted(camera) if distorted else camera for name, camera in cameras.items()}


def _camera(taken: pycolmap.Camera, number: int, *, distorted: bool) -> pycolmap.Camera:
    if not distorted:
        params = list(taken.params)
        return pycolmap.Camera(camera_id=number, model="PINHOLE", width=_WIDTH, height=_HEIGHT, params=params)
    # Longer than the rendered camera, so that the bent picture does not look beyond the rendered one.
    params = [1.1 * taken.mean_focal_length(), _WIDTH / 2, _HEIGHT / 2, _DISTORTION]
    return pycolmap.Camera(camera_id=number, model="SIMPLE_RADIAL", width=_WIDTH, height=_HEIGHT, params=params)


def _undistorted(camera: pycolmap.Camera) -> pycolmap.Camera:
    return pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)


def _picture(path: Path, taken: pycolmap.Camera, camera: pycolmap.Camera) -> NDArray[np.uint8]:
    """What `camera` sees in the place of the camera that has taken a picture."""
    picture = cv2.imread(str(path))
    if picture is None:
        raise RuntimeError(f"{path} was not written")
    x, y = np.meshgrid(np.arange(_WIDTH) + 0.5, np.arange(_HEIGHT) + 0.5)
    rays = np.asarray(camera.cam_from_img(np.column_stack([x.ravel(), y.ravel()])), dtype=np.float64)
    pixels = np.column_stack([rays, np.ones(len(rays))]) @ np.asarray(taken.calibration_matrix()).T
    maps = (pixels[:, :2] - 0.5).astype(np.float32).reshape(_HEIGHT, _WIDTH, 2)
    bent = cv2.remap(picture, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(bent, dtype=np.uint8)
