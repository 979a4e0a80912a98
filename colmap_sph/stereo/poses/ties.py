"""Matched pair → ties: corners of one image, measured in the other along and across the rows.

Rows of a rectified pair are epipolar planes, so a corner and its match lie in one row, as far as poses and lens
are right. How far they do not is measured here, by least-squares matching (Grün & Baltsavias, 1988) of a few
hundred small windows along and across the rows. Errors of poses and lens shift matches along the rows as well,
unseen: the *row residual* of a pair tells how far its disparities can be trusted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.scene import View
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.rectified_pair import (
    Float,
    RectifiedPair,
    Side,
    pixel_from_rectified_ray,
    rectified_coordinates,
)

Windows = Callable[[Float, Float, int], NDArray[np.float32]]
"""Reads windows around places: see `read_windows`, whose last three parameters it has."""

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
# Side of the windows that are matched, rectified pixels.
_SIDE = 15
# Of the disparities around a tie so many must exist, and be within so many pixels of their plane.
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
    smooth, planes = surfaces_at(places, disparity)
    kept = slice(None, None, -(-len(smooth) // MAX_TIES) or 1)
    fine = geometry.resampled(finer)
    lefts, rights = partial(read_windows, left, fine, "left"), partial(read_windows, right, fine, "right")
    return measure_ties(places[smooth[kept]], planes[kept], lefts, rights, finer)


def surfaces_at(places: Float, disparity: NDArray[np.float32]) -> tuple[NDArray[np.int64], Float]:
    """Numbers (m,) of those places (n, 2) around which disparities lie on a plane, and (m, 3) the planes.

    A plane is the disparity at the place, and its change per column and row.
    """
    planes = np.empty((len(places), 3))
    roughness = np.empty(len(places), dtype=np.float32)
    _native.fit_surfaces(disparity, np.ascontiguousarray(places), _LEAST_FOUND, planes, roughness)
    smooth = np.flatnonzero(roughness <= _MAX_ROUGHNESS)
    return smooth, planes[smooth]


def measure_ties(places: Float, planes: Float, lefts: Windows, rights: Windows, finer: float = 1.0) -> Ties:
    """Match the windows around places of the left rectified image in the right one.

    Parameters
    ----------
    places : (n, 2) float64 ndarray
        Columns and rows.
    planes : (n, 3) float64 ndarray
        Of the disparities around them, see `surfaces_at`.
    lefts, rights : callable
        Read the windows of all places, in their order, which have `finer` pixels per pixel of these.
    finer : float
        See `find_ties`.
    """
    if not len(places):
        return Ties.none()
    places, planes = places * finer, planes * [finer, 1, 1]
    upright = np.tile([1.0, 0.0], (len(places), 1))
    template = _Template.of(lefts(places, upright, _SIDE + 2))
    start = np.column_stack([places[:, 0] - planes[:, 0], places[:, 1]])
    found = start.copy()
    # The right column of the window's pixel (i, j) is that of its middle, plus slopes · (i, j).
    slopes = np.column_stack([1 - planes[:, 1], -planes[:, 2]])
    for _ in range(_STEPS):
        window = rights(found, slopes, _SIDE)
        move, correlation, sigma = template.step(window)
        found -= np.column_stack([(slopes * move[:, :2]).sum(axis=1), move[:, 1]])
        slopes -= slopes[:, :1] * move[:, 2:]
    good = (correlation > _LEAST_CORRELATION) & (sigma < _MAX_SIGMA).all(axis=1)
    good &= (np.abs(move[:, :2]) < _CONVERGED).all(axis=1) & (np.abs(found - start) < MAX_MOVE).all(axis=1)
    measured = ((part[good] / finer).astype(np.float32) for part in (places, found, sigma[:, 1]))
    return Ties(*measured)


@dataclass(frozen=True, eq=False)
class _Template:
    """Left windows, normalised, and how they change when they move: shift along and across, and two slopes."""

    values: NDArray[np.float32]
    jacobian: NDArray[np.float32]
    inverse: NDArray[np.float32]

    @classmethod
    def of(cls, windows: NDArray[np.float32]) -> "_Template":
        """From (n, h + 2, w + 2) grey values, with a rim of one pixel for the gradients."""
        count, pixels = len(windows), (windows.shape[1] - 2) * (windows.shape[2] - 2)
        values = np.empty((count, pixels), dtype=np.float32)
        jacobian = np.empty((count, 4, pixels), dtype=np.float32)
        normal = np.empty((count, 4, 4), dtype=np.float32)
        _native.make_templates(windows, _LEAST_CONTRAST, values, jacobian, normal)
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
        count = len(windows)
        move = np.empty((count, 4), dtype=np.float32)
        correlation = np.empty(count, dtype=np.float32)
        variance = np.empty(count, dtype=np.float32)
        template = self.values, self.jacobian, self.inverse
        flat = windows.reshape(count, -1)
        _native.step_windows(*template, flat, _LEAST_CONTRAST, move, correlation, variance)
        spread = np.diagonal(self.inverse, axis1=1, axis2=2)[:, :2]
        return move, correlation, np.sqrt(_CORRELATED * variance[:, None] * spread)


def read_windows(
    photo: tuple[View, NDArray[np.uint8] | NDArray[np.float32]],
    geometry: RectifiedPair,
    side: Side,
    places: Float,
    slopes: Float,
    length: int,
) -> NDArray[np.float32]:
    """(n, length, length) grey values of windows, straight from the image, whose border is repeated.

    Pixel (i, j) from the middle of a window lies at column place + slopes · (i, j), row place + j.
    """
    view, image = photo
    columns = np.empty((len(places), length, length), dtype=np.float32)
    rows = np.empty_like(columns)
    _native.place_windows(
        backend(),
        places,
        slopes,
        pixel_from_rectified_ray(view, geometry),
        (geometry.column_origin(side), geometry.row_origin),
        (geometry.columns_per_radian, geometry.rows_per_radian),
        geometry.surface == "spherical",
        geometry.flatness,
        columns,
        rows,
    )
    columns_there, rows_there = (part.reshape(-1, length) for part in (columns, rows))
    values = cv2.remap(image, columns_there, rows_there, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(columns.shape)


def filled_residuals(measured: Sequence[float | None]) -> list[float]:
    """Row residuals of pairs, with the median of all for those with too few ties; 0 where none has enough."""
    known = [value for value in measured if value is not None]
    usual = float(np.median(known)) if known else 0.0
    return [usual if value is None else value for value in measured]
