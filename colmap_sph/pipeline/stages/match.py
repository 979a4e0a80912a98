"""First stage: every pair of images, once → its disparity map, with the geometry that gives it meaning."""

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, RectificationError
from colmap_sph.pipeline.known.remembering import RememberingStage
from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.pair_files import facts_of_pair, write_pair
from colmap_sph.pipeline.stages.photo import Grey, Photo
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result
from colmap_sph.project.files import make_dir
from colmap_sph.project.images.reading import bytes_to_reduce, grey_bytes
from colmap_sph.project.masks import read_view_mask
from colmap_sph.project.state.array_file import OLD_SUFFIX, read_head
from colmap_sph.project.state.ownership import remove_array_files, remove_flat_pairs
from colmap_sph.project.workspace import Known
from colmap_sph.scene import View
from colmap_sph.stereo.blank import blank_pixels
from colmap_sph.stereo.census import RectifiedImage
from colmap_sph.stereo.matching import MatchingOptions, Scratch, match_pair, scratch_bytes
from colmap_sph.stereo.partners.pairing import Pair, as_pair
from colmap_sph.stereo.poses.ties import Ties, find_ties, row_residual, tolerable_sampling
from colmap_sph.stereo.rectification import rectify_pair, sampling_of
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Side
from colmap_sph.stereo.resampling import resample
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
_SECONDS = 0.14
_PAIR_SECONDS = 0.05
# Bytes on disk per left rectified pixel.
_FILE_BYTES = 2.0
# Largest bytes in use at a time: per left rectified pixel while a pair is matched, beside its scratch; …
_MATCH_BYTES = 53.0
# … while an image is read and rectified: per pixel of its own, and per left rectified pixel of both.
_READ_BYTES = 11.0
_RECTIFIED_BYTES = 10.0
# Rectified pixels of a large pair per pixel of its images at a sampling of 1, with a margin for what arrays do not
# count.
_RECTIFIED_SHARE = 1.4
# Scratch memory of a thread and bytes of a cache: more is no faster.
_SCRATCH_BYTES = 256 << 20
_CACHE_BYTES = 512 << 20

_photos: LoadCache[Photo] = LoadCache(lambda photo: photo.nbytes)
_masks: LoadCache[NDArray[np.uint8] | None] = LoadCache(lambda mask: 0 if mask is None else mask.nbytes)
_thread = threading.local()


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """A view without its sparse points, its image, and where its mask would be."""

    view: View
    image: Path
    mask: Path


@dataclass(frozen=True, eq=False)
class MatchTask:
    """A pair to match, with the bytes of scratch memory a thread may keep, and where its disparity map goes.

    `seeds` are those of its sparse points, see `seeds_of_points`. Where poses may be imprecise, the pair is
    matched at the share `trial` of its rows and columns first.
    """

    left: PhotoFile
    right: PhotoFile
    geometry: RectifiedPair
    seeds: Seeds
    trial: float
    options: MatchingOptions
    scratch_bytes: int
    target: Path
    key: str


def make_disparity_map(task: MatchTask) -> Facts:
    """Rectify and match a pair; writes its disparity map and ties."""
    if getattr(_thread, "scratch", None) is None or _thread.scratch.max_bytes != task.scratch_bytes:
        _thread.scratch = Scratch(task.scratch_bytes)
    share = 1.0
    if task.trial < 1:
        residual = row_residual(_match(task, task.geometry.resampled(task.trial))[1])
        share = tolerable_sampling(residual or 0.0, task.trial)
    geometry = task.geometry.resampled(share)
    disparity, ties = _match(task, geometry)
    pair = PairDisparity(task.left.view.name, task.right.view.name, geometry, disparity)
    return write_pair(task.target, pair, task.key, ties, share)


def _match(task: MatchTask, geometry: RectifiedPair) -> tuple[NDArray[np.float32], Ties]:
    disparity = match_pair(
        _rectified(task, geometry, "left"),
        _rectified(task, geometry, "right"),
        geometry.min_disparity,
        geometry.max_disparity,
        task.options,
        _thread.scratch,
        infinity=-geometry.disparity_origin,
        seeds=task.seeds * (geometry.columns_per_radian / task.geometry.columns_per_radian),
    )
    left, right = _photo(task.left), _photo(task.right)
    photos = (task.left.view, left.image), (task.right.view, right.image)
    return disparity, find_ties(*photos, geometry, disparity, left.corners)


def _photo(file: PhotoFile) -> Photo:
    size = (file.view.width, file.view.height)
    return _photos.get(f"{file_stamp(file.image)} {size}", lambda: Photo.read(file.image, size))


def _rectified(task: MatchTask, geometry: RectifiedPair, side: Side) -> RectifiedImage:
    photo = task.left if side == "left" else task.right
    view = photo.view
    image = _photo(photo).image
    keep_blank = task.options.keep_blank
    key = f"{file_stamp(photo.mask)} {view.width} {view.height} {file_stamp(photo.image)} {keep_blank}"
    mask = _masks.get(key, lambda: _mask(photo, image, keep_blank))
    return RectifiedImage(*resample(image, view, geometry, side, mask=mask))


def _mask(photo: PhotoFile, image: Grey, keep_blank: bool) -> NDArray[np.uint8] | None:
    """255 where an image takes part in matching, else 0; None where all of it does."""
    mask = read_view_mask(photo.mask, photo.view)
    blank = None if keep_blank else blank_pixels(image)
    if blank is None or not blank.any():
        return mask
    counts = np.where(blank, np.uint8(0), np.uint8(255))
    return counts if mask is None else np.minimum(counts, mask)


