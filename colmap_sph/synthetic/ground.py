"""The demo's ground from above: meadows, fields, gardens, drives and marked roads, painted as one map."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.primitives import FloatArray
from colmap_sph.synthetic.texture import Noise, Painting

UInt8Array = npt.NDArray[np.uint8]
Paint = tuple[int, int, int, int]

# RGB and the contrast of the noise on it (255 = 1.0).
_MEADOW: Paint = (118, 132, 82, 34)
_LAWN: Paint = (126, 150, 88, 26)
_HEDGE: Paint = (58, 80, 44, 48)
_PAVING: Paint = (176, 168, 154, 20)
_GRAVEL_DRIVE: Paint = (158, 148, 132, 26)
_SIDEWALK: Paint = (172, 168, 162, 18)
_ASPHALT: Paint = (104, 104, 108, 22)
_MARKING: Paint = (228, 228, 222, 14)
_FIELDS: tuple[Paint, ...] = (
    (186, 166, 104, 24),
    (134, 106, 78, 30),
    (150, 160, 84, 26),
    (88, 122, 56, 34),
    (164, 138, 98, 26),
)
_SUB_PIXEL_BITS = 4


@dataclass(frozen=True)
class Road:
    """A road along a smooth line.

    Attributes
    ----------
    line : (N, 2) float64
        World points of the middle, metres, about half a metre apart.
    width : float
        Carriageway in metres; a footway of 1.6 m runs on either side.
    """

    line: FloatArray
    width: float

    def distance(self, points: FloatArray) -> FloatArray:
        """Distance in metres of points (N, 2) from the middle."""
        offset = points[:, None, :] - self.line[None, ::4, :]
        distance: FloatArray = np.sqrt(np.min(np.sum(offset**2, axis=2), axis=1))
        return distance


@dataclass(frozen=True)
class Plot:
    """A building's place: centre (2,), (length, width) and garden in metres, yaw in radians."""

    centre: FloatArray
    size: tuple[float, float]
    yaw: float
    garden: float


class _Canvas:
    """Drawing in metres on the map's pixels."""

    def __init__(self, extent: tuple[float, float, float, float], texel: float) -> None:
        self.x_low, self.y_low, x_high, y_high = extent
        self.texel = texel
        self.columns = round((x_high - self.x_low) / texel)
        self.rows = round((y_high - self.y_low) / texel)
        self.pixels: UInt8Array = np.empty((self.rows, self.columns, 4), dtype=np.uint8)

    def _fixed(self, points: FloatArray) -> npt.NDArray[np.int32]:
        pixels = (points - [self.x_low, self.y_low]) / self.texel - 0.5
        return np.rint(pixels * (1 << _SUB_PIXEL_BITS)).astype(np.int32)

    def fill(self, outline: FloatArray, paint: Paint) -> None:
        """Fill a convex outline (N, 2)."""
        cv2.fillConvexPoly(self.pixels, self._fixed(outline), paint, cv2.LINE_AA, _SUB_PIXEL_BITS)

    def stroke(self, line: FloatArray, width: float, paint: Paint) -> None:
        """Draw a line (N, 2) of a width in metres."""
        thickness = max(round(width / self.texel), 1)
        cv2.polylines(self.pixels, [self._fixed(line)], False, paint, thickness, cv2.LINE_AA, _SUB_PIXEL_BITS)

    def field(self, outline: FloatArray, paint: Paint, direction: float, spacing: float) -> None:
        """Fill an outline with furrows `spacing` metres apart."""
        corners = self._fixed(outline) >> _SUB_PIXEL_BITS
        left, top = np.maximum(corners.min(axis=0), 0)
        right, bottom = np.minimum(corners.max(axis=0) + 1, [self.columns, self.rows])
        if left >= right or top >= bottom:
            return
        mask = np.zeros((bottom - top, right - left), dtype=np.uint8)
        cv2.fillConvexPoly(mask, (corners - [left, top]).astype(np.int32), 255, cv2.LINE_AA)
        across = np.arange(left, right)[None, :] * self.texel * np.cos(direction)
        along = np.arange(top, bottom)[:, None] * self.texel * np.sin(direction)
        furrow = 1.0 + 0.07 * np.sin((2 * np.pi / spacing) * (across + along))
        colour = np.asarray(paint, dtype=np.float32) * furrow[..., None].astype(np.float32)
        colour[..., 3] = paint[3]
        weight = (mask / np.float32(255))[..., None]
        part = self.pixels[top:bottom, left:right]
        part[:] = np.clip(part + weight * (colour - part), 0, 255).astype(np.uint8)


def rectangle(centre: FloatArray, size: tuple[float, float], yaw: float) -> FloatArray:
    """Corners of a turned rectangle.

    Parameters
    ----------
    centre : (2,) float64 ndarray
        Metres.
    size : (float, float)
        Along the turned x and y, metres.
    yaw : float
        Radians, counter-clockwise.

    Returns
    -------
    (4, 2) float64 ndarray
        Metres, in order around the rectangle.
    """
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    signs = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners: FloatArray = centre + (signs * np.asarray(size)) @ axes
    return corners


