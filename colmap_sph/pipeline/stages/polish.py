"""Between matching and matching again: the ties of all pairs → the sparse model with better poses, if they are.

What is accepted is decided by ties that had no part in the adjustment, and by the model's own tracks.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from colmap_sph.errors import InputError
from colmap_sph.pipeline.stages.facts import Facts, Polish
from colmap_sph.pipeline.stages.pair_files import read_pair, read_ties
from colmap_sph.pipeline.stages.stage import Cost, Job, Stage
from colmap_sph.project.files import make_dir, scratch_folder
from colmap_sph.project.polishing.adjustment import Observations, adjusted_model
from colmap_sph.project.polishing.options import PolishOptions
from colmap_sph.project.polishing.polished import keep_given, known_outcome, publish_polished, starting_model
from colmap_sph.project.scene_reader import scene_of_model
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.poses.quality import Judgement, judged, movements, refusal, sound_tracks
from colmap_sph.stereo.poses.tracks import ImageTies, Tracks, image_coordinates, tracks_of_ties, triangulated

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Processor seconds, and bytes in use, per image of the model.
_SECONDS = 0.4
_BYTES = 4e6


@dataclass(frozen=True, eq=False)
class PolishTask:
    """The model to polish, the disparity maps whose ties tell how, and where the result goes."""

    workspace: Workspace
    pairs: Mapping[Pair, Path]
    options: PolishOptions
    key: str


def polish_poses(task: PolishTask) -> Facts:
    """Polish the poses of a workspace's model; puts the polished one into its place where it is better."""
    workspace = task.workspace
    folder = starting_model(workspace)
    given = load_model(folder)
    scene = scene_of_model(given, folder)
    tracks = tracks_of_ties(_ties(task.pairs, scene), scene.index_of)
    tracks = sound_tracks(tracks, scene)
    reason = refusal(tracks, scene, task.options.least_residual)
    if reason:
        return _kept(task, reason)
    is_held_out = np.arange(len(tracks)) % HELD_OUT == 0
    used = tracks.only(~is_held_out)
    adjusted = adjusted_model(given, _observations(used, scene))
    if adjusted is None:
        return _kept(task, "their adjustment does not converge")
    after = scene_of_model(adjusted, folder)
    judgement = judged(tracks.only(is_held_out), scene, after)
    reason = judgement.refusal(task.options.least_gain)
    if reason:
        return _kept(task, reason)
    moved = movements(scene, after)
    polish = Polish(_success(judgement, moved), is_polished=True, movement=moved)
    with scratch_folder(workspace.polishing_scratch_dir):
        made = workspace.polishing_scratch_dir / "polished"
        make_dir(made)
        adjusted.write_binary(made)
        publish_polished(workspace, made, task.key, asdict(polish))
    return Facts(polish=polish)


HELD_OUT = 5
"""Of so many tracks one has no part in the adjustment."""


def _ties(pairs: Mapping[Pair, Path], scene: Scene) -> dict[Pair, ImageTies]:
    """Ties of all pairs, in image coordinates; a pair whose file cannot be read has none."""
    ties = {}
    for pair, path in pairs.items():
        with suppress(InputError):
            geometry = read_pair(path).geometry
            found = read_ties(path)
            left, right = (scene.view(name) for name in pair)
            ties[pair] = ImageTies(
                image_coordinates(left, geometry, "left", found.left),
                image_coordinates(right, geometry, "right", found.right),
            )
    return ties


def _observations(tracks: Tracks, scene: Scene) -> Observations:
    points = triangulated(tracks, scene.views) + scene.origin
    names = [view.name for view in scene.views]
    return Observations(names, tracks.track, tracks.view, tracks.pixels, points)


def _kept(task: PolishTask, reason: str) -> Facts:
    polish = Polish(f"The poses are kept as given: {reason}.")
    keep_given(task.workspace, task.key, asdict(polish))
    return Facts(polish=polish)


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
    pairs : sequence of (str, str)
        Pairs of image names that were to be matched.
    matched : collection of (str, str)
        Those of them that were: their ties tell.
    """

    name = "polish poses"
    whole = True
    make = staticmethod(polish_poses)

    def __init__(self, context: "Context", pairs: Sequence[Pair], matched: Collection[Pair] = ()) -> None:
        super().__init__(context, ["the sparse model"])
        self._pairs = pairs
        self._matched = matched

    def job(self, item: str) -> Job[PolishTask]:
        """See `Stage.job`."""
        context = self.context
        key = context.keys.polish(self._pairs, starting_model(context.workspace))
        paths = {pair: context.pair_path(*pair) for pair in self._matched}
        task = PolishTask(context.workspace, paths, context.options.polish, key)
        number = len(context.scene.views)
        cost = Cost(_SECONDS * number, _BYTES * number, 0.0)
        return Job(key, self._known(key), cost, task)

    def _known(self, key: str) -> Facts | None:
        outcome = None if self.context.keys.fresh else known_outcome(self.context.workspace, key)
        if outcome is None:
            return None
        try:
            return Facts(polish=msgspec.convert(outcome, Polish))
        except msgspec.ValidationError:
            return None
