"""The stages that compute maps: disparity maps of pairs, photometric and geometric maps of images.

Every stage asks for each of its results first whether an earlier run has made the very same; `pair_state`,
`vote_state` and `check_state` answer that without computing anything.
"""

import logging
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError
from colmap_sph.pipeline.context import Context, Done
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.pipeline.pair_files import (
    disparity_bytes,
    read_arrays,
    read_pair,
    stored_key,
    write_arrays,
    write_pair,
)
from colmap_sph.pipeline.records import forget, vouch, vouched_facts
from colmap_sph.project.files import make_dir
from colmap_sph.project.images import read_grey, read_undistorted
from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.masks import read_mask
from colmap_sph.project.workspace import MapKind
from colmap_sph.scene import View
from colmap_sph.stereo.confirm import confirm_depth
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.matching import RectifiedImage, Scratch, match_pair
from colmap_sph.stereo.normals import fit_normals
from colmap_sph.stereo.pairs import Pair, partners_of
from colmap_sph.stereo.rectification import rectify_pair
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Side
from colmap_sph.stereo.refinement import refine_maps
from colmap_sph.stereo.resampling import resample
from colmap_sph.stereo.vote import vote_depth

logger = logging.getLogger(__name__)

_CACHE_BYTES = 512 << 20
# Scratch memory of a matching thread: more is no faster.
_SCRATCH_BYTES = 256 << 20
# Largest bytes in use at a time: per left rectified pixel while a pair is matched, beside its scratch; per pixel
# of a view while its depth is voted, without its pairs' maps, or checked.
_MATCH_BYTES, _VOTE_BYTES, _CHECK_BYTES = 44.0, 45.0, 40.0
# … while an image is read and rectified: per pixel of its own, and per left rectified pixel of both.
_READ_BYTES, _RECTIFIED_BYTES = 9.0, 10.0
# Rectified pixels of a large pair per pixel of its images, with a margin for what arrays do not count.
_RECTIFIED_SHARE = 1.4
# … and refined, beside the grey images.
_REFINE_BYTES = 55.0


# ---- matching ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PairState:
    """Geometry and key of a pair, and whether its disparity map is there."""

    geometry: RectifiedPair
    key: str
    is_done: bool


def pair_state(context: Context, pair: Pair) -> PairState:
    """Rectify a pair of image names; `RectificationError` where that is impossible."""
    left, right = (context.scene.view(name) for name in pair)
    geometry = rectify_pair(context.scene, left, right, context.options.rectification)
    key = context.keys.pair(left, right, geometry)
    return PairState(geometry, key, stored_key(context.pair_path(*pair)) == key)


