"""Scene → for every image the partners it is matched with, best first.

Candidates share sparse points (3D points both images observe), seen under some parallax; the best of them together
see all of the image. Without tracks, or with few, the verified matches of COLMAP's database stand in for these
points, and without matches the overlap of the viewing frusta. A ``patch-match.cfg`` that the user wrote is obeyed.
"""

import itertools
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, OptionError
from colmap_sph.scene import Scene, SourceImages
from colmap_sph.stereo.partners.covisibility import Covisibility, CovisibilitySource, find_covisibility
from colmap_sph.stereo.partners.facing import Facing
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.partners.partner_choice import choose
from colmap_sph.stereo.partners.stations import StationCounter

logger = logging.getLogger(__name__)

PairSource = CovisibilitySource | Literal["patch-match.cfg"]
# Candidates that a view chooses from, unless it is to have more.
_MAX_CANDIDATES = 100
# So many are looked at together.
_AT_A_TIME = 64
# So many times as many may stand beside these.
_MAX_BESIDE = 10
# Of more candidates than twice as many those are looked at that share most, so many, and as many of the others,
# evenly: where a camera hovers, thousands may stand beside a view before the first that does not.
_MOST_SHARING = 1000


@dataclass(frozen=True)
class PairOptions:
    """Which pairs of images are matched."""

    num_pairs: int = 10
    """Partners of each image, at most."""

    min_triangulation_angle: float = 1.0
    """Least parallax of a pair in degrees: its 75th percentile over the points that both images see."""

    max_triangulation_angle: float = 60.0
    """Parallax in degrees above which a partner comes after all others."""

    min_shared_points: int = 10
    """Least number of sparse points (or verified matches) that both images must have, all views of a photograph
    together."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of its bounds."""
        if self.num_pairs < 1:
            raise OptionError(f"num_pairs must be at least 1, not {self.num_pairs}.", "num_pairs")
        if not 0 <= self.min_triangulation_angle < self.max_triangulation_angle <= 180:
            raise OptionError(
                "min_triangulation_angle must be less than max_triangulation_angle, both in 0..180 degrees, not "
                f"{self.min_triangulation_angle} and {self.max_triangulation_angle}.",
                "min_triangulation_angle",
                "max_triangulation_angle",
            )
        if self.min_shared_points < 1:
            message = f"min_shared_points must be at least 1, not {self.min_shared_points}."
            raise OptionError(message, "min_shared_points")


@dataclass(frozen=True)
class Partner:
    """An image that another, its reference, is matched with.

    Attributes
    ----------
    name : str
        Its image name.
    shared_points : int
        Sparse points which both images observe; verified matches or common samples of the frusta where the
        pair was found by these.
    angle : float
        75th percentile of the triangulation angle over these points in degrees; NaN where there is none.
    """

    name: str
    shared_points: int
    angle: float


@dataclass(frozen=True)
class PairSelection:
    """The partners of every reference image.

    Views that were cut from one photograph are one image here, which is called by the name of the first of them.

    Attributes
    ----------
    partners : mapping of str to tuple of Partner
        For each reference image, in the order of the scene, its partners with the best first; may be empty.
    source : "tracks", "database", "frusta" or "patch-match.cfg"
        What the selection rests on.
    """

    partners: Mapping[str, tuple[Partner, ...]]
    source: PairSource

    @property
    def without_partner(self) -> tuple[str, ...]:
        """Reference images that have no pair."""
        return tuple(name for name, partners in self.partners.items() if not partners)

    def unique_pairs(self) -> list[Pair]:
        """Return every pair once, in sorted order."""
        names = {
            tuple(sorted((reference, p.name))) for reference, partners in self.partners.items() for p in partners
        }
        return sorted((first, second) for first, second in names)


