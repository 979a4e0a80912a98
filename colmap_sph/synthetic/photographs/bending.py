"""Smooth bending of pictures that no camera model knows: what a pixel shows belongs a few pixels beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from colmap_sph.synthetic.primitives import FloatArray

_POWERS = [(i, j) for i in range(4) for j in range(4 - i)]
# A shift is a turn of the camera, most of a linear field a change of its calibration: not what is meant here.
_SHARES = np.array([0.0 if i + j == 0 else 0.5 if i + j == 1 else 1.0 for i, j in _POWERS])
_GRID = 65


@dataclass(frozen=True)
class Bending:
    """A cubic field: the pixel at (x, y) shows what an unbent picture shows at (x, y) + displacement.

    Attributes
    ----------
    coefficients : (2, 10) float64
        Of x and y, of the monomials in coordinates that run from -1 to 1 over the picture; pixels.
    width, height : int
        Pixels.
    """

    coefficients: FloatArray
    width: int
    height: int

    @classmethod
    def draw(cls, rms: float, width: int, height: int, rng: np.random.Generator) -> Bending:
        """Random field with this root mean square of each component over the picture, pixels."""
        coefficients = rng.standard_normal((2, len(_POWERS))) * _SHARES
        unit = cls(coefficients, width, height)
        size = np.sqrt(np.mean(unit.displacement(*unit._grid()) ** 2, axis=(1, 2)))
        return cls(coefficients * (rms / size)[:, None], width, height)

    def __add__(self, other: Bending) -> Bending:
        return Bending(self.coefficients + other.coefficients, self.width, self.height)

    def displacement(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """(2, ...) pixels, at image coordinates x and y that broadcast against each other."""
        u = 2.0 * x / self.width - 1.0
        v = 2.0 * y / self.height - 1.0
        total = np.zeros((2, *np.broadcast_shapes(u.shape, v.shape)))
        for (i, j), coefficients in zip(_POWERS, self.coefficients.T, strict=True):
            total += coefficients.reshape(2, *(1,) * (total.ndim - 1)) * (u**i * v**j)
        return total

    @property
    def largest(self) -> float:
        """Largest displacement in the picture, pixels."""
        return float(np.max(np.hypot(*self.displacement(*self._grid()))))

    def _grid(self) -> tuple[FloatArray, FloatArray]:
        return np.linspace(0, self.width, _GRID)[None, :], np.linspace(0, self.height, _GRID)[:, None]
