"""Where a camera model says that a ray is seen ↔ where it is: a smooth field of displacements.

A camera model is a formula with a few parameters. What a real lens does beyond it (phones, zooms, cheap optics, a
sensor that is not flat) is small and smooth: here it is a bicubic B-spline of rays.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline
    from scipy.sparse import csr_array

Float = NDArray[np.float64]

_ORDER = 4
# A field is small against its domain, so that this many steps invert it to the last digits.
_STEPS = 8
_NODES = 64
# Displacements may change by this much from a ray to one beside it: more is no lens.
_STEEPEST = 0.3


@dataclass(frozen=True, eq=False)
class LensField:
    """How far from where a camera model says each ray is seen the truth lies.

    Rays are (x, y) at z = 1 in the camera's frame.

    Attributes
    ----------
    low, high : (2,) float64 ndarray
        Corners of the domain; beyond its borders displacements are those of the border.
    coefficients : (2, rows + 3, columns + 3) float64 ndarray
        Of bicubic B-splines on a grid of `rows` and `columns` cells of the domain: x and y of the displacement.
    """

    low: Float
    high: Float
    coefficients: Float

    @classmethod
    def zero(cls, low: Float, high: Float, cells: tuple[int, int]) -> "LensField":
        """No displacement, on a grid of so many rows and columns of cells."""
        rows, columns = cells
        return cls(low, high, np.zeros((2, rows + _ORDER - 1, columns + _ORDER - 1)))

    def basis(self, rays: Float) -> "csr_array":
        """(n, coefficients of x) sparse matrix: what each coefficient adds at (n, 2) rays."""
        # Not before, here and below: they take their time to load, and few runs have a field.
        from scipy.sparse import csr_array

        rows, columns = self.coefficients.shape[1:]
        place = np.clip((rays - self.low) / (self.high - self.low), 0, 1)
        column, along = _weights(place[:, 0], columns - _ORDER + 1)
        row, across = _weights(place[:, 1], rows - _ORDER + 1)
        index = (row[:, :, None] * columns + column[:, None, :]).reshape(len(rays), -1)
        values = across[:, :, None] * along[:, None, :]
        starts = np.arange(0, index.size + 1, _ORDER**2)
        return csr_array((values.ravel(), index.ravel(), starts), shape=(len(rays), rows * columns))

    def at(self, rays: Float) -> Float:
        """(n, 2) displacements at (n, 2) rays as the camera model has them."""
        return np.asarray(self.basis(rays) @ self.coefficients.reshape(2, -1).T)

    def straightened(self, rays: Float) -> Float:
        """(n, 2) true rays of what the camera model sees at (n, 2) rays."""
        return np.asarray(rays + self.at(rays))

    def bent(self, rays: Float) -> Float:
        """(n, 2) rays at which the camera model sees (n, 2) true ones: the inverse of `straightened`."""
        seen = rays
        for _ in range(_STEPS):
            seen = rays - self.at(seen)
        return seen

    def bent_grid(self, x: Float, y: Float) -> Float:
        """(rows, columns, 2): what `bent` makes of the rays of a grid with these ascending x and y."""
        there = np.stack([spline(y, x) for spline in self._inverse], axis=2)
        return np.asarray(there + np.stack(np.meshgrid(x, y), axis=2))

    def nodes(self, number: int) -> Float:
        """(number², 2) rays, evenly over the domain."""
        x, y = (np.linspace(self.low[axis], self.high[axis], number) for axis in (0, 1))
        return np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)

    @property
    def is_sound(self) -> bool:
        """Whether it is finite, and nowhere so steep that rays would cross."""
        if not all(np.isfinite(part).all() for part in (self.low, self.high, self.coefficients)):
            return False
        if not (self.low < self.high).all():
            return False
        cell = (self.high - self.low) / (np.array(self.coefficients.shape[:0:-1]) - _ORDER + 1)
        steps = [np.abs(np.diff(self.coefficients, axis=2 - axis)) / cell[axis] for axis in (0, 1)]
        return bool(max(float(step.max()) for step in steps) < _STEEPEST)

    @cached_property
    def _inverse(self) -> "list[RectBivariateSpline]":
        """Displacements from true rays to those of the camera model, x and y."""
        from scipy.interpolate import RectBivariateSpline

        rays = self.nodes(_NODES)
        there = (self.bent(rays) - rays).reshape(_NODES, _NODES, 2)
        x, y = (np.linspace(self.low[axis], self.high[axis], _NODES) for axis in (0, 1))
        return [RectBivariateSpline(y, x, there[:, :, axis]) for axis in (0, 1)]


def _weights(place: Float, cells: int) -> tuple[NDArray[np.int64], Float]:
    """(n, 4) numbers and weights of the cubic B-splines that are not 0 at (n,) places in 0..1."""
    cell = np.clip((place * cells).astype(np.int64), 0, cells - 1)
    t = place * cells - cell
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1)
    return cell[:, None] + np.arange(_ORDER), weights / 6
