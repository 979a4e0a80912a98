"""How original images become undistorted ones: the options."""

from dataclasses import dataclass

import pycolmap

from colmap_sph.errors import OptionError


@dataclass(frozen=True)
class UndistortionOptions:
    """How the original images become undistorted ones."""

    max_image_size: int = -1
    """Longest side of the undistorted images in pixels; larger ones are reduced. -1: keep their size."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of its bounds."""
        if self.max_image_size != -1 and self.max_image_size < 16:
            raise OptionError(
                f"max_image_size must be -1 (keep the size) or at least 16, not {self.max_image_size}.",
                "max_image_size",
            )

    def for_colmap(self) -> pycolmap.UndistortCameraOptions:
        """The same as COLMAP's options."""
        options = pycolmap.UndistortCameraOptions()
        options.max_image_size = self.max_image_size
        return options
