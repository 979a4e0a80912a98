"""A convergent oblique block over a made-up town of tall buildings: pictures, model and exact depth on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_sph.synthetic.block import ground_corners
from colmap_sph.synthetic.capture import Capture, CaptureOptions, write_capture
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.pairs import look_at, pinhole
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.village import build_village

_TILT = np.radians(45.0)
_NORTH = (0.0, 1.0, 0.0)
# Standard deviation of the angles by which an aircraft's attitude is off, radians.
_ATTITUDE = np.radians(2.0)
# How many times the storeys of a village, and what they may rise above the ground with their roofs, metres.
_STOREYS = 3
_RELIEF = 45.0


@dataclass(frozen=True)
class TownOptions(CaptureOptions):
    """Vertical pictures, and oblique ones from all around that converge; about 45 metres of relief."""

    flying_height: float = 120.0
    """Height of the cameras above the mean ground in metres."""
    nadir_gsd: float = 0.15
    """Size of a pixel of the vertical pictures on the ground, metres."""
    oblique_gsd: float = 0.17
    """Size of a pixel in the middle of an oblique picture, across the line of sight, metres."""
    overlap: float = 0.8
    """Overlap of neighbouring pictures of one direction, as a share of their width or height."""
    strips: int = 2
    """Number of strips of vertical pictures."""
    strip_images: int = 3
    """Vertical pictures in a strip."""
    directions: int = 12
    """Number of oblique directions: with 12, neighbours differ by 21 degrees, the next by 41 and 60."""
    direction_images: int = 2
    """Pictures for each of them."""
    buildings: int = 40
    """Number of buildings (fewer where there is no room)."""
    trees: int = 60
    """Number of trees (fewer where there is no room)."""

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """As `CaptureOptions.bounds`."""
        return {
            "flying_height": (80.0, 1000.0),
            "nadir_gsd": (0.02, 2.0),
            "oblique_gsd": (0.02, 2.0),
            "overlap": (0.0, 0.95),
            "strips": (1, 50),
            "strip_images": (1, 50),
            "directions": (0, 72),
            "direction_images": (1, 50),
            "buildings": (0, 200),
            "trees": (0, 500),
            **super().bounds(),
        }


def town_cameras(options: TownOptions) -> dict[str, Camera]:
    """Cameras by image name: N_strip_number vertical, O_direction_number oblique at 45 degrees.

    The axes of the oblique ones meet the ground in a row through the block's middle, across their direction.
    """
    size = (options.width, options.height)
    rng = np.random.default_rng((options.seed, 53))
    height = options.flying_height
    cameras = {}
    nadir = pinhole(height / options.nadir_gsd, *size)
    spacing = np.array(size) * options.nadir_gsd * (1 - options.overlap)
    for strip in range(options.strips):
        for number in range(options.strip_images):
            place = ([number, strip] - (np.array([options.strip_images, options.strips]) - 1) / 2) * spacing
            aim = place + height * _ATTITUDE * rng.standard_normal(2)
            R, t = look_at((*place, height), (*aim, 0.0), _NORTH)
            cameras[f"N_{strip}_{number}.jpg"] = Camera(nadir, R, t, *size)
    distance = height / np.cos(_TILT)
    oblique = pinhole(distance / options.oblique_gsd, *size)
    base = options.width * options.oblique_gsd * (1 - options.overlap)
    for direction in range(options.directions):
        for number in range(options.direction_images):
            heading = 2 * np.pi * direction / options.directions + _ATTITUDE * rng.standard_normal()
            tilt = _TILT + _ATTITUDE * rng.standard_normal()
            forward = np.array([np.sin(heading), np.cos(heading), 0.0])
            across = np.array([forward[1], -forward[0], 0.0])
            target = (number - (options.direction_images - 1) / 2) * base * across
            eye = target - height * np.tan(tilt) * forward + [0.0, 0.0, height]
            R, t = look_at(eye, target)
            cameras[f"O_{direction:02}_{number}.jpg"] = Camera(oblique, R, t, *size)
    return dict(sorted(cameras.items()))


def make_town_block(output: Path, options: TownOptions | None = None, *, threads: int = 1) -> Capture:
    """Render the town and write it to disk; see `make_demo_block`."""
    options = options or TownOptions()
    options.check()
    cameras = town_cameras(options)
    town = build_village(options.nadir_gsd, options.buildings, options.trees, options.seed, storeys=_STOREYS)
    sun = Light().sun
    shadows = ShadowMap.cast(town.surfaces, sun, ground_corners(cameras, _RELIEF), options.nadir_gsd)
    return write_capture(
        output,
        cameras,
        town.surfaces,
        Light(sun, shadows=shadows),
        options,
        gsd=options.nadir_gsd,
        threads=threads,
    )
