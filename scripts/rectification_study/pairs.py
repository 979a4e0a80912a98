"""What each pair's disparity map gives, on both surfaces, for the pixels of the original images."""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.evaluation import DepthView, truth_at_pixel_origin, truth_normals_at_pixel_origin
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.pair_files import read_pair
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.pairing import as_pair
from colmap_sph.stereo.rectified_pair import PairDisparity, Surface
from colmap_sph.stereo.search.seeds import shared_points
from colmap_sph.stereo.vote import depth_candidates, right_disparity
from rectification_study.found import count_pair, summed
from rectification_study.runs import SURFACES, Run

CORRECT = 2.0
"""A depth is correct up to this error, in GSD of its pixel."""
ANGLE_EDGES = (0.0, 8.0, 15.0, 25.0, 40.0, 50.0, 60.0, 75.0, 180.0)
PARALLAX_EDGES = (0.0, 2.0, 4.0, 8.0, 15.0, 25.0, 40.0, 50.0, 60.0, 75.0, 180.0)
"""Of the angle at the sparse points that both images see between the rays to their centres, degrees."""
SLOPE_EDGES = (0.0, 20.0, 45.0, 70.0, 90.0)
"""Of surfaces against the plane that frame rectification uses, degrees."""

# A street far ahead changes its depth by so much of it from pixel to pixel, and is no edge.
_STEEPEST = 0.2

PairScores = dict[str, Any]
Map = NDArray[np.float32]


class ExactMaps:
    """Exact depth and normals at COLMAP's pixel origin, kept for a while; None for images without."""

    def __init__(self, exact: Sequence[DepthView] | None) -> None:
        self.views = {view.name: view for view in exact or ()}
        self.depth = lru_cache(maxsize=40)(self._depth)
        self.normals = lru_cache(maxsize=20)(self._normals)

    def _depth(self, name: str) -> Map | None:
        if name not in self.views:
            return None
        return truth_at_pixel_origin(self.views[name].read_depth(), largest_step=_STEEPEST)

    def known(self, view: View) -> Map:
        """Exact depth of every pixel, 0 = unknown."""
        depth = self.depth(view.name)
        return np.zeros((view.height, view.width), np.float32) if depth is None else depth

    def _normals(self, name: str) -> Map | None:
        view = self.views.get(name)
        return None if view is None else truth_normals_at_pixel_origin(view.read_depth(), view.K)

    def errors(self, view: View, depth: Map) -> Map:
        """Error of every pixel in GSD (depth / focal length); NaN without a depth or without exact depth."""
        error = np.full(depth.shape, np.nan, np.float32)
        truth = self.depth(view.name)
        if truth is not None:
            both = (depth > 0) & (truth > 0)
            error[both] = np.abs(depth[both] / truth[both] - 1) * np.float32(view.K[0, 0])
        return error

    def slopes(self, view: View, normal: NDArray[np.float64]) -> Map:
        """Angle in degrees of every pixel's surface against the plane with a world normal; NaN where none."""
        normals = self.normals(view.name)
        if normals is None:
            return np.full((view.height, view.width), np.nan, np.float32)
        cosine = np.abs(normals @ (view.R @ normal).astype(np.float32))
        angle = np.degrees(np.arccos(np.minimum(cosine, np.float32(1))))
        return np.where(normals.any(axis=2), angle, np.float32(np.nan))


def skipped_pairs(skipped: Iterable[str]) -> list[tuple[str, str]]:
    """Pairs that a run's report says it could not rectify, by the names of their images."""
    parts = [pair.partition(" - ") for pair in skipped]
    return [(left, right) for left, _, right in parts]


@cache
def pair_files(run: Run) -> dict[tuple[str, str], Path]:
    """File of every pair that a run matched, by the names of its images."""
    return pair_files_of(run.workspace)


def pair_files_of(workspace: Workspace) -> dict[tuple[str, str], Path]:
    """File of every pair that was matched in a workspace, by the sorted names of its images."""
    found = {}
    for file in sorted((workspace.state_dir / "pairs").rglob("*.sph")):
        pair = read_pair(file)
        found[as_pair(pair.left, pair.right)] = file
    return found


