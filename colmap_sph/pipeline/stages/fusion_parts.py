"""Maps of a view and of those that overlap it → its part of the cloud: what every way to make a cloud shares."""

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result, Stage
from colmap_sph.pipeline.stages.view_maps import MapSources, read_view_maps
from colmap_sph.project.cloud_files import write_part
from colmap_sph.project.files import scratch_folder
from colmap_sph.project.images.reading import bytes_to_reduce
from colmap_sph.scene import Region
from colmap_sph.stereo.fusion import MAX_PARTNERS, FusionOptions, PackedMaps, ViewMaps, fuse_view
from colmap_sph.stereo.partners.reads import best_order
from colmap_sph.stereo.region.inside import pixels_inside

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context
    from colmap_sph.pipeline.memory import MemoryGate

Partners = Mapping[str, tuple[list[str], list[int]]]
"""For each image to fuse those that it is looked up in, and their stations; see `PartnersInFusion`."""

CLOUD_BYTES = 22.0
"""Bytes on disk per pixel, of the cloud."""

# Processor seconds per megapixel of the image, and per image that overlaps it.
_SECONDS = 0.05
_PARTNER_SECONDS = 0.009
# Bytes per pixel: of the maps of a view with its image; of the view that is fused beside one of its partners, that
# is its maps, whether a finer pixel covers each of its own, the sums of colours, and a bit for each partner.
_MAPS_BYTES = 19.0
_FUSE_BYTES = 23.0
_PARTNER_BYTES = 1 / 8
# Of a mask, or of which pixels are a view's own, while depths are taken away; of larger maps that are reduced, and
# of what is reduced to meanwhile.
_MASK_BYTES = 2.0
_LARGER_BYTES = 16.0
_REDUCED_BYTES = 48.0
# Of maps that are packed; and what unpacking those of a view, or of a partner, takes.
_PACKED_BYTES = 16.0
_UNPACKING_BYTES = 12.0

_maps: LoadCache[ViewMaps | PackedMaps] = LoadCache(lambda view_maps: view_maps.nbytes)


@dataclass(frozen=True, eq=False)
class FuseTask:
    """A view to fuse, those that overlap it, what to add to its points, and the path of its part less suffixes.

    Of a `region`, in the scene's frame, only the points inside are made. `needed` says when the maps of the view
    and of each partner are needed next, see `LoadCache.get`. `is_packed` says that they are kept in less memory.
    """

    reference: MapSources
    partners: tuple[MapSources, ...]
    stations: tuple[int, ...]
    options: FusionOptions
    offset: NDArray[np.float64]
    stem: Path
    region: Region | None = None
    needed: tuple[float, ...] = ()
    with_visibility: bool = True
    is_packed: bool = False


def make_cloud_part(task: FuseTask) -> Facts:
    """Fuse a view; writes the points of the cloud which it sees better than any other."""
    needed = task.needed or (0.0,) * (1 + len(task.partners))
    reference = _view_maps(task.reference, needed[0], task.is_packed)
    if task.region is not None:
        inside = pixels_inside(reference.view, reference.depth, task.region)
        reference = replace(reference, depth=np.where(inside, reference.depth, np.float32(0)))
    unread: dict[str, str] = {}
    partners = _partner_maps(task, needed[1:], unread)
    bands = fuse_view(reference, partners, task.options, task.offset, task.stations)
    del reference  # of which not all is needed to the end
    points = write_part(task.stem, bands, with_visibility=task.with_visibility)
    return Facts(points=points, unread=unread)


def _view_maps(sources: MapSources, needed: float, is_packed: bool) -> ViewMaps:
    files = (sources.depth, sources.normals, sources.image, sources.mask)
    stamps = [file_stamp(file) for file in files if file is not None]
    size = (sources.view.width, sources.view.height)

    def load() -> ViewMaps | PackedMaps:
        maps = read_view_maps(sources)
        return (PackedMaps.of(maps) or maps) if is_packed else maps

    maps = _maps.get(f"{sources.index} {size} {stamps}", load, needed)
    return maps.unpacked() if isinstance(maps, PackedMaps) else maps


def _partner_maps(task: FuseTask, needed: Sequence[float], unread: dict[str, str]) -> Iterator[ViewMaps | None]:
    """Maps of the partners; None for one whose maps cannot be read, and the reason in `unread`."""
    for sources, when in zip(task.partners, needed, strict=True):
        maps: ViewMaps | None
        try:
            maps = _view_maps(sources, when, task.is_packed)
        except InputError as error:
            unread[sources.view.name] = str(error)
            maps = None
        yield maps
        del maps  # or they are there while the next are read


def seconds_per_megapixel(partners: int) -> float:
    """Processor seconds to fuse an image that so many others overlap."""
    return _SECONDS + _PARTNER_SECONDS * partners


