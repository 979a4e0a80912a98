"""Last stage: the maps of all images → the cloud.

Every image is fused into a part of the cloud, and the parts are joined; or COLMAP's fusion does it all at once.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_sph.errors import InputError, NoResultError, unwritable
from colmap_sph.pipeline.known.remembering import done
from colmap_sph.pipeline.memory import format_memory
from colmap_sph.pipeline.stages.cloud import (
    begin_cloud,
    facts_of_cloud,
    known_cloud,
    list_fused_images,
    report_cloud,
    vouch_for_cloud,
)
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.fusion_partners import PartnersInFusion
from colmap_sph.pipeline.stages.fusion_parts import (
    CLOUD_BYTES,
    FuseTask,
    Partners,
    PartsStage,
    index_in_model,
    seconds_per_megapixel,
)
from colmap_sph.pipeline.stages.stage import Cost, Job, Result, Stage
from colmap_sph.pipeline.stages.view_maps import MapSources, read_sound_maps, views_beside
from colmap_sph.platforms.memory import resident
from colmap_sph.project.cloud_files import (
    check_places,
    join_parts,
    link_workspace,
    move_cloud_into_place,
)
from colmap_sph.project.cloud_tiles import Part, publish_tiles, write_tiles
from colmap_sph.project.colmap_fusion import fuse_by_colmap
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.workspace import Workspace, mask_path
from colmap_sph.stereo.fusion import MAX_PARTNERS, FusionOptions
from colmap_sph.stereo.partners.pairing import Pair, partners_of

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

logger = logging.getLogger(__name__)

# In COLMAP's fusion: processor seconds per megapixel.
_COLMAP_SECONDS = 0.9
# Bytes in COLMAP's fusion: per pixel of all images together; and for a moment, per width times squared height.
_COLMAP_BYTES = 80.0
_COLMAP_MASK_BYTES = 0.1


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


def foreseen_fusion(context: "Context") -> tuple[int, float]:
    """Items of the last stage, and processor seconds of each on average, where all images have some depth."""
    options = context.options.fusion
    views = context.scene.views
    megapixels = sum(view.num_pixels for view in views) / 1e6
    if options.method == "colmap":
        return 1, _COLMAP_SECONDS * megapixels
    partners = min(options.check_num_images, MAX_PARTNERS, len(views) - 1)
    return len(views), seconds_per_megapixel(partners) * megapixels / len(views)


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
    # Their order is that of the cloud's parts.
    with_depth = {name: maps[name] for name in sorted(maps) if maps[name].facts.coverage > 0}
    stage = ColmapFuseStage if context.options.fusion.method == "colmap" else FuseStage
    return stage(context, pair_keys, with_depth)


class FuseStage(PartsStage):
    """Fuses the maps of every image with any depth into its part of the cloud, and joins these."""

    def __init__(self, context: "Context", pair_keys: Mapping[Pair, str], maps: Mapping[str, Result]) -> None:
        super().__init__(context, list(maps))
        self.with_visibility = context.options.fusion.visibility
        self._pair_keys = pair_keys
        self._key = _key_of_cloud(context, pair_keys, maps)
        self._known = known_cloud(context, self._key)
        self._is_there = self._known is not None

    @cached_property
    def partners(self) -> Partners:
        """See `PartsStage`."""
        return PartnersInFusion(self.context, self._pair_keys, self.items)

    @cached_property
    def sources(self) -> Mapping[str, MapSources]:
        """See `PartsStage`."""
        indices = index_in_model(self.context)
        # All at once: where maps turn out to be damaged, their records say other things meanwhile.
        among = self.context.scene.only(set(self.items))
        return {
            name: replace(_sources_of(self.context, name, indices[name]), beside=views_beside(among, name))
            for name in self.items
        }

    def is_missing(self, item: str) -> bool:
        """See `Stage.is_missing`."""
        return self._known is None

    def job(self, item: str) -> Job[FuseTask]:
        """See `Stage.job`: all parts are done where the cloud is."""
        return super().job(item) if self._known is None else done(self._key, Facts())

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Where the cloud must be made, its parts are there until this ends."""
        list_fused_images(self.context, self._names)
        if self._known is not None:
            yield
            return
        check_places(self.context.workspace)
        assert self.sources.keys() == set(self._names)
        with self.in_scratch():
            yield

    def close(self, results: Mapping[str, Result]) -> None:
        """Join the parts to the cloud."""
        context = self.context
        results = self.in_order(results)
        if self._known is None:
            if not results:
                raise NoResultError(f"No image could be fused ({context.report.skipped_images[self._names[0]]})")
            points = sum(result.facts.points for result in results.values())
            tiles, digests = self._put_together(results, points)
            facts = facts_of_cloud(context, list(results), points, self._partners_among(results))
            of_images = tuple(result.facts.points for result in results.values())
            self._known = replace(facts, of_images=of_images, tiles=tiles)
            is_complete = not self._report_unread(results) and len(results) == len(self.items)
            vouch_for_cloud(
                context, self._key, self._known, list(results), is_complete=is_complete, digests=digests
            )
        report_cloud(context, self._known, list(results))

    def _partners_among(self, results: Mapping[str, Result]) -> dict[str, tuple[list[str], list[int]]]:
        """The partners of the images that were fused, less those that were not."""
        among = {}
        for name in results:
            kept = [
                (other, number) for other, number in zip(*self.partners[name], strict=True) if other in results
            ]
            among[name] = ([other for other, _ in kept], [number for _, number in kept])
        return among

    def _put_together(self, results: Mapping[str, Result], points: int) -> tuple[int, tuple[str, ...]]:
        """Make the cloud of its parts, and move it to its place.

        Returns
        -------
        tiles : int
            Their number; 0: one file.
        digests : tuple of str
            Of the cloud's files, as far as they are known.
        """
        workspace = self.context.workspace
        most = self.context.options.fusion.max_points_per_file
        try:
            if 0 < most < points:
                return self._put_together_tiles(results, most), ()
            return 0, self._put_together_file(self._stems(results), points)
        except (OSError, RuntimeError) as error:
            raise unwritable(workspace.fused_path, error) from error

    def _put_together_file(self, stems: list[Path], points: int) -> tuple[str, ...]:
        workspace = self.context.workspace
        origin = self.context.scene.origin
        with_visibility = self.context.options.fusion.visibility
        digests = join_parts(stems, self._scratch, points, with_visibility=with_visibility)
        if origin.any():
            link_workspace(workspace, load_model(workspace.sparse_dir), origin, self._scratch)
        begin_cloud(self.context)  # not before: it may take hours, in which the one that is there is whole
        move_cloud_into_place(self._scratch, workspace, origin)
        return () if origin.any() else digests  # in map coordinates it is another file

    def _put_together_tiles(self, results: Mapping[str, Result], most: int) -> int:
        context = self.context
        made = self._scratch / "tiles"
        in_place = context.order.sorted(results)  # so that tiles are of neighbouring images
        parts = [Part(self._stem(name), results[name].facts.points) for name in in_place]
        with_visibility = context.options.fusion.visibility
        index = write_tiles(parts, made, most, context.scene.origin, with_visibility=with_visibility)
        publish_tiles(made, context.workspace)
        return len(index.tiles)

    def count(self, results: Mapping[str, Result]) -> tuple[int, int]:
        """One cloud."""
        return int(not self._is_there), int(self._is_there)