def _paint_fields(canvas: _Canvas, plots: list[Plot], rng: np.random.Generator, cell: float) -> None:
    """A patchwork of fields wherever no building stands near."""
    nx = int(np.ceil(canvas.columns * canvas.texel / cell)) + 2
    ny = int(np.ceil(canvas.rows * canvas.texel / cell)) + 2
    corners = np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), axis=-1) * cell
    corners = corners + np.array([canvas.x_low - cell, canvas.y_low - cell])
    corners = corners + rng.uniform(-0.18 * cell, 0.18 * cell, corners.shape)
    for j in range(ny - 1):
        for i in range(nx - 1):
            outline = corners[[j, j, j + 1, j + 1], [i, i + 1, i + 1, i]]
            kind = rng.random()
            direction = rng.uniform(0, np.pi)
            spacing = rng.uniform(1.2, 2.0)
            near = any(np.hypot(*(plot.centre - outline.mean(axis=0))) < 0.62 * cell for plot in plots)
            if not near and kind < 0.7:
                canvas.field(outline, _FIELDS[int(kind / 0.7 * len(_FIELDS))], direction, spacing)


def _paint_plots(canvas: _Canvas, plots: list[Plot], roads: list[Road]) -> None:
    middle = np.concatenate([road.line for road in roads])
    for plot in plots:
        length, width = plot.size
        garden = rectangle(plot.centre, (length + plot.garden, width + plot.garden), plot.yaw)
        canvas.fill(garden, _LAWN)
        canvas.stroke(np.vstack([garden, garden[:1]]), 0.7, _HEDGE)
    for plot in plots:
        length, width = plot.size
        nearest = middle[np.argmin(np.sum((middle - plot.centre) ** 2, axis=1))]
        canvas.stroke(np.stack([plot.centre, nearest]), 3.0, _GRAVEL_DRIVE)
        canvas.fill(rectangle(plot.centre, (length + 2.4, width + 2.4), plot.yaw), _PAVING)


def _paint_roads(canvas: _Canvas, roads: list[Road]) -> None:
    for road in roads:
        canvas.stroke(road.line, road.width + 3.2, _SIDEWALK)
    for road in roads:
        canvas.stroke(road.line, road.width, _ASPHALT)
    for number, road in enumerate(roads):
        others = [other for k, other in enumerate(roads) if k != number]
        steps = np.linalg.norm(np.diff(road.line, axis=0), axis=1)
        place = np.concatenate([[0.0], np.cumsum(steps)])
        clear = np.full(place.shape, np.inf)
        for other in others:
            clear = np.minimum(clear, other.distance(road.line) - other.width / 2)
        for start in np.arange(0.0, place[-1] - 3.0, 6.0):
            dash = (place >= start) & (place <= start + 3.0)
            if dash.sum() > 1 and clear[dash].min() > 4.0:
                canvas.stroke(road.line[dash], 0.22, _MARKING)
        _paint_crossing(canvas, road, clear)


def _paint_crossing(canvas: _Canvas, road: Road, clear: FloatArray) -> None:
    """Zebra crossings where the road comes within three metres of a junction."""
    for index in np.flatnonzero(np.diff((clear > 3.0).astype(np.int8)) != 0):
        direction = road.line[index + 1] - road.line[index]
        direction = direction / np.linalg.norm(direction)
        across = np.array([-direction[1], direction[0]])
        for offset in np.arange(-road.width / 2 + 0.6, road.width / 2 - 0.3, 1.2):
            middle = road.line[index] + offset * across
            canvas.stroke(np.stack([middle - 1.3 * direction, middle + 1.3 * direction]), 0.6, _MARKING)


def paint_ground(
    extent: tuple[float, float, float, float],
    noise: Noise,
    plots: list[Plot],
    roads: list[Road],
    rng: np.random.Generator,
) -> Painting:
    """Paint the map of the ground.

    Parameters
    ----------
    extent : (x_low, y_low, x_high, y_high)
        World rectangle in metres.
    noise : Noise
        Its ground sampling distance sets the size of the map's pixels.
    plots : list of Plot
    roads : list of Road
    rng : numpy.random.Generator

    Returns
    -------
    Painting
    """
    canvas = _Canvas(extent, 0.8 * noise.gsd)
    canvas.pixels[:] = _MEADOW
    _paint_fields(canvas, plots, rng, cell=26.0)
    _paint_plots(canvas, plots, roads)
    _paint_roads(canvas, roads)
    cv2.GaussianBlur(canvas.pixels, (0, 0), 0.7, dst=canvas.pixels)
    _weather(canvas, noise)
    return Painting(noise, canvas.pixels, (canvas.x_low, canvas.y_low), canvas.texel)


def _weather(canvas: _Canvas, noise: Noise) -> None:
    """Broad patches of lighter and darker, warmer and colder ground."""
    step = 8
    x = (np.arange(0, canvas.columns, step) * canvas.texel)[None, :]
    y = (np.arange(0, canvas.rows, step) * canvas.texel)[:, None]
    x, y = np.broadcast_arrays(x, y)
    bright = 1.0 + 0.07 * noise.sample(0.8 * x + 0.6 * y, 0.8 * y - 0.6 * x, stretch=8.0)
    warm = 0.035 * noise.sample(0.6 * x - 0.8 * y + 77.0, 0.6 * y + 0.8 * x, stretch=17.0)
    factor = np.stack([bright * (1 + warm), bright, bright * (1 - warm)], axis=-1).astype(np.float32)
    size = (canvas.columns, canvas.rows)
    enlarged = cv2.resize(factor, size, interpolation=cv2.INTER_LINEAR)
    canvas.pixels[..., :3] = np.clip(canvas.pixels[..., :3] * enlarged, 0, 255).astype(np.uint8)
