"""Pictures of a scene, their COLMAP model and their exact depth, written to disk."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from colmap_sph.errors import OptionError, OutputError, unwritable
from colmap_sph.synthetic.light import Light
from colmap_sph.synthetic.model import (
    MAX_INCIDENCE,
    SparsePoints,
    build_reconstruction,
    sample_sparse_points,
    write_reconstruction,
)
from colmap_sph.synthetic.photographs.imperfections import Imperfections
from colmap_sph.synthetic.photographs.moving_things import moving_things
from colmap_sph.synthetic.photographs.photograph import photograph
from colmap_sph.synthetic.photographs.real_camera import real_camera
from colmap_sph.synthetic.photographs.structure_from_motion import disturb
from colmap_sph.synthetic.primitives import Surface
from colmap_sph.synthetic.rays import Camera

logger = logging.getLogger(__name__)

# COLMAP's fusion takes a depth map's value at the integer (col, row), not at the pixel's centre.
TRUTH_ORIGIN = 0.0

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class CaptureOptions:
    """How pictures are taken and their model is made, whatever the scene."""

    width: int = 640
    """Width of a picture in pixels."""
    height: int = 480
    """Height of a picture in pixels."""
    points: int = 5000
    """Number of sparse points, each seen in three or more pictures."""
    max_incidence: float = MAX_INCIDENCE
    """Points are found up to this angle between ray and surface normal, degrees."""
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
    effects: Imperfections = field(default_factory=Imperfections)
    """What camera and world do to the pictures."""

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """Least and largest value of every number."""
        return {
            "width": (32, 8192),
            "height": (32, 8192),
            "points": (10, 1_000_000),
            "max_incidence": (10.0, 89.0),
            "keypoint_noise": (0.0, 10.0),
            "image_noise": (0.0, 50.0),
            "supersample": (1, 8),
            "jpeg_quality": (1, 100),
            "seed": (0, 2**32 - 1),
        }

    def check(self) -> None:
        """Raise OptionError naming every value out of its bounds."""
        wrong = {}
        for record, bounds in ((self, self.bounds()), (self.effects, self.effects.bounds())):
            for name, (low, high) in bounds.items():
                value = getattr(record, name)
                if not low <= value <= high:
                    wrong[name] = f"{name} = {value} (allowed: {low} to {high})"
        if wrong:
            raise OptionError("demo block options out of bounds: " + ", ".join(wrong.values()), *wrong)


@dataclass(frozen=True)
class Capture:
    """Pictures on disk and what is known about them.

    Attributes
    ----------
    root : Path
        Holds `images/NAME.jpg`, `sparse/0` and `truth/NAME.npz`.
    names : tuple of str
        Image names, sorted.
    cameras : tuple of Camera
        One per image, as they really are.
    sparse : SparsePoints
        Exact points and projections (the model's keypoints carry noise).
    surfaces : tuple of Surface
        All that stands still.
    gsd : float
        Ground sampling distance, metres.
    """

    root: Path
    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    sparse: SparsePoints
    surfaces: tuple[Surface, ...]
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


def write_capture(
    output: Path,
    cameras: Mapping[str, Camera],
    surfaces: Sequence[Surface],
    light: Light,
    options: CaptureOptions,
    *,
    gsd: float,
    blank: Collection[int] = (),
    threads: int = 1,
    progress: Progress | None = None,
) -> Capture:
    """Take pictures of a scene, write them, their exact depth and their model.

    Parameters
    ----------
    output : Path
        Folder for `images`, `sparse/0` and `truth`; files of the same names are replaced.
    cameras : mapping of str to Camera
        By image name, sorted.
    surfaces : sequence of Surface
    light : Light
    options : CaptureOptions
    gsd : float
        Ground sampling distance, metres.
    blank : collection of int
        Numbers of surfaces without texture, on which no sparse point can be.
    threads : int
        Pictures rendered at once; the result does not depend on it.
    progress : callable, optional
        Called with (finished pictures, all pictures) after every picture, from this thread.

    Returns
    -------
    Capture

    Raises
    ------
    OutputError
        If something cannot be written.
    """
    names = tuple(cameras)
    real = tuple(
        real_camera(camera, options.effects, options.seed, number)
        for number, camera in enumerate(cameras.values())
    )
    moving = [
        moving_things(surfaces, camera, options.effects.moving, gsd=gsd, seed=options.seed, number=number)
        for number, camera in enumerate(cameras.values())
    ]
    try:
        for folder in ("images", "truth"):
            (output / folder).mkdir(parents=True, exist_ok=True)
        jobs = [
            partial(_write_view, output, name, camera, (*surfaces, *before), light, options, number)
            for number, (name, camera, before) in enumerate(zip(names, real, moving, strict=True))
        ]
        pictures = _in_threads(jobs, threads, progress)
    except OSError as error:
        raise OutputError(f"cannot write the demo block to {output}: {error}") from error
    rng = np.random.default_rng((options.seed, len(names)))
    sparse = sample_sparse_points(
        surfaces, real, options.points, rng, max_incidence=options.max_incidence, blank=blank, moving=moving
    )
    model = build_reconstruction(
        names,
        real,
        sparse,
        colours=_point_colours(sparse, pictures),
        keypoint_noise=options.keypoint_noise,
        rng=rng,
    )
    disturb(model, options.effects, options.seed)
    capture = Capture(output, names, real, sparse, tuple(surfaces), gsd)
    write_reconstruction(model, capture.sparse_dir)
    logger.info("demo block: %d pictures, %d points in %s", len(names), len(sparse.points), output)
    return capture


def _in_threads(
    jobs: Sequence[Callable[[], npt.NDArray[np.uint8]]], threads: int, progress: Progress | None
) -> list[npt.NDArray[np.uint8]]:
    """Results of all jobs, in their order."""
    results = []
    with ThreadPoolExecutor(threads) as pool:
        running = [pool.submit(job) for job in jobs]
        try:
            for done, job in enumerate(running, start=1):
                results.append(job.result())
                if progress is not None:
                    progress(done, len(jobs))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return results


def _write_view(
    root: Path,
    name: str,
    camera: Camera,
    surfaces: Sequence[Surface],
    light: Light,
    options: CaptureOptions,
    number: int,
) -> npt.NDArray[np.uint8]:
    """Render one picture and write it and its truth; returns the RGB picture."""
    rendering = photograph(
        surfaces,
        camera,
        options.effects,
        origin=TRUTH_ORIGIN,
        supersample=options.supersample,
        light=light,
        read_noise=options.image_noise,
        seed=options.seed,
        number=number,
    )
    write_picture(root / "images" / name, rendering.image, options.jpeg_quality)
    # Half precision keeps a unit vector to 0.03 degrees in half the space.
    np.savez(
        root / "truth" / f"{name}.npz",
        depth=rendering.depth.astype(np.float32),
        normals=rendering.normals.astype(np.float16),
    )
    return rendering.image


def write_picture(path: Path, picture: npt.NDArray[np.uint8], *quality: int) -> None:
    """Write an RGB picture, as JPEG of a quality or as PNG; `OutputError` where that is impossible."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, *quality] if quality else []
    # Not by OpenCV's own function of files, which on Windows knows names in one alphabet only.
    encoded = cv2.imencode(path.suffix, np.ascontiguousarray(picture[..., ::-1]), flags)[1]
    try:
        path.write_bytes(encoded.tobytes())
    except OSError as error:
        raise unwritable(path, error) from error


def _point_colours(sparse: SparsePoints, pictures: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """RGB of every point in the last picture that shows it."""
    colours = np.zeros((len(sparse.points), 3), dtype=np.uint8)
    for picture, places, rows in zip(pictures, sparse.observations, sparse.point_indices, strict=True):
        column, row = np.floor(places).astype(np.int64).T
        colours[rows] = picture[row, column]
    return colours