def match_pairs(context: Context, pairs: Sequence[Pair]) -> dict[Pair, str]:
    """Rectify and match pairs of image names, each once.

    Writes their disparity maps; returns the keys of the pairs that could be matched, by pair.
    """
    report = context.report
    make_dir(context.workspace.pairs_dir)
    thread, threads = threading.local(), context.options.num_threads
    gate = MemoryGate(context.options.memory_budget)
    # Scratch memory and caches take of what the largest pair leaves, but never starve.
    largest = max(view.width * view.height for view in context.scene.views)
    spare = int(max(gate.spare(_RECTIFIED_SHARE * _MATCH_BYTES * largest), gate.free / 8))
    scratch_bytes = min(_SCRATCH_BYTES, spare // (3 * threads))
    cache_bytes = min(_CACHE_BYTES, spare // 6)
    gate.keep(threads * scratch_bytes + 2 * cache_bytes)
    images = LoadCache(
        lambda name: read_grey(context.workspace.image_path(name)), lambda image: image.nbytes, cache_bytes
    )
    masks = LoadCache(lambda name: _read_mask(context, name), lambda m: 0 if m is None else m.nbytes, cache_bytes)

    def rectified(name: str, geometry: RectifiedPair, side: Side) -> RectifiedImage:
        view, mask = context.scene.view(name), masks.get(name)
        return RectifiedImage(*resample(images.get(name), view, geometry, side, mask=mask))

    def work(pair: Pair) -> Done:
        state = pair_state(context, pair)
        if state.is_done:
            return Done(state.key, made=False)
        geometry, (left, right) = state.geometry, pair
        if not hasattr(thread, "scratch"):
            thread.scratch = Scratch(scratch_bytes)
        rectified_pixels = geometry.height * geometry.left_width
        pixels = max(view.width * view.height for view in map(context.scene.view, pair))
        needed = max(_MATCH_BYTES * rectified_pixels, _READ_BYTES * pixels + _RECTIFIED_BYTES * rectified_pixels)
        with gate.reserve(needed, f"the pair {left} - {right}"):
            disparity = match_pair(
                rectified(left, geometry, "left"),
                rectified(right, geometry, "right"),
                geometry.min_disparity,
                geometry.max_disparity,
                context.options.matching,
                thread.scratch,
            )
            write_pair(context.pair_path(*pair), PairDisparity(*pair, geometry, disparity), state.key)
        return Done(state.key, made=True)

    def skip(pair: Pair, reason: str) -> None:
        report.skipped_pairs[" - ".join(pair)] = reason
        logger.warning("%s - %s skipped: %s", *pair, reason)

    matched = context.for_all("match pairs", work, pairs, skip)
    if not matched:
        reason = next(iter(report.skipped_pairs.values()), "no pair")
        raise NoResultError(f"None of the {len(pairs)} pairs could be matched ({reason}).")
    report.pairs = len(matched)
    return {pair: matched[pair].key for pair in sorted(matched)}


# ---- photometric maps --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class VoteState:
    """Key of a view's photometric depth; whether that, and the maps made from it, are there."""

    key: str
    is_voted: bool
    is_done: bool


def vote_state(context: Context, pair_keys: Mapping[Pair, str], view: View) -> VoteState:
    """See `VoteState`; `pair_keys` are those of all pairs, by pair."""
    keys = [pair_keys[pair] for pair in _pairs_of(pair_keys, view.name)]
    key = context.keys.vote(view, keys)
    voted = stored_key(context.estimate_path(view.name)) == key
    coverage = _finished_coverage(context, view.name, "photometric", context.keys.photometric(key))
    return VoteState(key, voted, voted and coverage is not None)


def estimate_views(context: Context, pair_keys: Mapping[Pair, str]) -> dict[str, str]:
    """Vote the photometric depth of every view; writes depth, normal and sigma maps.

    Returns the keys of the votes by image name, without those of views that failed.
    """
    for view in context.scene.views:
        make_dir(context.estimate_path(view.name).parent)

    gate = MemoryGate(context.options.memory_budget)

    def work(view: View) -> Done:
        state = vote_state(context, pair_keys, view)
        if not state.is_done:
            maps = sum(disparity_bytes(context.pair_path(*pair)) for pair in _pairs_of(pair_keys, view.name))
            with gate.reserve(maps + _VOTE_BYTES * view.width * view.height, view.name):
                estimate = _read_estimate(context, view.name) if state.is_voted else _vote(view, state.key)
                planes = fit_normals(view, estimate, context.options.normals)
                _write_maps(context, view, *planes, "photometric", context.keys.photometric(state.key))
        return Done(state.key, made=not state.is_done)

    def _vote(view: View, key: str) -> DepthEstimate:
        files = (context.pair_path(*pair) for pair in _pairs_of(pair_keys, view.name))
        estimate = vote_depth(view, (read_pair(file) for file in files), context.options.vote)
        mask = _read_mask(context, view.name)
        if mask is not None:
            # A pixel next to the rim can see a neighbour's disparity. Fusion leaves out what has no depth.
            estimate.depth[mask == 0] = 0
        arrays = {"depth": estimate.depth, "sigma": estimate.sigma, "support": estimate.support}
        write_arrays(context.estimate_path(view.name), arrays, key)
        return estimate

    results = context.for_all("estimate depth", work, context.scene.views, context.skip_view)
    return {view.name: done.key for view, done in results.items()}


# ---- geometric maps ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CheckState:
    """Key of a view's geometric maps, and the share of pixels with a depth where they are there."""

    key: str
    coverage: float | None


def check_state(context: Context, partners: Sequence[str], votes: Mapping[str, str], view: View) -> CheckState:
    """See `CheckState`; `votes` are the keys of the votes by image name, of `partners` and the view's own."""
    key = context.keys.geometric(votes[view.name], [votes[name] for name in partners])
    return CheckState(key, _finished_coverage(context, view.name, "geometric", key))


def check_views(context: Context, pairs: Iterable[Pair], votes: Mapping[str, str]) -> dict[str, str]:
    """Check every view's depth against its partners'; writes the geometric depth and normal maps.

    `votes` are what `estimate_views` returned. Returns the keys of the maps by image name.
    """
    report, partners = context.report, partners_of(pairs)
    gate = MemoryGate(context.options.memory_budget)
    most = max(_checking_bytes(context, view, partners.get(view.name, [])) for view in context.scene.views)
    cache_bytes = int(min(_CACHE_BYTES, gate.spare(1.2 * most) / 2))
    gate.keep(2 * cache_bytes)
    images = LoadCache(
        lambda name: read_undistorted(context.workspace.image_path(name), cv2.IMREAD_GRAYSCALE),
        lambda image: image.nbytes,
        cache_bytes,
    )
    estimates = LoadCache(lambda name: _read_estimate(context, name), lambda e: 9 * e.depth.size, cache_bytes)

    def work(view: View) -> Done:
        names = [name for name in partners.get(view.name, []) if name in votes]
        state = check_state(context, names, votes, view)
        if state.coverage is not None:
            return Done(state.key, made=False, coverage=state.coverage)
        with gate.reserve(_checking_bytes(context, view, names), view.name):
            others = ((context.scene.view(name), estimates.get(name)) for name in names)
            checked = confirm_depth(view, estimates.get(view.name), others, context.options.confirm)
            planes = fit_normals(view, checked, context.options.normals)
            if context.options.refinement.rounds and checked.depth.any():
                sources = [(context.scene.view(name), images.get(name)) for name in names]
                image, options = images.get(view.name), context.options.refinement
                planes = refine_maps(view, image, checked, *planes, sources, options)
            coverage = _write_maps(context, view, *planes, "geometric", state.key)
        return Done(state.key, made=True, coverage=coverage)

    views = [view for view in context.scene.views if view.name in votes]
    results = context.for_all("check consistency", work, views, context.skip_view)
    coverage = {view.name: done.coverage for view, done in results.items()}
    report.coverage = {view.name: coverage.get(view.name, 0.0) for view in context.scene.views}
    report.images = sum(share > 0 for share in report.coverage.values())
    failures = [report.skipped_images[name] for name in report.coverage if name in report.skipped_images]
    if failures and not report.images:
        raise NoResultError(f"No image has a depth map ({failures[0]})")
    for name in (name for name, share in report.coverage.items() if share == 0):
        known = "no depth of it is confirmed by another image"
        report.skipped_images.setdefault(name, known if name in partners else "no pair of it could be matched")
    if not report.images:
        masked = context.workspace.masks_dir.is_dir()
        raise NoResultError(
            "No depth was confirmed by a second image; are the model's poses right for these images"
            + (", and is black in the masks what is to be ignored?" if masked else "?")
        )
    return {view.name: done.key for view, done in results.items()}


# ---- helpers -----------------------------------------------------------------------------------------------


def _pairs_of(pairs: Iterable[Pair], name: str) -> list[Pair]:
    """Pairs of an image, by the name of its partner."""
    return sorted((pair for pair in pairs if name in pair), key=lambda pair: [n for n in pair if n != name])


def _read_mask(context: Context, name: str) -> NDArray[np.uint8] | None:
    view = context.scene.view(name)
    return read_mask(context.workspace.mask_path(name), view.width, view.height)


def _read_estimate(context: Context, name: str) -> DepthEstimate:
    return DepthEstimate(**read_arrays(context.estimate_path(name), ("depth", "sigma", "support")))


def _checking_bytes(context: Context, view: View, partners: Sequence[str]) -> float:
    """Largest bytes in use while a view's depth is checked and refined."""
    pixels = view.width * view.height
    if not context.options.refinement.rounds:
        return _CHECK_BYTES * pixels
    others = (context.scene.view(name) for name in partners)
    return (_REFINE_BYTES + 1) * pixels + sum(other.width * other.height for other in others)


def _write_maps(
    context: Context,
    view: View,
    normals: NDArray[np.float32],
    depth: NDArray[np.float32],
    kind: MapKind,
    key: str,
) -> float:
    """Write both maps of planes, return the share of pixels with one."""
    record, (depth_path, normal_path) = context.maps_record(view.name, kind), context.map_paths(view.name, kind)
    forget(record)
    write_depth_map(depth_path, depth)
    write_normal_map(normal_path, normals)
    coverage = float((depth > 0).mean())
    vouch(record, key, [depth_path, normal_path], coverage=coverage)
    return coverage


def _finished_coverage(context: Context, name: str, kind: MapKind, key: str) -> float | None:
    """Share of pixels with a depth in an image's maps, or None where they must be made."""
    facts = vouched_facts(context.maps_record(name, kind), key, context.map_paths(name, kind))
    return None if facts is None else facts["coverage"]
