"""Pieces of a cloud → LAS points: how fine coordinates are, the header, and what stands in a point.

LAS 1.4 with point format 7 [1]_: coordinates are 32-bit integers times a scale, plus an offset, colours have 16
bits. Normals, the number of images and the deviation of their maps are extra dimensions.

References
----------
.. [1] ASPRS, *LAS Specification 1.4 - R15*, 2019.
"""

import logging
import math
from dataclasses import dataclass
from importlib.metadata import version

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, OptionError, counted
from colmap_sph.products.clouds.source import UNKNOWN, Cloud, CloudPiece
from colmap_sph.products.georeference import Georeference

logger = logging.getLogger(__name__)

_POINT_FORMAT = 7
# Names that PDAL and CloudCompare know.
_NORMALS = ("NormalX", "NormalY", "NormalZ")
_IMAGES = "Images"
_DEVIATION = "StdDev"
# Coordinates of a cloud are computed in 32-bit floats, of which 24 bits are digits.
_STEPS = 2.0**23
_LARGEST = 2.0**31 - 1
_COARSEST = 1e-4
_FULL_COLOUR = 257  # times 255 is all of 16 bits


@dataclass(frozen=True, eq=False)
class Extent:
    """Number of a cloud's points, and the least and largest of their map coordinates, (3,) each."""

    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def extent_of(cloud: Cloud, georeference: Georeference) -> Extent:
    """Look at all points once; `NoResultError` where none has possible coordinates."""
    count = 0
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for piece in cloud.pieces():
        if len(piece.xyz):
            places = georeference.to_map(piece.xyz)
            count += len(places)
            low = np.minimum(low, places.min(axis=0))
            high = np.maximum(high, places.max(axis=0))
    if not count:
        raise NoResultError(f"No point of {cloud.paths[0]} has possible coordinates; fuse again.")
    if count < cloud.count:
        logger.warning(
            "%s of the cloud's %s have no possible coordinates; left out",
            counted(cloud.count - count, "point"),
            f"{cloud.count:,}",
        )
    return Extent(count, low, high)


def finest_scale(extent: Extent) -> float:
    """The step between coordinates by which nothing is lost: a power of ten, 0.0001 at most.

    It is finer than that of 32-bit floats at the borders of the cloud, and fits 32-bit integers.
    """
    half = float((extent.high - extent.low).max()) / 2
    if half == 0:
        return _COARSEST
    wanted = min(_power_of_ten(math.floor(math.log10(half / _STEPS))), _COARSEST)
    return max(wanted, _least_scale(half))


def _least_scale(half: float) -> float:
    """Least power of ten by which half a cloud, and as much again for a round offset, fits 32-bit integers."""
    return _power_of_ten(math.ceil(math.log10(2 * half / _LARGEST)))


def _power_of_ten(exponent: int) -> float:
    return float(f"1e{exponent}")  # to the last digit


def las_header(cloud: Cloud, extent: Extent, georeference: Georeference, scale: float | None) -> laspy.LasHeader:
    """The header of a LAS file, without its points.

    Parameters
    ----------
    cloud : Cloud
    extent : Extent
    georeference : Georeference
    scale : float or None
        Step between coordinates in map units; None: the `finest_scale`.

    Raises
    ------
    OptionError
        The scale is too fine for the cloud's size, or as coarse as the cloud is large.
    """
    half = float((extent.high - extent.low).max()) / 2
    if scale is not None and half > 0 and 2 * half / scale > _LARGEST:
        raise OptionError(
            f"las_scale {scale:g} is too fine for a cloud of {2 * half:.6g} units; give {_least_scale(half):g} or "
            "more.",
            "las_scale",
        )
    if scale is not None and 0 < half <= scale / 2:
        raise OptionError(f"las_scale {scale:g} is no less than the whole cloud, {2 * half:.6g}.", "las_scale")
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version="1.4")
    header.system_identifier = "dense image matching"
    header.generating_software = f"colmap_sph {version('colmap_sph')}"
    header.scales = np.full(3, scale or finest_scale(extent))
    header.offsets = _round_middle(extent, half)
    if cloud.has_normals:
        header.add_extra_dims([laspy.ExtraBytesParams(name, "float32", "unit normal") for name in _NORMALS])
    if cloud.has_images:
        header.add_extra_dims([laspy.ExtraBytesParams(_IMAGES, "uint16", "images that see the point")])
    if cloud.measure is not None:
        words = "std of the maps, along normal"
        header.add_extra_dim(laspy.ExtraBytesParams(_DEVIATION, "float32", words, no_data=[UNKNOWN]))
    if georeference.wkt:
        header.vlrs.append(WktCoordinateSystemVlr(georeference.wkt))
    header.global_encoding.wkt = True  # as this point format asks for, with a system or without
    return header


def _round_middle(extent: Extent, half: float) -> NDArray[np.float64]:
    """Offsets near the middle of a cloud: round numbers, for people."""
    middle = (extent.low + extent.high) / 2
    step = 10.0 ** math.floor(math.log10(half)) if half > 0 else 1.0
    return np.asarray(np.round(middle / step) * step)


def las_points(
    piece: CloudPiece, header: laspy.LasHeader, georeference: Georeference
) -> laspy.ScaleAwarePointRecord:
    """A piece of a cloud as points of a file."""
    points = laspy.ScaleAwarePointRecord.zeros(len(piece.xyz), header=header)
    steps = (georeference.to_map(piece.xyz) - header.offsets) / header.scales
    for name, values in zip("XYZ", np.rint(steps).astype(np.int32).T, strict=True):
        points[name] = values
    once = np.ones(len(piece.xyz), np.uint8)
    points["return_number"] = once
    points["number_of_returns"] = once
    if piece.rgb is not None:
        for name, values in zip(("red", "green", "blue"), piece.rgb.T, strict=True):
            points[name] = values.astype(np.uint16) * _FULL_COLOUR
    if piece.normals is not None:
        for name, values in zip(_NORMALS, georeference.directions_to_map(piece.normals).T, strict=True):
            points[name] = values
    if piece.counts is not None:
        points[_IMAGES] = np.minimum(piece.counts, 65535).astype(np.uint16)
    if piece.deviation is not None:
        known = piece.deviation >= 0
        points[_DEVIATION] = np.where(known, piece.deviation * georeference.scale, UNKNOWN)
    return points