def match_seconds(pixels: float) -> float:
    """Processor seconds to match rectified images that have so many pixels together."""
    return _PAIR_SECONDS + _SECONDS * pixels / 1e6


class MatchStage(RememberingStage[Pair, MatchTask]):
    """Matches pairs of image names."""

    name = "match pairs"
    remembered_as: ClassVar[Known | None] = "pairs"
    make = staticmethod(make_disparity_map)
    caches = (_photos, _masks)

    @staticmethod
    def found(task: MatchTask) -> Facts | None:
        """See `Stage.found`."""
        names = (task.left.view.name, task.right.view.name)
        return facts_of_pair(task.target, task.key, *names, task.geometry)

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
        return [str(self.context.pair_path(*item))]

    def is_there(self, item: Pair, key: str) -> bool:
        """See `RememberingStage`."""
        head = read_head(self.context.pair_path(*item))
        return head is not None and head.key == key

    def ask(self, item: Pair) -> Job[MatchTask]:
        """See `RememberingStage`; `RectificationError` for a pair that cannot be rectified."""
        context = self.context
        first, second = (context.scene.view(name) for name in item)
        points = shared_points(context.scene, first, second)
        left, right = finer_first(points, first, second)
        geometry = self._geometry(left, right)
        seeds = seeds_of_points(left, right, geometry, points)
        trial = self._trial(left, right, geometry)
        key = context.keys.pair(left, right, geometry, seeds, trial)
        target = context.pair_path(*item)
        left_pixels = geometry.height * geometry.left_width
        pixels = max(left.num_pixels, right.num_pixels)
        reading = max(_READ_BYTES * pixels, bytes_to_reduce(left, right))
        both_pixels = left_pixels + geometry.height * geometry.right_width
        cost = Cost(
            seconds=match_seconds(both_pixels) + (match_seconds(trial**2 * both_pixels) if trial < 1 else 0.0),
            memory=max(_MATCH_BYTES * left_pixels, reading + _RECTIFIED_BYTES * left_pixels),
            disk=_FILE_BYTES * left_pixels,
            scratch=scratch_bytes(left_pixels, context.options.matching),
        )
        task = MatchTask(
            self._photo(left),
            self._photo(right),
            geometry,
            seeds,
            trial,
            context.options.matching,
            self._scratch_bytes,
            target,
            key,
        )
        return Job(key, self.found(task), cost, task)

    def _geometry(self, left: View, right: View) -> RectifiedPair:
        try:
            details = (self._detail(left), self._detail(right))
            outlines = (self.context.outline(left.name), self.context.outline(right.name))
            options = self.context.options.rectification
            return rectify_pair(self.context.scene, left, right, options, details, outlines)
        except RectificationError:
            self._unfit.add(as_pair(left.name, right.name))
            raise

    def _detail(self, view: View) -> float:
        """Detail of an image; of one that is not there yet, that of those that are, or what a sharp one has."""
        return self.context.details.get(view.name, self._usual_detail)

    def _trial(self, left: View, right: View, geometry: RectifiedPair) -> float:
        """Share of the rows and columns at which to find out how precise the poses are; 1 where that is known."""
        if all(view.reprojection_error <= _PRECISE_POSES for view in (left, right)):
            return 1.0
        pixels_per_radian = max(float(view.K[0, 0]) for view in (left, right))
        return min(_TRIAL_SAMPLING * pixels_per_radian / geometry.columns_per_radian, 1.0)

    def _photo(self, view: View) -> PhotoFile:
        if view.name not in self._photos:
            workspace = self.context.workspace
            self._photos[view.name] = PhotoFile(
                view.without_points(), workspace.image_path(view.name), workspace.mask_path(view.name)
            )
        return self._photos[view.name]

    def label(self, item: Pair) -> str:
        """See `Stage.label`."""
        return f"the pair {item[0]} - {item[1]}"

    def skip(self, item: Pair, reason: str) -> None:
        """See `Stage.skip`."""
        self.context.report.skipped_pairs[" - ".join(item)] = reason
        self.context.progress.leave_out("pair", " - ".join(item), reason)
        logger.warning("%s - %s skipped: %s", *item, reason)
        if item not in self._unfit:  # for a reason that may pass
            for name in item:
                self.context.leave_incomplete(name, f"a pair of it was not matched: {reason}")

    def kept_memory(self, gate: "MemoryGate") -> Kept:
        """Scratch memory and caches take of what the largest pair leaves, but never starve."""
        views = self.context.scene.views
        largest = max(view.num_pixels for view in views)
        finest = max(sampling_of(self._detail(view)) for view in views)
        share = _RECTIFIED_SHARE * (finest * self.context.options.rectification.sampling) ** 2
        spare = int(max(gate.spare(share * _MATCH_BYTES * largest), gate.free / 8))
        scratch = min(_SCRATCH_BYTES, spare // (3 * gate.threads))
        paths = (self.context.workspace.image_path(view.name) for view in views)
        filled = sum(view.num_pixels * (grey_bytes(path) + 1) for view, path in zip(views, paths, strict=True))
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
            reason = next(iter(report.skipped_pairs.values()), "no pair")
            raise NoResultError(f"None of the {len(self.items)} pairs could be matched ({reason}).")
        report.pairs = len(results)
        self.remember(results)
