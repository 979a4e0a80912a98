"""Procedural surface colour: band-limited noise and the patterns of roofs, façades and painted ground.

Everything is a function of the position on the surface, so every view sees the same texture. Noise ends at
three ground sampling distances, edges are one wide: a picture of that sampling distance does not alias.
Colours are RGB in [0, 1] as displayed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
Colour = tuple[float, float, float]

_CELLS = 256


class Material(Protocol):
    """Colour of a surface as a function of the place on it."""

    def colour(self, coordinates: FloatArray) -> Float32Array:
        """RGB (N, 3) at texture coordinates (2, N) in metres."""


@lru_cache(maxsize=4)
def _random_fields(seed: int, size: int) -> tuple[Float32Array, Float32Array]:
    """(size * size,) noise in octaves and (_CELLS, _CELLS) white noise: not to be changed, scenes share them."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    lowest = 2.0 / 300.0
    highest = 0.5 / 3.0
    spectrum *= np.hypot(frequency, lowest) ** -0.75 / (1.0 + (frequency / highest) ** 8)
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(size, size))
    tile: Float32Array = (noise / noise.std()).astype(np.float32).ravel()
    cells: Float32Array = rng.random((_CELLS, _CELLS), dtype=np.float32)
    tile.flags.writeable = cells.flags.writeable = False
    return tile, cells


class Noise:
    """Periodic random field with octaves from 3 to about 300 ground sampling distances.

    Parameters
    ----------
    gsd : float
        Ground sampling distance in metres: the size of a picture element on the surface.
    seed : int
        The same seed gives the same field.
    tile : int
        Samples of a period in each direction, half a sampling distance each; a power of two.

    Notes
    -----
    White noise filtered in the frequency domain, a little more energy in every finer octave. Materials that look
    at the tile on two scales hide its period.
    """

    def __init__(self, gsd: float, seed: int = 0, *, tile: int = 1024) -> None:
        self.gsd = float(gsd)
        self._scale = 2.0 / self.gsd
        self._size = tile
        self._tile, self._cells = _random_fields(seed, tile)

    def sample(self, u: FloatArray, v: FloatArray, stretch: float = 1.0) -> Float32Array:
        """Field of zero mean and unit variance.

        Parameters
        ----------
        u, v : float64 ndarray
            Coordinates, metres; of one shape.
        stretch : float
            Features are so many times larger.

        Returns
        -------
        float32 ndarray of the same shape
        """
        x = u * (self._scale / stretch)
        y = v * (self._scale / stretch)
        column = np.floor(x)
        row = np.floor(y)
        fx = (x - column).astype(np.float32)
        fy = (y - row).astype(np.float32)
        size = self._size
        i = column.astype(np.int64) & (size - 1)
        j = (row.astype(np.int64) & (size - 1)) * size
        i_next = (i + 1) & (size - 1)
        j_next = (j + size) & (size * size - 1)
        tile = self._tile
        top = tile[i + j]
        top += fx * (tile[i_next + j] - top)
        bottom = tile[i + j_next]
        bottom += fx * (tile[i_next + j_next] - bottom)
        top += fy * (bottom - top)
        return top

    def cell(self, u: FloatArray, v: FloatArray) -> Float32Array:
        """One uniform random number in [0, 1) for each unit cell of (u, v)."""
        mask = _CELLS - 1
        row, column = np.floor(v).astype(np.int64) & mask, np.floor(u).astype(np.int64) & mask
        number: Float32Array = self._cells[row, column]
        return number

    def mottle(self, u: FloatArray, v: FloatArray) -> Float32Array:
        """Fine and coarse noise together, on turned axes so that the period does not show."""
        coarse = self.sample(0.83 * u + 0.56 * v + 31.0, 0.83 * v - 0.56 * u + 17.0, stretch=9.3)
        return np.float32(0.85) * self.sample(u, v) + np.float32(0.5) * coarse


def _tinted(colour: Colour, brightness: npt.NDArray[np.float32]) -> Float32Array:
    return np.asarray(colour, dtype=np.float32) * brightness[:, None]


def _inside(distance: FloatArray, half: float, softness: float) -> Float32Array:
    """1 where |distance| < half, 0 outside, with an edge `softness` wide."""
    return np.clip((half - np.abs(distance)) / softness + 0.5, 0.0, 1.0).astype(np.float32)


def _blend(below: Float32Array, above: Float32Array, weight: Float32Array) -> Float32Array:
    return below + weight[:, None] * (above - below)


@dataclass(frozen=True)
class Mottled:
    """One colour with noise: gravel roofs, plaster, foliage, bare test planes."""

    noise: Noise
    base: Colour = (0.55, 0.52, 0.47)
    contrast: float = 0.2
    offset: tuple[float, float] = (0.0, 0.0)
    stretch: float = 1.0

    def colour(self, coordinates: FloatArray) -> Float32Array:
        """See `Material.colour`."""
        u = (coordinates[0] + self.offset[0]) / self.stretch
        v = (coordinates[1] + self.offset[1]) / self.stretch
        return _tinted(self.base, 1.0 + np.float32(self.contrast) * self.noise.mottle(u, v))


