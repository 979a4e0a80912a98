"""The record of what a camera and the world do to pictures, and to the model that is written with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

_BOUNDS: Mapping[str, tuple[float, float]] = {
    "photon_noise": (0.0, 50.0),
    "vignetting": (0.0, 1.0),
    "exposure": (0.0, 3.0),
    "blur": (0.0, 20.0),
    "defocus": (0.0, 20.0),
    "motion_blur": (0.0, 50.0),
    "rolling_shutter": (0.0, 100.0),
    "lens": (0.0, 20.0),
    "wobble": (0.0, 20.0),
    "rotation_error": (0.0, 20.0),
    "centre_error": (0.0, 20.0),
    "clouds": (0.0, 1.0),
    "specular": (0.0, 5.0),
    "moving": (0, 200),
}


@dataclass(frozen=True)
class Imperfections:
    """Strengths; none by default. What is random is drawn from the block's seed, for each image anew.

    Noise that all pixels have alike and JPEG quality are `image_noise` and `jpeg_quality` of `CaptureOptions`.
    """

    photon_noise: float = 0.0
    """Standard deviation of the noise at white, grey values of 255; it grows with the root of the light."""
    vignetting: float = 0.0
    """Share of the light lost in the corners."""
    exposure: float = 0.0
    """Images are exposed by up to so many stops more or less, evenly spread."""
    blur: float = 0.0
    """Standard deviation of a Gaussian blur, pixels."""
    defocus: float = 0.0
    """Radius of the disc that a point becomes, pixels."""
    motion_blur: float = 0.0
    """Way of the camera's shake during the exposure, pixels; its direction is random."""
    rolling_shutter: float = 0.0
    """Way of the picture while the rows are read, pixels: the camera turns about a random axis across its view."""
    lens: float = 0.0
    """Distortion that the written camera model does not know, one for all images: rms of x and of y, pixels."""
    wobble: float = 0.0
    """Bending of its own of every image: rms of x and of y, pixels."""
    rotation_error: float = 0.0
    """Written rotations are wrong by so many pixels about each axis (standard deviation over the focal length)."""
    centre_error: float = 0.0
    """Written centres are wrong along each axis by what so many pixels are at the images' median depth."""
    bundle_adjusted: bool = False
    """Adjust poses and points to the tracks of the images as they are, as structure from motion does."""
    sky: bool = False
    """A sky of graded blue where no surface is met, in place of one colour."""
    clouds: float = 0.0
    """How much of that sky soft clouds hide, 0 to 1."""
    specular: float = 0.0
    """Brightness of the sun's highlight on surfaces, of 1; it moves with the camera."""
    moving: int = 0
    """Boxes of a car's size at other places in each image; the exact depth is that of what the image shows."""

    @staticmethod
    def bounds() -> Mapping[str, tuple[float, float]]:
        """Least and largest value of every strength."""
        return _BOUNDS
