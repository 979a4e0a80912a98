"""Options of polishing."""

from dataclasses import dataclass
from typing import Literal, get_args

from colmap_sph.errors import OptionError

Polishing = Literal["off", "on", "always"]
"""Whether poses are polished; "always" leaves out the cautions that do not come from measurement."""


@dataclass(frozen=True)
class PolishOptions:
    """How poses and cameras of the sparse model are polished on ties between the images, and all matched again."""

    poses: Polishing = "off"
    """Adjust the poses of the sparse model where ties of the matched pairs show that they are imprecise and that
    this helps (on, or the option without a value), or also those of rigs, of models in map coordinates and of
    models without tracks (always)."""
    cameras: bool = False
    """Also adjust the lens distortion of each camera, or find what it does beyond any camera model, and write that
    model to colmap_sph/refined in the workspace, for another run."""
    least_residual: float = 0.15
    """Poses are left as they are where rows of the pairs disagree by fewer pixels than this."""
    least_gain: float = 0.05
    """Adjusted poses are used where ties that had no part in it fit better by this share."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if self.poses not in get_args(Polishing):
            raise OptionError(f"poses must be 'off', 'on' or 'always', not {self.poses!r}.", "poses")
        if not 0 <= self.least_residual <= 100:
            raise OptionError(f"least_residual must lie in 0..100, not {self.least_residual}.", "least_residual")
        if not 0 <= self.least_gain < 1:
            raise OptionError(f"least_gain must lie in 0..1, not {self.least_gain}.", "least_gain")
        if self.cameras and self.poses == "off":
            raise OptionError("cameras needs polished poses; give --polish-poses, too.", "cameras")

    @property
    def is_wanted(self) -> bool:
        """Whether anything is to be polished."""
        return self.poses != "off"
