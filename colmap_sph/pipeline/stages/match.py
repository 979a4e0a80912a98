"""First stage: every pair of images, once → its disparity map, with the geometry that gives it meaning."""

import logging
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, get_args
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, RectificationError
from colmap_sph.pipeline.known.remembering import RememberingStage
from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.pair_files import facts_of_pair, write_pair
from colmap_sph.pipeline.stages.photo import Photo, PhotoFile, kept_masks, small_bytes, still_bytes
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result
from colmap_sph.platforms.memory import give_back_freed_memory
from colmap_sph.project.files import make_dir
from colmap_sph.project.images.reading import bytes_to_reduce, grey_bytes
from colmap_sph.project.state.array_file import OLD_SUFFIX, read_head
from colmap_sph.project.state.ownership import remove_array_files, remove_flat_pairs, undistorted_place
from colmap_sph.project.workspace import KnownFile
from colmap_sph.scene import Photograph, View
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.matching import MatchingOptions, match_pair, pair_scratch_bytes
from colmap_sph.stereo.partners.pairing import Pair, as_pair
from colmap_sph.stereo.photographs.resampling import resample_photograph
from colmap_sph.stereo.photographs.ties import find_ties_of_photographs
from colmap_sph.stereo.poses.ties import Ties, find_ties, row_residual, tolerable_sampling
from colmap_sph.stereo.rectification import rectify_pair, sampling_of
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Side, is_fine
from colmap_sph.stereo.resampling import resample
from colmap_sph.stereo.search.bands import Scratches
from colmap_sph.stereo.search.idle import at_once
from colmap_sph.stereo.search.seeds import Seeds, finer_first, seeds_of_points, shared_points

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context
    from colmap_sph.pipeline.memory import MemoryGate

logger = logging.getLogger(__name__)

# Where sparse points project to within so many pixels, poses are precise, and no trial tells more. Else there is
# one at so many rectified pixels per pixel.
_PRECISE_POSES = 0.35
_TRIAL_SAMPLING = 0.4
# Processor seconds per megapixel of both rectified images, and of a pair beside that.
_SECONDS = 0.1
_PAIR_SECONDS = 0.02
# Bytes on disk per left rectified pixel.
_FILE_BYTES = 2.0
# Largest bytes in use at a time: per left rectified pixel while a pair is matched, beside its scratch; …
_MATCH_BYTES = 34.0
# … while an image is read and rectified: per pixel of its own, and per left rectified pixel of both.
_READ_BYTES = 11.0
_RECTIFIED_BYTES = 10.0
# Rectified pixels of a large pair per pixel of its images at a sampling of 1, with a margin for what arrays do not
# count.
_RECTIFIED_SHARE = 1.4
# Scratch memory of a thread and bytes of a cache: more is no faster.
_SCRATCH_BYTES = 320 << 20
_CACHE_BYTES = 512 << 20

_photos: LoadCache[Photo] = LoadCache(lambda photo: photo.nbytes)
_thread = threading.local()
_lock = threading.Lock()
_all_scratches: WeakValueDictionary[int, Scratches] = WeakValueDictionary()


@dataclass(frozen=True, eq=False)
class MatchTask:
    """A pair to match, with the bytes of scratch memory a thread may keep, and where its disparity map goes.

    Each side is one view, or all that were cut from one photograph. `seeds` are those of its sparse points, see
    `seeds_of_points`. Where poses may be imprecise, the pair is matched at the share `trial` of its rows and
    columns first. `back` is the same pair the other way round, where it is matched both ways, with the same key
    and at the same share, so that it is not tried.
    """

    left: tuple[PhotoFile, ...]
    right: tuple[PhotoFile, ...]
    geometry: RectifiedPair
    seeds: Seeds
    trial: float
    options: MatchingOptions
    scratch_bytes: int
    target: Path
    key: str
    back: "MatchTask | None" = None

    @property
    def ways(self) -> list["MatchTask"]:
        """Itself, and the other way round."""
        return [self] if self.back is None else [self, self.back]


def make_disparity_maps(task: MatchTask) -> Facts:
    """Rectify and match a pair; writes its disparity map and ties, both where it is matched both ways."""
    share = _tolerable_share(task)
    return _facts_of(make_disparity_map(way, share) for way in task.ways)