class PartsStage(Stage[str, FuseTask]):
    """Fuses the maps of every image into its part of a cloud.

    Parameters
    ----------
    context : Context
    names : sequence of str
        Of the images, in the order in which their parts are joined.
    """

    name = "fuse"
    make = staticmethod(make_cloud_part)
    caches = (_maps,)
    region: Region | None = None
    """Where points are wanted, see `FuseTask`."""

    with_visibility = True
    """Whether it shall be known which images see each point."""

    def __init__(self, context: "Context", names: Sequence[str]) -> None:
        super().__init__(context, context.order.sorted(names))
        self._names = names
        self._is_open = False
        self._is_packed = False
        self._needed: dict[str, tuple[float, ...]] = {}
        self._scratch = context.workspace.fusion_scratch_dir
        self._key = ""

    @property
    @abstractmethod
    def partners(self) -> Partners:
        """Of each image."""

    @property
    @abstractmethod
    def sources(self) -> Mapping[str, MapSources]:
        """Where what is fused of each image lies."""

    def job(self, item: str) -> Job[FuseTask]:
        """See `Stage.job`."""
        scene = self.context.scene
        pixels = scene.view(item).num_pixels
        partners, stations = self.partners[item]
        seconds = seconds_per_megapixel(len(partners))
        memory = _bytes_to_fuse(len(partners), is_packed=self._is_packed) * pixels
        memory += max(_bytes_to_read(self.sources[name], is_packed=self._is_packed) for name in [item, *partners])
        cost = Cost(seconds * pixels / 1e6, memory, CLOUD_BYTES * pixels)
        task = FuseTask(
            self.sources[item],
            tuple(self.sources[partner] for partner in partners),
            tuple(stations),
            self.context.options.fusion,
            scene.anchor,
            self._stem(item),
            self.region,
            self._needed.get(item, ()),
            self.with_visibility,
            self._is_packed,
        )
        return Job(self._key, None, cost, task)

    def _stem(self, name: str) -> Path:
        return self._scratch / f"{self.context.scene.view(name).image_id}"

    def in_order(self, results: Mapping[str, Result]) -> dict[str, Result]:
        """Results in the order in which they are joined, and not in which they were made."""
        return {name: results[name] for name in self._names if name in results}

    def _stems(self, results: Mapping[str, Result]) -> list[Path]:
        return [self._stem(name) for name in results]

    @contextmanager
    def in_scratch(self) -> Iterator[None]:
        """Parts are made in a folder that is there until this ends."""
        self._is_open = True
        with scratch_folder(self._scratch):
            yield

    def kept_memory(self, gate: "MemoryGate") -> Kept:
        """See `Stage.kept_memory`; where maps are to be made, the order of the work is chosen for it."""
        pixels = {name: self.context.scene.view(name).num_pixels for name in self.items}
        filled = _MAPS_BYTES * sum(pixels.values())
        largest = max(pixels.values(), default=0)
        each = _bytes_to_fuse(MAX_PARTNERS) + _MAPS_BYTES
        whole, packed = (gate.spare(2 * most * largest) / 2 for most in (each, each + 2 * _UNPACKING_BYTES))
        self._is_packed = whole < filled and packed / _PACKED_BYTES > whole / _MAPS_BYTES
        cache = int(min(filled, packed if self._is_packed else whole))
        if self._is_open:  # once, and not by every worker at a time
            partners = {name: self.partners[name][0] for name in self.items}
            if cache < filled:
                orders = (self.items, *self.context.order.in_strips(self.items))
                each = _PACKED_BYTES if self._is_packed else _MAPS_BYTES
                sizes = {name: each * number for name, number in pixels.items()}
                self.items = best_order(orders, partners, sizes, cache)
            self._needed = _next_uses(self.items, partners)
        return Kept(cache=cache, caches=1, filled=filled)

    def _report_unread(self, results: Mapping[str, Result]) -> bool:
        """Report images whose maps could not be read while others were fused; whether there are any."""
        unread = {name: reason for result in results.values() for name, reason in result.facts.unread.items()}
        for name, reason in sorted(unread.items()):
            if name in self.context.report.skipped_images:  # reported where it was to be fused itself
                continue
            self.context.leave_incomplete(name, f"the cloud lacks its agreement with other images: {reason}")
        return bool(unread)


def _bytes_to_fuse(partners: int, *, is_packed: bool = False) -> float:
    """Largest bytes in use while a view is fused, per pixel, beside the maps of one of so many partners."""
    bits = math.ceil(_PARTNER_BYTES * min(partners, MAX_PARTNERS))
    return _FUSE_BYTES + bits + _UNPACKING_BYTES * is_packed


def _bytes_to_read(sources: MapSources, *, is_packed: bool = False) -> float:
    """Largest bytes in use while the maps of a view are read, and from then on."""
    view, larger = sources.view, sources.map_view
    is_masked = sources.mask is not None or bool(sources.beside)
    each = _MAPS_BYTES + _UNPACKING_BYTES * is_packed + _MASK_BYTES * is_masked
    maps = each * view.num_pixels
    if larger is not None:
        maps = max(maps, _LARGER_BYTES * larger.num_pixels + _REDUCED_BYTES * view.num_pixels)
    return max(maps, bytes_to_reduce(view))


def _next_uses(items: Sequence[str], partners: Mapping[str, Sequence[str]]) -> dict[str, tuple[float, ...]]:
    """When the maps of each image and of its partners are needed next, as numbers of items."""
    needed = {}
    next_of: dict[str, float] = {}
    for number, item in reversed(list(enumerate(items))):
        names = [item, *partners[item]]
        needed[item] = tuple(next_of.get(name, math.inf) for name in names)
        next_of |= dict.fromkeys(names, float(number))
    return needed


def index_in_model(context: "Context") -> dict[str, int]:
    """What ``fused.ply.vis`` calls each image by: its place among the registered ones of the model."""
    index_of = {image_id: index for index, image_id in enumerate(context.scene.image_ids)}
    return {view.name: index_of[view.image_id] for view in context.scene.views}
