"""Cloud and samples of all views, from above → the layers of a map, with cameras and footprints to draw on it."""

import threading
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.pictures import COLOURS, shaded
from colmap_sph.pages.reasons import Reason
from colmap_sph.pages.samples import MapSamples
from colmap_sph.scene import Photograph, View

Bytes = NDArray[np.uint8]

# Cells along the longer side: of what the cloud shows, and of what is counted.
_MOST_CELLS = 720
_FEWEST_CELLS = 48
_COUNTED_CELLS = 160
# Cloud points per cell that leave few holes.
_POINTS_PER_CELL = 3.0
# Gaps narrower than so many cells are not the scene's: the cloud is thinned, or only some of its points are drawn.
_GAP = 5
# Share of points and cameras that the frame goes around; it is then wider by so much.
_INSIDE = 98.0
_MARGIN = 0.04
_NOTHING_LOST = (Reason.CONFIRMED, Reason.OUTSIDE, Reason.MASKED)


@dataclass(frozen=True, eq=False)
class Frame:
    """The rectangle that a map shows, and its axes.

    Attributes
    ----------
    axes : (3, 3) float64 ndarray
        See `map_axes`.
    left, bottom, width, height : float
        In model units along the axes.
    low, high : float
        Where the surface lies along the axis that points up.
    """

    axes: NDArray[np.float64]
    left: float
    bottom: float
    width: float
    height: float
    low: float
    high: float

    def cells(self, longest: int) -> tuple[int, int]:
        """Rows and columns of square cells, so many along the longer side."""
        side = max(self.width, self.height) / longest
        return max(round(self.height / side), 1), max(round(self.width / side), 1)

    def place(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) of world points: shares of the width from the left, and of the height from the top."""
        along = points @ self.axes[:2].T
        x = (along[:, 0] - self.left) / self.width
        y = 1 - (along[:, 1] - self.bottom) / self.height
        return np.column_stack([x, y])


def frame_around(points: NDArray[np.float64], centers: NDArray[np.float64], axes: NDArray[np.float64]) -> Frame:
    """Frame points of the surface, and the cameras as far as they are not far away."""
    ends = (50 - _INSIDE / 2, 50 + _INSIDE / 2)
    along = (points if len(points) else centers) @ axes.T
    low, high = np.percentile(along, ends, axis=0)
    size = max((high - low)[:2].max(), 1e-9)
    cameras = np.percentile(centers @ axes.T, ends, axis=0)
    low[:2] = np.maximum(np.minimum(low, cameras[0]), low - size)[:2]
    high[:2] = np.minimum(np.maximum(high, cameras[1]), high + size)[:2]
    margin = _MARGIN * max((high - low)[:2].max(), 1e-9)
    width, height = (high - low)[:2] + 2 * margin
    return Frame(axes, low[0] - margin, low[1] - margin, width, height, low[2], high[2])


def seen_from_above(
    frame: Frame, points: NDArray[np.float64], colours: Bytes
) -> tuple[Bytes, Bytes, tuple[float, float]]:
    """Draw the highest point of each cell, in small gaps that of the nearest.

    Parameters
    ----------
    frame : Frame
    points : (n, 3) float64 ndarray
        World frame.
    colours : (n, 3) uint8 ndarray

    Returns
    -------
    coloured, heights : (h, w, 4) uint8 ndarray
        Clear where there is no point.
    ends : (float, float)
        Least and largest height of the scale, relative to the least.
    """
    area = min(frame.width, frame.height) / max(frame.width, frame.height)
    longest = int(np.clip(np.sqrt(len(points) / _POINTS_PER_CELL / area), _FEWEST_CELLS, _MOST_CELLS))
    shape = frame.cells(longest)
    up = points @ frame.axes[2]
    cells, inside = _cells(frame, points, shape)
    highest = np.full(shape[0] * shape[1], -np.inf)
    np.maximum.at(highest, cells, up[inside])
    is_highest = up[inside] == highest[cells]
    top = np.full(len(highest), -1, np.int64)
    top[cells[is_highest]] = np.flatnonzero(inside)[is_highest]  # of several the last counts
    top = _without_gaps(top.reshape(shape))
    there = top >= 0
    picture = np.zeros((*shape, 4), np.uint8)
    if there.any():
        picture[there] = np.column_stack([colours[top[there]], np.full(there.sum(), 255, np.uint8)])
    height = np.where(there, up[np.maximum(top, 0)] if len(up) else 0.0, 0.0)
    extent = max(frame.high - frame.low, 1e-12)
    return picture, shaded((height - frame.low) / extent, there, clear=True), (0.0, extent)


def _without_gaps(top: NDArray[np.int64]) -> NDArray[np.int64]:
    """(h, w) numbers of points in cells, -1: none; in small gaps between them that of the nearest instead."""
    empty = (top < 0).astype(np.uint8)
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_GAP, _GAP))
    closed = cv2.morphologyEx(1 - empty, cv2.MORPH_CLOSE, around)
    _, nearest = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    point_of = np.full(nearest.max() + 1, -1)
    point_of[nearest[empty == 0]] = top[empty == 0]
    return np.where(closed > 0, point_of[nearest], top)


def _cells(
    frame: Frame, points: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Numbers of the cells of those points that lie in the frame, and which these are."""
    x, y = (frame.place(points) * [shape[1], shape[0]]).T
    inside = np.asarray((x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0]))
    return np.asarray(y[inside].astype(np.int64) * shape[1] + x[inside].astype(np.int64)), inside


