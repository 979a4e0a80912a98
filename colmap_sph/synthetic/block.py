"""A small penta-camera block over a made-up village: pictures, COLMAP model and exact depth on disk."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from colmap_sph.errors import OptionError, OutputError
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.model import (
    SparsePoints,
    build_reconstruction,
    sample_sparse_points,
    write_reconstruction,
)
from colmap_sph.synthetic.pairs import look_at, pinhole
from colmap_sph.synthetic.primitives import FloatArray
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.render import render
from colmap_sph.synthetic.village import Village, build_village

logger = logging.getLogger(__name__)

# COLMAP's fusion takes a depth map's value at the integer (col, row), not at the pixel's centre.
TRUTH_ORIGIN = 0.0

_OBLIQUE_ANGLE = np.radians(45.0)
# Name and horizontal viewing direction, as penta-camera blocks call them.
_OBLIQUE_VIEWS = {"F": (0.0, 1.0), "B": (0.0, -1.0), "L": (-1.0, 0.0), "R": (1.0, 0.0)}
# What a building, a terrain wave or a tree may stick out of the mean ground, metres.
_RELIEF = 22.0


@dataclass(frozen=True)
class BlockOptions:
    """Size and shape of the demo block."""

    width: int = 640
    """Width of a picture in pixels."""
    height: int = 480
    """Height of a picture in pixels."""
    flying_height: float = 100.0
    """Height of the cameras above the mean ground in metres."""
    nadir_gsd: float = 0.13
    """Size of a pixel of the vertical pictures on the ground, metres."""
    oblique_gsd: float = 0.15
    """Size of a pixel in the middle of an oblique picture, across the line of sight, metres."""
    forward_overlap: float = 0.78
    """Overlap of neighbouring pictures in a strip, as a share of their width."""
    side_overlap: float = 0.60
    """Overlap of the strips, as a share of the pictures' height."""
    strips: int = 2
    """Number of strips of vertical pictures."""
    strip_images: int = 4
    """Vertical pictures in a strip."""
    oblique_images: int = 3
    """Pictures for each of the four oblique directions."""
    buildings: int = 36
    """Number of buildings (fewer where there is no room)."""
    trees: int = 100
    """Number of trees (fewer where there is no room)."""
    points: int = 5000
    """Number of sparse points, each seen in three or more pictures."""
    keypoint_noise: float = 0.3
    """Standard deviation of the keypoints about the exact projections, pixels."""
    image_noise: float = 1.5
    """Standard deviation of the sensor noise, grey levels of 255."""
    supersample: int = 2
    """Rays per pixel in each direction."""
    jpeg_quality: int = 95
    """Quality of the JPEG pictures."""
    seed: int = 1
    """Seed of everything random: the same seed gives the same block."""

    def check(self) -> None:
        """Raise OptionError naming every value out of its bounds."""
        bounds: Mapping[str, tuple[float, float]] = {
            "width": (32, 8192),
            "height": (32, 8192),
            "flying_height": (50.0, 1000.0),
            "nadir_gsd": (0.02, 1.0),
            "oblique_gsd": (0.02, 1.0),
            "forward_overlap": (0.0, 0.95),
            "side_overlap": (0.0, 0.95),
            "strips": (1, 50),
            "strip_images": (1, 50),
            "oblique_images": (0, 50),
            "buildings": (0, 200),
            "trees": (0, 500),
            "points": (10, 1_000_000),
            "keypoint_noise": (0.0, 10.0),
            "image_noise": (0.0, 50.0),
            "supersample": (1, 8),
            "jpeg_quality": (1, 100),
            "seed": (0, 2**32 - 1),
        }
        wrong = {
            name: f"{name} = {getattr(self, name)} (allowed: {low} to {high})"
            for name, (low, high) in bounds.items()
            if not low <= getattr(self, name) <= high
        }
        if wrong:
            raise OptionError("demo block options out of bounds: " + ", ".join(wrong.values()), *wrong)


