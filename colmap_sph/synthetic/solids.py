"""Solids that stand on the ground: boxes, houses with saddle or hip roofs; and balls."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from colmap_sph.synthetic.primitives import CORNER_SIGNS, ConvexPolyhedron, Ellipsoid, FloatArray
from colmap_sph.synthetic.texture import Material


def _rotation_about_z(yaw: float) -> FloatArray:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _solid(
    local_planes: Sequence[tuple[Sequence[float], float]],
    base: npt.ArrayLike,
    extent: tuple[float, float, float],
    yaw: float,
    materials: Sequence[Material],
) -> ConvexPolyhedron:
    """Half-spaces given in the frame of the solid's base centre, turned by yaw and moved to `base`."""
    anchor = np.asarray(base, dtype=np.float64)
    rotation = _rotation_about_z(yaw)
    lengths = np.array([np.linalg.norm(normal) for normal, _ in local_planes])
    normals = np.array([normal for normal, _ in local_planes], dtype=np.float64) / lengths[:, None]
    offsets = np.array([offset for _, offset in local_planes]) / lengths
    world_normals = normals @ rotation.T
    half = 0.5 * np.asarray(extent)
    hull = anchor + (CORNER_SIGNS * half + [0.0, 0.0, half[2]]) @ rotation.T
    return ConvexPolyhedron(world_normals, offsets + world_normals @ anchor, hull, anchor, tuple(materials), yaw)


def box(
    base: npt.ArrayLike, size: tuple[float, float, float], materials: Sequence[Material], yaw: float = 0.0
) -> ConvexPolyhedron:
    """Box standing on `base`, the centre of its lower face.

    Parameters
    ----------
    base : (3,) array_like
    size : (length, width, height) in metres
    materials : sequence of Material
        For the faces +x, -x, +y, -y, top, bottom (before the turn); the last serves the remaining ones.
    yaw : float
        Turn about the vertical in radians.

    Returns
    -------
    ConvexPolyhedron
    """
    length, width, height = size
    planes: list[tuple[Sequence[float], float]] = [
        ((1, 0, 0), length / 2),
        ((-1, 0, 0), length / 2),
        ((0, 1, 0), width / 2),
        ((0, -1, 0), width / 2),
        ((0, 0, 1), height),
        ((0, 0, -1), 0.0),
    ]
    return _solid(planes, base, size, yaw, materials)


def gabled_house(
    base: npt.ArrayLike,
    size: tuple[float, float, float],
    ridge_height: float,
    materials: Sequence[Material],
    yaw: float = 0.0,
    *,
    hipped: bool = False,
) -> ConvexPolyhedron:
    """House with a saddle roof whose ridge runs along its length, or with a hip roof.

    Parameters
    ----------
    base : (3,) array_like
        Centre of the lower face.
    size : (length, width, height of the eaves) in metres
    ridge_height : float
        Height of the ridge above the base, metres; above the eaves.
    materials : sequence of Material
        For the gables (+x, -x), the long walls (+y, -y), the roof; the last serves the remaining faces.
    yaw : float
        Turn about the vertical in radians.
    hipped : bool
        Slope the roof at the gables too.

    Returns
    -------
    ConvexPolyhedron
    """
    length, width, eaves = size
    rise = ridge_height - eaves
    planes: list[tuple[Sequence[float], float]] = [
        ((1, 0, 0), length / 2),
        ((-1, 0, 0), length / 2),
        ((0, 1, 0), width / 2),
        ((0, -1, 0), width / 2),
        ((0, 2 * rise / width, 1), ridge_height),
        ((0, -2 * rise / width, 1), ridge_height),
        ((0, 0, -1), 0.0),
    ]
    if hipped:
        slope = 2 * rise / width
        planes += [((slope, 0, 1), eaves + slope * length / 2), ((-slope, 0, 1), eaves + slope * length / 2)]
    return _solid(planes, base, (length, width, ridge_height), yaw, materials)


def sphere(centre: npt.ArrayLike, radius: float, material: Material) -> Ellipsoid:
    """A sphere.

    Parameters
    ----------
    centre : (3,) array_like
        World frame.
    radius : float
        Metres.
    material : Material

    Returns
    -------
    Ellipsoid
    """
    return Ellipsoid(np.asarray(centre, dtype=np.float64), np.full(3, float(radius)), material)
