"""A street between two rows of houses, seen along it by who walks or drives: pictures, model, exact depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_sph.synthetic.capture import Capture, CaptureOptions, write_capture
from colmap_sph.synthetic.ground import Road, paint_ground
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.pairs import look_at, pinhole
from colmap_sph.synthetic.primitives import Ellipsoid, Plane, Surface
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.solids import box, gabled_house
from colmap_sph.synthetic.texture import Colour, Facade, Mottled, Noise, RoofTiles

# x is across the street, y along it, z up; metres. The cameras go along y from 0.
_LANE = 1.4
_EYE = 1.65
_CARRIAGEWAY = 11.4
_KERB = 0.14
_FRONTS = 8.6
_BEHIND = 12.0
_AHEAD = 75.0
# Distance at which a pixel is as large as the texture is fine, and the focal length over the picture's width.
_DISTANCE = 10.0
_FOCAL = 0.75
# The way weaves: metres to both sides, metres of a period; and whoever holds the camera looks about, radians.
_WEAVE = (0.25, 9.7)
_GLANCE = np.radians(3.0)

_PLASTER: tuple[Colour, ...] = (
    (0.84, 0.79, 0.70),
    (0.77, 0.66, 0.55),
    (0.72, 0.73, 0.72),
    (0.81, 0.70, 0.56),
    (0.66, 0.50, 0.43),
)
_PAINTWORK: tuple[Colour, ...] = ((0.70, 0.17, 0.15), (0.80, 0.80, 0.79), (0.24, 0.33, 0.50), (0.42, 0.44, 0.46))


@dataclass(frozen=True)
class CanyonOptions(CaptureOptions):
    """How the street is passed: on foot a picture every metre, in a car one every three."""

    images: int = 14
    """Number of pictures."""
    step: float = 1.0
    """Way between two pictures, metres: about 1 walking, 3 driving."""
    max_incidence: float = 83.0
    """As for others; all pictures see the road at the same grazing angle, so its points are found, too."""

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """As `CaptureOptions.bounds`."""
        return {"images": (2, 1000), "step": (0.05, 20.0), **super().bounds()}


def canyon_gsd(options: CanyonOptions) -> float:
    """Size of a pixel ten metres ahead, metres."""
    return _DISTANCE / (_FOCAL * options.width)


def canyon_cameras(options: CanyonOptions) -> dict[str, Camera]:
    """Cameras by image name, C_number: along the street, each epipole of neighbours inside the picture."""
    K = pinhole(_FOCAL * options.width, options.width, options.height)
    width, period = _WEAVE
    cameras = {}
    for number in range(options.images):
        way = number * options.step
        phase = 2 * np.pi * way / period
        eye = np.array([_LANE + width * np.sin(phase), way, _EYE + 0.04 * np.cos(1.7 * phase)])
        yaw = _GLANCE * np.sin(2.3 * number)
        pitch = 0.02 + 0.01 * np.cos(1.9 * number)
        R, t = look_at(eye, eye + np.array([np.sin(yaw), np.cos(yaw), np.tan(pitch)]))
        cameras[f"C_{number:03}.jpg"] = Camera(K, R, t, options.width, options.height)
    return cameras


def build_canyon(gsd: float, way: float, seed: int) -> tuple[Surface, ...]:
    """Lay out the scene.

    Parameters
    ----------
    gsd : float
        Ground sampling distance in metres that the texture is made for.
    way : float
        Metres from the first camera to the last.
    seed : int
        The same seed gives the same street.

    Returns
    -------
    tuple of Surface
        The carriageway first.
    """
    rng = np.random.default_rng((seed, 47))
    noise = Noise(gsd, seed, tile=2048)
    start, end = -_BEHIND, way + _AHEAD
    surfaces: list[Surface] = [_carriageway(noise, start, end, rng), *_patches(noise, start, end, rng)]
    for side in (-1.0, 1.0):
        surfaces.append(_footway(noise, side, start, end))
        surfaces += _houses(noise, side, start, end, rng)
        surfaces += _parked_cars(noise, side, start, end, rng)
        surfaces += _trees_and_lamps(noise, side, start, end, rng)
    surfaces += _across(noise, end)
    return tuple(surfaces)


def make_canyon_block(output: Path, options: CanyonOptions | None = None, *, threads: int = 1) -> Capture:
    """Render the street and write it to disk; see `make_demo_block`."""
    options = options or CanyonOptions()
    options.check()
    gsd = canyon_gsd(options)
    way = (options.images - 1) * options.step
    surfaces = build_canyon(gsd, way, options.seed)
    ends = (-_BEHIND, way + _AHEAD + 1.0)
    extent = np.array([[x, y, z] for x in (-11.0, 11.0) for y in ends for z in (0.0, 20.0)])
    sun = (-0.55, -0.50, 1.0)
    light = Light(sun, shadows=ShadowMap.cast(surfaces[1:], sun, extent, max(2 * gsd, 0.04)))
    return write_capture(output, canyon_cameras(options), surfaces, light, options, gsd=gsd, threads=threads)


def _carriageway(noise: Noise, start: float, end: float, rng: np.random.Generator) -> Plane:
    middle = np.arange(start - 20.0, end + 20.0, 0.5)
    road = Road(np.column_stack([np.zeros_like(middle), middle]), _CARRIAGEWAY)
    asphalt = paint_ground((-16.0, start - 20.0, 16.0, end + 20.0), noise, [], [road], rng)
    # Who goes straight on must not meet the same noise again.
    return Plane((0, 0, 0), (0, 0, 1), replace(asphalt, turn=0.6), (60.0, end + 40.0))


def _patches(noise: Noise, start: float, end: float, rng: np.random.Generator) -> list[Surface]:
    """Mended places in the asphalt, and covers."""
    parts: list[Surface] = []
    for y in np.arange(start, end, 4.5):
        x = rng.uniform(-3.2, 3.2)
        shade = rng.uniform(0.22, 0.52)
        tar = Mottled(noise, (shade, shade, shade), 0.22, (x, y))
        size = (rng.uniform(0.5, 1.6), rng.uniform(0.5, 3.0), 0.004)
        parts.append(box((x, y + rng.uniform(0, 3), 0.0), size, (tar,), rng.normal(0, 0.05)))
    return parts


def _footway(noise: Noise, side: float, start: float, end: float) -> Surface:
    width = _FRONTS - _CARRIAGEWAY / 2 + 1.0
    middle = side * (_CARRIAGEWAY / 2 + width / 2)
    kerb = Mottled(noise, (0.62, 0.61, 0.58), 0.14)
    slabs = RoofTiles(noise, (0.60, 0.58, 0.55), (side, side), tile=0.5)
    size = (width, end - start, _KERB)
    return box((middle, (start + end) / 2, 0.0), size, (kerb, kerb, kerb, kerb, slabs))


def _houses(noise: Noise, side: float, start: float, end: float, rng: np.random.Generator) -> list[Surface]:
    """A closed row, each house a little nearer to the street or farther from it."""
    parts: list[Surface] = []
    y = start
    while y < end:
        length = min(rng.uniform(8.0, 14.0), max(end - y, 4.0))
        parts += _house(noise, side, y + length / 2, length, rng)
        y += length
    return parts


def _house(noise: Noise, side: float, y: float, length: float, rng: np.random.Generator) -> list[Surface]:
    """Walls and roof with plinth, cornice, pilasters, and a bay or balconies."""
    front = _FRONTS + rng.uniform(0.0, 0.6)
    storeys = int(rng.integers(2, 5))
    height = 3.0 * storeys + 0.7
    offset = (float(rng.uniform(0, 60)), float(rng.uniform(0, 60)))
    wall = Facade(noise, _PLASTER[rng.integers(len(_PLASTER))], height, length, offset)
    stone = Mottled(noise, (0.66, 0.62, 0.55), 0.16, offset)
    tiles = RoofTiles(noise, (0.56, 0.33, 0.26), offset)
    # The ridge runs along the street: the solid's length is along y.
    house = gabled_house(
        (side * (front + 5.0), y, 0.0), (length, 10.0, height), height + 3.5, (wall,) * 4 + (tiles,), np.pi / 2
    )

    def before(y_shift: float, foot: float, depth: float, width: float, rise: float, cover: Mottled) -> Surface:
        """A box that stands out of the front by its depth."""
        return box((side * (front - depth / 2 + 0.05), y + y_shift, foot), (depth + 0.1, width, rise), (cover,))

    parts: list[Surface] = [house, before(0.0, height - 0.45, 0.4, length, 0.4, stone)]
    parts.append(before(0.0, 0.0, 0.08, length, 0.9, stone))
    parts += [before(edge * (length / 2 - 0.3), 0.0, 0.16, 0.6, height - 0.4, stone) for edge in (-1, 1)]
    parts.append(before(rng.uniform(-0.3, 0.3) * length, 0.0, 0.9, 1.5, 0.5, stone))
    if rng.random() < 0.5:
        bay = Mottled(noise, (0.74, 0.70, 0.64), 0.15, offset)
        parts.append(before(rng.uniform(-0.25, 0.25) * length, 3.1, 0.8, 2.4, height - 4.2, bay))
    else:
        metal = Mottled(noise, (0.38, 0.38, 0.40), 0.20, offset)
        place = rng.uniform(-0.25, 0.25) * length
        parts += [before(place, 3.0 * storey + 0.1, 1.0, 2.6, 1.0, metal) for storey in range(1, storeys)]
    return parts


def _parked_cars(noise: Noise, side: float, start: float, end: float, rng: np.random.Generator) -> list[Surface]:
    """Cars at the kerb with gaps between them, each a body and a cabin."""
    parts: list[Surface] = []
    for y in np.arange(start, end, 6.0):
        if rng.random() < 0.25:
            continue
        place = (side * (_CARRIAGEWAY / 2 - 1.15 + rng.normal(0, 0.08)), y + rng.uniform(-0.5, 0.5))
        yaw = np.pi / 2 + rng.normal(0, 0.02)
        offset = (float(rng.uniform(0, 60)), 0.0)
        paint = Mottled(noise, _PAINTWORK[rng.integers(len(_PAINTWORK))], 0.09, offset)
        glass = Mottled(noise, (0.20, 0.23, 0.27), 0.16, offset)
        parts.append(box((*place, 0.2), (4.3, 1.8, 0.7), (paint,), yaw))
        parts.append(box((*place, 0.9), (2.3, 1.6, 0.6), (glass, glass, glass, glass, paint), yaw))
        tyre = Mottled(noise, (0.14, 0.14, 0.15), 0.15, offset)
        parts += [box((place[0], place[1] + axle, 0.0), (1.7, 0.6, 0.3), (tyre,)) for axle in (-1.35, 1.35)]
    return parts


def _trees_and_lamps(
    noise: Noise, side: float, start: float, end: float, rng: np.random.Generator
) -> list[Surface]:
    """In turn, at the kerb."""
    parts: list[Surface] = []
    metal = Mottled(noise, (0.30, 0.31, 0.32), 0.14)
    bark = Mottled(noise, (0.36, 0.30, 0.24), 0.24)
    kerb = side * (_CARRIAGEWAY / 2 + 0.7)
    for number, y in enumerate(np.arange(start + 5.0 + 4.0 * (side > 0), end, 9.0)):
        if number % 2:
            parts.append(box((kerb, y, 0.0), (0.16, 0.16, 6.5), (metal,)))
            continue
        parts.append(box((kerb, y, 0.0), (0.3, 0.3, 3.4), (bark,)))
        for _ in range(7):
            centre = np.array([kerb, y, 4.3]) + rng.uniform(-1, 1, 3) * [0.7, 0.8, 0.9]
            leaves = Mottled(noise, (0.31, 0.43, 0.20), 0.27, (centre[0], y), stretch=1.3)
            parts.append(Ellipsoid(centre, np.full(3, rng.uniform(0.6, 0.95)), leaves))
    return parts


def _across(noise: Noise, end: float) -> list[Surface]:
    """The house at which the street ends."""
    wall = Facade(noise, (0.74, 0.62, 0.52), 15.7, 40.0, (5.0, 9.0))
    roof = RoofTiles(noise, (0.50, 0.34, 0.28), (5.0, 9.0))
    return [gabled_house((0.0, end + 7.0, 0.0), (40.0, 10.0, 15.7), 19.0, (wall,) * 4 + (roof,))]
