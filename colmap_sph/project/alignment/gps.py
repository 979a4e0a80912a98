"""Photographs → where they were taken, as GPS wrote it into their Exif data."""

from pathlib import Path

import numpy as np
import OpenImageIO

_UNIT = np.array([1.0, 1 / 60, 1 / 3600])


def read_gps(path: Path) -> tuple[float, float, float] | None:
    """Latitude and longitude in degrees, and height in metres, of a photograph; None where it does not say.

    North and east are positive; the height is what the camera calls so.
    """
    if not path.is_file():
        return None
    file = OpenImageIO.ImageInput.open(str(path))
    if file is None:
        OpenImageIO.geterror()  # which is kept otherwise, and printed at the end
        return None
    spec = file.spec()
    file.close()
    latitude = _degrees(spec, "Latitude", "S")
    longitude = _degrees(spec, "Longitude", "W")
    height = spec.getattribute("GPS:Altitude")
    if latitude is None or longitude is None or height is None or not np.isfinite(height):
        return None
    is_below = spec.getattribute("GPS:AltitudeRef") == 1
    return latitude, longitude, -float(height) if is_below else float(height)


def _degrees(spec: OpenImageIO.ImageSpec, name: str, negative: str) -> float | None:
    values = spec.getattribute(f"GPS:{name}")
    if values is None:
        return None
    parts = np.atleast_1d(np.array(values, np.float64))
    if len(parts) > 3 or not np.isfinite(parts).all():
        return None
    degrees = float(parts @ _UNIT[: len(parts)])
    return -degrees if str(spec.getattribute(f"GPS:{name}Ref")).startswith(negative) else degrees
