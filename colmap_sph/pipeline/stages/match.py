"""First stage: every pair of images, once → its disparity map, with the geometry that gives it meaning."""

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError, RectificationError
from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.pair_files import is_pair_there, write_pair
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result, Stage
from colmap_sph.project.files import make_dir
from colmap_sph.project.images.reading import grey_bytes, read_grey
from colmap_sph.project.masks import read_mask
from colmap_sph.project.state.array_file import OLD_SUFFIX
from colmap_sph.project.state.ownership import remove_array_files
from colmap_sph.scene import View
from colmap_sph.stereo.blank import blank_pixels
from colmap_sph.stereo.matching import MatchingOptions, RectifiedImage, Scratch, match_pair, scratch_bytes
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.rectification import rectify_pair
from colmap_sph.stereo.rectified_pair import PairDisparity, RectifiedPair, Side
from colmap_sph.stereo.resampling import resample

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context
    from colmap_sph.pipeline.memory import MemoryGate

logger = logging.getLogger(__name__)

# Processor seconds per megapixel of both rectified images.
_SECONDS = 0.1
# Bytes on disk per left rectified pixel.
_FILE_BYTES = 2.0
# Largest bytes in use at a time: per left rectified pixel while a pair is matched, beside its scratch; …
_MATCH_BYTES = 44.0
# … while an image is read and rectified: per pixel of its own, and per left rectified pixel of both.
_READ_BYTES = 11.0
_RECTIFIED_BYTES = 10.0
# Rectified pixels of a large pair per pixel of its images, with a margin for what arrays do not count.
_RECTIFIED_SHARE = 1.4
# Scratch memory of a thread and bytes of a cache: more is no faster.
_SCRATCH_BYTES = 256 << 20
_CACHE_BYTES = 512 << 20

_images: LoadCache[NDArray[np.uint8] | NDArray[np.float32]] = LoadCache(lambda image: image.nbytes)
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
    """A pair to match, with the bytes of scratch memory a thread may keep, and where its disparity map goes."""

    left: PhotoFile
    right: PhotoFile
    geometry: RectifiedPair
    options: MatchingOptions
    scratch_bytes: int
    target: Path
    key: str


def make_disparity_map(task: MatchTask) -> Facts:
    """Rectify and match a pair; writes its disparity map."""
    geometry = task.geometry
    if getattr(_thread, "scratch", None) is None or _thread.scratch.max_bytes != task.scratch_bytes:
        _thread.scratch = Scratch(task.scratch_bytes)
    disparity = match_pair(
        _rectified(task, "left"),
        _rectified(task, "right"),
        geometry.min_disparity,
        geometry.max_disparity,
        task.options,
        _thread.scratch,
        infinity=-geometry.disparity_origin,
    )
    pair = PairDisparity(task.left.view.name, task.right.view.name, geometry, disparity)
    write_pair(task.target, pair, task.key)
    return Facts()


def _rectified(task: MatchTask, side: Side) -> RectifiedImage:
    photo = task.left if side == "left" else task.right
    view = photo.view
    image = _images.get(file_stamp(photo.image), lambda: read_grey(photo.image))
    keep_blank = task.options.keep_blank
    key = f"{file_stamp(photo.mask)} {view.width} {view.height} {file_stamp(photo.image)} {keep_blank}"
    mask = _masks.get(key, lambda: _mask(photo, image, keep_blank))
    return RectifiedImage(*resample(image, view, task.geometry, side, mask=mask))


def _mask(
    photo: PhotoFile, image: NDArray[np.uint8] | NDArray[np.float32], keep_blank: bool
) -> NDArray[np.uint8] | None:
    """255 where an image takes part in matching, else 0; None where all of it does."""
    mask = read_mask(photo.mask, photo.view.width, photo.view.height)
    blank = None if keep_blank else blank_pixels(image)
    if blank is None or not blank.any():
        return mask
    counts = np.where(blank, np.uint8(0), np.uint8(255))
    return counts if mask is None else np.minimum(counts, mask)


