"""How original images become undistorted ones: the options."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pycolmap

from colmap_sph.errors import OptionError
from colmap_sph.project.wide.cuts import Cuts, cuts_of

_SCALES = (0.2, 2.0)


@dataclass(frozen=True)
class UndistortionOptions:
    """How the original images become undistorted ones."""

    max_image_size: int = -1
    """Longest side of the undistorted images in pixels; larger ones are reduced. -1: keep their size."""

    wide_scale: float = 0.7
    """Focal length of the pinhole views that are cut from fisheyes and panoramas, of theirs in the middle."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of its bounds."""
        if self.max_image_size != -1 and self.max_image_size < 16:
            raise OptionError(
                f"max_image_size must be -1 (keep the size) or at least 16, not {self.max_image_size}.",
                "max_image_size",
            )

        if not _SCALES[0] <= self.wide_scale <= _SCALES[1]:
            raise OptionError(
                f"wide_scale must lie in {_SCALES[0]}..{_SCALES[1]}, not {self.wide_scale}.", "wide_scale"
            )

    def cuts(self, model: pycolmap.Reconstruction, place: Path) -> Cuts:
        """What is cut from the wide images of a model, which is in a folder; see `cuts_of`."""
        return cuts_of(model, str(place), scale=self.wide_scale, max_size=self.max_image_size)

    def of_marker(self, cuts: Cuts) -> dict[str, Any]:
        """Those that have a part in the workspace, plain values."""
        values = asdict(self)
        if not cuts.views:
            del values["wide_scale"]
        return values

    def for_colmap(self) -> pycolmap.UndistortCameraOptions:
        """The same as COLMAP's options."""
        options = pycolmap.UndistortCameraOptions()
        options.max_image_size = self.max_image_size
        return options
