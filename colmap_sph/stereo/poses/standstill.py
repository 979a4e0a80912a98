"""Images of a camera that turns → the pixels that stand still all the same: they do not belong to the scene.

A backdrop behind a turntable, the room behind an object that is turned in the hand, the legs of a drone, the
bonnet of a car, a time stamp: the poses are those of the scene, and all images show what moves with the camera at
the same place. Neighbouring images would even agree on depths of it, which their poses make up.

No surface of the scene looks the same, at the same place, in images that are turned far against each other. A
tower of four equal sides does at some of the turns only, and a mast on the axis of a circle of images, or the
horizon, has no texture in two directions; neither counts.
"""

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import View

Float = NDArray[np.float32]
Mask = NDArray[np.uint8]

# Images that are turned by so many degrees show no surface alike.
_TURNED = 45.0
# An object with equal sides looks alike at some turns, but hardly at this one. Where images are nowhere turned by
# less than the second, all may show one of its sides.
_TURNED_LITTLE = 20.0
_NOT_LITTLE = 35.0
# So many images of a camera are compared with the others, those that are turned most against each other; fewer
# than so many turned ones tell nothing.
_COMPARED = 9
_LEAST_COMPARED = 3
# Cameras whose sizes and focal lengths differ by no more than this show still things at the same place, ...
_ALIKE = 0.01
# ... and so many different ones are looked for: where all differ, nobody used one camera.
_MOST_CAMERAS = 16
# Images are smoothed by so many pixels, as backdrops shake and undistorted cameras differ by a pixel or so.
_SMOOTHING = 1.0
# Side of the windows that are compared, pixels, and the correlation of their slopes, both along rows and along
# columns, at which they show the same: an edge that stands still makes up for nothing across it.
_SIDE = 9
_LEAST_CORRELATION = 0.6
# A window has texture in two directions where the mean squared slopes along the one with less are at least so many
# grey values per pixel, and this share of their mean.
_LEAST_SLOPE = 1.0
_LEAST_SHARE = 0.2
# Windows beside what moves show that, too: still are also pixels at most so far from a still one whose own grey
# value, the mean of 3 x 3, differs by no more than this.
_REACH = _SIDE // 2
_SAME_GREY = 3.0


def turned_views(views: Sequence[View]) -> dict[str, tuple[str, ...]]:
    """Find images of the same camera that are turned far against each other.

    Parameters
    ----------
    views : sequence of View

    Returns
    -------
    dict of str to tuple of str
        Name of each view → those that it is to be compared with, nine at most; views with fewer than three are
        left out, and so are those cut from a photograph.

    Examples
    --------
    Four views in a row along a circle, 60° apart:

    >>> turns = [np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    ...          for a in np.radians([0, 60, 120, 180])]
    >>> views = [View(k, f"{k}", 40, 30, np.diag([50.0, 50, 1]), turn, np.zeros(3), np.empty(0, np.int64))
    ...          for k, turn in enumerate(turns)]
    >>> turned_views(views)["0"]
    ('3', '2', '1')
    """
    found = {}
    for members in _by_camera(views):
        rotations = np.array([view.R for view in members])
        chosen = _spread(rotations)
        for view, rotation in zip(members, rotations, strict=True):
            turned = _degrees(rotation, rotations[chosen]) >= _TURNED
            names = tuple(members[index].name for index in np.array(chosen)[turned])
            if len(names) >= _LEAST_COMPARED:
                found[view.name] = names
    return found


def slightly_turned_views(views: Sequence[View], names: Collection[str]) -> dict[str, str]:
    """Find of each of some views another of the same camera, turned by about 20 degrees; names → names.

    Views of which no other is turned by less than 35 degrees are left out.
    """
    found = {}
    for members in _by_camera(views):
        rotations = np.array([view.R for view in members])
        for index, view in enumerate(members):
            if view.name in names:
                turns = _degrees(view.R, rotations)
                turns[index] = np.inf
                nearest = int(np.abs(turns - _TURNED_LITTLE).argmin())
                if turns[nearest] < _NOT_LITTLE:
                    found[view.name] = members[nearest].name
    return found


def _by_camera(views: Sequence[View]) -> list[list[View]]:
    """Views with about the same size and focal length, in the order of their names."""
    cameras: list[tuple[NDArray[np.float64], list[View]]] = []
    for view in sorted(views, key=lambda view: view.name):
        if view.original:
            continue
        shape = np.array([view.width, view.height, view.K[0, 0]])
        for known, members in cameras:
            if (np.abs(shape - known) <= _ALIKE * known).all():
                members.append(view)
                break
        else:
            if len(cameras) < _MOST_CAMERAS:
                cameras.append((shape, [view]))
    return [members for _, members in cameras]


def _degrees(rotation: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles by which a rotation (3, 3) differs from others (n, 3, 3)."""
    cosines = (np.einsum("ij,nij->n", rotation, others) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosines, -1, 1))), np.float64)


def _spread(rotations: NDArray[np.float64]) -> list[int]:
    """The first of the rotations, and some more, each as far as can be from those before it."""
    chosen = [0]
    nearest = _degrees(rotations[0], rotations)
    while len(chosen) < min(_COMPARED, len(rotations)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, _degrees(rotations[chosen[-1]], rotations))
    return chosen


def still_pixels(image: Mask, others: Iterable[Mask]) -> Mask:
    """Find the pixels of an image that others, turned far against it, show alike at the same place.

    Parameters
    ----------
    image : (H, W) uint8 ndarray
        Grey values.
    others : iterable of (H', W') uint8 ndarray
        Those of images of the same camera, see `turned_views`, of about the same size.

    Returns
    -------
    (H, W) uint8 ndarray
        1 where more than half of the others show the same, else 0.
    """
    window = _Window(image)
    votes = np.zeros((2, *image.shape), np.uint8)
    number = 0
    for other in others:
        fitted = np.asarray(cv2.resize(other, image.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
        window.compare(_Window(fitted), votes)
        number += 1
    alike, same = 2 * votes > number
    near = cv2.dilate(alike.astype(np.uint8), np.ones((2 * _REACH + 1,) * 2, np.uint8))
    return np.where(alike, np.uint8(1), near & same)


class _Window:
    """An image, its slopes, and whether the window around each pixel has texture."""

    def __init__(self, image: Mask) -> None:
        grey = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SMOOTHING)
        self.smooth = cv2.blur(grey, (3, 3))
        self.slopes = [cv2.Sobel(grey, cv2.CV_32F, *axis, ksize=3, scale=1 / 8) for axis in ((1, 0), (0, 1))]
        self.squares = [_blurred(slope * slope) for slope in self.slopes]
        along, down = self.squares
        mean = (along + down) / 2
        least = mean - np.sqrt(((along - down) / 2) ** 2 + _blurred(self.slopes[0] * self.slopes[1]) ** 2)
        self.is_textured = least >= np.maximum(_LEAST_SLOPE, _LEAST_SHARE * mean)

    def compare(self, other: "_Window", votes: Mask) -> None:
        """Count where both windows are alike, and where both pixels are; votes (2, H, W)."""
        are_alike = self.is_textured & other.is_textured
        for slope, other_slope, square, other_square in zip(
            self.slopes, other.slopes, self.squares, other.squares, strict=True
        ):
            are_alike &= _blurred(slope * other_slope) >= _LEAST_CORRELATION * np.sqrt(square * other_square)
        votes[0] += are_alike
        votes[1] += np.abs(self.smooth - other.smooth) <= _SAME_GREY


def _blurred(values: NDArray[Any]) -> Float:
    return np.asarray(cv2.blur(values, (_SIDE, _SIDE)), np.float32)
