"""Second stage: the disparity maps of every image's pairs vote on its photometric depth."""

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from colmap_sph.errors import NoResultError
from colmap_sph.pipeline.known.remembering import NO_COST, RememberingStage
from colmap_sph.pipeline.stages.facts import Agreement, Facts
from colmap_sph.pipeline.stages.maps import MAP_BYTES, MapFiles
from colmap_sph.pipeline.stages.pair_files import (
    bytes_to_read,
    facts_of_estimate,
    read_estimate,
    read_pair,
    residuals_of,
    write_estimate,
)
from colmap_sph.pipeline.stages.stage import Cost, Job, Result, keys_of
from colmap_sph.project.files import make_dir
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.masks import read_view_mask
from colmap_sph.scene import View
from colmap_sph.stereo.agreement import compare_with_sparse
from colmap_sph.stereo.depth import DepthEstimate, Depths, drop_other_depths
from colmap_sph.stereo.normals import NormalOptions, fit_normals
from colmap_sph.stereo.partners.pairing import Pair, as_pair, partners_of
from colmap_sph.stereo.region.focus import Focus, region_of
from colmap_sph.stereo.region.inside import drop_outside
from colmap_sph.stereo.region.shown import count_focus
from colmap_sph.stereo.region.window import Window
from colmap_sph.stereo.vote import VoteOptions, bytes_of_band, vote_depth

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Processor seconds per megapixel of the image: per pair that votes; and of the normals of one kind of maps, for
# each pixel of the radius of their windows.
_SECONDS = 0.027
_NORMALS_SECONDS = 0.027
# Estimates reach so many pixels beyond the region that maps are cut to: what windows at its border look at.
REGION_MARGIN = 24
# Bytes on disk per pixel: of the estimate.
_ESTIMATE_BYTES = 9.0
# Largest bytes in use at a time, per pixel: of a mask that is read beside the estimate, when the disparity maps of
# pairs are not in use any more; and beside these while maps are made of the estimate, or pixels counted that show
# a region. And of a disparity map that is not made yet.
_MASK_BYTES = 7.0
_MAPS_BYTES = 45.0
_DISPARITY_BYTES = 4.0


@dataclass(frozen=True, eq=False)
class VoteTask:
    """A view's pairs, or its estimate where only the maps are to be made from it, and where the results go.

    The photometric maps are made where they are wanted: confirmation needs none.
    """

    view: View
    lead: str
    pairs: tuple[Path, ...]
    pair_keys: tuple[str, ...]
    mask: Path
    estimate: Path
    stations: tuple[int, ...]
    residuals: tuple[float, ...]
    vote_options: VoteOptions
    normal_options: NormalOptions
    depths: Depths | None
    window: Window
    focus: Focus | None
    matched: tuple[str, ...]
    maps: MapFiles
    wants_maps: bool
    vote_key: str
    maps_key: str


def make_photometric_maps(task: VoteTask) -> Facts:
    """Vote on the depth of a view; writes it with its standard deviation and support, and the photometric maps."""
    view = task.window.view(task.view)
    # A worker that was lost may have come so far.
    facts = facts_of_estimate(task.estimate, task.vote_key, view)
    if not task.wants_maps:
        task.maps.remove()  # of an earlier vote, or with other normals
        return _vote(task, view)[1] if facts is None else facts
    estimate = _vote(task, view)[0] if facts is None else read_estimate(task.estimate, view, task.vote_key)
    normals, depth = fit_normals(view, estimate, task.normal_options)
    drop_other_depths(depth, task.depths)
    drop_outside(view, depth, region_of(task.focus))
    shown = count_focus(view, estimate.depth, depth, task.focus)
    normals, depth = (task.window.padded(pixels, task.view) for pixels in (normals, depth))
    return task.maps.write(normals, depth, task.maps_key, partners=task.matched, shown=shown)


def _vote(task: VoteTask, view: View) -> tuple[DepthEstimate, Facts]:
    pairs = (read_pair(file, key) for file, key in zip(task.pairs, task.pair_keys, strict=True))
    estimate = vote_depth(view, pairs, task.vote_options, task.stations, task.residuals, task.lead)
    mask = read_view_mask(task.mask, task.view)
    if mask is not None:
        # A pixel next to the rim can see a neighbour's disparity. Fusion leaves out what has no depth.
        estimate.depth[task.window.part(mask) == 0] = 0
    drop_other_depths(estimate.depth, task.depths)
    drop_outside(view, estimate.depth, region_of(task.focus), REGION_MARGIN)
    facts = _facts_of(task, view, estimate)
    write_estimate(task.estimate, estimate, task.vote_key, facts, corner=task.window[:2])
    return estimate, facts


def _facts_of(task: VoteTask, view: View, estimate: DepthEstimate) -> Facts:
    depth = estimate.depth if task.focus is None else estimate.depth.copy()
    drop_outside(view, depth, region_of(task.focus))
    shown = count_focus(view, estimate.depth, depth, task.focus)
    return Facts.of_map(int(np.count_nonzero(depth)), task.view.num_pixels, shown)


def report_photometric(context: "Context", votes: Mapping[str, Result]) -> None:
    """Report the photometric maps of a run that ends with them as it would report the geometric ones."""
    report = context.report
    report.coverage = {view.name: 0.0 for view in context.scene.views}
    if context.focus is not None:
        report.in_region = {name: result.facts.in_region for name, result in votes.items()}
    for name, result in votes.items():
        view = context.scene.view(name)
        depth = read_depth_map(context.map_files(name, "photometric").depth)
        mask = read_view_mask(context.workspace.mask_path(name), view)
        sights = context.sparse_tracks.sights(name).between(context.options.rectification.depths)
        agreement = Agreement(*compare_with_sparse(view, depth, sights, mask))
        report.coverage[name] = result.facts.coverage
        report.agreement[name] = agreement.share
        report.sparse_points += agreement
    report.overall_agreement = report.sparse_points.share
    report.images = sum(share > 0 for share in report.coverage.values())
    if not report.images:
        raise NoResultError("No image has a depth map: no two of its pairs agree on any depth.")


