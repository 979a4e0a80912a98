"""A scene and its pairs → the scene with polished poses, where these are asked for and better.

The pairs are matched with the given poses first, for their ties; then the poses are polished, and the stages that
follow match all again. Where a run before has polished the same, its model is there, and nothing of this is done.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from colmap_sph.errors import shell_word
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.stages.facts import Polish
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.polish import GivenModel, PolishStage, kept_as_given
from colmap_sph.platforms.files import plain_path
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.pairing import Pair

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor

logger = logging.getLogger(__name__)


class MatchToPolishStage(MatchStage):
    """Matches the pairs with the given poses."""

    name = "match pairs to polish"
    remembered_as = None  # its results make room for those with the polished poses


def with_polished_poses(
    context: Context, pairs: Sequence[Pair], executor: "Executor", given: GivenModel
) -> Context:
    """Polish the poses of the workspace's model, and return the context of what is to be matched.

    Parameters
    ----------
    context : Context
        With the scene of the given model.
    pairs : sequence of (str, str)
    executor : callable
        What is done with each stage. One that only asks gets a context under whose keys there is no result, where
        it is not known yet what polishing comes to.
    given : GivenModel

    Returns
    -------
    Context
    """
    if given.reason_to_keep:
        return _told(context, given, kept_as_given(given.reason_to_keep, context.options.polish))
    polish = _outcome(context, pairs, executor, given)
    if polish is None:
        return replace(context, keys=Keys(context.workspace, context.options, fresh=True))
    context = _told(context, given, polish)
    if not polish.is_polished:
        return context
    names = context.scene.index_of
    return replace(context, scene=anchored(read_scene(context.workspace.sparse_dir)).only(names))


def _outcome(context: Context, pairs: Sequence[Pair], executor: "Executor", given: GivenModel) -> Polish | None:
    """What polishing comes to, after matching the pairs where that is not known yet; None where it is not done."""
    stage = PolishStage(context, given, pairs)
    known = stage.job(stage.items[0]).done
    if known is not None:
        return known.polish
    matched = executor(MatchToPolishStage(context, pairs))
    # What could not be matched now may be with other poses, and is told of then.
    context.report.skipped_pairs.clear()
    context.report.incomplete.clear()
    (result,) = executor(PolishStage(context, given, pairs, matched.keys())).values()
    return result.facts.polish


def _told(context: Context, given: GivenModel, polish: Polish) -> Context:
    words = [polish.words, polish.advice]
    if polish.is_refined:  # by the paths of this run: the outcome may be that of one from another folder
        refined, root = context.workspace.refined_model_dir, plain_path(context.workspace.root)
        output = root.with_name(f"{root.name}_refined")
        words.append(
            f"Use them in another run: colmap_sph run --model {shell_word(refined)} --images "
            f"{shell_word(given.image_dir)} --output {shell_word(output)}"
        )
    context.report.polishing = " ".join(filter(None, words))
    logger.info("%s", context.report.polishing)
    context.report.pose_movement = dict(polish.movement)
    return context
