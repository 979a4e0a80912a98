"""The name of a coordinate system → what PROJ knows of it; PROJ is an optional extra."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OptionError, reason_of

if TYPE_CHECKING:
    import pyproj

_MISSING = "needs PROJ, which is not installed; install this program with it: pip install '.[geo]'"
# WGS 84 with heights above its ellipsoid: what GPS gives.
_GPS = "EPSG:4979"
# Metres from the ellipsoid: what is farther, as a local model is, lies in no geocentric system.
_HIGHEST = 1e5
# Units of a projected system; UTM's zones begin farther from theirs, and models in frames of their own end nearer.
_NEAR_ORIGIN = 1e5
_FIRST_UTM_NORTH = 32601
_FIRST_UTM_SOUTH = 32701


def read_crs(name: str) -> "pyproj.CRS":
    """The coordinate system of a name, such as "EPSG:25832" or "EPSG:25832+7837".

    Raises
    ------
    InputError
        PROJ is not installed.
    OptionError
        It is not known, or does not count in units of length along three axes at right angles.
    """
    proj = _pyproj("--crs")
    try:
        crs: pyproj.CRS = proj.CRS.from_user_input(name)
    except Exception as error:  # PROJ's own, whose class is not at hand where it is missing
        raise OptionError(
            f"--crs {name} is no coordinate system that PROJ knows ({reason_of(error)}); give one such as "
            "EPSG:25832, see https://epsg.io."
        ) from error
    if not (crs.is_projected or crs.is_geocentric or crs.is_engineering):
        raise OptionError(
            f"--crs {name} ({crs.name}) counts in degrees, and a model cannot; give a projected system, such as "
            "a UTM zone."
        )
    if len({axis.unit_conversion_factor for axis in crs.axis_info}) > 1:
        raise OptionError(
            f"--crs {name} ({crs.name}) counts heights in another unit than places, and a model cannot; give a "
            "system with one unit."
        )
    if [axis.direction for axis in crs.axis_info[:2]] == ["south", "west"]:
        raise OptionError(
            f"--crs {name} ({crs.name}) counts to the south and the west, in which a model would be mirrored; "
            "give one that counts to the east and the north, such as EPSG:5514 for EPSG:5513."
        )
    return crs


def wkt_of(crs: "pyproj.CRS") -> str:
    """A coordinate system in the WKT that LAS 1.4 asks for (OGC 01-009), or where that has no words for it, in
    WKT 2."""
    try:
        return str(crs.to_wkt("WKT1_GDAL"))
    except Exception:  # PROJ's own
        return str(crs.to_wkt())


def utm_zone_of(latitude: float, longitude: float) -> str:
    """Name of the UTM zone (WGS 84) of a place in degrees.

    Examples
    --------
    >>> utm_zone_of(48.1, 11.6), utm_zone_of(-33.9, 151.2)
    ('EPSG:32632', 'EPSG:32756')
    """
    zone = int((longitude + 180) // 6) % 60
    return f"EPSG:{(_FIRST_UTM_NORTH if latitude >= 0 else _FIRST_UTM_SOUTH) + zone}"


def from_gps(crs: "pyproj.CRS", positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) latitudes, longitudes (degrees) and heights (metres) of GPS in a coordinate system.

    Heights are those above the ellipsoid of WGS 84, unless the system has heights of its own; in the unit of the
    system's other axes.

    Raises
    ------
    InputError
        A place lies beyond the system, or PROJ lacks the grid of its datum or heights.
    """
    latitudes, longitudes, heights = positions.T
    try:
        # Without the grid PROJ would take heights, and places, of one datum for those of another.
        transformer = _pyproj("--align").Transformer.from_crs(
            _GPS, crs, always_xy=True, only_best=True, allow_ballpark=False
        )
        x, y, z = transformer.transform(longitudes, latitudes, heights, errcheck=True)
    except RuntimeError as error:  # ProjError
        raise InputError(
            f"PROJ cannot take GPS positions to {crs.name} ({reason_of(error)}); install its grids by `pyproj "
            "sync`, or give as --crs a system that needs none, such as a UTM zone without heights."
        ) from error
    if len(crs.axis_info) == 2:  # which leaves heights as they are, in metres
        z = z / crs.axis_info[0].unit_conversion_factor
    places = np.column_stack([x, y, z]).astype(np.float64)
    if not np.isfinite(places).all():
        row = int(np.flatnonzero(~np.isfinite(places).all(axis=1))[0])
        latitude, longitude = positions[row, :2]
        raise InputError(
            f"The position {latitude:.6f}, {longitude:.6f} (latitude, longitude) has no place in {crs.name}; "
            "check the position and --crs."
        )
    return places


def is_in_area(crs: "pyproj.CRS", place: NDArray[np.float64]) -> bool:
    """Whether a place in a coordinate system lies where that is meant for, or not much beyond; True where its area
    is not known."""
    # PROJ knows none of a system that is put together, as "EPSG:25832+7837" is.
    area = crs.area_of_use or next((part.area_of_use for part in crs.sub_crs_list), None)
    if area is None:
        return True
    try:
        transformer = _pyproj("--crs").Transformer.from_crs(crs, _GPS, always_xy=True)
    except RuntimeError:  # ProjError: a local grid, of which PROJ does not know where it is
        return True
    longitude, latitude, height = transformer.transform(*place)
    if not np.isfinite([longitude, latitude]).all() or (crs.is_geocentric and abs(height) > _HIGHEST):
        return False
    width = (area.east - area.west) % 360 or 360
    # A model in a frame of its own lies at the origin, which in UTM is not far from a zone, and in none.
    is_at_origin = np.abs(place[:2]).max() < _NEAR_ORIGIN
    beyond = 0.0 if is_at_origin else max(width, area.north - area.south) / 2
    east_of_west = (longitude - area.west + beyond) % 360
    is_in_width = width + 2 * beyond >= 360 or east_of_west <= width + 2 * beyond
    return bool(is_in_width and area.south - beyond <= latitude <= area.north + beyond)


def _pyproj(option: str) -> Any:
    try:
        return import_module("pyproj")
    except ImportError as error:
        raise InputError(f"{option} {_MISSING}.") from error
