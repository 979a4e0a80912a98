"""A camera whose picture is bent and that moves while its rows are read: which ray each of its pixels sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from colmap_sph.synthetic.photographs.bending import Bending
from colmap_sph.synthetic.photographs.imperfections import Imperfections
from colmap_sph.synthetic.primitives import FloatArray
from colmap_sph.synthetic.rays import Camera, Index, Rays, grid_window

_LENS = 201
_WOBBLE = 202
_SHUTTER = 203
_ITERATIONS = 30


@dataclass(frozen=True)
class Motion:
    """What a camera does while its rows are read, from the first to the last, evenly.

    Attributes
    ----------
    rotation : (3,) float64
        Turn about the camera's own axes: axis times angle, radians.
    translation : (3,) float64
        Way of the centre in the world, metres.
    """

    rotation: FloatArray
    translation: FloatArray


@dataclass(frozen=True)
class RealCamera(Camera):
    """A camera with a bent picture and a rolling shutter; its pose is that of its middle row.

    `project` and `back_project` are those of the ideal camera that a written model knows.

    Attributes
    ----------
    bending : Bending, optional
    motion : Motion, optional
    """

    bending: Bending | None = None
    motion: Motion | None = None

    def rays(self, x: FloatArray, y: FloatArray) -> Rays:
        """As `Camera.rays`: what the pixels there really see."""
        return RealRays(self, x, y)

    def observe(self, points: FloatArray) -> FloatArray:
        """Image coordinates (N, 2) at which world points (N, 3) really appear.

        They solve pixel + displacement(pixel) = projection by the pose of the pixel's row; a fixed point, since
        neither changes by as much as a pixel from one pixel to the next.
        """
        pixel = self.project(points)[0]
        for _ in range(_ITERATIONS):
            turns, centres = self.poses(pixel[:, 1])
            ideal = np.einsum("nij,nj->ni", turns, points - centres) @ self.K.T
            straight = ideal[:, :2] / ideal[:, 2:]
            bend = self.bending.displacement(pixel[:, 0], pixel[:, 1]).T if self.bending else 0.0
            pixel = straight - bend
        return pixel

    def poses(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (N, 3, 3) from the world and centres (N, 3) while rows y (N,) are read."""
        if self.motion is None:
            return np.broadcast_to(self.R, (y.size, 3, 3)), np.broadcast_to(self.centre, (y.size, 3))
        share = (y / self.height - 0.5)[:, None]
        turns: FloatArray = Rotation.from_rotvec(share * self.motion.rotation).as_matrix() @ self.R
        return turns, self.centre + share * self.motion.translation


class RealRays(Rays):
    """Rays of unit z, in the camera of their row, through the grid x, y of a real camera's pixels."""

    def __init__(self, camera: RealCamera, x: FloatArray, y: FloatArray) -> None:
        self.camera = camera
        self.x = x
        self.y = y
        self.shape = (y.size, x.size)
        straight = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0))
        # A curved edge between corners that are straightly projected needs a pixel more.
        self._margin = 1.0
        if camera.bending is not None:
            straight[:2] += camera.bending.displacement(x[None, :], y[:, None])
            self._margin += camera.bending.largest
        turns, centres = camera.poses(y)
        inverse = np.linalg.inv(camera.K)
        self.directions = np.einsum("hji,jk,khw->ihw", turns, inverse, straight, optimize=True)
        self.origins = camera.centre.reshape(3, 1, 1)
        if camera.motion is not None:
            self.origins = np.broadcast_to(centres.T[:, :, None], self.directions.shape)

    def depth(self, distance: FloatArray) -> FloatArray:
        """As `Rays.depth`: that in the camera of the middle row."""
        if self.camera.motion is None:
            return distance
        axis = self.camera.R[2].reshape(3, 1, 1)
        start = np.sum(axis * (self.origins - self.camera.centre.reshape(3, 1, 1)), axis=0)
        depth: FloatArray = start + distance * np.sum(axis * self.directions, axis=0)
        return depth

    def image(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `Rays.image`."""
        return self.camera.project(points)

    def window(self, low: FloatArray, high: FloatArray) -> Index | None:
        """As `Rays.window`."""
        return grid_window(self.x, self.y, low - self._margin, high + self._margin)

    def windows(self, hulls: Sequence[FloatArray]) -> list[Index | None]:
        """As `Rays.windows`.

        To the camera of the middle row an object is as large as where first and last row see it, together.
        """
        camera = self.camera
        if camera.motion is None:
            return super().windows(hulls)
        turns, centres = camera.poses(np.array([0.0, float(camera.height)]))
        steps = [camera.R.T @ turn for turn in turns]
        both = [
            np.concatenate([(hull - c) @ step.T + camera.centre for step, c in zip(steps, centres, strict=True)])
            for hull in hulls
        ]
        return super().windows(both)


def real_camera(camera: Camera, effects: Imperfections, seed: int, number: int) -> Camera:
    """The camera as it is: bent and moving, with its field and motion drawn from the seeds.

    Parameters
    ----------
    camera : Camera
        As a written model knows it.
    effects : Imperfections
    seed, number : int
        Seed of the block and the picture's number in it.

    Returns
    -------
    Camera
        The given one where nothing bends or moves it.
    """
    size = (camera.width, camera.height)
    bending = None
    motion = None
    if effects.lens > 0:
        bending = Bending.draw(effects.lens, *size, np.random.default_rng((seed, _LENS)))
    if effects.wobble > 0:
        own = Bending.draw(effects.wobble, *size, np.random.default_rng((seed, number, _WOBBLE)))
        bending = own if bending is None else bending + own
    if effects.rolling_shutter > 0:
        angle = np.random.default_rng((seed, number, _SHUTTER)).uniform(0, 2 * np.pi)
        turn = effects.rolling_shutter / camera.K[0, 0]
        motion = Motion(turn * np.array([np.cos(angle), np.sin(angle), 0.0]), np.zeros(3))
    if bending is None and motion is None:
        return camera
    return RealCamera(camera.K, camera.R, camera.t, *size, bending, motion)
