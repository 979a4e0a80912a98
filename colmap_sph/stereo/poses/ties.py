"""Matched pair → ties: corners of one image, measured in the other along and across the rows.

Rows of a rectified pair are epipolar planes, so a corner and its match lie in one row, as far as poses and lens
are right. How far they do not is measured here, by least-squares matching (Grün & Baltsavias, 1988) of a few
hundred small windows along and across the rows. Errors of poses and lens shift matches along the rows as well,
unseen: the *row residual* of a pair tells how far its disparities can be trusted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View
from colmap_sph.stereo.rectified_pair import (
    Float,
    RectifiedPair,
    Side,
    pixel_from_rectified_ray,
    rectified_coordinates,
)

MAX_TIES = 300
"""Of a pair."""
MIN_TIES = 30
"""Fewer ties tell too little of a pair."""

MAX_MOVE = 6.0
"""A window that moves by more pixels, along or across the rows, is lost: no row residual is larger."""

MAX_RESIDUAL = 0.45
"""Rows that disagree by more rectified pixels, root mean square, show windows that are too different to match."""
# A pair keeps so much of its rows and columns, however imprecise its poses are.
_LEAST = 0.25

# A corner is looked for in every cell of an image; so many cells along its longer side.
_CELLS = 64
_CORNER_WINDOW = 5
# Radius of the windows that are matched, and of those whose disparities must be one surface, rectified pixels.
_RADIUS = 7
_SURFACE_RADIUS = 4
# Of the disparities there so many must exist, and be within so many pixels of their plane.
_LEAST_FOUND = 0.8
_MAX_ROUGHNESS = 1.0
# Steps of the least squares: they converge fast where they do.
_STEPS = 5
_CONVERGED = 0.02
_LEAST_CORRELATION = 0.8
# A tie must know both its places by so much, pixels of standard deviation: not on an edge alone.
_MAX_SIGMA = 0.15
# What windows of perfectly posed images measure, pixels: interpolation and slants.
_NOISE_FLOOR = 0.08
# Neighbouring pixels share about half of what they say: resampled, and blurred by the lens.
_CORRELATED = 2.0
# Grey values: windows of less contrast hold noise.
_LEAST_CONTRAST = 0.5
_REGULARISER = 1e-3
# Residuals beyond so many robust standard deviations are mismatches.
_OUTLIER = 3.0
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class Ties:
    """Corners of the left image of a pair, and where the right one shows them.

    Attributes
    ----------
    left, right : (n, 2) float32 ndarray
        Column and row, rectified array coordinates.
    sigma : (n,) float32 ndarray
        Standard deviation of a right row, pixels, as the windows' noise gives it.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    sigma: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.left)

    @classmethod
    def none(cls) -> "Ties":
        """No tie."""
        return cls(np.empty((0, 2), np.float32), np.empty((0, 2), np.float32), np.empty(0, np.float32))

    @property
    def row_shifts(self) -> NDArray[np.float32]:
        """(n,) right row less left row, pixels."""
        return np.asarray(self.right[:, 1] - self.left[:, 1])


def row_residual(ties: Ties) -> float | None:
    """Root mean square of the row shifts beyond what windows measure anyway, pixels; None of too few ties.

    Mismatches are left out: shifts beyond three robust standard deviations.
    """
    if len(ties) < MIN_TIES:
        return None
    shifts = ties.row_shifts.astype(float)
    scale = max(_MAD_TO_SIGMA * float(np.median(np.abs(shifts))), _NOISE_FLOOR)
    kept = np.abs(shifts) <= _OUTLIER * scale
    noise = max(_NOISE_FLOOR**2, float(np.mean(ties.sigma[kept].astype(float) ** 2)))
    return round(float(np.sqrt(max(float(np.mean(shifts[kept] ** 2)) - noise, 0.0))), 2)


def tolerable_sampling(residual: float, trial: float) -> float:
    """How much of a pair's rows and columns to keep, so that what its rows disagree by does not hide matches.

    Parameters
    ----------
    residual : float
        Row residual, pixels, when the pair was matched at the share `trial` of its rows and columns.
    trial : float

    Returns
    -------
    float
        0.25 to 1.
    """
    if residual <= MAX_RESIDUAL * trial:
        return 1.0
    return round(max(MAX_RESIDUAL * trial / residual, _LEAST), 2)


