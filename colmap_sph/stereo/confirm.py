"""Depth maps of neighbouring views → what they confirm of each other.

What enough partners confirm and few see through is the *geometric* depth, averaged with theirs.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_sph import _native
from colmap_sph.errors import OptionError
from colmap_sph.scene import View, pixel_transfer
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.kernels import backend


@dataclass(frozen=True)
class ConfirmOptions:
    """What other views must say of a view's depth for it to stay."""

    max_reprojection_error: float = 2.0
    """Two views' depths agree when the point, seen by the other view, projects back within this many pixels, and
    twice what their rows disagree by."""
    tolerance: float = 4.5
    """Two views' depths agree when they also differ by less than this many standard deviations."""
    min_consistent: int = 2
    """Views, of those that share a pair with the image, that must confirm a geometric depth; those that stand side
    by side count as one. One is enough where no other has a depth; but an image with hardly any is one that does
    not confirm. 0: none need, but none may look through it."""
    max_contradiction: float = 0.5
    """A depth is dropped when more views look through it than this share of those that confirm it."""
    min_contradicting_support: int = 2
    """Pairs that must agree on a view's photometric depth before it can look through another's. A view with fewer
    pairs contradicts no other."""
    min_surface: float = 0.65
    """Where one view alone confirms a depth, at least this share of the 5 x 5 pixels around it must be of the same
    surface: what a single pair found in passing is rarely right. Where two do, half of it is enough. Where one
    fewer confirms it than must, and none looks through it, half as many pixels may be off it: 0.6 becomes 0.8.
    0: nothing is asked of the surface, and no view that must confirm is forgone."""

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


# Points may project back farther away by so many row residuals, of so many pixels at most: what is more is wrong.
_RESIDUALS = 2.0
_MOST_RESIDUAL = 1.5
# Views that must confirm a depth but need not where it is part of a surface that none looks through.
_MAY_MISS = 1
# Slope of the steepest surface that is looked for around a pixel, as depth over width.
_STEEPEST = 2.0
# A partner with depth on less of its image than this fits no other: if it is turned, mirrored or of another place,
# its silence would let pass what any two images make of each other. So it counts as one that does not confirm, and
# nobody's confirmation is forgone beside it.
_LEAST_COVERED = 0.1


def confirm_depth(
    view: View,
    estimate: DepthEstimate,
    partners: Iterable[tuple[View, DepthEstimate]],
    options: ConfirmOptions,
    stations: Sequence[int] | None = None,
    residuals: Sequence[float] | None = None,
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
    stations : sequence of int, optional
        Number of the station of each partner, equal ones side by side (see `Stations`): partners of one station
        count as one. Without it each is a station of its own.
    residuals : sequence of float, optional
        Row residual of the view's pair with each partner, radians. Without it poses and lenses are perfect.

    Returns
    -------
    DepthEstimate
        `support` is the number of confirming stations.
    """
    sums = _Sums.empty(estimate.depth.shape)
    sizes = Counter(stations)
    numbers = itertools.count() if stations is None else stations
    shifts = itertools.repeat(0.0) if residuals is None else residuals
    are_counted = stations is not None and residuals is not None
    numbered = zip(numbers, partners, shifts, strict=are_counted)
    any_silence_counts = False
    for number, members in groupby(numbered, key=lambda member: member[0]):
        has_others = sizes[number] > 1
        station = _Sums.empty(estimate.depth.shape) if has_others else sums
        for _, of_one in groupby(members, key=lambda member: member[1][0].photograph):
            views = [(*partner, residual) for _, partner, residual in of_one]
            silence_counts = _fits_none([partner_estimate for _, partner_estimate, _ in views])
            any_silence_counts |= silence_counts
            for partner, partner_estimate, residual in views:
                _compare(view, estimate, partner, partner_estimate, options, residual, silence_counts, station)
        if has_others:
            _add_as_one(station, sums)
    _native.confirm_depth(
        estimate.depth,
        estimate.sigma,
        options.min_consistent,
        0 if any_silence_counts else _MAY_MISS,
        options.max_contradiction,
        options.min_surface,
        _STEEPEST / view.K[0, 0],
        *sums,
    )
    return DepthEstimate(sums.weighted, sums.weight, sums.agreeing)


class _Sums(NamedTuple):
    """Verdicts on every pixel, as `_native.compare_depths` adds them up."""

    observing: NDArray[np.uint8]
    agreeing: NDArray[np.uint8]
    contradicting: NDArray[np.uint8]
    weighted: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> "_Sums":
        observing, agreeing, contradicting = (np.zeros(shape, np.uint8) for _ in range(3))
        weighted, weight = (np.zeros(shape, np.float32) for _ in range(2))
        return cls(observing, agreeing, contradicting, weighted, weight)


def _fits_none(estimates: Sequence[DepthEstimate]) -> bool:
    """Whether the views of one photograph have next to no depth: of those cut from it, one may show the sky."""
    found = sum(np.count_nonzero(estimate.depth) for estimate in estimates)
    return bool(found < _LEAST_COVERED * sum(estimate.depth.size for estimate in estimates))


def _compare(
    view: View,
    estimate: DepthEstimate,
    partner: View,
    partner_estimate: DepthEstimate,
    options: ConfirmOptions,
    residual: float,
    silence_counts: bool,
    sums: _Sums,
) -> None:
    """Add what a partner says of every pixel."""
    _native.compare_depths(
        backend(),
        estimate.depth,
        estimate.sigma,
        partner_estimate.depth,
        partner_estimate.sigma,
        partner_estimate.support,
        pixel_transfer(view, partner),
        pixel_transfer(partner, view),
        options.max_reprojection_error + _RESIDUALS * min(residual * float(view.K[0, 0]), _MOST_RESIDUAL),
        options.tolerance,
        options.min_contradicting_support,
        silence_counts,
        *sums,
    )


def _add_as_one(station: _Sums, sums: _Sums) -> None:
    """Add what the views of one station say as if it were one: what most of them say, with their mean weight."""
    # Of two, one is enough: where one of them is wrongly placed, the other has its say.
    one_of_two = (station.agreeing > 0) & (station.observing == 2)
    agrees = one_of_two | (2 * station.agreeing.astype(np.int16) > station.observing)
    contradicts = station.contradicting > station.agreeing
    for verdict, counts in (
        (station.observing > 0, sums.observing),
        (agrees, sums.agreeing),
        (contradicts, sums.contradicting),
    ):
        np.add(counts, 1, out=counts, where=verdict & (counts < np.iinfo(counts.dtype).max))
    for depths, total in ((station.weighted, sums.weighted), (station.weight, sums.weight)):
        np.divide(depths, station.agreeing, out=depths, where=agrees)
        np.add(total, depths, out=total, where=agrees)