def _views_of_partners(context: "Context", pairs: Iterable[Pair]) -> dict[str, list[str]]:
    """The views of each view's partners."""
    leads = partners_of(pairs)
    names = (view.name for lead in leads for view in context.scene.photograph(lead).views)
    return {name: [*chain(*context.facing.views(name, leads[context.lead(name)]))] for name in names}


def _key_of_cloud(context: "Context", pair_keys: Mapping[Pair, str], maps: Mapping[str, Result]) -> str:
    """The pairs and the model tell who looks where, and who stands beside whom."""
    pairs = (sorted(pair_keys), context.options.pairs.min_triangulation_angle)
    return context.keys.cloud({name: result.key for name, result in maps.items()}, pairs, context.scene)


def _sources_of(context: "Context", name: str, index: int) -> MapSources:
    options = context.options.fusion
    maps = context.map_files(name, options.input)
    folder = options.mask_path
    if folder is not None and context.options.scheduler:
        folder = folder.absolute()  # workers have other current folders
    return MapSources(
        context.scene.view(name).without_points(),
        index,
        maps.depth,
        maps.normals,
        context.workspace.image_path(name),
        None if folder is None else mask_path(folder, name),
        maps.digests(),
        maps.record,
    )


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
        self._partners = None if context.scene.has_tracks else _views_of_partners(context, pair_keys)
        self._key = _key_of_cloud(context, pair_keys, maps)
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
        cost = Cost(_COLMAP_SECONDS * pixels / 1e6, memory, CLOUD_BYTES * pixels)
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
            is_complete = self._sound == self._names
            vouch_for_cloud(self.context, self._key, self._known, self._sound, is_complete=is_complete)
        report_cloud(self.context, self._known)
