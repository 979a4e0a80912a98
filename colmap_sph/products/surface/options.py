"""Options of a surface model and its orthophoto."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import OptionError

_AXES = {
    sign + name: axis
    for sign, factor in (("", 1.0), ("+", 1.0), ("-", -1.0))
    for name, axis in zip("xyz", factor * np.eye(3), strict=True)
}

_FARTHEST = 1e9


@dataclass(frozen=True)
class SurfaceOptions:
    """What of a workspace's depth maps is drawn into a raster, and how."""

    cell: float = 0.0
    """Side of a cell, in units of the model or of its map; 0: what a pixel covers, the median over all maps."""
    up: str = "auto"
    """Where up is: x, -y …, or a direction "x,y,z" in the model's frame. auto: as the images stand; z where the
    model is in map coordinates."""
    plane: tuple[str, str, str] | None = None
    """Look at a plane instead of down, a façade: its lower left, lower right and upper left corner, each "x,y,z"
    on the map."""
    plane_depth: float = 0.0
    """With --plane: what lies at most so far in front of it or behind; 0: a tenth of its width."""
    min_images: int = 3
    """So many images must agree on a height, or all that see the cell where these are fewer."""
    fill: int = 0
    """Fill holes from their lower rims, inversely to the distance, as far as so many cells from these. What is
    filled has a count of 0. 0: holes stay."""
    orthophoto: bool = True
    """Make the orthophoto, too."""
    balance: bool = True
    """Bring the images to one brightness and colour in the orthophoto."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name in ("cell", "plane_depth"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise OptionError(f"{name} must be a positive number, or 0, not {value}.", name)
        if self.min_images < 1:
            raise OptionError(f"min_images must be at least 1, not {self.min_images}.", "min_images")
        if not 0 <= self.fill <= 1000:
            raise OptionError(f"fill must lie between 0 and 1000, not {self.fill}.", "fill")
        self.up_axis()
        self.plane_corners()
        if self.plane is not None and self.up != "auto":
            raise OptionError("up and plane are both given; the latter says itself where to look.", "up", "plane")
        if self.plane is None and self.plane_depth:
            raise OptionError("plane_depth is for plane, which is missing.", "plane_depth", "plane")

    def up_axis(self) -> NDArray[np.float64] | None:
        """(3,) unit vector in the model's frame; None: to be found."""
        if self.up == "auto":
            return None
        if self.up in _AXES:
            return np.asarray(_AXES[self.up])
        axis = _three_numbers(self.up, "up")
        length = float(np.linalg.norm(axis))
        if length == 0:
            raise OptionError("up must be a direction, not 0,0,0.", "up")
        return axis / length

    def plane_corners(self) -> NDArray[np.float64] | None:
        """(3, 3) lower left, lower right and upper left corner; None: none given."""
        if self.plane is None:
            return None
        corners = np.array([_three_numbers(text, "plane") for text in self.plane])
        if np.abs(corners).max() > _FARTHEST:
            raise OptionError(f"plane has coordinates beyond {_FARTHEST:g}, where no map reaches.", "plane")
        across = corners[1:] - corners[0]
        lengths = np.linalg.norm(across, axis=1)
        if not (lengths > 0).all() or np.linalg.norm(np.cross(*across)) < 0.1 * lengths.prod():
            raise OptionError(
                "plane needs three corners that are not in line, nor two of them in one place.", "plane"
            )
        return corners


def _three_numbers(text: str, name: str) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise OptionError(f'{name} takes three numbers, as in 0.5,-1,2; not "{text[:40]}".', name)
    return values
