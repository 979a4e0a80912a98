"""A sky at infinity: its colour depends on the direction alone, never on where the camera stands."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from colmap_sph.synthetic.primitives import FloatArray
from colmap_sph.synthetic.texture import Float32Array

_HORIZON = np.array([0.80, 0.87, 0.94], dtype=np.float32)
_ZENITH = np.array([0.36, 0.56, 0.86], dtype=np.float32)
_CLOUD = np.array([0.96, 0.96, 0.97], dtype=np.float32)
_WAVES = 32
# Radians of phase per radian of direction: clouds of about 5 to 60 degrees.
_FREQUENCIES = (6.0, 70.0)


@dataclass(frozen=True)
class Sky:
    """Blue that pales towards the horizon, with soft clouds.

    Parameters
    ----------
    clouds : float
        How much of the blue the clouds hide where they are densest, 0 (clear) to 1.
    seed : int
        Of the clouds.

    Notes
    -----
    Up is the world's z. The clouds' density is a sum of waves over the unit direction, the finer the weaker.
    """

    clouds: float = 0.0
    seed: int = 0
    _waves: FloatArray = field(init=False, repr=False)
    _phases: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng((self.seed, 77))
        directions = rng.standard_normal((_WAVES, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        object.__setattr__(self, "_waves", directions * np.geomspace(*_FREQUENCIES, _WAVES)[:, None])
        object.__setattr__(self, "_phases", rng.uniform(0, 2 * np.pi, _WAVES))

    def colour(self, directions: FloatArray) -> Float32Array:
        """Displayed RGB (N, 3) in [0, 1] along world directions (3, N) of any length."""
        unit = directions / np.linalg.norm(directions, axis=0)
        height = np.sqrt(np.maximum(unit[2], 0.0)).astype(np.float32)[:, None]
        blue: Float32Array = _HORIZON + height * (_ZENITH - _HORIZON)
        if self.clouds == 0:
            return blue
        blue += np.float32(self.clouds) * self._density(unit) * (_CLOUD - blue)
        return blue

    def _density(self, unit: FloatArray) -> Float32Array:
        """Clouds (N, 1) in [0, 1] along unit directions (3, N)."""
        total = np.zeros(unit.shape[1])
        strongest = np.linalg.norm(self._waves[0])
        for wave, phase in zip(self._waves, self._phases, strict=True):
            total += (strongest / np.linalg.norm(wave)) ** 0.7 * np.sin(wave @ unit + phase)
        share = np.clip(0.4 + 0.25 * total, 0.0, 1.0)
        return np.asarray(share * share * (3.0 - 2.0 * share), np.float32)[:, None]