def _tolerable_share(task: MatchTask) -> float:
    """Share of its rows and columns at which to match a pair, both ways."""
    if task.trial >= 1:
        return 1.0
    residual = row_residual(_match(task, task.geometry.resampled(task.trial))[1])
    return tolerable_sampling(residual or 0.0, task.trial)


def _facts_of(ways: Iterable[Facts]) -> Facts:
    """What is known of a pair that is matched one way or both."""
    facts, *others = ways
    if not others:
        return facts
    known = [each.row_residual for each in (facts, *others) if each.row_residual is not None]
    return Facts(row_residual=float(np.mean(known)) if known else None)


def make_disparity_map(task: MatchTask, share: float) -> Facts:
    """Rectify and match a pair one way, at a share of its rows and columns."""
    geometry = task.geometry.resampled(share)
    disparity, ties = _match(task, geometry)
    pair = PairDisparity(task.left[0].view.name, task.right[0].view.name, geometry, disparity)
    return write_pair(task.target, pair, task.key, ties, share)


def _match(task: MatchTask, geometry: RectifiedPair) -> tuple[NDArray[np.float32], Ties]:
    images = at_once(*(partial(_rectified, task, geometry, side) for side in get_args(Side)))
    disparity = match_pair(
        images.pop(0),  # which lets go of them
        images.pop(),
        geometry.min_disparity,
        geometry.max_disparity,
        task.options,
        _scratches(task.scratch_bytes),
        infinity=-geometry.disparity_origin,
        seeds=task.seeds * (geometry.columns_per_radian / task.geometry.columns_per_radian),
        fine=is_fine(task.left[0].view, geometry),
    )
    return disparity, _ties(task, geometry, disparity)


def _scratches(max_bytes: int) -> Scratches:
    """Working memory that threads share, and that goes when they end."""
    own = getattr(_thread, "scratches", None)
    if own is None or own.max_bytes != max_bytes:
        with _lock:
            own = _all_scratches.get(max_bytes) or Scratches(max_bytes, give_back_freed_memory)
            _all_scratches[max_bytes] = own
        _thread.scratches = own
    return own


def _ties(task: MatchTask, geometry: RectifiedPair, disparity: NDArray[np.float32]) -> Ties:
    left, right = ([(file.view, _photo(file)) for file in side] for side in (task.left, task.right))
    if len(left) == len(right) == 1:
        ((view, photo),) = left
        ((other_view, other_photo),) = right
        photos = ((view, photo.image), (other_view, other_photo.image))
        return find_ties(*photos, geometry, disparity, photo.corners)
    lefts, rights = ([(view, photo.image, photo.corners) for view, photo in side] for side in (left, right))
    return find_ties_of_photographs(lefts, rights, geometry, disparity)


def _photo(file: PhotoFile) -> Photo:
    size = (file.view.width, file.view.height)
    return _photos.get(f"{file_stamp(file.image)} {size}", lambda: Photo.read(file.image, size))


def _rectified(task: MatchTask, geometry: RectifiedPair, side: Side) -> RectifiedImage:
    files = task.left if side == "left" else task.right
    views = [file.view for file in files]
    images = [_photo(file).image for file in files]
    keep_blank = task.options.keep_blank
    masks = [file.kept_pixels(image, keep_blank=keep_blank) for file, image in zip(files, images, strict=True)]
    if len(views) == 1:
        return RectifiedImage(*resample(images[0], views[0], geometry, side, mask=masks[0]))
    return RectifiedImage(*resample_photograph(images, views, geometry, side, masks))


def match_seconds(pixels: float) -> float:
    """Processor seconds to match rectified images that have so many pixels together."""
    return _PAIR_SECONDS + _SECONDS * pixels / 1e6