def pair_depths(first: View, second: View, pair: PairDisparity, options: RunOptions) -> tuple[Map, Map]:
    """Depth of both images' pixels from their pair alone, whichever of them is the left one; 0 = none."""
    carried = right_disparity(pair, options.vote.max_disparity_step)

    def depth_of(view: View) -> Map:
        left = view.name == pair.left
        disparity = pair.disparity if left else carried
        return depth_candidates(view, disparity, pair.geometry, "left" if left else "right", options.vote)[0]

    return depth_of(first), depth_of(second)


def score_pairs(
    scene: Scene, runs: Mapping[Surface, Run], exact: Sequence[DepthView] | None, options: RunOptions
) -> list[PairScores]:
    """Score every pair that was matched on either surface.

    Returns
    -------
    list of dict
        ``left``, ``right``, ``view_angle_deg`` between the viewing directions, ``parallax_deg`` (the median angle
        at the sparse points of both between the rays to their centres), and per surface ``skipped`` (why), or:
        ``matched`` pixels of the two original images that the pair gives a depth; ``warped`` pixels, those of the
        rectified images. With exact depth also ``correct`` pixels, those of every class of slopes where the pair
        was matched on both, ``median_error_gsd``, and that of the pixels matched on both,
        ``median_error_common_gsd``; and, where it was skipped, too, the ``counts`` of `count_pair`.
    """
    maps = ExactMaps(exact)
    skipped = {pair for run in runs.values() for pair in skipped_pairs(run.report["skipped_pairs"])}
    names = sorted(skipped.union(*(pair_files(run) for run in runs.values())))

    def score(pair: tuple[str, str]) -> PairScores:
        views = scene.view(pair[0]), scene.view(pair[1])
        found = {m: read_pair(pair_files(run)[pair]) for m, run in runs.items() if pair in pair_files(run)}
        scores: PairScores = {"left": pair[0], "right": pair[1], **_geometry_of(scene, *views)}
        for surface, run in runs.items():
            reason = run.failure or run.report["skipped_pairs"].get(" - ".join(pair), "not matched")
            scores[surface] = {"skipped": reason} if surface not in found else {}
        depths = {surface: pair_depths(*views, disparity, options) for surface, disparity in found.items()}
        for surface, disparity in found.items():
            geometry = disparity.geometry
            scores[surface]["warped"] = geometry.height * (geometry.left_width + geometry.right_width)
            scores[surface]["matched"] = sum(int((depth > 0).sum()) for depth in depths[surface])
        if maps.views:
            plane = found["frame"].geometry.rectified_from_world[2] if len(found) == len(SURFACES) else None
            for surface, of_surface in _exact_scores(views, depths, maps, plane).items():
                scores[surface] |= of_surface
            truths = maps.known(views[0]), maps.known(views[1])
            for surface in runs:
                scores[surface]["counts"] = count_pair(views, depths.get(surface), truths)
        return scores

    with ThreadPoolExecutor(options.num_threads) as pool:
        return list(pool.map(score, names))


def _geometry_of(scene: Scene, left: View, right: View) -> dict[str, float]:
    cosine = float(np.clip(left.viewing_direction @ right.viewing_direction, -1, 1))
    both = shared_points(scene, left, right)
    rays = [both - view.center for view in (left, right)]
    first, second = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    angles = np.arccos(np.clip(np.sum(first * second, axis=1), -1, 1))
    parallax = float(np.degrees(np.median(angles))) if len(both) else 0.0
    return {"view_angle_deg": float(np.degrees(np.arccos(cosine))), "parallax_deg": parallax}


