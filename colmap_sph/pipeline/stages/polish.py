"""Between matching and matching again: the ties of all pairs → the sparse model with better poses, if they are.

What is accepted is decided by ties that had no part in the adjustment, and by the model's own tracks.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from colmap_sph.pipeline.stages.facts import Facts, Polish
from colmap_sph.pipeline.stages.fine_ties import CACHE_BYTES, fine_ties
from colmap_sph.pipeline.stages.stage import Cost, Job, Result, Stage
from colmap_sph.project.files import remove, scratch_folder
from colmap_sph.project.polishing.adjustment import Observations, adjusted_model
from colmap_sph.project.polishing.options import PolishOptions
from colmap_sph.project.polishing.polished import (
    keep_given,
    known_outcome,
    publish_polished,
    starting_model,
)
from colmap_sph.project.scene_reader import scene_of_model
from colmap_sph.project.sparse_model import has_model, load_model, write_model
from colmap_sph.project.state.typed import from_plain
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.quality import (
    Judgement,
    common_bends,
    judged,
    movements,
    refusal,
    sound_tracks,
    usual_error,
)
from colmap_sph.stereo.poses.tracks import Tracks, tracks_of_ties, triangulated

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Of so many tracks one has no part in the adjustment.
_HELD_OUT = 5
# Images are bent alike where what they have in common is more than this share of their residuals.
_BENT_SHARE = 0.05
# Processor seconds, and bytes in use, per image of the model.
_SECONDS = 0.4
_BYTES = 4e6
# The same where cameras are refined, too, and bytes whatever their number.
_FIELD_SECONDS = 0.5
_FIELD_BYTES = 400e6


@dataclass(frozen=True)
class GivenModel:
    """The model that a run was given, of the original images.

    Attributes
    ----------
    model_dir, image_dir : Path
    reason_to_keep : str
        Why its poses must not be polished, as the end of a sentence; empty where they may be.
    """

    model_dir: Path
    image_dir: Path
    reason_to_keep: str = ""


@dataclass(frozen=True, eq=False)
class PolishTask:
    """The model to polish, the disparity maps whose ties tell how, and where the result goes.

    `step` is called after each step but the last: the pairs, the poses, the cameras' distortion.
    """

    workspace: Workspace
    given: GivenModel
    pairs: Mapping[Pair, Path]
    options: PolishOptions
    undistortion: UndistortionOptions
    key: str
    step: Callable[[], None]


def polish_poses(task: PolishTask) -> Facts:
    """Polish the poses of a workspace's model; puts the polished one into its place where it is better."""
    workspace = task.workspace
    if task.options.cameras:  # what an earlier run found of other images
        remove(workspace.refined_model_dir)
    folder = starting_model(workspace)
    given = load_model(folder)
    scene = scene_of_model(given, folder)
    tracks = tracks_of_ties(fine_ties(workspace, task.pairs, scene, task.step), scene.index_of)
    tracks = sound_tracks(tracks, scene)
    reason = refusal(tracks, scene, task.options.least_residual)
    if reason:
        return _kept(task, reason)
    used, held_out = _divided(tracks)
    adjusted = adjusted_model(given, _observations(used, scene))
    if adjusted is None:
        return _kept(task, "their adjustment does not converge")
    after = scene_of_model(adjusted, folder)
    judgement = judged(held_out, scene, after)
    advice = _advice(task, tracks, scene, judgement)
    reason = judgement.refusal(task.options.least_gain)
    if reason:
        return _kept(task, reason, advice)
    moved = movements(scene, after, tracks)
    success = _success(judgement, moved)
    polish = Polish(success, is_polished=True, movement=moved, advice=advice, is_refined=_is_refined(task))
    with scratch_folder(workspace.polishing_scratch_dir):
        made = workspace.polishing_scratch_dir / "polished"
        write_model(adjusted, made)
        publish_polished(workspace, made, task.key, asdict(polish))
    return Facts(polish=polish)


def _divided(tracks: Tracks) -> tuple[Tracks, Tracks]:
    """Tracks to adjust by, and those to judge by."""
    is_held_out = np.arange(len(tracks)) % _HELD_OUT == 0
    return tracks.only(~is_held_out), tracks.only(is_held_out)


def _observations(tracks: Tracks, scene: Scene) -> Observations:
    points = triangulated(tracks, scene.views) + scene.origin
    names = [view.name for view in scene.views]
    return Observations(names, tracks.track, tracks.view, tracks.pixels, points, usual_error(tracks, scene))


def kept_as_given(reason: str, options: PolishOptions, advice: str = "") -> Polish:
    """What to say of poses that are not polished; of cameras, too, where these were asked for."""
    if options.cameras and not advice:
        advice = "So are the cameras."
    return Polish(f"The poses are kept as given: {reason}.", advice=advice)


