"""Depth maps of neighbouring views → what they confirm of each other.

What enough partners confirm and few see through is the *geometric* depth, averaged with theirs.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import View, pixel_transfer
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.kernels import backend


@dataclass(frozen=True)
class ConfirmOptions:
    """What other views must say of a view's depth for it to stay."""

    max_reprojection_error: float = 2.0
    """Two views' depths agree when the point, seen by the other view, projects back within this many pixels."""
    tolerance: float = 4.5
    """Two views' depths agree when they also differ by less than this many standard deviations."""
    min_consistent: int = 2
    """Views, of those that share a pair with the image, that must confirm a geometric depth; one is enough for a
    point that no other has in view."""
    max_contradiction: float = 0.5
    """A depth is dropped when more views look through it than this share of those that confirm it."""
    min_contradicting_support: int = 2
    """Pairs that must agree on a view's photometric depth before it can look through another's. A view with fewer
    pairs contradicts no other."""
    min_surface: float = 0.6
    """Where one view alone confirms a depth, at least this share of the 7 x 7 pixels around it must be of the same
    surface: what a single pair found in passing is rarely right."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        for name in ("max_reprojection_error", "tolerance"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be positive, not {getattr(self, name)}.", name)
        for name, least in (("min_contradicting_support", 1), ("min_consistent", 0)):
            if not least <= getattr(self, name) <= 255:
                raise OptionError(f"{name} must lie in {least}..255, not {getattr(self, name)}.", name)
        if not self.max_contradiction >= 0:
            raise OptionError(
                f"max_contradiction must not be negative, not {self.max_contradiction}.", "max_contradiction"
            )
        if not 0 <= self.min_surface <= 1:
            raise OptionError(f"min_surface must lie in 0..1, not {self.min_surface}.", "min_surface")


# Slope of the steepest surface that is looked for around a pixel, as depth over width.
_STEEPEST = 4.0


def confirm_depth(
    view: View,
    estimate: DepthEstimate,
    partners: Iterable[tuple[View, DepthEstimate]],
    options: ConfirmOptions,
) -> DepthEstimate:
    """Geometric depth of a view: what the depth maps of its partners confirm, averaged with theirs.

    Parameters
    ----------
    view : View
    estimate : DepthEstimate
        Its photometric depth.
    partners : iterable of (View, DepthEstimate)
        Neighbouring views and their photometric depths.
    options : ConfirmOptions

    Returns
    -------
    DepthEstimate
        `support` is the number of confirming partners.
    """
    shape = estimate.depth.shape
    observing, agreeing, contradicting = (np.zeros(shape, np.uint8) for _ in range(3))
    weighted = np.zeros(shape, np.float32)
    weight = np.zeros(shape, np.float32)
    for partner, partner_estimate in partners:
        _native.compare_depths(
            backend(),
            estimate.depth,
            estimate.sigma,
            partner_estimate.depth,
            partner_estimate.sigma,
            partner_estimate.support,
            pixel_transfer(view, partner),
            pixel_transfer(partner, view),
            options.max_reprojection_error,
            options.tolerance,
            options.min_contradicting_support,
            observing,
            agreeing,
            contradicting,
            weighted,
            weight,
        )
    _native.confirm_depth(
        estimate.depth,
        estimate.sigma,
        options.min_consistent,
        options.max_contradiction,
        options.min_surface,
        _STEEPEST / view.K[0, 0],
        observing,
        agreeing,
        contradicting,
        weighted,
        weight,
    )
    return DepthEstimate(weighted, weight, agreeing)
