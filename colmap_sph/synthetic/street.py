"""A row of houses against the sky, seen from the other side of a street: pictures, model, exact depth on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_sph.synthetic.capture import Capture, CaptureOptions, write_capture
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.pairs import look_at, pinhole
from colmap_sph.synthetic.primitives import ConvexPolyhedron, Ellipsoid, FloatArray, Plane, Surface
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.solids import box, gabled_house
from colmap_sph.synthetic.texture import Facade, Mottled, Noise, RoofTiles

BLANK_HOUSE = 1
"""Number, among the street's surfaces, of the house whose walls have no texture."""

# The houses' fronts stand about at y = 0, the cameras at negative y; metres.
_DISTANCE = 26.0
_HALF_ANGLE = np.radians(32.0)
_HEIGHTS = (2.2, 8.0)
_AIM = 4.6
_GROUND = 60.0
# Focal length over the picture's width.
_FOCAL = 0.9
# x, length, height of the eaves, of the ridge, offset of the texture.
_HOUSES = ((-17.0, 10.0, 6.6, 10.2, 3.0), (-5.5, 9.0, 5.2, 9.0, 17.0), (17.5, 11.0, 6.0, 9.6, 29.0))
_BLANK_SIZE = (8.0, 7.0, 7.5)
_BLANK_PLACE = (5.6, 4.0, 0.0)


@dataclass(frozen=True)
class StreetOptions(CaptureOptions):
    """How many pictures of the street are taken, and what its blank house is like."""

    images: int = 12
    """Number of pictures: two rows on an arc before the houses."""
    blank_contrast: float = 0.0
    """Contrast of the texture on the walls of one house, 0 (none) to 1; that of other things is about 0.15."""

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """As `CaptureOptions.bounds`."""
        return {"images": (2, 1000), "blank_contrast": (0.0, 1.0), **super().bounds()}


def street_gsd(options: StreetOptions) -> float:
    """Size of a pixel on the houses' fronts, seen from the middle of the arc, metres."""
    return _DISTANCE / (_FOCAL * options.width)


def street_cameras(options: StreetOptions) -> dict[str, Camera]:
    """Cameras by image name, S_row_number: two rows on an arc about the houses, towards its middle."""
    K = pinhole(_FOCAL * options.width, options.width, options.height)
    lower = (options.images + 1) // 2
    cameras = {}
    for row, count in enumerate((lower, options.images - lower)):
        angles = np.linspace(-1, 1, count) * _HALF_ANGLE if count > 1 else [0.0]
        for number, angle in enumerate(angles):
            eye = (_DISTANCE * np.sin(angle), -_DISTANCE * np.cos(angle), _HEIGHTS[row])
            # Half of the turn: each sees another part of the row.
            R, t = look_at(eye, (0.35 * eye[0], 0.0, _AIM))
            cameras[f"S_{row}_{number:02}.jpg"] = Camera(K, R, t, options.width, options.height)
    return cameras


def build_street(gsd: float, seed: int, blank_contrast: float = 0.0) -> tuple[Surface, ...]:
    """Lay out the scene.

    Parameters
    ----------
    gsd : float
        Ground sampling distance in metres that the texture is made for.
    seed : int
        The same seed gives the same street.
    blank_contrast : float
        See `StreetOptions`.

    Returns
    -------
    tuple of Surface
        The ground, the house without texture (`BLANK_HOUSE`), all others.
    """
    rng = np.random.default_rng((seed, 31))
    noise = Noise(gsd, seed)
    ground = Plane((0, 0, 0), (0, 0, 1), Mottled(noise, (0.50, 0.49, 0.45), 0.16), (_GROUND, _GROUND))
    plain = Mottled(noise, (0.80, 0.79, 0.76), blank_contrast)
    surfaces: list[Surface] = [ground, box(_BLANK_PLACE, _BLANK_SIZE, (plain,))]
    for x, length, eaves, ridge, offset in _HOUSES:
        surfaces.append(_house(noise, x, length, eaves, ridge, offset))
    surfaces += _greenery(noise, rng)
    surfaces += _posts(noise)
    return tuple(surfaces)


def make_street_block(output: Path, options: StreetOptions | None = None, *, threads: int = 1) -> Capture:
    """Render the street and write it to disk; see `make_demo_block`."""
    options = options or StreetOptions()
    options.check()
    gsd = street_gsd(options)
    surfaces = build_street(gsd, options.seed, options.blank_contrast)
    extent = np.array([[x, y, z] for x in (-45.0, 45.0) for y in (-30.0, 40.0) for z in (0.0, 12.0)])
    sun = (-0.45, -0.75, 0.85)
    light = Light(sun, shadows=ShadowMap.cast(surfaces[1:], sun, extent, 2 * gsd))
    cameras = street_cameras(options)
    return write_capture(
        output,
        cameras,
        surfaces,
        light,
        options,
        gsd=gsd,
        blank=(BLANK_HOUSE,) if options.blank_contrast == 0 else (),
        threads=threads,
    )


def _house(noise: Noise, x: float, length: float, eaves: float, ridge: float, offset: float) -> ConvexPolyhedron:
    colour = (0.84, 0.76 - 0.004 * offset, 0.62)
    front = Facade(noise, colour, eaves, length, (offset, 2 * offset))
    gable = Facade(noise, colour, eaves, 8.0, (2 * offset, offset))
    roof = RoofTiles(noise, (0.60, 0.34, 0.27), (offset, offset))
    return gabled_house((x, 4.0, 0.0), (length, 8.0, eaves), ridge, (gable, gable, front, front, roof))


def _greenery(noise: Noise, rng: np.random.Generator) -> list[Surface]:
    """Trees behind the houses and beside them, bushes and stems before them."""
    parts: list[Surface] = []
    for x, y, radius in (
        (-27.0, 3.0, 3.2),
        (-11.2, 12.0, 3.6),
        (0.0, 14.0, 4.2),
        (11.0, 11.0, 3.4),
        (27.0, 6.0, 3.6),
    ):
        stem = Mottled(noise, (0.36, 0.30, 0.24), 0.2, (x, y))
        parts.append(box((x, y, 0.0), (0.5, 0.5, 1.6 * radius), (stem,)))
        for _ in range(7):
            shift = rng.uniform(-0.6, 0.6, 3) * radius
            leaves = Mottled(noise, (0.31, 0.43, 0.20), 0.27, (x + shift[0], y), stretch=1.3)
            radii = np.full(3, radius * rng.uniform(0.45, 0.7))
            parts.append(Ellipsoid(np.array([x, y, 2.0 * radius]) + shift, radii, leaves))
    for number in range(9):
        centre = np.array([-20.0 + 5.0 * number, -3.5 + rng.uniform(-1, 1), 0.45])
        leaves = Mottled(noise, (0.33, 0.45, 0.21), 0.27, (number, 0.0), stretch=1.3)
        parts.append(Ellipsoid(centre, np.full(3, rng.uniform(0.45, 0.9)), leaves))
    return parts


def _posts(noise: Noise) -> list[Surface]:
    """Thin posts at the kerb that reach into the sky."""
    metal = Mottled(noise, (0.30, 0.31, 0.32), 0.12)
    places: list[FloatArray] = [np.array([x, -5.0, 0.0]) for x in (-14.0, -2.0, 10.5)]
    return [box(place, (0.16, 0.16, 10.5), (metal,)) for place in places]