def _kept(task: PolishTask, reason: str, advice: str = "") -> Facts:
    polish = replace(kept_as_given(reason, task.options, advice), is_refined=_is_refined(task))
    keep_given(task.workspace, task.key, asdict(polish))
    return Facts(polish=polish)


def _is_refined(task: PolishTask) -> bool:
    """Whether this polishing has left a model with refined cameras; one of an earlier run is gone by now."""
    return task.options.cameras and has_model(task.workspace.refined_model_dir)


def _advice(task: PolishTask, tracks: Tracks, scene: Scene, judgement: Judgement) -> str:
    """What to do about images that are bent alike; where it was asked for, what came of it."""
    if task.options.cameras:
        return _with_refined_cameras(task, tracks, scene, judgement)
    bent = [bend for bend in common_bends(tracks, scene) if bend.share > _BENT_SHARE]
    words = (
        f"The {len(bend.views)} images with the camera of {scene.views[bend.views[0]].name} are bent alike, by "
        f"{bend.pixels:.2f} px beyond what poses can take up: its lens model is imprecise; try --polish-cameras."
        for bend in bent
    )
    return " ".join(words)


def _with_refined_cameras(task: PolishTask, tracks: Tracks, scene: Scene, judgement: Judgement) -> str:
    """Refine the cameras of the original model, and leave it in the workspace where it is better."""
    # Not before: what it is solved with takes its time to load.
    from colmap_sph.pipeline.stages.refine_cameras import CamerasToRefine, refine_cameras

    task.step()
    used, held_out = _divided(tracks)
    to_refine = CamerasToRefine(
        task.given.model_dir, task.undistortion, scene, _observations(used, scene), held_out, task.step
    )
    before = min(judgement.before, judgement.after)
    return refine_cameras(to_refine, before, task.options.least_gain, task.workspace.refined_model_dir)


def _success(judgement: Judgement, moved: Mapping[str, float]) -> str:
    farthest = max(moved, key=lambda name: moved[name])
    return (
        f"The poses were polished: images moved by {np.median(list(moved.values())):.2f} px (median) to "
        f"{moved[farthest]:.2f} px ({farthest}). {judgement.words}"
    )


class PolishStage(Stage[str, PolishTask]):
    """Polishes the poses of the scene's model; its one item is the model.

    Parameters
    ----------
    context : Context
        Of the given model.
    given : GivenModel
    pairs : sequence of (str, str)
        Pairs of image names that were to be matched.
    matched : collection of (str, str)
        Those of them that were: their ties tell.
    """

    name = "polish poses"
    whole = True
    make = staticmethod(polish_poses)

    def __init__(
        self, context: "Context", given: GivenModel, pairs: Sequence[Pair], matched: Collection[Pair] = ()
    ) -> None:
        super().__init__(context, ["the sparse model"])
        self._given = given
        self._pairs = pairs
        self._matched = matched
        self._steps_left = self.steps - 1

    @property
    def steps(self) -> int:
        """See `Stage.steps`: the pairs' ties, the poses, and two of the cameras."""
        return len(self._matched) + (3 if self.context.options.polish.cameras else 1)

    def _step(self) -> None:
        self._steps_left -= 1
        self.context.progress.advance()

    def close(self, results: Mapping[str, Result]) -> None:
        """Tell the steps that were not needed; see `Stage.close`."""
        while self._steps_left:
            self._step()

    def job(self, item: str) -> Job[PolishTask]:
        """See `Stage.job`."""
        context = self.context
        key = context.keys.polish(self._pairs, starting_model(context.workspace))
        paths = {pair: context.pair_path(*pair) for pair in self._matched}
        task = PolishTask(
            context.workspace,
            self._given,
            paths,
            context.options.polish,
            context.options.undistortion,
            key,
            self._step,
        )
        number = len(context.scene.views)
        is_refining = context.options.polish.cameras
        seconds = _SECONDS + (_FIELD_SECONDS if is_refining else 0)
        memory = _BYTES * number + max(CACHE_BYTES, _FIELD_BYTES if is_refining else 0)
        cost = Cost(seconds * number, memory, 0.0)
        return Job(key, self._known(key), cost, task)

    def _known(self, key: str) -> Facts | None:
        outcome = None if self.context.keys.fresh else known_outcome(self.context.workspace, key)
        if outcome is None:
            return None
        try:
            polish = from_plain(outcome, Polish)
        except msgspec.ValidationError:
            return None
        is_lost = polish.is_refined and not has_model(self.context.workspace.refined_model_dir)
        return None if is_lost else Facts(polish=polish)
