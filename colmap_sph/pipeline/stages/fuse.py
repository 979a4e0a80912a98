"""Last stage: the maps of all images → the cloud.

Every image is fused into a part of the cloud, and the parts are joined; or COLMAP's fusion does it all at once.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, NoResultError, OutputError, reason_of
from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.pipeline.memory import format_memory, resident
from colmap_sph.pipeline.stages.cloud import (
    begin_cloud,
    facts_of_cloud,
    known_cloud,
    list_fused_images,
    report_cloud,
    vouch_for_cloud,
)
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.fusion_partners import partners_in_fusion
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result, Stage
from colmap_sph.pipeline.stages.view_maps import MapSources, read_sound_maps, read_view_maps
from colmap_sph.project.cloud_files import (
    check_places,
    join_parts,
    link_workspace,
    move_cloud_into_place,
    write_part,
)
from colmap_sph.project.colmap_fusion import fuse_by_colmap
from colmap_sph.project.files import scratch_folder
from colmap_sph.project.masks import warn_of_unused_masks
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.workspace import Workspace, mask_path
from colmap_sph.stereo.fusion import FusionOptions, ViewMaps, fuse_view
from colmap_sph.stereo.partners.pairing import Pair, partners_of

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context
    from colmap_sph.pipeline.memory import MemoryGate

logger = logging.getLogger(__name__)

# Processor seconds per megapixel of the image, and per image that overlaps it; per megapixel in COLMAP's fusion.
_SECONDS = 0.05
_PARTNER_SECONDS = 0.011
_COLMAP_SECONDS = 0.9
# Bytes on disk per pixel, of the cloud.
_CLOUD_BYTES = 12.0
# Bytes per pixel: of the maps of a view with its image; largest in use while a view is fused.
_MAPS_BYTES = 19.0
_FUSE_BYTES = 60.0
# Bytes in COLMAP's fusion: per pixel of all images together; and for a moment, per width times squared height.
_COLMAP_BYTES = 80.0
_COLMAP_MASK_BYTES = 0.1

_maps: LoadCache[ViewMaps] = LoadCache(lambda view_maps: view_maps.nbytes)


@dataclass(frozen=True, eq=False)
class FuseTask:
    """A view to fuse, those that overlap it, what to add to its points, and the path of its part less suffixes."""

    reference: MapSources
    partners: tuple[MapSources, ...]
    stations: tuple[int, ...]
    options: FusionOptions
    offset: NDArray[np.float64]
    stem: Path


def make_cloud_part(task: FuseTask) -> Facts:
    """Fuse a view; writes the points of the cloud which it sees better than any other."""
    reference = _view_maps(task.reference)
    unread: dict[str, str] = {}
    partners = _partner_maps(task.partners, unread)
    bands = fuse_view(reference, partners, task.options, task.offset, task.stations)
    return Facts(points=write_part(task.stem, bands), unread=unread)


def _view_maps(sources: MapSources) -> ViewMaps:
    files = (sources.depth, sources.normals, sources.image, sources.mask)
    stamps = [file_stamp(file) for file in files if file is not None]
    return _maps.get(f"{sources.index} {stamps}", lambda: read_view_maps(sources))


def _partner_maps(partners: Sequence[MapSources], unread: dict[str, str]) -> Iterator[ViewMaps | None]:
    """Maps of the partners; None for one whose maps cannot be read, and the reason in `unread`."""
    for sources in partners:
        try:
            maps = _view_maps(sources)
        except InputError as error:
            unread[sources.view.name] = str(error)
            maps = None
        yield maps


@dataclass(frozen=True, eq=False)
class ColmapFuseTask:
    """A workspace to fuse by COLMAP; see `fuse_by_colmap`."""

    workspace: Workspace
    options: FusionOptions
    threads: int
    partners: Mapping[str, Sequence[str]] | None


def make_cloud_by_colmap(task: ColmapFuseTask) -> Facts:
    """Fuse all images by COLMAP's own fusion; writes the cloud."""
    points = fuse_by_colmap(
        task.workspace,
        task.options.for_colmap(),
        threads=task.threads,
        kind=task.options.input,
        partners=task.partners,
    )
    return Facts(points=points)


def fuse_stage(context: "Context", pair_keys: Mapping[Pair, str], maps: Mapping[str, Result]) -> "Stage[str, Any]":
    """Choose the last stage by the method that the options name.

    Parameters
    ----------
    context : Context
    pair_keys : mapping
        Key of each pair that was matched.
    maps : mapping of str to Result
        Results of the stage before.

    Returns
    -------
    FuseStage or ColmapFuseStage
        On the images with any depth.
    """
    with_depth = {name: result for name, result in maps.items() if result.facts.coverage > 0}
    stage = ColmapFuseStage if context.options.fusion.method == "colmap" else FuseStage
    return stage(context, pair_keys, with_depth)


