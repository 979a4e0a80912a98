"""Matched pairs of a model without points → are its poses those of the images?

Of other models sparse points tell, see `self_check`. Without them ties do: with wrong poses most pairs have hardly
any. So have some with right poses; where most pairs have few, features of the images decide.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from statistics import median

from colmap_sph.errors import InputError, NoResultError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.stages.stage import Result
from colmap_sph.project.images.reading import read_whole_grey
from colmap_sph.project.masks import read_view_mask
from colmap_sph.scene import View
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.features import Features, Shown, epipolar_share, find_features, match_features

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


def check_poses(context: Context, matched: Mapping[Pair, Result]) -> None:
    """Raise `NoResultError` where a model has no points, and images and their pairs contradict its poses.

    Parameters
    ----------
    context : Context
    matched : mapping of (str, str) to Result
        Matched pairs.
    """
    if context.scene.has_tracks:
        return
    sound = sum(result.facts.row_residual is not None for result in matched.values())
    if sound >= _SOUND_SHARE * len(matched):
        return
    logger.info("%d of %d pairs have enough ties: features of images are compared", sound, len(matched))
    pairs = sorted(matched)
    _judge(context, pairs[:: -(-len(pairs) // _MOST_ASKED)])


def _judge(context: Context, pairs: Sequence[Pair]) -> None:
    @cache
    def features_of(lead: str) -> Features | None:
        with suppress(InputError):  # cannot be read for a moment, and so tells nothing
            return find_features([_shown(context, view) for view in context.scene.photograph(lead).views])
        return None

    fitting: list[int] = []
    contradicting: list[int] = []
    for left, right in pairs:
        first, second = features_of(left), features_of(right)
        if first is None or second is None:
            continue
        matches = match_features(first, second)
        if len(matches) < _TELLING:
            continue
        baseline = context.scene.view(right).center - context.scene.view(left).center
        share = epipolar_share(first, second, matches, baseline)
        (fitting if share > _FITTING else contradicting).append(len(matches))
    told = len(fitting) + len(contradicting)
    logger.info("Features fit the poses in %d of %d pairs, of %d asked", len(fitting), told, len(pairs))
    if len(contradicting) > len(fitting) and sum(contradicting) >= _ENOUGH:
        finding = f"lie on each other's epipolar lines in only {len(fitting)} of {told} pairs"
        raise NoResultError(_refusal(finding))
    usual = median(len(features_of(name) or ()) for pair in pairs for name in pair)
    if not told and usual >= _MANY_FEATURES and len(pairs) >= _MANY_PAIRS:
        raise NoResultError(_refusal(f"match in none of {len(pairs)} pairs that should show the same"))


def _shown(context: Context, view: View) -> Shown:
    image = read_whole_grey(context.workspace.image_path(view.name), (view.width, view.height))
    return view, image, read_view_mask(context.workspace.mask_path(view.name), view)


def _refusal(finding: str) -> str:
    return (
        f"The model has no points to compare with, and features of its images {finding}: these images do not "
        "belong to its poses and cameras (exchanged, of another model, other axes, a wrong focal length); check "
        "--model and --images. What was made is left on disk."
    )