def _exact_scores(
    views: tuple[View, View],
    depths: Mapping[Surface, tuple[Map, Map]],
    maps: ExactMaps,
    plane: NDArray[np.float64] | None,
) -> dict[Surface, dict[str, Any]]:
    """Per surface what exact depth says about a pair's depths; by slope against a plane where one is given."""

    def flat(parts: Sequence[Map]) -> Map:
        return np.concatenate([part.ravel() for part in parts])

    errors = {
        surface: flat([maps.errors(view, depth) for view, depth in zip(views, of_surface, strict=True)])
        for surface, of_surface in depths.items()
    }
    common = np.logical_and.reduce([np.isfinite(error) for error in errors.values()])
    slopes = None if plane is None else flat([maps.slopes(view, plane) for view in views])
    scores: dict[Surface, dict[str, Any]] = {}
    for surface, error in errors.items():
        scores[surface] = {
            "correct": int((error <= CORRECT).sum()),
            "median_error_gsd": _median(error[np.isfinite(error)]),
            "median_error_common_gsd": _median(error[common]),
        }
        if slopes is not None:
            counts, _ = np.histogram(slopes[(error <= CORRECT) & np.isfinite(slopes)], SLOPE_EDGES)
            scores[surface]["correct_by_slope"] = counts.tolist()
    return scores


def by_angle(scored: Sequence[PairScores]) -> list[dict[str, Any]]:
    """Sums over the pairs of each class of angles between the viewing directions, and over all."""
    return _classed(scored, "view_angle_deg", ANGLE_EDGES)


def by_parallax(scored: Sequence[PairScores]) -> list[dict[str, Any]]:
    """Sums over the pairs of each class of parallax angles, and over all."""
    return _classed(scored, "parallax_deg", PARALLAX_EDGES)


def _classed(scored: Sequence[PairScores], key: str, edges: Sequence[float]) -> list[dict[str, Any]]:
    groups = [(low, high, [pair for pair in scored if low <= pair[key] < high]) for low, high in pairwise(edges)]
    rows = []
    for low, high, inside in [*groups, (edges[0], edges[-1], list(scored))]:
        if inside:
            row: dict[str, Any] = {"from": low, "to": high, "pairs": len(inside)}
            row |= {surface: _summed([pair[surface] for pair in inside]) for surface in SURFACES}
            rows.append(row | _found_rows(inside))
    return rows


def _found_rows(inside: Sequence[PairScores]) -> dict[str, Any]:
    """Sums per surface, in all pairs and in those that both surfaces have; found only with exact depth."""
    common = [pair for pair in inside if not any("skipped" in pair[surface] for surface in SURFACES)]
    warped = [sum(pair[surface]["warped"] for pair in common) for surface in SURFACES]
    result: dict[str, Any] = {"common_pairs": len(common), "warped_common": warped}
    if all("counts" in pair[surface] for pair in inside for surface in SURFACES):
        for key, chosen in (("found", inside), ("found_common", common)):
            result[key] = {surface: summed(pair[surface]["counts"] for pair in chosen) for surface in SURFACES}
    return result


def telling_pairs(scored: Sequence[PairScores], count: int) -> list[PairScores]:
    """Pairs to look at: those in which the surfaces differ most, each of another class of angles if possible."""
    usable = [pair for pair in scored if all("matched" in pair[surface] for surface in SURFACES)]
    usable.sort(key=lambda pair: abs(pair["spherical"]["matched"] - pair["frame"]["matched"]), reverse=True)
    chosen: dict[int, PairScores] = {}
    for pair in usable:
        chosen.setdefault(int(np.digitize(pair["view_angle_deg"], ANGLE_EDGES)), pair)
    first = list(chosen.values())
    return [*first, *(pair for pair in usable if pair not in first)][:count]


def _summed(scores: Sequence[dict[str, Any]]) -> dict[str, Any]:
    done = [one for one in scores if "skipped" not in one]
    total: dict[str, Any] = {"skipped": len(scores) - len(done)}
    for key in ("matched", "correct", "warped"):
        if all(key in one for one in done):
            total[key] = sum(one[key] for one in done)
    slopes = [one["correct_by_slope"] for one in done if "correct_by_slope" in one]
    if slopes:
        total["correct_by_slope"] = np.sum(slopes, axis=0).tolist()
    for key in ("median_error_gsd", "median_error_common_gsd"):
        known = [one[key] for one in done if one.get(key) is not None]
        total[key] = float(np.median(known)) if known else None
    return total


def _median(values: Map) -> float | None:
    return float(np.median(values)) if len(values) else None