@dataclass(frozen=True)
class DemoBlock:
    """A block on disk and what is known about it.

    Attributes
    ----------
    root : Path
        Holds `images/NAME.jpg`, `sparse/0` and `truth/NAME.npz`.
    names : tuple of str
        Image names, sorted.
    cameras : tuple of Camera
        One per image.
    sparse : SparsePoints
        Exact points and projections (the model's keypoints carry noise).
    village : Village
    gsd : float
        Ground sampling distance of the vertical pictures, metres.
    """

    root: Path
    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    sparse: SparsePoints
    village: Village
    gsd: float

    @property
    def images_dir(self) -> Path:
        """Folder of the pictures."""
        return self.root / "images"

    @property
    def sparse_dir(self) -> Path:
        """Folder of the COLMAP model."""
        return self.root / "sparse" / "0"

    @property
    def truth_dir(self) -> Path:
        """Folder of the exact depth and normals."""
        return self.root / "truth"

    def truth(self, name: str) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Exact depth (H, W), 0 = none, and normals (H, W, 3) of an image at COLMAP's fusion origin."""
        return read_truth(self.truth_dir / f"{name}.npz")


def read_truth(path: Path) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Read the exact depth (H, W) and normals (H, W, 3) of one image from `truth/NAME.npz`."""
    with np.load(path) as arrays:
        return arrays["depth"], arrays["normals"].astype(np.float32)


def demo_cameras(options: BlockOptions) -> dict[str, Camera]:
    """Cameras by image name: N_strip_number vertical, F/B/L/R_number oblique at 45 degrees.

    The oblique stations stand off from the block's middle so that their axes meet the ground there.
    """
    size = (options.width, options.height)
    up_north = (0.0, 1.0, 0.0)
    nadir = pinhole(options.flying_height / options.nadir_gsd, *size)
    base = options.width * options.nadir_gsd * (1 - options.forward_overlap)
    strip_base = options.height * options.nadir_gsd * (1 - options.side_overlap)
    cameras = {}
    for strip in range(options.strips):
        for number in range(options.strip_images):
            x = (number - (options.strip_images - 1) / 2) * base
            y = (strip - (options.strips - 1) / 2) * strip_base
            R, t = look_at((x, y, options.flying_height), (x, y, 0.0), up_north)
            cameras[f"N_{strip}_{number}.jpg"] = Camera(nadir, R, t, *size)
    distance = options.flying_height / np.cos(_OBLIQUE_ANGLE)
    oblique = pinhole(distance / options.oblique_gsd, *size)
    base = options.width * options.oblique_gsd * (1 - options.forward_overlap)
    stand_off = options.flying_height * np.tan(_OBLIQUE_ANGLE)
    for view, direction in _OBLIQUE_VIEWS.items():
        forward = np.array([*direction, 0.0])
        across = np.array([direction[1], -direction[0], 0.0])
        for number in range(options.oblique_images):
            target = (number - (options.oblique_images - 1) / 2) * base * across
            eye = target - stand_off * forward + [0.0, 0.0, options.flying_height]
            R, t = look_at(eye, target)
            cameras[f"{view}_{number}.jpg"] = Camera(oblique, R, t, *size)
    return dict(sorted(cameras.items()))


def _ground_corners(cameras: Mapping[str, Camera]) -> FloatArray:
    """Corners of the ground that the pictures show, at the lowest and highest level of the scene."""
    corners = []
    for camera in cameras.values():
        image = np.array([[0, 0], [0, camera.height], [camera.width, 0], [camera.width, camera.height]], float)
        far = camera.back_project(image, np.ones(4)) - camera.centre
        for level in (-_RELIEF / 2, _RELIEF):
            reach = (level - camera.centre[2]) / np.minimum(far[:, 2], -0.05)
            corners.append(camera.centre + reach[:, None] * far)
    return np.concatenate(corners)


def _write_view(
    root: Path, name: str, camera: Camera, village: Village, light: Light, options: BlockOptions, number: int
) -> npt.NDArray[np.uint8]:
    """Render one picture and write it and its truth; returns the RGB picture."""
    rendering = render(
        village.surfaces,
        camera.K,
        camera.R,
        camera.t,
        camera.width,
        camera.height,
        origin=TRUTH_ORIGIN,
        supersample=options.supersample,
        light=light,
        noise=options.image_noise,
        seed=(options.seed, number),
    )
    path = root / "images" / name
    quality = [cv2.IMWRITE_JPEG_QUALITY, options.jpeg_quality]
    if not cv2.imwrite(str(path), np.ascontiguousarray(rendering.image[..., ::-1]), quality):
        raise OutputError(f"cannot write {path}: check the disk space and the folder's permissions")
    # Half precision keeps a unit vector to 0.03 degrees in half the space.
    np.savez(
        root / "truth" / f"{name}.npz",
        depth=rendering.depth.astype(np.float32),
        normals=rendering.normals.astype(np.float16),
    )
    return rendering.image


def _write_views(
    root: Path,
    cameras: Mapping[str, Camera],
    village: Village,
    options: BlockOptions,
    threads: int,
    progress: Callable[[int, int], None] | None,
) -> list[npt.NDArray[np.uint8]]:
    """Render and write all pictures in a pool of threads; returns them in the order of the cameras."""
    sun = Light().sun
    shadows = ShadowMap.cast(village.surfaces, sun, _ground_corners(cameras), options.nadir_gsd)
    light = Light(sun, shadows=shadows)
    pictures = []
    with ThreadPoolExecutor(threads) as pool:
        jobs = [
            pool.submit(_write_view, root, name, camera, village, light, options, number)
            for number, (name, camera) in enumerate(cameras.items())
        ]
        try:
            for done, job in enumerate(jobs, start=1):
                pictures.append(job.result())
                if progress is not None:
                    progress(done, len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return pictures


def _point_colours(sparse: SparsePoints, pictures: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """RGB of every point in the last picture that shows it."""
    colours = np.zeros((len(sparse.points), 3), dtype=np.uint8)
    for picture, places, rows in zip(pictures, sparse.observations, sparse.point_indices, strict=True):
        column, row = np.floor(places).astype(np.int64).T
        colours[rows] = picture[row, column]
    return colours


def make_demo_block(
    output: Path,
    options: BlockOptions | None = None,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> DemoBlock:
    """Render the demo block and write it to disk.

    Parameters
    ----------
    output : Path
        Folder for `images`, `sparse/0` and `truth`; files of the same names are replaced.
    options : BlockOptions, optional
    threads : int
        Pictures rendered at once; the result does not depend on it.
    progress : callable, optional
        Called with (finished pictures, all pictures) after every picture, from this thread.

    Returns
    -------
    DemoBlock

    Raises
    ------
    OptionError
        If an option is out of its bounds.
    OutputError
        If something cannot be written.
    """
    options = options or BlockOptions()
    options.check()
    if threads < 1:
        raise OptionError(f"threads = {threads} (allowed: 1 or more)")
    cameras = demo_cameras(options)
    names = tuple(cameras)
    try:
        for folder in ("images", "truth"):
            (output / folder).mkdir(parents=True, exist_ok=True)
        village = build_village(options.nadir_gsd, options.buildings, options.trees, options.seed)
        pictures = _write_views(output, cameras, village, options, threads, progress)
    except OSError as error:
        raise OutputError(f"cannot write the demo block to {output}: {error}") from error
    rng = np.random.default_rng((options.seed, len(names)))
    sparse = sample_sparse_points(village.surfaces, tuple(cameras.values()), options.points, rng)
    model = build_reconstruction(
        names,
        tuple(cameras.values()),
        sparse,
        colours=_point_colours(sparse, pictures),
        keypoint_noise=options.keypoint_noise,
        rng=rng,
    )
    block = DemoBlock(output, names, tuple(cameras.values()), sparse, village, options.nadir_gsd)
    write_reconstruction(model, block.sparse_dir)
    logger.info("demo block: %d pictures, %d points in %s", len(names), len(sparse.points), output)
    return block