class MatchStage(RememberingStage[Pair, MatchTask]):
    """Matches pairs of image names."""

    name = "match pairs"
    remembered_as: ClassVar[KnownFile | None] = "pairs"
    make = staticmethod(make_disparity_maps)
    caches = (_photos, kept_masks)

    @staticmethod
    def found(task: MatchTask) -> Facts | None:
        """See `Stage.found`."""
        found = []
        for way in task.ways:
            names = (way.left[0].view.name, way.right[0].view.name)
            facts = facts_of_pair(way.target, way.key, *names, way.geometry)
            if facts is None:
                return None
            found.append(facts)
        return _facts_of(found)

    def __init__(self, context: "Context", pairs: Sequence[Pair]) -> None:
        super().__init__(context, pairs)
        self._scratch_bytes = _SCRATCH_BYTES
        self._unfit: set[Pair] = set()
        self._photos: dict[str, PhotoFile] = {}
        self._usual_detail = float(np.median([*context.details.values()] or [1.0]))

    def input_key(self) -> str:
        """See `RememberingStage`."""
        context = self.context
        options = context.options
        return context.keys.stage("pair", context.scene_key, options.rectification, options.matching)

    def files(self, item: Pair) -> list[str]:
        """See `RememberingStage`."""
        return [str(path) for path in self.context.pair_paths(*item)]

    def is_there(self, item: Pair, key: str) -> bool:
        """See `RememberingStage`."""
        heads = map(read_head, self.context.pair_paths(*item))
        return all(head is not None and head.key == key for head in heads)

    def ask(self, item: Pair) -> Job[MatchTask]:
        """See `RememberingStage`; `RectificationError` for a pair that cannot be rectified."""
        context = self.context
        first, second = (context.scene.photograph(name) for name in item)
        points = shared_points(context.scene, first, second)
        leads = finer_first(points, first.lead, second.lead)
        left, right = (context.scene.photograph(lead.name) for lead in leads)
        ways = [(left, right), (right, left)]
        asked = [
            self._ask(*way, points, target, is_first=not number)
            for number, (way, target) in enumerate(zip(ways, context.pair_paths(*item), strict=False))
        ]
        (task, cost), *backs = asked
        for back, other_cost in backs:
            key = context.keys.both_ways([task.key, back.key])
            task = replace(task, key=key, back=replace(back, key=key))
            cost = cost.beside(other_cost)
        return Job(task.key, self.found(task), cost, task)

    def _ask(
        self, left: Photograph, right: Photograph, points: NDArray[np.float64], target: Path, *, is_first: bool
    ) -> tuple[MatchTask, Cost]:
        """What is to be done one way, and what it costs."""
        context = self.context
        geometry = self._geometry(left, right)
        seeds = seeds_of_points(left.lead, right.lead, geometry, points)
        trial = self._trial(left, right, geometry) if is_first else 1.0
        key = context.keys.pair(left, right, geometry, seeds, trial, context.still)
        left_pixels = geometry.height * geometry.left_width
        of_sides = [self._reading_bytes(side) for side in (left, right)]
        # Both at once, where a thread is idle.
        reading = sum(of_sides) if context.options.num_threads > 1 else max(of_sides)
        both_pixels = left_pixels + geometry.height * geometry.right_width
        cost = Cost(
            seconds=match_seconds(both_pixels) + (match_seconds(trial**2 * both_pixels) if trial < 1 else 0.0),
            memory=max(_MATCH_BYTES * left_pixels, reading + _RECTIFIED_BYTES * left_pixels),
            disk=_FILE_BYTES * left_pixels,
            scratch=pair_scratch_bytes(left_pixels, context.options.matching),
        )
        task = MatchTask(
            tuple(map(self._photo, left.views)),
            tuple(map(self._photo, right.views)),
            geometry,
            seeds,
            trial,
            context.options.matching,
            self._scratch_bytes,
            target,
            key,
        )
        return task, cost

    def _reading_bytes(self, side: Photograph) -> float:
        """Largest bytes in use while one side of a pair is read."""
        still = max((still_bytes(view) for view in side.views if view.name in self.context.still), default=0.0)
        return max(_READ_BYTES * side.num_pixels, bytes_to_reduce(*side.views), still)

    def _geometry(self, left: Photograph, right: Photograph) -> RectifiedPair:
        try:
            details = (self._detail_of(left), self._detail_of(right))
            outlines = (self._outlines(left), self._outlines(right))
            options = self.context.options.rectification
            return rectify_pair(self.context.scene, left, right, options, details, outlines)
        except RectificationError:
            self._unfit.add(as_pair(left.lead.name, right.lead.name))
            raise

    def _outlines(self, photograph: Photograph) -> list[NDArray[np.float64]]:
        return [self.context.outline(view.name) for view in photograph.views]

    def _detail_of(self, photograph: Photograph) -> float:
        """Detail of a photograph: the median of its views'."""
        return float(np.median([self._detail(view) for view in photograph.views]))

    def _detail(self, view: View) -> float:
        """Detail of an image; of one that is not there yet, that of those that are, or what a sharp one has."""
        return self.context.details.get(view.name, self._usual_detail)

    def _trial(self, left: Photograph, right: Photograph, geometry: RectifiedPair) -> float:
        """Share of the rows and columns at which to find out how precise the poses are; 1 where that is known."""
        if all(view.reprojection_error <= _PRECISE_POSES for view in (*left.views, *right.views)):
            return 1.0
        pixels_per_radian = max(float(view.K[0, 0]) for view in (left.lead, right.lead))
        return min(_TRIAL_SAMPLING * pixels_per_radian / geometry.scales[0], 1.0)

    def _photo(self, view: View) -> PhotoFile:
        if view.name not in self._photos:
            workspace = self.context.workspace
            self._photos[view.name] = PhotoFile(
                view.without_points(),
                workspace.image_path(view.name),
                workspace.mask_path(view.name),
                undistorted_place(workspace, view.name).record,
                tuple(map(workspace.image_path, self.context.still.get(view.name, ()))),
            )
        return self._photos[view.name]

    def label(self, item: Pair) -> str:
        """See `Stage.label`."""
        return f"the pair {item[0]} - {item[1]}"

    def skip(self, item: Pair, reason: str) -> None:
        """See `Stage.skip`."""
        names = [self.context.scene.view(name).photograph for name in item]
        pair = " - ".join(names)
        self.context.report.skipped_pairs[pair] = reason
        self.context.progress.leave_out("pair", pair, reason)
        logger.warning("%s skipped: %s", pair, reason)
        if item not in self._unfit:  # for a reason that may pass
            for name in names:
                self.context.leave_incomplete(name, f"a pair of it was not matched: {reason}")

    def kept_memory(self, gate: "MemoryGate") -> Kept:
        """Scratch memory and caches take of what the largest pair leaves, but never starve."""
        views, photographs = self.context.scene.views, self.context.scene.photographs
        largest = max(photograph.num_pixels for photograph in photographs)
        finest = max(sampling_of(self._detail(view)) for view in views)
        share = _RECTIFIED_SHARE * (finest * self.context.options.rectification.sampling) ** 2
        reading = min(gate.threads, 2) * max(map(self._reading_bytes, photographs))
        needed = max(share * _MATCH_BYTES * largest, reading + share * _RECTIFIED_BYTES * largest)
        spare = int(max(gate.spare(needed), gate.free / 8))
        scratch = min(_SCRATCH_BYTES, spare // (3 * gate.threads))
        paths = (self.context.workspace.image_path(view.name) for view in views)
        whole = sum(view.num_pixels * (grey_bytes(path) + 1) for view, path in zip(views, paths, strict=True))
        compared = sorted({name for names in self.context.still.values() for name in names})
        filled = whole + sum(map(small_bytes, map(self.context.scene.view, compared)))
        return Kept(scratch, min(_CACHE_BYTES, spare // 6), 2, filled)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """See `Stage.opened`."""
        for folder in sorted({self.context.pair_path(*pair).parent for pair in self.items}):
            make_dir(folder)
        remove_array_files(self.context.workspace, OLD_SUFFIX)
        remove_flat_pairs(self.context.workspace)
        yield

    @contextmanager
    def holding(self, kept: Kept) -> Iterator[None]:
        """See `Stage.holding`."""
        self._scratch_bytes = kept.scratch
        with super().holding(kept):
            yield

    def close(self, results: Mapping[Pair, Result]) -> None:
        """See `Stage.close`."""
        report = self.context.report
        if not results:
            reason = min(report.skipped_pairs.items())[1] if report.skipped_pairs else "no pair"
            raise NoResultError(f"None of the {len(self.items)} pairs could be matched ({reason}).")
        report.pairs = len(results)
        self.remember(results)
