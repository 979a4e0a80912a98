"""View and box → the part of the view's image that may show what lies in the box: its outline, and a window."""

from dataclasses import replace
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Region, View
from colmap_sph.stereo.partners.frusta import sees

# Rays along each side of an image, and points along each side of a box.
_RAYS = 65
_BOX_POINTS = 9
# What is less wide or high is not worth a look.
_LEAST_SIDE = 16

Map = TypeVar("Map", bound=np.generic)


class Window(NamedTuple):
    """Columns `left` to `right` and rows `top` to `bottom` of an image, these excluded."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def whole(cls, view: View) -> "Window":
        """All of a view's image."""
        return cls(0, 0, view.width, view.height)

    @classmethod
    def around(cls, outline: NDArray[np.float64]) -> "Window":
        """The pixels that an outline of (n, 2) corners touches."""
        low = np.floor(outline.min(axis=0)).astype(int)
        high = np.ceil(outline.max(axis=0)).astype(int)
        return cls(*low.tolist(), *high.tolist())

    @property
    def num_pixels(self) -> int:
        """Pixels in it."""
        return (self.right - self.left) * (self.bottom - self.top)

    def view(self, view: View) -> View:
        """What of a view lies in it."""
        return view.cropped(*self)

    def part(self, pixels: NDArray[Map]) -> NDArray[Map]:
        """(h, w, …) what of an (H, W, …) array of pixels lies in it."""
        return np.ascontiguousarray(pixels[self.top : self.bottom, self.left : self.right])

    def padded(self, pixels: NDArray[Map], view: View) -> NDArray[Map]:
        """The (H, W, …) array of a view's pixels that has (h, w, …) `pixels` in it, and 0 around."""
        if self == Window.whole(view):
            return pixels
        whole = np.zeros((view.height, view.width, *pixels.shape[2:]), pixels.dtype)
        whole[self.top : self.bottom, self.left : self.right] = pixels
        return whole


def turned(view: View, region: Region) -> View:
    """The view in a world frame whose axes are a region's."""
    return view if region.axes is None else replace(view, R=view.R @ region.axes.T)


def outline_on(view: View, box: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Outline what of a view may show the inside of a box, with some room around; None where next to nothing does.

    Parameters
    ----------
    view : View
    box : (2, 3) float64 ndarray
        Least and most coordinates in the view's world frame, finite.

    Returns
    -------
    (n, 2) float64 ndarray or None
        Corners of a convex polygon, in image coordinates; see `extent.outline_of` for their order.

    Examples
    --------
    A camera of 640 x 640 pixels looks at the middle of a box that is half as wide as what it sees:

    >>> K = np.array([[640.0, 0, 320], [0, 640, 320], [0, 0, 1]])
    >>> view = View(1, "a", 640, 640, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    >>> Window.around(outline_on(view, np.array([[-2.5, -2.5, 10], [2.5, 2.5, 11]])))
    Window(left=150, top=150, right=490, bottom=490)
    """
    steps = np.linspace(0, 1, _RAYS)
    x, y = (each.ravel() for each in np.meshgrid(steps * view.width, steps * view.height))
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ view.inverse_K.T @ view.R
    # The depths at which each ray enters and leaves the three slabs that make the box.
    with np.errstate(divide="ignore", invalid="ignore"):
        enters, leaves = np.sort((box[:, None] - view.center) / rays, axis=0)
    meets = np.fmax.reduce(enters, axis=1, initial=0.0) <= np.fmin.reduce(leaves, axis=1, initial=np.inf)
    # A small box lies between the rays.
    sides = np.meshgrid(*(np.linspace(low, high, _BOX_POINTS) for low, high in box.T))
    points = np.stack([side.ravel() for side in sides], axis=1)
    shown = np.concatenate([np.stack([x[meets], y[meets]], axis=1), view.project(points[sees(view, points)])[0]])
    if not len(shown):
        return None
    size = np.array([view.width, view.height])
    room = size / (_RAYS - 1) * [[-1, -1], [-1, 1], [1, -1], [1, 1]]
    corners = np.clip((shown[:, None] + room).reshape(-1, 2), 0, size)
    hull = cv2.convexHull(corners.astype(np.float32))[:, 0].astype(np.float64)
    if (np.ptp(hull, axis=0) < _LEAST_SIDE).any():
        return None
    return hull if _turns_as_images_do(hull) else hull[::-1]


def _turns_as_images_do(outline: NDArray[np.float64]) -> bool:
    x, y = outline.T
    return bool(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0)