def normals_seconds(options: NormalOptions) -> float:
    """Processor seconds per megapixel to fit normals."""
    return _NORMALS_SECONDS * options.radius


def vote_seconds(pairs: int) -> float:
    """Processor seconds per megapixel of an image on whose depth so many pairs vote."""
    return _SECONDS * pairs


class VoteStage(RememberingStage[str, VoteTask]):
    """Votes on the depth of every image of the scene. Its results have the keys of the votes."""

    name = "vote on depth"
    remembered_as = "photometric"
    make = staticmethod(make_photometric_maps)

    @staticmethod
    def found(task: VoteTask) -> Facts | None:
        """See `Stage.found`."""
        voted = facts_of_estimate(task.estimate, task.vote_key, task.window.view(task.view))
        if voted is None:
            return None
        if task.wants_maps:
            return task.maps.facts(task.maps_key)
        return None if task.maps.are_outdated(task.maps_key) else voted

    def __init__(self, context: "Context", matched: Mapping[Pair, Result]) -> None:
        super().__init__(context, context.order.sorted(context.scene.index_of))
        self._pair_keys = keys_of(matched)
        self._residuals = residuals_of(matched)
        self._partners = partners_of(matched)

    def input_key(self) -> str:
        """See `RememberingStage`."""
        context = self.context
        options = context.options
        given = (options.pairs, options.rectification, options.vote, options.normals, context.wants_photometric)
        matched = sorted((*pair, key, self._residuals[pair]) for pair, key in self._pair_keys.items())
        return context.keys.stage("vote", context.scene_key, given, matched)

    def files(self, item: str) -> list[str]:
        """See `RememberingStage`."""
        maps = self.context.map_files(item, "photometric").paths if self.context.wants_photometric else []
        return [*maps, str(self.context.estimate_path(item))]

    def is_there(self, item: str, key: str) -> bool:
        """See `RememberingStage`."""
        window = self.context.window(item)
        view = window.view(self.context.scene.view(item))
        maps = self.context.map_files(item, "photometric")
        if facts_of_estimate(self.context.estimate_path(item), key, view) is None:
            return False
        return not self.context.wants_photometric or maps.facts(self.context.keys.photometric(key)) is not None

    def close(self, results: Mapping[str, Result]) -> None:
        """See `Stage.close`."""
        self.remember(results)

    def ask(self, item: str) -> Job[VoteTask]:
        """See `RememberingStage`."""
        context = self.context
        view = context.scene.view(item)
        lead = context.lead(item)
        matched = self._partners.get(lead, [])
        partners, stations = context.stations.elsewhere(item, matched)
        paths = [context.pair_paths(lead, partner) for partner in partners]
        files = tuple(itertools.chain(*paths))
        # One that is matched both ways has two maps.
        pairs = [as_pair(lead, partner) for partner, maps in zip(partners, paths, strict=True) for _ in maps]
        stations = [number for number, maps in zip(stations, paths, strict=True) for _ in maps]
        residuals = [self._residuals[pair] for pair in pairs]
        keys = [self._pair_keys[pair] for pair in pairs]
        key = context.keys.vote(view, keys, stations, residuals, context.cut(item))
        task = VoteTask(
            view.without_points(),
            lead,
            files,
            tuple(keys),
            context.workspace.mask_path(item),
            context.estimate_path(item),
            tuple(stations),
            tuple(residuals),
            context.options.vote,
            context.options.normals,
            context.options.rectification.depths,
            context.window(item),
            context.focus,
            tuple(matched),
            context.map_files(item, "photometric"),
            context.wants_photometric,
            key,
            context.keys.photometric(key),
        )
        facts = self.found(task)
        # What making it costs stands in the heads of all its pairs' files.
        return Job(key, facts, self._cost(task) if facts is None else NO_COST, task)

    def _cost(self, task: VoteTask) -> Cost:
        pixels = task.window.num_pixels
        unknown = (_DISPARITY_BYTES * pixels, 0.0)
        disparities = [bytes_to_read(file, task.lead) or unknown for file in task.pairs]
        view = task.view
        is_voted = facts_of_estimate(task.estimate, task.vote_key, task.window.view(view)) is not None
        seconds = 0.0 if is_voted else vote_seconds(len(task.pairs))
        disk = 0.0 if is_voted else _ESTIMATE_BYTES * pixels
        kept = sum(kept for kept, _ in disparities)
        memory = max(
            [_ESTIMATE_BYTES * pixels + bytes_of_band(view, len(task.pairs)), *(more for _, more in disparities)]
        )
        memory = max(memory + kept, _ESTIMATE_BYTES * pixels + _MASK_BYTES * view.num_pixels)
        if self.context.focus is not None:
            memory = max(memory, _MAPS_BYTES * pixels + kept)
        if self.context.wants_photometric:
            seconds += normals_seconds(self.context.options.normals)
            disk += MAP_BYTES * view.num_pixels
            memory = max(memory, _MAPS_BYTES * pixels + MAP_BYTES * (view.num_pixels - pixels) + kept)
        return Cost(seconds * pixels / 1e6, memory, disk)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """See `Stage.opened`."""
        for name in self.items:
            make_dir(self.context.estimate_path(name).parent)
        yield
