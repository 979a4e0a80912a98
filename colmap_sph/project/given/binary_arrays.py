"""Observations and points of a binary model as arrays; COLMAP's library gives them one by one, in microseconds.

The files must have been read by `read_binary_model` before, which refuses what is damaged.
"""

import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.project.files import open_regular
from colmap_sph.project.given.binary_model import image_end, point3D_end

_POINT2D = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
# Of a point, before its track: id, coordinates.
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3)])
_AT_A_TIME = 1 << 16


@dataclass(frozen=True, eq=False)
class Observations:
    """What an image observes.

    Attributes
    ----------
    xy : (n, 2) float64 ndarray
        Image coordinates.
    point : (n,) int64 ndarray
        Ids of sparse points.
    """

    xy: NDArray[np.float64]
    point: NDArray[np.int64]


def read_observations(path: Path) -> Iterator[tuple[int, Observations]]:
    """Read ``images.bin``: the id of each image, and what it observes, one after the other."""
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = struct.unpack_from("<Q", data)
        offset = 8
        for _ in range(count):
            end = image_end(data, offset)
            (image_id,) = struct.unpack_from("<I", data, offset)
            number = (end - data.find(b"\0", offset + 64) - 9) // _POINT2D.itemsize
            # A copy, so that nothing keeps the file in memory.
            points = np.frombuffer(data[end - number * _POINT2D.itemsize : end], _POINT2D)
            points = points[points["point"] >= 0]
            yield image_id, Observations(points["xy"].copy(), points["point"].copy())
            offset = end


def read_points(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Read ``points3D.bin``: (n,) ascending ids, and (n, 3) coordinates."""
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = struct.unpack_from("<Q", data)
        points = np.empty(count, _POINT)
        places = np.empty(_AT_A_TIME, np.int64)
        offset = 8
        for first in range(0, count, _AT_A_TIME):
            number = min(_AT_A_TIME, count - first)
            begin = offset
            for index in range(number):
                places[index] = offset - begin
                offset = point3D_end(data, offset)
            part = np.frombuffer(data[begin:offset], np.uint8)
            heads = part[places[:number, None] + np.arange(_POINT.itemsize)]
            points[first : first + number] = heads.view(_POINT)[:, 0]
    order = np.argsort(points["id"], kind="stable")
    return points["id"][order], points["xyz"][order]