def select_pairs(
    scene: Scene,
    options: PairOptions,
    *,
    explicit: Mapping[str, SourceImages] | None = None,
    matches: Mapping[Pair, int] | None = None,
) -> PairSelection:
    """Choose the partners of every image.

    Parameters
    ----------
    scene : Scene
    options : PairOptions
    explicit : mapping, optional
        ``patch-match.cfg`` as `read_patch_match_cfg` returns it. Only its reference images are processed;
        their lists are obeyed without any gate; ``__auto__`` means the choice made here.
    matches : mapping, optional
        Names of two images → number of their verified matches; serves where the model has no or few tracks.

    Returns
    -------
    PairSelection

    Raises
    ------
    NoResultError
        No image has a partner.

    Examples
    --------
    Three cameras in a row, each of which sees points up to 4 units beside it: neighbours see most of the same.

    >>> import numpy as np
    >>> from colmap_sph.scene import View
    >>> K = np.array([[200.0, 0, 100], [0, 200, 100], [0, 0, 1]])
    >>> points = np.array([(x, y, 8) for x in np.arange(-5, 8) for y in np.arange(-3, 4)])
    >>> views = []
    >>> for k in range(3):
    ...     seen = np.flatnonzero(np.abs(points[:, 0] - k) < 4)
    ...     views.append(View(k, "abc"[k], 200, 200, K, np.eye(3), np.array([-k, 0, 0]), seen))
    >>> select_pairs(Scene(tuple(views), points), PairOptions(num_pairs=1)).unique_pairs()
    [('a', 'b'), ('b', 'c')]
    """
    options.check()
    if len(scene.photographs) == 1:
        raise NoResultError(
            f"No pair of images overlaps, as there is one image only, {scene.photographs[0].name}; depth needs "
            "others that see the same from elsewhere."
        )
    graph = find_covisibility(scene, options.min_shared_points, matches)
    if explicit is None:
        photographs = enumerate(graph.photographs)
        partners = {photograph.lead.name: best_partners(graph, options, i) for i, photograph in photographs}
        selection = PairSelection(partners, graph.source)
    else:
        selection = _explicit_selection(scene, graph, options, explicit)
    report_selection(selection, options)
    return selection