@dataclass(eq=False)
class Ground:
    """What all views know of each cell of a map, added up view by view, in any order and by any thread.

    Attributes
    ----------
    frame : Frame
    images : (h, w) int32 ndarray
        Images with a confirmed depth there.
    gsd : (h, w) float32 ndarray
        Of the finest of them, model units per pixel; infinite without any.
    samples : (reasons, h, w) int64 ndarray
        Samples of each `Reason`.
    """

    frame: Frame
    images: NDArray[np.int32] = field(init=False)
    gsd: NDArray[np.float32] = field(init=False)
    samples: NDArray[np.int64] = field(init=False)
    _lock: threading.Lock = field(init=False, default_factory=threading.Lock)

    def __post_init__(self) -> None:
        shape = self.frame.cells(_COUNTED_CELLS)
        self.images = np.zeros(shape, np.int32)
        self.gsd = np.full(shape, np.inf, np.float32)
        self.samples = np.zeros((len(Reason), *shape), np.int64)

    def add(self, view: View, samples: MapSamples, reasons: Bytes, depth: NDArray[np.float32]) -> None:
        """Add a view's samples, with what `find_reasons` says of them."""
        self.add_points(surface_points(view, samples, depth), reasons.ravel(), depth.ravel(), view.K[0, 0])

    def add_points(
        self, points: NDArray[np.float64], reasons: Bytes, depth: NDArray[np.float32], focal: np.float64
    ) -> None:
        """Add (n,) samples of an image with a focal length: world points (n, 3), their `Reason`s and depths."""
        height = points @ self.frame.axes[2]
        slack = 0.1 * (self.frame.high - self.frame.low)
        # Sky and the like have a depth that is made up.
        likely = (depth > 0) & (height >= self.frame.low - slack) & (height <= self.frame.high + slack)
        shape = self.images.shape
        cells, inside = _cells(self.frame, points, (shape[0], shape[1]))
        likely = likely[inside]
        cells = cells[likely]
        which = reasons[inside][likely]
        seen = cells[which == Reason.CONFIRMED]
        gsd = (depth[inside][likely] / focal)[which == Reason.CONFIRMED]
        with self._lock:
            np.add.at(self.samples.reshape(len(Reason), -1), (which, cells), 1)
            self.images.ravel()[np.unique(seen)] += 1
            np.minimum.at(self.gsd.reshape(-1), seen, gsd)

    def count_layer(self) -> tuple[Bytes, tuple[float, float]]:
        """How many images see each cell, on a scale from 0."""
        most = max(int(np.percentile(self.images[self.images > 0], 98)) if self.images.any() else 1, 1)
        return shaded(self.images / most, self.images > 0, clear=True), (0, most)

    def gsd_layer(self) -> tuple[Bytes, tuple[float, float] | None]:
        """GSD of the finest image, fine yellow and coarse blue, and the ends of the scale."""
        there = np.isfinite(self.gsd)
        if not there.any():
            return shaded(self.gsd, there, clear=True), None
        fine, coarse = (float(value) for value in np.percentile(self.gsd[there], (1, 99)))
        scaled = (np.where(there, self.gsd, 0) - fine) / max(coarse - fine, 1e-6 * coarse)
        return shaded(1 - scaled, there, clear=True), (fine, coarse)

    def weak_layer(self) -> tuple[Bytes, dict[Reason, float]]:
        """Cells of which more was lost than confirmed, in the colour of the most frequent reason.

        Returns
        -------
        picture : (h, w, 4) uint8 ndarray
        shares : dict
            Of all cells with any sample that was asked for those that are weak for each reason, the largest first.
        """
        lost = self.samples.copy()
        lost[list(_NOTHING_LOST)] = 0
        weak = lost.sum(axis=0) > self.samples[Reason.CONFIRMED]
        why = lost.argmax(axis=0)
        table = np.array([COLOURS[reason] for reason in Reason], np.uint8)
        picture = np.dstack([table[why], np.where(weak, 255, 0).astype(np.uint8)])
        wanted = [reason for reason in Reason if reason != Reason.OUTSIDE]
        known = max(int(self.samples[wanted].any(axis=0).sum()), 1)
        shares = {reason: float((weak & (why == reason)).sum() / known) for reason in Reason}
        largest = sorted(shares.items(), key=lambda item: -item[1])
        return picture, {reason: share for reason, share in largest if share > 0}


def surface_points(view: View, samples: MapSamples, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """(h w, 3) world points of a view's samples."""
    columns, rows = np.meshgrid(samples.columns, samples.rows)
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)])
    rays = view.inverse_K @ pixels * depth.reshape(1, -1)
    return np.asarray((rays - view.t[:, None]).T @ view.R)


def footprint(view: View, samples: MapSamples, depth: NDArray[np.float32], frame: Frame) -> NDArray[np.float64]:
    """(4, 2) places on a map of what the samples in an image's corners see."""
    grid = surface_points(view, samples, depth).reshape(*depth.shape, 3)
    return frame.place(np.array([grid[0, 0], grid[0, -1], grid[-1, -1], grid[-1, 0]]))


def looks_towards(view: View | Photograph, frame: Frame) -> NDArray[np.float64]:
    """(2,) direction of view on a map, to the right and down; short where the camera looks along its normal."""
    along = frame.axes[:2] @ view.viewing_direction
    return np.array([along[0], -along[1]])
