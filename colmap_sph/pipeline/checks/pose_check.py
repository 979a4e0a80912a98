"""Matched pairs of a model without points → are its poses and cameras those of the images?

Of other models sparse points tell, see `self_check`. Without them features of the images do: they are matched by
what they look like, and so show how far poses and focal lengths are off, where ties are but what fits them.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from statistics import median

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, NoResultError
from colmap_sph.pipeline.checks.self_check import add_doubt
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.stages.photo import still_mask
from colmap_sph.pipeline.stages.stage import Result
from colmap_sph.project.images.reading import read_whole_grey
from colmap_sph.project.masks import read_view_mask
from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.features import (
    Features,
    Shown,
    epipolar_distances,
    find_features,
    inverted,
    match_features,
    with_focal_length,
)

logger = logging.getLogger(__name__)

# With right poses most pairs have ties (.6 to .9 of them on six scenes, .2 on a drive straight ahead), with wrong
# ones few (.0 to .3).
_SOUND_SHARE = 0.5
# An even part of the pairs is asked. One tells something where so many of its features match, and fits where most
# of these lie in common epipolar planes; with right poses more than .8 of the pairs do, with wrong ones less than
# .35.
_MOST_ASKED = 20
_TELLING = 20
_FITTING = 0.5
# Fewer matches in all do not refuse a model.
_ENOUGH = 60
# Where images have so many features, but none of so many pairs shares any, they do not show the same.
_MANY_FEATURES = 300
_MANY_PAIRS = 8
# Focal lengths that are tried, as factors of what is given. What is given fits best where it is right; where it is
# a tenth too long or too short, the factor that undoes it does, and brings features nearer, to .2 to .6 of their
# distance (four scenes). Where poses are off by half a degree no factor does to less than .67.
_FACTORS = np.exp(np.linspace(-0.4, 0.4, 33))
_LEAST_CHANGE = 0.05
_NEARER = 0.65
_LEAST_DISTANCE = 1e-6
_NEARER_PAIRS = 0.55
_FEWEST_PAIRS = 5
# Features lie no farther from their epipolar planes (in the median, see `epipolar_distances`) with poses as
# structure from motion leaves them: up to .24. Poses off by a quarter or half a degree make it .4 to .7.
_USUAL_DISTANCE = 0.35


@dataclass(frozen=True, eq=False)
class Compared:
    """A pair whose features tell something."""

    photographs: tuple[Photograph, Photograph]
    features: tuple[Features, Features]
    matches: NDArray[np.int64]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))  # of the views' frame, in the model's

    @property
    def is_whole(self) -> bool:
        """Whether its photographs are one view each."""
        return all(len(photograph.views) == 1 for photograph in self.photographs)

    @cached_property
    def distances(self) -> NDArray[np.float64]:
        """See `epipolar_distances`."""
        return self._distances_of(*self.features)

    def distances_with(self, factor: float) -> NDArray[np.float64]:
        """The same with so many times the focal length, of photographs that are one view."""
        if factor == 1.0:
            return self.distances
        pairs = zip(self.features, self.photographs, strict=True)
        return self._distances_of(*(with_focal_length(shown, of.views[0], factor) for shown, of in pairs))

    @cached_property
    def fits_inverted(self) -> bool:
        """Whether it would fit if poses were world_from_cam."""
        if not self.is_whole:
            return False
        views = [photograph.views[0] for photograph in self.photographs]
        first, second = (inverted(shown, view) for shown, view in zip(self.features, views, strict=True))
        left, right = (view.t - view.R @ self.origin for view in views)  # as they were written: centres, then
        return bool((epipolar_distances(first, second, self.matches, right - left) <= 1).mean() > _FITTING)

    def _distances_of(self, first: Features, second: Features) -> NDArray[np.float64]:
        left, right = self.photographs
        return epipolar_distances(first, second, self.matches, right.center - left.center)

    @property
    def fits(self) -> bool:
        """Whether most of the features lie in common epipolar planes."""
        return bool((self.distances <= 1).mean() > _FITTING)


def check_poses(context: Context, matched: Mapping[Pair, Result]) -> None:
    """Judge the poses and cameras of a model without points by features of its images.

    Raises `NoResultError` where they are contradicted; the report tells where they are less exact than usual.

    Parameters
    ----------
    context : Context
    matched : mapping of (str, str) to Result
        Matched pairs.
    """
    if context.scene.has_tracks or not matched:
        return
    sound = sum(result.facts.row_residual is not None for result in matched.values())
    logger.info("%d of %d pairs have enough ties: features of images are compared", sound, len(matched))
    asked = sorted(matched)[:: -(-len(matched) // _MOST_ASKED)]
    compared, usual_features = _compare(context, asked)
    _refuse_focal_length(compared)
    if sound < _SOUND_SHARE * len(matched):
        _refuse_poses(compared, asked, usual_features)
    _doubt_poses(context, compared)


def _compare(context: Context, pairs: Sequence[Pair]) -> tuple[list[Compared], float]:
    """Pairs that tell something, and how many features the images of such pairs have."""

    @cache
    def features_of(lead: str) -> Features | None:
        with suppress(InputError):  # cannot be read for a moment, and so tells nothing
            return find_features([_shown(context, view) for view in context.scene.photograph(lead).views])
        return None

    origin = context.scene.origin + context.scene.anchor
    compared = []
    for left, right in pairs:
        first, second = features_of(left), features_of(right)
        if first is None or second is None:
            continue
        matches = match_features(first, second)
        if len(matches) >= _TELLING:
            photographs = (context.scene.photograph(left), context.scene.photograph(right))
            compared.append(Compared(photographs, (first, second), matches, origin))
    return compared, median(len(features_of(name) or ()) for pair in pairs for name in pair)


def _refuse_focal_length(compared: Sequence[Compared]) -> None:
    """Raise `NoResultError` where features fit other focal lengths far better.

    It would pass else: depth is wrong by as much as the focal length, in all images alike.
    """
    whole = [pair for pair in compared if pair.is_whole]
    if len(whole) < _FEWEST_PAIRS:
        return
    factor, nearer, of_pairs = fitting_factor(whole)
    logger.info(
        "Features fit focal length x %.3f best: %.2f of their distance, less in %.2f of the pairs",
        factor,
        nearer,
        of_pairs,
    )
    if abs(factor - 1) >= _LEAST_CHANGE and nearer < _NEARER and of_pairs >= _NEARER_PAIRS:
        raise NoResultError(
            f"The model has no points to compare with, and features of its images fit {factor:.2f} times its "
            "focal length far better: its cameras are not those of these images (of another size, cropped, of "
            "another lens), and depth would be wrong by as much; check --model and --images. What was made is "
            "left on disk."
        )


def fitting_factor(compared: Sequence[Compared]) -> tuple[float, float, float]:
    """Find by how much focal lengths are to be multiplied for features to lie nearest to their epipolar planes.

    Parameters
    ----------
    compared : sequence of Compared
        Of photographs that are one view.

    Returns
    -------
    factor : float
    nearer : float
        Distance of the features then, as a share of what it is.
    of_pairs : float
        Share of the pairs in which it is less.
    """
    now = np.array([np.median(pair.distances) for pair in compared])
    there = np.array([[np.median(pair.distances_with(factor)) for pair in compared] for factor in _FACTORS])
    # Where cameras do not turn, any focal length fits, and with a longer one a pixel is a smaller angle.
    there *= np.maximum(_FACTORS, 1)[:, None]
    best = int(np.median(there, axis=1).argmin())
    nearer = float(np.median(there[best]) / max(np.median(now), _LEAST_DISTANCE))
    return float(_FACTORS[best]), nearer, float((there[best] < now).mean())


def _refuse_poses(compared: Sequence[Compared], asked: Sequence[Pair], usual_features: float) -> None:
    """Raise `NoResultError` where most features do not lie in common epipolar planes."""
    others = [pair for pair in compared if not pair.fits]
    fitting = len(compared) - len(others)
    logger.info("Features fit the poses in %d of %d pairs, of %d asked", fitting, len(compared), len(asked))
    if 2 * sum(pair.fits_inverted for pair in compared) > max(len(compared), 2 * fitting, _FEWEST_PAIRS):
        raise NoResultError(
            "The model has no points to compare with, and features of its images fit the inverse of its poses: "
            "these are world_from_cam (camera to world), and COLMAP's are cam_from_world. Write R transposed and "
            "-R transposed * t in place of R and t. What was made is left on disk."
        )
    if fitting < len(others) and sum(len(pair.matches) for pair in others) >= _ENOUGH:
        finding = f"lie on each other's epipolar lines in only {fitting} of {len(compared)} pairs"
        raise NoResultError(_refusal(finding))
    if not compared and usual_features >= _MANY_FEATURES and len(asked) >= _MANY_PAIRS:
        raise NoResultError(_refusal(f"match in none of {len(asked)} pairs that should show the same"))


def _doubt_poses(context: Context, compared: Sequence[Compared]) -> None:
    """Put into the report where features lie farther from their epipolar planes than usual."""
    if len(compared) < _FEWEST_PAIRS:
        return
    distance = distance_of_pairs(compared)
    logger.info("Features lie %.2f %% of an image from their epipolar planes", distance)
    if distance > _USUAL_DISTANCE:
        add_doubt(
            context.report,
            f"Features of the images lie {distance:.1f} % of an image's longer side from each other's epipolar "
            "lines (0.2 % at most are usual): the poses of this model without points are off by as much, "
            "and depth by more. Triangulate points and adjust the model (COLMAP: point_triangulator, "
            "bundle_adjuster).",
        )


def distance_of_pairs(compared: Sequence[Compared]) -> float:
    """Median distance of features from their epipolar planes, see `epipolar_distances`.

    Of the pairs in which most fit, if that is half of them: in the others features are mistaken for each other, as
    those of equal windows are.
    """
    fitting = [pair for pair in compared if pair.fits]
    told = fitting if 2 * len(fitting) >= len(compared) else compared
    return median(float(np.median(pair.distances)) for pair in told)


def _shown(context: Context, view: View) -> Shown:
    """What stands still while the camera turns does not tell of its poses."""
    place = context.workspace.image_path
    image = read_whole_grey(place(view.name), (view.width, view.height))
    mask = read_view_mask(context.workspace.mask_path(view.name), view)
    turned = context.still.get(view.name)
    if turned:
        moves = 255 * (1 - still_mask(view, place(view.name), [place(name) for name in turned]))
        mask = moves if mask is None else np.minimum(mask, moves)
    return view, image, mask


def _refusal(finding: str) -> str:
    return (
        f"The model has no points to compare with, and features of its images {finding}: these images do not "
        "belong to its poses and cameras (exchanged, of another model, other axes, a wrong focal length); check "
        "--model and --images. What was made is left on disk."
    )