@dataclass(frozen=True)
class RoofTiles:
    """Courses of tiles, each tile of its own brightness, weathered in patches."""

    noise: Noise
    base: Colour = (0.62, 0.33, 0.24)
    offset: tuple[float, float] = (0.0, 0.0)
    tile: float = 0.75

    def colour(self, coordinates: FloatArray) -> Float32Array:
        """See `Material.colour`."""
        u, v = coordinates
        course = v / self.tile
        place = u / self.tile + 0.5 * np.floor(course)
        shade = 0.80 + 0.28 * self.noise.cell(place + self.offset[0] * 7, course + self.offset[1] * 7)
        joint = np.abs(course - np.floor(course) - 0.5) * 2.0
        shade -= (0.16 * joint**4).astype(np.float32)
        shade += 0.11 * self.noise.mottle(u + self.offset[0], v + self.offset[1])
        return _tinted(self.base, shade)


@dataclass(frozen=True)
class Facade:
    """Plaster with rows of windows up to the eaves; v = 0 is the ground, u = 0 the middle of the wall."""

    noise: Noise
    base: Colour = (0.80, 0.76, 0.68)
    height: float = 6.0
    width: float = 8.0
    offset: tuple[float, float] = (0.0, 0.0)
    storey: float = 3.0

    def colour(self, coordinates: FloatArray) -> Float32Array:
        """See `Material.colour`."""
        u, v = coordinates
        soft = self.noise.gsd
        mottle = self.noise.mottle(u + self.offset[0], v + self.offset[1])
        wall = _tinted(self.base, 1.0 + 0.10 * mottle)
        count = max(round(self.width / 2.7), 1)
        spacing = self.width / count
        column = u / spacing + 0.5 * (count % 2)
        row = v / self.storey
        across = (column - np.floor(column) - 0.5) * spacing
        up = (row - np.floor(row) - 0.55) * self.storey
        has_window = ((v < self.height - 0.4) & (np.abs(u) < self.width / 2)).astype(np.float32)
        frame = has_window * _inside(across, 0.75, soft) * _inside(up, 0.90, soft)
        glass = has_window * _inside(across, 0.58, soft) * _inside(up, 0.74, soft)
        tone = self.noise.cell(column + self.offset[0] * 3, row + self.offset[1] * 3)
        reflection = 0.35 + 0.75 * tone + 0.12 * mottle
        wall = _blend(wall, _tinted((0.92, 0.91, 0.88), 1.0 + 0.04 * mottle), frame)
        wall = _blend(wall, _tinted((0.22, 0.27, 0.33), reflection), glass)
        plinth = _inside(v, 0.5, soft)
        return _blend(wall, _tinted((0.45, 0.43, 0.41), 1.0 + 0.12 * mottle), plinth)


@dataclass(frozen=True)
class Painting:
    """A painted map of the ground in world (x, y), with noise of locally varying contrast on top.

    Parameters
    ----------
    noise : Noise
    pixels : (rows, columns, 4) uint8
        RGB and the contrast of the noise (255 = 1.0); row 0 is the southern edge. Beyond its edge the map
        goes on as its mirror image.
    corner : (float, float)
        World (x, y) of the outer corner of pixel (0, 0), metres.
    texel : float
        Size of a pixel in metres.
    turn : float
        Angle in radians by which the axes of the noise, along which it repeats, are turned against x and y.
    """

    noise: Noise
    pixels: npt.NDArray[np.uint8] = field(repr=False)
    corner: tuple[float, float]
    texel: float
    turn: float = 0.0

    def colour(self, coordinates: FloatArray) -> Float32Array:
        """See `Material.colour`."""
        rows, columns = self.pixels.shape[:2]
        x, i, i_next = _mirrored((coordinates[0] - self.corner[0]) / self.texel - 0.5, columns)
        y, j, j_next = _mirrored((coordinates[1] - self.corner[1]) / self.texel - 0.5, rows)
        flat = self.pixels.reshape(-1, 4)
        x = x[:, None]
        y = y[:, None]
        low = flat[j * columns + i] * (1 - x) + flat[j * columns + i_next] * x
        high = flat[j_next * columns + i] * (1 - x) + flat[j_next * columns + i_next] * x
        value = (low + (high - low) * y) * np.float32(1.0 / 255.0)
        east, north = coordinates
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        detail = self.noise.sample(cosine * east + sine * north, cosine * north - sine * east)
        painted: Float32Array = value[:, :3] * (1.0 + value[:, 3] * detail)[:, None]
        return painted


def _mirrored(
    position: FloatArray, size: int
) -> tuple[Float32Array, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Fraction, index and next index of a position along an axis that continues as its mirror image."""
    whole = np.floor(position)
    fraction = (position - whole).astype(np.float32)
    index = whole.astype(np.int64)
    period = 2 * size
    index_next = (index + 1) % period
    index = index % period
    return fraction, np.minimum(index, period - 1 - index), np.minimum(index_next, period - 1 - index_next)
