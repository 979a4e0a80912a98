"""A gentle height field, met by rays to the last digits: the ground of the demo block."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.primitives import FloatArray, IntArray, Surface
from colmap_sph.synthetic.texture import Material

# Of the distance, for the intersection with the terrain.
_ACCURACY = 1e-12
_PLAIN_STEPS = 5
_SAFE_STEPS = 3000
_TINY = 1e-300
# Rays between those of the coarse grid on which the terrain is solved first.
_COARSE = 4


@dataclass(frozen=True)
class Terrain(Surface):
    """The height field z = base + sum of a sin(k . (x, y) + phase), met by descending rays from above.

    Parameters
    ----------
    base : float
        Mean height in metres.
    amplitudes : (M,) float64
        Metres.
    wave_vectors : (M, 2) float64
        Radians per metre.
    phases : (M,) float64
    material : Material
        Drawn in world (x, y).
    """

    base: float
    amplitudes: FloatArray
    wave_vectors: FloatArray
    phases: FloatArray
    material: Material
    materials: tuple[Material, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "materials", (self.material,))

    @property
    def steepest(self) -> float:
        """Bound of the slope."""
        return float(np.sum(np.abs(self.amplitudes) * np.linalg.norm(self.wave_vectors, axis=1)))

    def height(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Height in metres at world (x, y), arrays of any shape."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        height = np.full(x.shape, self.base)
        for amplitude, (kx, ky), phase in zip(self.amplitudes, self.wave_vectors, self.phases, strict=True):
            height += amplitude * np.sin(kx * x + ky * y + phase)
        return height

    def slopes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the height along x and y at world (x, y)."""
        x_slope = np.zeros(x.shape)
        y_slope = np.zeros(x.shape)
        for amplitude, (kx, ky), phase in zip(self.amplitudes, self.wave_vectors, self.phases, strict=True):
            derivative = amplitude * np.cos(kx * x + ky * y + phase)
            x_slope += kx * derivative
            y_slope += ky * derivative
        return x_slope, y_slope

    def intersect(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """See `Surface.intersect`; rays that do not descend, or start below the highest wave, miss."""
        shape = np.broadcast_shapes(origins.shape, directions.shape)
        face = np.zeros(shape[1:], dtype=np.int8)
        guess = self._guess(np.broadcast_to(origins, shape), np.broadcast_to(directions, shape)).ravel()
        origins = np.broadcast_to(origins, shape).reshape(3, -1)
        directions = np.broadcast_to(directions, shape).reshape(3, -1)
        hits = (directions[2] < 0) & (origins[2] > self.base + self._relief)
        level = np.hypot(directions[0], directions[1])
        # A ray steeper than every slope meets the surface once: plain Newton cannot find a wrong root.
        steep = hits & (-directions[2] > 1.05 * self.steepest * level)
        with np.errstate(all="ignore"):
            distance, settled = self._newton(origins, directions, guess)
        rest = np.flatnonzero(hits & ~(steep & settled))
        if rest.size:
            distance[rest] = self._first_root(origins[:, rest], directions[:, rest])
        distance[~hits] = np.inf
        return distance.reshape(shape[1:]), face

    @property
    def _relief(self) -> float:
        return float(np.sum(np.abs(self.amplitudes))) + 1e-9

    @property
    def _curvature(self) -> float:
        """Bound of the second derivative in any direction."""
        return float(np.sum(np.abs(self.amplitudes) * np.sum(self.wave_vectors**2, axis=1)))

    def _guess(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Start of the iteration: the mean level, on a large grid of rays the solution on a coarser one.

        Inverse depth is interpolated: on planar ground it is affine across a pinhole picture.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            if directions.ndim != 3 or min(directions.shape[1:]) < 16 * _COARSE:
                level: FloatArray = (self.base - origins[2]) / directions[2]
                return level
            grid = (slice(None), slice(None, None, _COARSE), slice(None, None, _COARSE))
            inverse = 1.0 / self.intersect(origins[grid], directions[grid])[0]
            for axis in (0, 1):
                place = np.arange(directions.shape[axis + 1]) / _COARSE
                low = np.minimum(place.astype(np.int64), inverse.shape[axis] - 2)
                share = (place - low).reshape((-1, 1) if axis == 0 else (1, -1))
                below = np.take(inverse, low, axis)
                above = np.take(inverse, low + 1, axis)
                inverse = below + share * (above - below)
            return 1.0 / inverse

    def _newton(
        self, origins: FloatArray, directions: FloatArray, guess: FloatArray
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """A few steps of Newton's method for all rays, and which of them have settled."""
        distance = guess.copy()
        settled = np.zeros(distance.shape, dtype=np.bool_)
        active: IntArray = np.arange(distance.size)
        for number in range(_PLAIN_STEPS):
            o = origins[:, active] if number else origins
            d = directions[:, active] if number else directions
            step, moved = self._newton_step(o, d, distance[active])
            distance[active] = moved
            settled[active] = self._is_small(step, moved, d)
            active = active[~settled[active]]
            if not active.size:
                break
        return distance, settled

    def _newton_step(
        self, origins: FloatArray, directions: FloatArray, distance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        x = origins[0] + distance * directions[0]
        y = origins[1] + distance * directions[1]
        x_slope, y_slope = self.slopes(x, y)
        gap = origins[2] + distance * directions[2] - self.height(x, y)
        step = -gap / (directions[2] - x_slope * directions[0] - y_slope * directions[1])
        return step, distance + step

    def _is_small(self, step: FloatArray, distance: FloatArray, directions: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether Newton's error after this step, at most curvature times its square, is negligible."""
        level_square = directions[0] ** 2 + directions[1] ** 2
        falling = -directions[2] - self.steepest * np.sqrt(level_square)
        error = 0.5 * self._curvature * level_square * step**2
        small: npt.NDArray[np.bool_] = error <= _ACCURACY * distance * falling
        return small

    def _first_root(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """First root for rays that may have several, from above, by steps that cannot pass it.

        The gap between ray and ground falls no faster than a parabola with the value and slope found here and
        the largest curvature of the terrain; the step goes to that parabola's root. Close to the ground this
        is Newton's method.
        """
        distance: FloatArray = (self.base + self._relief - origins[2]) / directions[2]
        active: IntArray = np.arange(distance.size)
        for _ in range(_SAFE_STEPS):
            o = origins[:, active]
            d = directions[:, active]
            s = distance[active]
            x, y = o[0] + s * d[0], o[1] + s * d[1]
            x_slope, y_slope = self.slopes(x, y)
            gap = np.maximum(o[2] + s * d[2] - self.height(x, y), 0.0)
            fall = x_slope * d[0] + y_slope * d[1] - d[2]
            curvature = self._curvature * (d[0] ** 2 + d[1] ** 2)
            step = 2.0 * gap / (fall + np.sqrt(fall**2 + 2.0 * curvature * gap) + _TINY)
            distance[active] = s + step
            active = active[step > _ACCURACY * s]
            if not active.size:
                break
        distance[active] = np.inf
        return distance

    def normals(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.normals`."""
        x_slope, y_slope = self.slopes(points[0], points[1])
        length = np.sqrt(1.0 + x_slope**2 + y_slope**2)
        return np.stack([-x_slope / length, -y_slope / length, 1.0 / length])

    def texture_coordinates(self, points: FloatArray, faces: IntArray) -> FloatArray:
        """See `Surface.texture_coordinates`."""
        return points[:2]
