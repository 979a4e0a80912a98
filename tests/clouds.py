"""COLMAP's fused clouds and visibility files, read by their documented formats alone."""

import struct
from pathlib import Path

import numpy as np

from colmap_sph.evaluation import PointCloud, read_geometry

FUSED = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])


def read_fused(path: Path) -> np.ndarray:
    """Points of a ``fused.ply`` as records of `xyz`, `normal` and `rgb`."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    assert len(body) == count * FUSED.itemsize
    return np.frombuffer(body, FUSED)


def read_points(path: Path) -> np.ndarray:
    """(N, 3) points of a cloud in any format."""
    cloud = read_geometry(path)
    assert isinstance(cloud, PointCloud)
    return cloud.points


def read_visibility(path: Path) -> list[tuple[int, ...]]:
    """For each point of a ``fused.ply.vis`` the indices of the images that see it.

    https://colmap.github.io/format.html: uint64 number of points, then for each a uint32 count and that many
    uint32 image indices.
    """
    data = path.read_bytes()
    (num_points,) = struct.unpack_from("<Q", data)
    offset = 8
    visible = []
    for _ in range(num_points):
        (count,) = struct.unpack_from("<I", data, offset)
        visible.append(struct.unpack_from(f"<{count}I", data, offset + 4))
        offset += 4 + 4 * count
    assert offset == len(data)
    return visible
