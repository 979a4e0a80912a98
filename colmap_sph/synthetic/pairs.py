"""Ready-made stereo pairs over analytic scenes, one for every geometry that rectification has to stand."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.light import Light
from colmap_sph.synthetic.primitives import FloatArray, Plane, Surface
from colmap_sph.synthetic.rays import Camera
from colmap_sph.synthetic.render import Rendering, render
from colmap_sph.synthetic.solids import box, gabled_house, sphere
from colmap_sph.synthetic.texture import Mottled, Noise

_UP = (0.0, 0.0, 1.0)
# Distance in metres at which a pixel is as large as the texture is fine.
_YARD_DEPTH = 6.0


def look_at(eye: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike = _UP) -> tuple[FloatArray, FloatArray]:
    """Pose of a camera that looks from one point to another.

    Parameters
    ----------
    eye, target : (3,) array_like
        World points in metres.
    up : (3,) array_like
        World direction that points up in the picture; not along the line of sight.

    Returns
    -------
    R, t : (3, 3) and (3,) float64
        `x_cam = R x_world + t`.

    Raises
    ------
    ValueError
        `up` is along the line of sight.
    """
    centre = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    length = np.linalg.norm(right)
    if length < 1e-9:
        raise ValueError("look_at: up is parallel to the line of sight")
    right /= length
    R = np.stack([right, np.cross(forward, right), forward])
    return R, -R @ centre


def pinhole(focal_length: float, width: int, height: int) -> FloatArray:
    """Calibration matrix with the principal point in the middle of the picture.

    Parameters
    ----------
    focal_length : float
        Pixels.
    width, height : int
        Pixels.

    Returns
    -------
    (3, 3) float64 ndarray
        Pixels; the first pixel's centre is at (0.5, 0.5).
    """
    return np.array([[focal_length, 0.0, width / 2], [0.0, focal_length, height / 2], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class SyntheticPair:
    """Two cameras before one scene; without a light of its own, the sun of `Light()` shines."""

    surfaces: tuple[Surface, ...]
    left: Camera
    right: Camera
    light: Light = field(default_factory=Light)

    def render(
        self,
        side: Literal["left", "right"],
        *,
        origin: float = 0.5,
        supersample: int = 2,
        light: Light | None = None,
        noise: float = 0.0,
        seed: int = 0,
    ) -> Rendering:
        """Render one side; see `render`.

        Parameters
        ----------
        side : {"left", "right"}
        origin : float
            Depth and normals are those along the rays through (col + origin, row + origin).
        supersample : int
            Rays per pixel and direction.
        light : Light, optional
            In place of the pair's own.
        noise : float
            Standard deviation of the sensor noise, grey values.
        seed : int
            Of the noise.

        Returns
        -------
        Rendering
        """
        camera = self.left if side == "left" else self.right
        return render(
            self.surfaces,
            camera.K,
            camera.R,
            camera.t,
            camera.width,
            camera.height,
            origin=origin,
            supersample=supersample,
            light=light or self.light,
            noise=noise,
            seed=seed,
        )


def _camera(
    eye: npt.ArrayLike,
    target: npt.ArrayLike,
    focal_length: float,
    size: tuple[int, int],
    up: npt.ArrayLike = _UP,
) -> Camera:
    R, t = look_at(eye, target, up)
    return Camera(pinhole(focal_length, *size), R, t, *size)


def slanted_plane_pair(
    slant: float = 30.0,
    tilt: float = 0.0,
    *,
    depth: float = 10.0,
    focal_length: float = 400.0,
    size: tuple[int, int] = (320, 240),
    seed: int = 0,
) -> SyntheticPair:
    """Parallel cameras, a metre apart, before one textured plane.

    Parameters
    ----------
    slant : float
        Angle in degrees between the plane's normal and the line of sight.
    tilt : float
        Direction of the slant in the picture, degrees: 0 turns the plane about the vertical (disparity
        changes along the rows), 90 about the horizontal.
    depth : float
        Depth in metres where the left camera's axis meets the plane.
    focal_length : float
        Pixels.
    size : (int, int)
        Width and height in pixels.
    seed : int
        Seed of the texture.

    Returns
    -------
    SyntheticPair
    """
    left = Camera(pinhole(focal_length, *size), np.eye(3), np.zeros(3), *size)
    right = replace(left, t=np.array([-1.0, 0.0, 0.0]))
    angle = np.radians(slant)
    direction = np.radians(tilt)
    normal = (np.sin(angle) * np.cos(direction), np.sin(angle) * np.sin(direction), -np.cos(angle))
    # Between what the foreshortened and the other direction want.
    gsd = depth / focal_length / np.sqrt(max(np.cos(angle), 0.1))
    material = Mottled(Noise(gsd, seed), contrast=0.22)
    behind_the_camera = Light((-0.3, -0.4, -0.85))
    return SyntheticPair((Plane((0.0, 0.0, depth), normal, material),), left, right, behind_the_camera)


def _yard(gsd: float) -> tuple[Surface, ...]:
    """A yard with a house, boxes and balls on a floor, closed by a wall: occlusions from every side."""
    noise = Noise(gsd)
    floor = Mottled(noise, (0.50, 0.52, 0.45), 0.22)
    plaster = Mottled(noise, (0.72, 0.66, 0.58), 0.18, offset=(3.1, 7.7))
    roof = Mottled(noise, (0.60, 0.36, 0.28), 0.20, offset=(11.3, 2.9))
    ball = Mottled(noise, (0.42, 0.52, 0.30), 0.25, offset=(5.3, 1.7))
    return (
        Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), floor),
        Plane((0.0, 14.0, 0.0), (0.1, -1.0, 0.0), plaster),
        gabled_house((-3.0, 9.0, 0.0), (4.0, 3.0, 2.2), 3.6, (plaster,) * 4 + (roof,), yaw=0.5),
        box((3.2, 8.0, 0.0), (2.0, 2.4, 1.8), (plaster, plaster, roof), yaw=-0.3),
        box((0.4, 10.5, 0.0), (1.2, 1.2, 3.0), (roof,), yaw=0.9),
        sphere((1.0, 6.5, 0.8), 0.8, ball),
        sphere((-1.2, 5.5, 0.5), 0.5, ball),
    )


def convergent_pair(
    angle: float = 20.0,
    *,
    focal_length: float = 400.0,
    size: tuple[int, int] = (320, 240),
) -> SyntheticPair:
    """Two cameras on an arc that look at one place of a yard.

    Parameters
    ----------
    angle : float
        Degrees between the cameras' axes.
    focal_length : float
        Pixels.
    size : (int, int)
        Width and height in pixels.

    Returns
    -------
    SyntheticPair
    """
    target = np.array([0.0, 8.0, 1.2])
    half = np.radians(angle) / 2
    eyes = [target + np.array([9.0 * np.sin(turn), -9.0 * np.cos(turn), 2.5]) for turn in (-half, half)]
    left, right = (_camera(eye, target, focal_length, size) for eye in eyes)
    return SyntheticPair(_yard(_YARD_DEPTH / focal_length), left, right)


def forward_motion_pair(
    step: float = 1.0,
    *,
    focal_length: float = 320.0,
    size: tuple[int, int] = (320, 240),
) -> SyntheticPair:
    """Motion along the first camera's axis: the epipole is the principal point.

    Parameters
    ----------
    step : float
        Metres.
    focal_length : float
        Pixels.
    size : (int, int)
        Width and height in pixels.

    Returns
    -------
    SyntheticPair
    """
    eye = np.array([0.0, -1.0, 3.0])
    target = np.array([0.0, 8.0, 1.2])
    axis = (target - eye) / np.linalg.norm(target - eye)
    left = _camera(eye, target, focal_length, size)
    right = _camera(eye + step * axis, target, focal_length, size)
    return SyntheticPair(_yard(_YARD_DEPTH / focal_length), left, right)


def epipole_inside_pair(
    step: float = 1.0,
    *,
    focal_length: float = 320.0,
    size: tuple[int, int] = (320, 240),
) -> SyntheticPair:
    """Forward and sideways motion with a turn: the epipoles lie inside both pictures, off their middle.

    Parameters
    ----------
    step : float
        About the metres from camera to camera.
    focal_length : float
        Pixels.
    size : (int, int)
        Width and height in pixels.

    Returns
    -------
    SyntheticPair
    """
    eye = np.array([0.0, -1.0, 3.0])
    motion = np.array([0.2, 0.95, -0.1])
    left = _camera(eye, (0.0, 8.0, 1.2), focal_length, size)
    right = _camera(eye + step * motion, (-0.3, 8.0, 1.4), focal_length, size, up=(0.1, 0.0, 1.0))
    return SyntheticPair(_yard(_YARD_DEPTH / focal_length), left, right)
