"""A courtyard with trees, arcades and benches, taken with fisheyes of 190 degrees or as panoramas."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_sph.errors import OutputError
from colmap_sph.synthetic.capture import CaptureOptions, write_picture
from colmap_sph.synthetic.light import Light, ShadowMap
from colmap_sph.synthetic.model import build_reconstruction, sample_sparse_points, write_reconstruction
from colmap_sph.synthetic.photographs.optics import sensor_readings
from colmap_sph.synthetic.primitives import Ellipsoid, FloatArray, Plane, Surface
from colmap_sph.synthetic.render import exact_geometry, exact_picture
from colmap_sph.synthetic.solids import box, gabled_house
from colmap_sph.synthetic.texture import Facade, Mottled, Noise, RoofTiles
from colmap_sph.synthetic.wide.cameras import Fisheye, Panorama, WideCamera

logger = logging.getLogger(__name__)

# Metres.
_HALF_LENGTH = 11.0
_HALF_WIDTH = 8.0
_EAVES = 7.0
_SPACING = 1.5
_DISTANCE = 6.0
_COEFFICIENTS = (0.038, -0.008, 0.0083, -0.0027)
# Radius in focal lengths of the image circle, with a little room around it.
_CIRCLE = 1.86


@dataclass(frozen=True)
class CourtyardOptions(CaptureOptions):
    """How many pictures of the courtyard are taken, and by what.

    `width` is that of the pictures; their height follows from the lens.
    """

    width: int = 480
    points: int = 4000
    panoramas: bool = False
    """Panoramas (EQUIRECTANGULAR, twice as wide as high) instead of square fisheyes."""
    images: int = 10
    """Number of pictures: two rows."""

    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """As `CaptureOptions.bounds`."""
        return {"images": (2, 1000), **super().bounds()}


def courtyard_cameras(options: CourtyardOptions) -> dict[str, WideCamera]:
    """Cameras by image name: two rows at two heights, held about upright, looking about north."""
    rng = np.random.default_rng((options.seed, 47))
    columns = (options.images + 1) // 2
    cameras = {}
    for number in range(options.images):
        row, column = divmod(number, columns)
        place = [(column - (columns - 1) / 2) * _SPACING, (row - 1.0) * _SPACING * 1.3, 1.7 + 0.9 * row]
        centre = np.array(place) + rng.normal(0, [0.15, 0.15, 0.08])
        turn = rng.normal(0, np.radians([12.0, 6.0, 3.0]))
        cameras[f"C_{row}_{column:02}.png"] = _camera(options, centre, turn)
    return cameras


def _camera(options: CourtyardOptions, centre: FloatArray, turn: FloatArray) -> WideCamera:
    """A camera that looks north (+y), turned by heading, pitch and roll."""
    heading, pitch, roll = turn
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    R = _about(2, roll) @ _about(0, pitch) @ _about(1, heading) @ upright
    t = -R @ centre
    width = options.width
    if options.panoramas:
        return Panorama(np.eye(3), R, t, width, width // 2)
    focal = width / 2 / _CIRCLE
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, width / 2], [0.0, 0.0, 1.0]])
    return Fisheye(K, R, t, width, width, _COEFFICIENTS)


def _about(axis: int, angle: float) -> FloatArray:
    """Rotation about an axis of the camera frame."""
    turn = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn[[first, second], [first, second]] = np.cos(angle)
    turn[first, second] = -np.sin(angle)
    turn[second, first] = np.sin(angle)
    return turn


def courtyard_gsd(options: CourtyardOptions) -> float:
    """Size of a pixel at the usual distance of a wall, metres."""
    focal = options.width / (2 * np.pi) if options.panoramas else options.width / 2 / _CIRCLE
    return _DISTANCE / focal


def build_courtyard(gsd: float, seed: int) -> tuple[Surface, ...]:
    """Lay out the scene: the ground first, houses on four sides, what stands between them."""
    noise = Noise(0.5 * gsd, seed)
    ground = Plane((0, 0, 0), (0, 0, 1), RoofTiles(noise, (0.55, 0.53, 0.49), (3, 5), tile=0.6), (60.0, 60.0))
    return ground, *_houses(noise), *_arcade(noise), *_things(noise, np.random.default_rng((seed, 48)))


def _houses(noise: Noise) -> list[Surface]:
    """Four houses around the yard, of unlike height."""
    parts: list[Surface] = []
    colours = ((0.80, 0.72, 0.60), (0.74, 0.62, 0.52), (0.80, 0.78, 0.74), (0.66, 0.68, 0.70))
    sides = ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0))
    for number, ((east, north), colour) in enumerate(zip(sides, colours, strict=True)):
        length = 2 * (_HALF_LENGTH if east == 0 else _HALF_WIDTH) - 0.02 + (10.0 if east == 0 else 0.0)
        height = _EAVES + 1.5 * (number % 3)
        wall = Facade(noise, colour, height, length, (7.0 * number, 3.0 * number))
        roof = RoofTiles(noise, (0.56, 0.33, 0.26), (5.0 * number, 1.0))
        place = (east * (_HALF_LENGTH + 4.0), north * (_HALF_WIDTH + 4.0), 0.0)
        turn = 0.0 if east == 0 else np.pi / 2
        parts.append(gabled_house(place, (length, 8.0, height), height + 2.5, (wall,) * 4 + (roof,), turn))
    return parts


def _arcade(noise: Noise) -> list[Surface]:
    """A roofed walk along the north side, its roof on pillars."""
    stone = Mottled(noise, (0.66, 0.62, 0.55), 0.22)
    tiles = RoofTiles(noise, (0.50, 0.36, 0.28), (2.0, 9.0))
    parts: list[Surface] = [
        box((0.0, _HALF_WIDTH - 0.9, 2.9), (18.0, 1.8, 0.3), (stone, stone, stone, stone, tiles, stone))
    ]
    parts += [box((x, _HALF_WIDTH - 1.6, 0.0), (0.35, 0.35, 2.9), (stone,)) for x in np.arange(-8.4, 8.5, 2.8)]
    return parts


def _things(noise: Noise, rng: np.random.Generator) -> list[Surface]:
    """Benches, a fountain, tubs and trees, around the cameras."""
    wood = Mottled(noise, (0.50, 0.36, 0.22), 0.28)
    stone = Mottled(noise, (0.62, 0.60, 0.56), 0.25)
    bark = Mottled(noise, (0.36, 0.30, 0.24), 0.28)
    parts: list[Surface] = [
        box((-1.2, 3.4, 0.0), (2.4, 2.4, 0.6), (stone,), 0.3),
        box((-1.2, 3.4, 0.6), (0.5, 0.5, 1.2), (stone,), 0.3),
        Ellipsoid(np.array([-1.2, 3.4, 2.1]), np.full(3, 0.4), stone),
    ]
    for x, y, yaw in ((5.5, 1.5, 1.2), (-6.5, 0.5, -1.3), (3.0, -5.5, 0.1), (-3.5, -5.8, 0.0)):
        parts.append(box((x, y, 0.35), (1.8, 0.5, 0.12), (wood,), yaw))
        parts.append(box((x, y, 0.0), (1.4, 0.3, 0.35), (stone,), yaw))
    for x, y in ((7.5, 4.5), (-8.0, 4.2), (8.0, -5.0), (-7.5, -4.8)):
        parts.append(box((x, y, 0.0), (0.35, 0.35, 2.6), (bark,)))
        for _ in range(6):
            centre = np.array([x, y, 3.6]) + rng.uniform(-1, 1, 3) * [0.8, 0.8, 0.9]
            leaves = Mottled(noise, (0.31, 0.43, 0.20), 0.30, (centre[0], y), stretch=1.3)
            parts.append(Ellipsoid(centre, np.full(3, rng.uniform(0.6, 0.9)), leaves))
    for x in (3.2, 4.4, 5.6):
        tub = Mottled(noise, (0.64, 0.40, 0.30), 0.22, (x, 0.0))
        parts.append(box((x, 4.6, 0.0), (0.7, 0.7, 0.8), (tub,), 0.2 * x))
        parts.append(Ellipsoid(np.array([x, 4.6, 1.2]), np.full(3, 0.5), Mottled(noise, (0.30, 0.45, 0.22), 0.3)))
    return parts


def make_courtyard(output: Path, options: CourtyardOptions | None = None) -> dict[str, WideCamera]:
    """Render the courtyard and write pictures, model and exact range to disk; see `write_wide_capture`."""
    options = options or CourtyardOptions()
    options.check()
    gsd = courtyard_gsd(options)
    surfaces = build_courtyard(gsd, options.seed)
    sides = (_HALF_LENGTH + 8.0, _HALF_WIDTH + 8.0)
    extent = np.array(
        [[x, y, z] for x in (-sides[0], sides[0]) for y in (-sides[1], sides[1]) for z in (0.0, 13.0)]
    )
    sun = (-0.35, -0.45, 0.95)
    light = Light(sun, shadows=ShadowMap.cast(surfaces[1:], sun, extent, gsd))
    cameras = courtyard_cameras(options)
    write_wide_capture(output, cameras, surfaces, light, options)
    return cameras


def write_wide_capture(
    output: Path,
    cameras: Mapping[str, WideCamera],
    surfaces: Sequence[Surface],
    light: Light,
    options: CaptureOptions,
) -> None:
    """Take pictures with wide cameras: `images/NAME`, `sparse/0` and `truth/NAME.npz`.

    The latter holds `range` (H, W) along the rays of the pixels' centres, 0 where nothing is met, and the rays
    themselves: `rays` (H, W, 3), unit vectors in the camera frame.

    Raises
    ------
    OutputError
        If something cannot be written.
    """
    try:
        for folder in ("images", "truth"):
            (output / folder).mkdir(parents=True, exist_ok=True)
        for number, (name, camera) in enumerate(cameras.items()):
            _write_view(output, name, camera, surfaces, light, options, number)
    except OSError as error:
        raise OutputError(f"cannot write the pictures to {output}: {error}") from error
    rng = np.random.default_rng((options.seed, len(cameras)))
    sparse = sample_sparse_points(
        surfaces, list(cameras.values()), options.points, rng, max_incidence=options.max_incidence
    )
    model = build_reconstruction(
        list(cameras), list(cameras.values()), sparse, keypoint_noise=options.keypoint_noise, rng=rng
    )
    for point in model.points3D.values():  # COLMAP knows no ray beyond 90 degrees of a fisheye
        point.error = options.keypoint_noise
    write_reconstruction(model, output / "sparse" / "0")
    logger.info("%d pictures, %d points in %s", len(cameras), len(sparse.points), output)


def _write_view(
    root: Path,
    name: str,
    camera: WideCamera,
    surfaces: Sequence[Surface],
    light: Light,
    options: CaptureOptions,
    number: int,
) -> None:
    picture = exact_picture(surfaces, camera, supersample=options.supersample, light=light)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.directions(x.ravel(), y.ravel()).T.reshape(camera.height, camera.width, 3)
    is_seen = np.isfinite(rays).all(axis=2)
    noise = np.random.default_rng((options.seed, number))
    image = sensor_readings(picture, options.image_noise, 0.0, noise)
    image[~is_seen] = 0
    distance, _, _ = exact_geometry(surfaces, camera)
    distance[~is_seen] = 0
    write_picture(root / "images" / name, image)
    np.savez(root / "truth" / f"{name}.npz", range=distance.astype(np.float32), rays=rays.astype(np.float32))
