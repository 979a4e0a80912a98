"""Geometric maps of the views cut from each wide image → a map of its range and normals."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result, Stage, keys_of
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.state.ownership import range_place
from colmap_sph.project.state.records import begin, vouch_when_on_disk, vouched_facts
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.range_maps import (
    ViewMaps,
    forget_rays,
    pixels_shown,
    range_and_normals,
    write_range_map,
)
from colmap_sph.project.wide.table import read_cuts
from colmap_sph.scene import View

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

# Of a pixel of the wide image, and of its views: processor seconds, bytes in use; bytes on disk.
_SECONDS = 0.8e-7
_BYTES = 60.0
_VIEW_BYTES = 32.0
_BAND_BYTES = 40e6
_FILE_BYTES = 8.0


@dataclass(frozen=True)
class RangeFacts:
    """What the record of a range map says of it: the share of what the lens shows that has a range."""

    coverage: Annotated[float, Meta(ge=0, le=1)]


@dataclass(frozen=True, eq=False)
class RangeTask:
    """A wide image's views with their cuts and maps, and where its range map goes."""

    views: tuple[tuple[View, Cut, Path, Path], ...]
    target: Path
    record: Path
    key: str


def make_range_map(task: RangeTask) -> Facts:
    """Join the maps of an image's views; writes its range map."""
    _, first, _, _ = task.views[0]
    maps = [
        ViewMaps(cut.face.R, view.K, read_depth_map(depth), read_normal_map(normals))
        for view, cut, depth, normals in task.views
    ]
    distance, normals = range_and_normals(first.lens, maps)
    begin(task.record, [task.target], sync=False)
    try:
        digest = write_range_map(task.target, distance, normals)
    except OSError as error:
        raise OutputError(f"{task.target} cannot be written ({reason_of(error)}); check space.") from error
    facts = RangeFacts(int(np.count_nonzero(distance)) / max(pixels_shown(first.lens), 1))
    vouch_when_on_disk(task.record, task.key, {task.target: digest}, facts)
    return Facts(coverage=facts.coverage)


class RangeStage(Stage[str, RangeTask]):
    """Makes the range map of every wide image from the geometric maps of its views.

    Parameters
    ----------
    context : Context
    maps : mapping of str to Result
        Of the geometric maps, by the views' names.
    """

    name = "join views"
    make = staticmethod(make_range_map)

    @staticmethod
    def found(task: RangeTask) -> Facts | None:
        """See `Stage.found`."""
        known = vouched_facts(task.record, task.key, [task.target], RangeFacts)
        return None if known is None else Facts(coverage=known.coverage)

    def __init__(self, context: "Context", maps: Mapping[str, Result]) -> None:
        # A workspace that is only foreseen has no table yet; nothing of it is there, either. Its views have about
        # as many pixels together as their image.
        self._cuts = read_cuts(context.workspace.sparse_dir)
        self._keys = keys_of(maps)
        self._views: dict[str, list[View]] = {}
        for view in context.scene.views:
            if view.original and view.name in maps:
                self._views.setdefault(view.original, []).append(view.without_points())
        super().__init__(context, sorted(self._views))

    def job(self, item: str) -> Job[RangeTask]:
        """See `Stage.job`."""
        context = self.context
        place = range_place(context.workspace, item)
        views = []
        for view in self._views[item]:
            cut = self._cuts.get(view.name)
            if cut is not None:
                maps = context.map_files(view.name, "geometric")
                views.append((view, cut, maps.depth, maps.normals))
        cuts = [(cut.lens, cut.face) for _, cut, _, _ in views]
        key = context.keys.range_map([self._keys[view.name] for view in self._views[item]], cuts)
        task = RangeTask(tuple(views), place.files[0], place.record, key)
        done = self.found(task) if views else None
        of_views = sum(view.num_pixels for view in self._views[item])
        pixels = views[0][1].lens.width * views[0][1].lens.height if views else of_views
        memory = _BYTES * pixels + _VIEW_BYTES * of_views + _BAND_BYTES
        seconds = _SECONDS * pixels * len(self._views[item])
        return Job(key, done, Cost(seconds, memory, _FILE_BYTES * pixels), task)

    @contextmanager
    def holding(self, kept: Kept) -> Iterator[None]:
        """Keep the rays of an image's pixels until the end."""
        try:
            yield
        finally:
            forget_rays()

    def close(self, results: Mapping[str, Result]) -> None:
        """See `Stage.close`."""
        self.context.report.originals = {name: result.facts.coverage for name, result in results.items()}