class FuseStage(Stage[str, FuseTask]):
    """Fuses the maps of every image with any depth into its part of the cloud, and joins these."""

    name = "fuse"
    make = staticmethod(make_cloud_part)

    def __init__(self, context: "Context", pair_keys: Mapping[Pair, str], maps: Mapping[str, Result]) -> None:
        super().__init__(context, list(maps))
        self._partners = partners_in_fusion(context, pair_keys, self.items)
        self._key = context.keys.cloud({name: maps[name].key for name in maps}, self._partners, context.scene)
        self._known = known_cloud(context, self._key)
        self._is_there = self._known is not None
        index_of = {image_id: index for index, image_id in enumerate(context.scene.image_ids)}
        # All at once: where maps turn out to be damaged, their records say other things meanwhile.
        self._sources = {
            name: _sources_of(context, name, index_of[context.scene.view(name).image_id]) for name in self.items
        }
        self._scratch = context.workspace.fusion_scratch_dir

    def job(self, item: str) -> Job[FuseTask]:
        """See `Stage.job`; all parts are done where the cloud is."""
        scene = self.context.scene
        view = scene.view(item)
        pixels = view.num_pixels
        partners, stations = self._partners[item]
        seconds = _SECONDS + _PARTNER_SECONDS * len(partners)
        cost = Cost(seconds * pixels / 1e6, _FUSE_BYTES * pixels, _CLOUD_BYTES * pixels)
        task = FuseTask(
            self._sources[item],
            tuple(self._sources[partner] for partner in partners),
            tuple(stations),
            self.context.options.fusion,
            scene.anchor,
            self._stem(item),
        )
        return Job(self._key, None if self._known is None else Facts(), cost, task)

    def _stem(self, name: str) -> Path:
        return self._scratch / f"{self.context.scene.view(name).image_id}"

    def kept_memory(self, gate: "MemoryGate") -> Kept:
        """See `Stage.kept_memory`."""
        pixels = [view.num_pixels for view in map(self.context.scene.view, self.items)]
        filled = _MAPS_BYTES * sum(pixels)
        spare = gate.spare(2 * _FUSE_BYTES * max(pixels, default=0)) / 2
        return Kept(cache=int(min(filled, spare)), caches=1, filled=filled)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Where the cloud must be made, its parts are there until this ends."""
        list_fused_images(self.context, self.items)
        if self._known is not None:
            yield
            return
        check_places(self.context.workspace)
        _warn_of_masks(self.context)
        with scratch_folder(self._scratch):
            yield

    @contextmanager
    def holding(self, kept: Kept) -> Iterator[None]:
        """See `Stage.holding`."""
        with _maps.holding(kept.cache):
            yield

    def close(self, results: Mapping[str, Result]) -> None:
        """Join the parts to the cloud."""
        context = self.context
        if self._known is None:
            if not results:
                raise NoResultError(f"No image could be fused ({context.report.skipped_images[self.items[0]]})")
            points = sum(result.facts.points for result in results.values())
            self._put_together([self._stem(name) for name in results], points)
            facts = facts_of_cloud(context, list(results), points, self._partners_among(results))
            self._known = replace(facts, of_images=tuple(result.facts.points for result in results.values()))
            is_complete = not self._report_unread(results) and len(results) == len(self.items)
            vouch_for_cloud(context, self._key, self._known, is_complete=is_complete)
        report_cloud(context, self._known, list(results))

    def _partners_among(self, results: Mapping[str, Result]) -> dict[str, tuple[list[str], list[int]]]:
        """The partners of the images that were fused, less those that were not."""
        among = {}
        for name in results:
            kept = [
                (other, number) for other, number in zip(*self._partners[name], strict=True) if other in results
            ]
            among[name] = ([other for other, _ in kept], [number for _, number in kept])
        return among

    def _report_unread(self, results: Mapping[str, Result]) -> bool:
        """Report images whose maps could not be read while others were fused; whether there are any."""
        unread = {name: reason for result in results.values() for name, reason in result.facts.unread.items()}
        for name, reason in sorted(unread.items()):
            if name in self.context.report.skipped_images:  # reported where it was to be fused itself
                continue
            self.context.leave_incomplete(name, f"the cloud lacks its agreement with other images: {reason}")
        return bool(unread)

    def _put_together(self, stems: list[Path], points: int) -> None:
        """Make the cloud of its parts, and move it to its place."""
        workspace = self.context.workspace
        origin = self.context.scene.origin
        try:
            join_parts(stems, self._scratch, points)
            if origin.any():
                link_workspace(workspace, load_model(workspace.sparse_dir), origin, self._scratch)
            begin_cloud(self.context)  # not before: it may take hours, in which the one that is there is whole
            move_cloud_into_place(self._scratch, workspace, origin)
        except (OSError, RuntimeError) as error:
            raise OutputError(
                f"{workspace.fused_path} cannot be written ({reason_of(error)}); check space and permissions."
            ) from error

    def count(self, results: Mapping[str, Result]) -> tuple[int, int]:
        """One cloud."""
        return int(not self._is_there), int(self._is_there)


def _sources_of(context: "Context", name: str, index: int) -> MapSources:
    options = context.options.fusion
    maps = context.map_files(name, options.input)
    return MapSources(
        context.scene.view(name).without_points(),
        index,
        maps.depth,
        maps.normals,
        context.workspace.image_path(name),
        None if options.mask_path is None else mask_path(options.mask_path, name),
        maps.digests(),
        maps.record,
    )


def _warn_of_masks(context: "Context") -> None:
    """Report masks that fusion will not use."""
    folder = context.options.fusion.mask_path
    if folder is not None:
        names = [view.name for view in context.scene.views]
        warn_of_unused_masks(folder, names, context.workspace.images_dir)


class ColmapFuseStage(Stage[str, ColmapFuseTask]):
    """Fuses all maps at once by COLMAP's fusion, which holds them in memory whatever the budget."""

    name = "fuse"
    whole = True
    make = staticmethod(make_cloud_by_colmap)

    def __init__(self, context: "Context", pair_keys: Mapping[Pair, str], maps: Mapping[str, Result]) -> None:
        super().__init__(context, ["the cloud"])
        self._names = list(maps)
        self._sound = self._names
        self._views = [context.scene.view(name) for name in self._names]
        # Without tracks COLMAP would find no images that overlap.
        self._partners = None if context.scene.has_tracks else partners_of(pair_keys)
        self._key = context.keys.cloud(
            {name: maps[name].key for name in maps}, self._partners or {}, context.scene
        )
        self._known = known_cloud(context, self._key)

    def job(self, item: str) -> Job[ColmapFuseTask]:
        """See `Stage.job`."""
        context = self.context
        options = context.options
        pixels = sum(view.num_pixels for view in self._views)
        memory = _COLMAP_BYTES * pixels
        if options.fusion.use_cache:
            memory = min(memory, options.fusion.cache_size * 1e9)
        memory += _COLMAP_MASK_BYTES * max((view.num_pixels * view.height for view in self._views), default=0)
        cost = Cost(_COLMAP_SECONDS * pixels / 1e6, memory, _CLOUD_BYTES * pixels)
        task = ColmapFuseTask(context.workspace, options.fusion, options.num_threads, self._partners)
        return Job(self._key, None if self._known is None else Facts(), cost, task)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Begin the cloud anew where it must be made."""
        if self._known is None:
            check_places(self.context.workspace)
            self._sound = list(filter(self._is_sound, self._names))
            if not self._sound:
                reason = self.context.report.skipped_images[self._names[0]]
                raise NoResultError(f"No image could be fused ({reason})")
            begin_cloud(self.context)
            _warn_of_masks(self.context)
            self._warn_of_memory()
        list_fused_images(self.context, self._sound)
        yield

    def _is_sound(self, name: str) -> bool:
        """Whether COLMAP can be given an image's maps, which it trusts."""
        try:
            read_sound_maps(_sources_of(self.context, name, 0))
        except InputError as error:
            self.context.skip_view(name, str(error))
            return False
        return True

    def _warn_of_memory(self) -> None:
        """COLMAP's cache bounds its memory, but makes it many times slower."""
        context = self.context
        total = context.options.memory_budget
        needed = resident() + _COLMAP_BYTES * sum(view.num_pixels for view in self._views)
        if needed > total and not context.options.fusion.use_cache:
            logger.warning(
                "COLMAP's fusion will take about %s of memory, more than the %s allowed; "
                "--fusion.use-cache True bounds it, but takes hours.",
                format_memory(needed),
                format_memory(total),
            )

    def close(self, results: Mapping[str, Result]) -> None:
        """See `Stage.close`."""
        if self._known is None:
            points = sum(result.facts.points for result in results.values())
            self._known = facts_of_cloud(self.context, self._sound, points)
            vouch_for_cloud(self.context, self._key, self._known, is_complete=self._sound == self._names)
        report_cloud(self.context, self._known)
