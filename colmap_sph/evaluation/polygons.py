"""Polygons of any number of corners → triangles."""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt

_MAX_CORNERS = 1000

Faces = npt.NDArray[np.int64]


class Polygons:
    """Polygons that come one by one, or many with the same number of corners."""

    def __init__(self) -> None:
        self._parts: list[npt.NDArray[np.generic]] = []
        self._single: dict[int, array[int]] = {}

    def add(self, corners: npt.NDArray[np.generic]) -> None:
        """Add N polygons of K corners each, as an (N, K) ndarray of integers."""
        if corners.dtype.kind not in "iu":
            raise ValueError("its faces refer to vertices by numbers that are not whole")
        self._parts.append(corners)

    def add_one(self, corners: list[bytes]) -> None:
        """Add a polygon whose corners are written in decimals.

        Raises
        ------
        ValueError, OverflowError
            They are not, or have more than 64 bits.
        """
        self._single.setdefault(len(corners), array("q")).extend(map(int, corners))

    def triangles(self) -> Faces:
        """Cut every polygon into triangles about its first corner; what has less than three corners is left out.

        Returns
        -------
        (F, 3) int64 ndarray

        Raises
        ------
        ValueError
            A polygon has so many corners that such triangles are not its surface, and take for ever to measure.
        """
        self._check_lengths()
        parts = [*self._parts]
        parts += [np.array(numbers).reshape(-1, count) for count, numbers in self._single.items() if count]
        fans = [_fans(part.astype(np.int64)) for part in parts if part.shape[1] >= 3]
        return np.concatenate(fans) if fans else np.empty((0, 3), np.int64)

    def _check_lengths(self) -> None:
        longest = max([0, *self._single, *(part.shape[1] for part in self._parts if len(part))])
        if longest > _MAX_CORNERS:
            raise ValueError(
                f"it has a face of {longest} corners, more than {_MAX_CORNERS}: cut faces into triangles first"
            )


def _fans(corners: Faces) -> Faces:
    first = np.broadcast_to(corners[:, :1], (len(corners), corners.shape[1] - 2))
    return np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2).reshape(-1, 3)
