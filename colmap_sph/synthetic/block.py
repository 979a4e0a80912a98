"""A small penta-camera block over a made-up village: pictures, COLMAP model and exact depth on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_sph.errors import OptionError
from colmap_sph.synthetic.capture import Capture, CaptureOptions, Progress, write_capture
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.pairs import look_at, pinhole
from colmap_sph.synthetic.primitives import FloatArray
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.village import Village, build_village

_OBLIQUE_ANGLE = np.radians(45.0)
# Name and horizontal viewing direction, as penta-camera blocks call them.
_OBLIQUE_VIEWS = {"F": (0.0, 1.0), "B": (0.0, -1.0), "L": (-1.0, 0.0), "R": (1.0, 0.0)}
# What a building, a terrain wave or a tree may stick out of the mean ground, metres.
_RELIEF = 22.0


@dataclass(frozen=True)
class BlockOptions(CaptureOptions):
    """Size and shape of the demo block."""

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

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """As `CaptureOptions.bounds`."""
        return {
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
            **super().bounds(),
        }


@dataclass(frozen=True)
class DemoBlock(Capture):
    """A block on disk and what is known about it; its GSD is that of the vertical pictures.

    Attributes
    ----------
    village : Village
    """

    village: Village


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


def ground_corners(cameras: Mapping[str, Camera], relief: float) -> FloatArray:
    """Corners (M, 3) of the ground that the pictures show, at the lowest and highest level of the scene.

    It rises by `relief` metres above the mean ground, and falls by half of it below.
    """
    corners = []
    for camera in cameras.values():
        image = np.array([[0, 0], [0, camera.height], [camera.width, 0], [camera.width, camera.height]], float)
        far = camera.back_project(image, np.ones(4)) - camera.centre
        for level in (-relief / 2, relief):
            reach = (level - camera.centre[2]) / np.minimum(far[:, 2], -0.05)
            corners.append(camera.centre + reach[:, None] * far)
    return np.concatenate(corners)


def make_demo_block(
    output: Path,
    options: BlockOptions | None = None,
    *,
    threads: int = 1,
    progress: Progress | None = None,
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
    village = build_village(options.nadir_gsd, options.buildings, options.trees, options.seed)
    sun = Light().sun
    shadows = ShadowMap.cast(village.surfaces, sun, ground_corners(cameras, _RELIEF), options.nadir_gsd)
    capture = write_capture(
        output,
        cameras,
        village.surfaces,
        Light(sun, shadows=shadows),
        options,
        gsd=options.nadir_gsd,
        threads=threads,
        progress=progress,
    )
    return DemoBlock(**vars(capture), village=village)
