"""Which images were matched with which, and under what parallax."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.run_facts import RunFacts
from colmap_sph.project.pair_lists import pairs_on_disk
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Photograph, Scene
from colmap_sph.stereo.partners.partner_choice import triangulation_angles

# As `pipeline.context.Context.pair_path` names them.
# Points that tell a pair's angle, and which of their angles it is, as where pairs are chosen.
_MOST_POINTS = 512
_PERCENTILE = 75


@dataclass(frozen=True)
class PairFacts:
    """A pair that was matched.

    Attributes
    ----------
    left, right : int
        Places of its photographs among those of the page.
    angle : float or None
        Parallax at the points that both see, degrees; None where they share none.
    rows : float or None
        How far rows of the rectified images disagree, pixels, where that is known.
    """

    left: int
    right: int
    angle: float | None
    rows: float | None


def pairs_of(
    workspace: Workspace,
    scene: Scene,
    photographs: Sequence[Photograph],
    facts: RunFacts,
    surfaces: Mapping[str, NDArray[np.float64]],
) -> list[PairFacts]:
    """Find the pairs that were matched: as the report says, or else as files of disparity maps are called.

    Parameters
    ----------
    workspace : Workspace
    scene : Scene
    photographs : sequence of Photograph
        All of the scene's, in the order of the page.
    facts : RunFacts
    surfaces : mapping of str to (n, 3) float64 ndarray
        Some points that images see, which tell angles where the model has no tracks.

    Returns
    -------
    list of PairFacts
    """
    told = facts.matched_pairs or [(left, right, None) for left, right in pairs_on_disk(workspace, scene)]
    known = [pair for pair in told if pair[0] in scene.index_of and pair[1] in scene.index_of]
    place_of = {view.name: place for place, photograph in enumerate(photographs) for view in photograph.views}
    return [
        PairFacts(
            place_of[left],
            place_of[right],
            _angle(scene, left, right, surfaces.get(left)),
            None if rows is None else round(rows, 3),
        )
        for left, right, rows in known
    ]


def _angle(scene: Scene, left: str, right: str, surface: NDArray[np.float64] | None) -> float | None:
    """Parallax of a pair, degrees."""
    views = scene.photograph(left), scene.photograph(right)
    rows = np.intersect1d(views[0].point_indices, views[1].point_indices, assume_unique=True)
    points = scene.points[rows[:: -(-len(rows) // _MOST_POINTS) or 1]]
    if not len(points) and surface is not None:
        points = surface[:: -(-len(surface) // _MOST_POINTS) or 1]
    if not len(points):
        return None
    angles = triangulation_angles(points, views[0].center, views[1].center)
    return round(float(np.percentile(angles, _PERCENTILE)), 2)