def find_corners(image: NDArray[np.uint8] | NDArray[np.float32]) -> Float:
    """The best corner of every cell of an image, the same whichever pair asks.

    Parameters
    ----------
    image : (H, W) uint8 or float32 ndarray
        Grey.

    Returns
    -------
    (n, 2) float64 ndarray
        Image coordinates, the sharpest corners first.
    """
    height, width = image.shape
    cell = max(-(-max(height, width) // _CELLS), 2 * _CORNER_WINDOW)
    columns = np.arange(width // cell)
    found = [np.empty((0, 3))]
    for top in range(0, height - cell + 1, cell):
        first = max(top - _CORNER_WINDOW, 0)
        strength = cv2.cornerMinEigenVal(image[first : top + cell + _CORNER_WINDOW], _CORNER_WINDOW)
        band = strength[top - first :][:cell, : len(columns) * cell].reshape(cell, len(columns), cell)
        cells = band.swapaxes(0, 1).reshape(len(columns), cell * cell)
        best = cells.argmax(axis=1)
        found.append(np.column_stack([columns * cell + best % cell, top + best // cell, cells[columns, best]]))
    corners = np.concatenate(found)
    order = np.argsort(-corners[:, 2], kind="stable")
    return corners[order, :2] + 0.5


def find_ties(
    left: tuple[View, NDArray[np.uint8] | NDArray[np.float32]],
    right: tuple[View, NDArray[np.uint8] | NDArray[np.float32]],
    geometry: RectifiedPair,
    disparity: NDArray[np.float32],
    corners: Float,
    finer: float = 1.0,
) -> Ties:
    """Measure corners of the left image in the right one.

    Parameters
    ----------
    left, right : (View, (h, w) uint8 or float32 ndarray)
        Both views with their grey undistorted images.
    geometry : RectifiedPair
    disparity : (H, W_left) float32 ndarray
        Of the left image's pixels; NaN = none. Where to look, and that it is one surface.
    corners : (n, 2) float64 ndarray
        Image coordinates in the left image, the best first.
    finer : float
        The windows have so many pixels per rectified pixel: what is matched coarsely can be measured finely.

    Returns
    -------
    Ties
        At most `MAX_TIES`, in pixels of `geometry`.
    """
    places = rectified_coordinates(left[0], geometry, "left", corners)
    places, planes = _on_surfaces(places, disparity)
    if not len(places):
        return Ties.none()
    fine = geometry.resampled(finer)
    places, planes = places * finer, planes * [finer, 1, 1]
    template = _Template.of(_windows(left, fine, "left", _around(places, _RADIUS + 1)))
    found = np.column_stack([places[:, 0] - planes[:, 0], places[:, 1]])
    # The right column of the window's pixel (i, j) is that of its middle, plus slopes · (i, j).
    slopes = np.column_stack([1 - planes[:, 1], -planes[:, 2]])
    for _ in range(_STEPS):
        window = _windows(right, fine, "right", _around(found, _RADIUS, slopes))
        move, correlation, sigma = template.step(window)
        found -= np.column_stack([(slopes * move[:, :2]).sum(axis=1), move[:, 1]])
        slopes -= slopes[:, :1] * move[:, 2:]
    start = np.column_stack([places[:, 0] - planes[:, 0], places[:, 1]])
    good = (correlation > _LEAST_CORRELATION) & (sigma < _MAX_SIGMA).all(axis=1)
    good &= (np.abs(move[:, :2]) < _CONVERGED).all(axis=1) & (np.abs(found - start) < MAX_MOVE).all(axis=1)
    measured = ((part[good] / finer).astype(np.float32) for part in (places, found, sigma[:, 1]))
    return Ties(*measured)


def _on_surfaces(places: Float, disparity: NDArray[np.float32]) -> tuple[Float, Float]:
    """Those places, up to `MAX_TIES`, around which disparities lie on a plane, and (n, 3) the planes.

    A plane is the disparity in the middle of the window, and its change per column and row.
    """
    height, width = disparity.shape
    middle = np.rint(places).astype(int)
    size = [width - 1, height - 1]
    inside = ((middle >= _SURFACE_RADIUS) & (middle <= np.array(size) - _SURFACE_RADIUS)).all(axis=1)
    places, middle = places[inside], middle[inside]
    steps = np.arange(-_SURFACE_RADIUS, _SURFACE_RADIUS + 1)
    window = disparity[middle[:, 1, None, None] + steps[:, None], middle[:, 0, None, None] + steps].astype(float)
    column, row = (part.ravel() for part in np.meshgrid(steps, steps))
    window = window.reshape(-1, len(column))  # there may be no window
    there = np.isfinite(window)
    found = there.mean(axis=1) >= _LEAST_FOUND
    places, middle, window, there = (part[found] for part in (places, middle, window, there))
    basis = np.stack([np.ones(len(column)), column, row], axis=1)
    values = np.where(there, window, 0)
    normal = (there @ (basis[:, :, None] * basis[:, None]).reshape(len(basis), -1)).reshape(-1, 3, 3)
    planes = np.asarray(np.linalg.solve(normal, (values @ basis)[:, :, None]), float)[:, :, 0]
    rough = np.where(there, np.abs(window - planes @ basis.T), 0).max(axis=1)
    smooth = np.flatnonzero(rough <= _MAX_ROUGHNESS)
    smooth = smooth[:: -(-len(smooth) // MAX_TIES) or 1]
    planes[:, 0] += ((places - middle) * planes[:, 1:]).sum(axis=1)
    return places[smooth], np.asarray(planes[smooth])


def _around(places: Float, radius: int, slopes: Float | None = None) -> tuple[Float, Float]:
    """(n, h, w) columns and (n, h, 1) rows of windows around places, with sloping columns if these are given."""
    offsets = np.arange(-radius, radius + 1, dtype=float)
    i, j = offsets[None, None, :], offsets[None, :, None]
    along = i + 0 * j if slopes is None else slopes[:, 0, None, None] * i + slopes[:, 1, None, None] * j
    columns = places[:, 0, None, None] + along
    return columns, places[:, 1, None, None] + j


@dataclass(frozen=True, eq=False)
class _Template:
    """Left windows, normalised, and how they change when they move: shift along and across, and two slopes."""

    values: NDArray[np.float32]
    jacobian: NDArray[np.float32]
    inverse: NDArray[np.float32]

    @classmethod
    def of(cls, windows: NDArray[np.float32]) -> "_Template":
        """From (n, 2 r + 3, 2 r + 3) grey values, with a rim of one pixel for the gradients."""
        inner = windows[:, 1:-1, 1:-1]
        values, scale = _normalised(inner)
        along = (windows[:, 1:-1, 2:] - windows[:, 1:-1, :-2]).reshape(values.shape) / (2 * scale)
        across = (windows[:, 2:, 1:-1] - windows[:, :-2, 1:-1]).reshape(values.shape) / (2 * scale)
        radius = inner.shape[1] // 2
        j, i = (part.ravel() for part in np.mgrid[-radius : radius + 1, -radius : radius + 1])
        jacobian = np.stack([along, across, along * i, along * j], axis=2)
        jacobian -= jacobian.mean(axis=1, keepdims=True)
        normal = jacobian.swapaxes(1, 2) @ jacobian
        # What a window does not tell moves it nowhere, and has no small standard deviation.
        normal += _REGULARISER * np.eye(4, dtype=np.float32)
        return cls(values, jacobian, np.linalg.inv(normal))

    def step(
        self, windows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """One step of the least squares (inverse compositional) towards right windows.

        Returns
        -------
        move : (n, 4) float32 ndarray
            Of the window's pixels: along and across, and the change of the slopes.
        correlation : (n,) float32 ndarray
        sigma : (n, 2) float32 ndarray
            Standard deviations of the shift along and across, pixels.
        """
        values, _ = _normalised(windows)
        difference = values - self.values
        move = (self.inverse @ (self.jacobian.swapaxes(1, 2) @ difference[:, :, None]))[:, :, 0]
        variance = (difference**2).mean(axis=1)
        correlation = (values * self.values).mean(axis=1)
        spread = np.diagonal(self.inverse, axis1=1, axis2=2)[:, :2]
        return move, correlation, np.sqrt(_CORRELATED * variance[:, None] * spread)


def _normalised(windows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(n, pixels) windows with mean 0 and variance 1, and (n, 1) the standard deviations that they had."""
    flat = windows.reshape(len(windows), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    scale = np.sqrt((flat**2).mean(axis=1, keepdims=True)) + _LEAST_CONTRAST
    return flat / scale, scale


def _windows(
    photo: tuple[View, NDArray[np.uint8] | NDArray[np.float32]],
    geometry: RectifiedPair,
    side: Side,
    places: tuple[Float, Float],
) -> NDArray[np.float32]:
    """Grey values at (n, h, w) columns and (n, h, 1) rows, straight from the image, whose border is repeated."""
    view, image = photo
    columns, rows = places
    along = ((columns + geometry.column_origin(side)) / geometry.columns_per_radian).astype(np.float32)
    across = ((rows + geometry.row_origin) / geometry.rows_per_radian).astype(np.float32)
    # Rows are the same all along a window: most of a ray is known by them, see `resampling`.
    if geometry.surface == "spherical":
        sine, cosine, row_ray = np.sin(along), np.cos(along), (np.sin(across), np.cos(across))
    else:
        sine, cosine, row_ray = along, np.ones_like(along), (across, np.ones_like(across))
    camera = pixel_from_rectified_ray(view, geometry).astype(np.float32)
    x, y, z = (a * sine + (b * row_ray[0] + c * row_ray[1]) * cosine for a, b, c in camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        # COLMAP counts from the pixel's corner, cv2.remap from its centre.
        maps = [np.where(z > 0, part / z, -1) - np.float32(0.5) for part in (x, y)]
    columns_there, rows_there = (part.reshape(-1, part.shape[-1]) for part in maps)
    values = cv2.remap(image, columns_there, rows_there, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(maps[0].shape)


def filled_residuals(measured: Sequence[float | None]) -> list[float]:
    """Row residuals of pairs, with the median of all for those with too few ties; 0 where none has enough."""
    known = [value for value in measured if value is not None]
    usual = float(np.median(known)) if known else 0.0
    return [usual if value is None else value for value in measured]