class MatchStage(Stage[Pair, MatchTask]):
    """Matches pairs of image names."""

    name = "match pairs"
    make = staticmethod(make_disparity_map)

    def __init__(self, context: "Context", pairs: Sequence[Pair]) -> None:
        super().__init__(context, pairs)
        self._scratch_bytes = _SCRATCH_BYTES
        self._unfit: set[Pair] = set()

    def job(self, item: Pair) -> Job[MatchTask]:
        """See `Stage.job`; `RectificationError` for a pair that cannot be rectified."""
        context = self.context
        left, right = (context.scene.view(name) for name in item)
        geometry = self._geometry(left, right)
        key = context.keys.pair(left, right, geometry)
        target = context.pair_path(*item)
        left_pixels = geometry.height * geometry.left_width
        pixels = max(left.num_pixels, right.num_pixels)
        cost = Cost(
            seconds=_SECONDS * (left_pixels + geometry.height * geometry.right_width) / 1e6,
            memory=max(_MATCH_BYTES * left_pixels, _READ_BYTES * pixels + _RECTIFIED_BYTES * left_pixels),
            disk=_FILE_BYTES * left_pixels,
            scratch=scratch_bytes(left_pixels, context.options.matching),
        )
        task = MatchTask(
            self._photo(left),
            self._photo(right),
            geometry,
            context.options.matching,
            self._scratch_bytes,
            target,
            key,
        )
        is_there = is_pair_there(target, key, left.name, right.name, geometry)
        return Job(key, Facts() if is_there else None, cost, task)

    def _geometry(self, left: View, right: View) -> RectifiedPair:
        try:
            return rectify_pair(self.context.scene, left, right, self.context.options.rectification)
        except RectificationError:
            self._unfit.add((left.name, right.name))
            raise

    def _photo(self, view: View) -> PhotoFile:
        workspace = self.context.workspace
        return PhotoFile(view.without_points(), workspace.image_path(view.name), workspace.mask_path(view.name))

    def label(self, item: Pair) -> str:
        """See `Stage.label`."""
        return f"the pair {item[0]} - {item[1]}"

    def skip(self, item: Pair, reason: str) -> None:
        """See `Stage.skip`."""
        self.context.report.skipped_pairs[" - ".join(item)] = reason
        logger.warning("%s - %s skipped: %s", *item, reason)
        if item not in self._unfit:  # for a reason that may pass
            for name in item:
                self.context.leave_incomplete(name, f"a pair of it was not matched: {reason}")

    def kept_memory(self, gate: "MemoryGate") -> Kept:
        """Scratch memory and caches take of what the largest pair leaves, but never starve."""
        views = self.context.scene.views
        largest = max(view.num_pixels for view in views)
        spare = int(max(gate.spare(_RECTIFIED_SHARE * _MATCH_BYTES * largest), gate.free / 8))
        scratch = min(_SCRATCH_BYTES, spare // (3 * self.context.options.num_threads))
        paths = (self.context.workspace.image_path(view.name) for view in views)
        filled = sum(view.num_pixels * (grey_bytes(path) + 1) for view, path in zip(views, paths, strict=True))
        return Kept(scratch, min(_CACHE_BYTES, spare // 6), 2, filled)

    @contextmanager
    def opened(self) -> Iterator[None]:
        """See `Stage.opened`."""
        make_dir(self.context.workspace.pairs_dir)
        remove_array_files(self.context.workspace, OLD_SUFFIX)
        yield

    @contextmanager
    def holding(self, kept: Kept) -> Iterator[None]:
        """See `Stage.holding`."""
        self._scratch_bytes = kept.scratch
        with _images.holding(kept.cache), _masks.holding(kept.cache):
            yield

    def close(self, results: Mapping[Pair, Result]) -> None:
        """See `Stage.close`."""
        report = self.context.report
        if not results:
            reason = next(iter(report.skipped_pairs.values()), "no pair")
            raise NoResultError(f"None of the {len(self.items)} pairs could be matched ({reason}).")
        report.pairs = len(results)