class Overlap:
    """Tells which views overlap each view of a scene; may be used by several threads.

    Where the model has no or few tracks, projected points or the frusta say what overlaps.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._graph = find_covisibility(scene, 1, None)
        self._index_of = {photograph.name: index for index, photograph in enumerate(scene.photographs)}

    def of(self, name: str, most: int) -> list[str]:
        """Names of up to so many views, those whose photographs share most points with the view's first.

        Of each of these photographs there is one, its first.
        """
        photographs = self._scene.photographs
        candidates, _ = self._graph.candidates(self._index_of[self._scene.photograph(name).name])
        return [photographs[j].lead.name for j in candidates[:most]]


def overlapping_views(scene: Scene, most: int) -> dict[str, list[str]]:
    """Names of up to `most` views that overlap each view, see `Overlap`."""
    overlap = Overlap(scene)
    facing = Facing(scene)
    found = {view.name: facing.views(view.name, overlap.of(view.name, most)) for view in scene.views}
    return {name: [*itertools.chain(*views)] for name, views in found.items()}


def best_partners(graph: Covisibility, options: PairOptions, i: int) -> tuple[Partner, ...]:
    """Return the best partners of photograph `i`, each by the name of its first view.

    These are the ones that together see most of it, then those under a wide angle, and last those that stand
    beside one of these.
    """
    near: list[Partner] = []
    wide: list[Partner] = []
    beside: list[Partner] = []
    worths: list[NDArray[np.float32]] = []
    most = max(_MAX_CANDIDATES, options.num_pairs)
    photographs = graph.photographs
    stations = StationCounter(graph.seen_by(i), photographs[i], options.min_triangulation_angle)
    candidates, weights = (found[_looked_at(len(found))] for found in graph.candidates(i))
    for first in range(0, len(candidates), _AT_A_TIME):
        if len(near) == most or len(near) + len(wide) == 2 * most or len(beside) == _MAX_BESIDE * most:
            break
        some = candidates[first : first + _AT_A_TIME]
        angles = graph.angles(i, some)
        is_apart = ~np.isnan(angles) | (graph.centers[some] != graph.centers[i]).any(axis=1)
        good = np.flatnonzero(is_apart & ~(angles < options.min_triangulation_angle))
        is_new = stations.are_new([photographs[j] for j in some[good]])
        chosen = []
        for k, new in zip(good.tolist(), is_new, strict=True):
            if len(near) == most or len(near) + len(wide) == 2 * most or len(beside) == _MAX_BESIDE * most:
                break
            name = photographs[some[k]].lead.name
            partner = Partner(name, int(weights[first + k]), float(angles[k]))
            if not new:
                beside.append(partner)
            elif angles[k] > options.max_triangulation_angle:
                wide.append(partner)
            else:
                near.append(partner)
                chosen.append(k)
        if chosen:
            worths.append(graph.worths(i, some[chosen]))
    best = choose(np.concatenate(worths), options.num_pairs) if worths else []
    return tuple(([near[k] for k in best] + wide + beside)[: options.num_pairs])


def _looked_at(count: int) -> NDArray[np.int64]:
    """Places of the candidates that are looked at, ascending, of so many with those that share most first."""
    if count <= 2 * _MOST_SHARING:
        return np.arange(count)
    others = np.linspace(_MOST_SHARING, count - 1, _MOST_SHARING).astype(np.int64)
    return np.concatenate([np.arange(_MOST_SHARING), others])


def _explicit_selection(
    scene: Scene, graph: Covisibility, options: PairOptions, explicit: Mapping[str, SourceImages]
) -> PairSelection:
    index_of = scene.index_of
    place_of = {photograph.name: place for place, photograph in enumerate(graph.photographs)}
    partners: dict[str, tuple[Partner, ...]] = {}
    obeyed = set(index_of) - set(explicit) != set()
    for name in sorted(explicit.keys() & index_of.keys(), key=index_of.__getitem__):
        sources = explicit[name]
        photograph = scene.photograph(name)
        i = place_of[photograph.name]
        if isinstance(sources, int):
            found = best_partners(graph, options, i)
        else:
            obeyed = True
            named = index_of if sources == "__all__" else sources
            places = [place_of[scene.photograph(other).name] for other in named if other in index_of]
            known = np.array([place for place in dict.fromkeys(places) if place != i], np.int64)
            found = tuple(
                Partner(graph.photographs[j].lead.name, int(weight), float(angle))
                for j, weight, angle in zip(known, graph.weights(i, known), graph.angles(i, known), strict=True)
            )
        # Views of one photograph have their partners in common.
        before = partners.get(photograph.lead.name, ())
        others = {partner.name for partner in before}
        partners[photograph.lead.name] = before + tuple(each for each in found if each.name not in others)
    if obeyed:  # else it is as COLMAP writes it, with all images
        _warn_unknown(explicit, index_of)
    return PairSelection(partners, "patch-match.cfg" if obeyed else graph.source)


def _warn_unknown(explicit: Mapping[str, SourceImages], index_of: Mapping[str, int]) -> None:
    listed: set[str] = set(explicit)
    for sources in explicit.values():
        if isinstance(sources, list):
            listed.update(sources)
    for name in sorted(listed - set(index_of)):
        logger.warning("patch-match.cfg names %s, which is not among the usable images; ignored", name)


def report_selection(selection: PairSelection, options: PairOptions) -> None:
    """Log what was chosen; `NoResultError` where no image has a partner."""
    words = {
        "tracks": "the sparse points that images share",
        "database": "the verified matches in the database, as the model has no or few tracks",
        "frusta": "the overlap of the viewing frusta, as the model has no or few tracks",
        "patch-match.cfg": "patch-match.cfg",
    }
    num_unique = len(selection.unique_pairs())
    if num_unique == 0:
        if selection.source == "patch-match.cfg":
            raise NoResultError(
                "No pair of the model's usable images comes of patch-match.cfg; mend or delete it."
            )
        # Others may be what splats begin with: drawn at random.
        points = " do points without tracks lie on what they show? if not, delete them"
        raise NoResultError(
            f"No pair of images overlaps and has parallax, going by {words[selection.source]}: at least "
            f"{options.min_shared_points} shared points and a triangulation angle of "
            f"{options.min_triangulation_angle} degrees are needed; check the model (were its images taken from "
            f"different places?{points if selection.source == 'frusta' else ''}), or lower "
            "--pairs.min-shared-points or --pairs.min-triangulation-angle."
        )
    logger.info("%d pairs of %d images, by %s", num_unique, len(selection.partners), words[selection.source])
    for name in selection.without_partner:
        logger.warning("%s has no partner with enough overlap and parallax; it gets no depth map", name)
