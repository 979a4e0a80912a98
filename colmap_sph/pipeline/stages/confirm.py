"""Third stage: every image's depth is confirmed by its partners' and refined on their images: geometric maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import NoResultError
from colmap_sph.pipeline.known.remembering import RememberingStage
from colmap_sph.pipeline.load_cache import LoadCache, file_stamp
from colmap_sph.pipeline.stages.facts import Agreement, Facts
from colmap_sph.pipeline.stages.maps import MAP_BYTES, MapFiles
from colmap_sph.pipeline.stages.pair_files import read_estimate, residuals_of
from colmap_sph.pipeline.stages.stage import Cost, Job, Kept, Result, keys_of
from colmap_sph.pipeline.stages.vote import normals_seconds
from colmap_sph.project.images.reading import bytes_to_reduce, read_whole_grey
from colmap_sph.project.masks import read_view_mask
from colmap_sph.project.state.ownership import undistorted_place
from colmap_sph.project.undistortion.rounding import coarsest_jpeg_step
from colmap_sph.scene import View
from colmap_sph.stereo.agreement import SparseSights, compare_with_sparse
from colmap_sph.stereo.blank import drop_scattered, faint_pixels, faint_rays
from colmap_sph.stereo.confirm import ConfirmOptions, confirm_depth
from colmap_sph.stereo.depth import DepthEstimate, Depths, drop_other_depths
from colmap_sph.stereo.normals import NormalOptions, fit_normals
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.partners.pairing import Pair, as_pair, partners_of
from colmap_sph.stereo.photographs.fringes import drop_fringes, drop_rims
from colmap_sph.stereo.refinement import RefinementOptions, refine_maps, suits_half_size
from colmap_sph.stereo.region.focus import Focus, region_of
from colmap_sph.stereo.region.inside import drop_outside, is_inside
from colmap_sph.stereo.region.shown import count_shown
from colmap_sph.stereo.region.window import Window

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context
    from colmap_sph.pipeline.memory import MemoryGate

# Processor seconds per megapixel of the image: for its faint places, per partner, and per partner's image that is
# matched in.
_FAINT_SECONDS = 0.05
_CONFIRM_SECONDS = 0.015
_REFINE_SECONDS = 0.075
# Largest bytes in use at a time, per pixel of the image: while it is confirmed, and more where partners share a
# station; or refined beside grey images, and more at half its size.
_CONFIRM_BYTES = 40.0
_STATION_BYTES = 11.0
_REFINE_BYTES = 36.0
_HALF_SIZE_BYTES = 20.0
# Per pixel: of an image and of an estimate in the cache; of a partner's image as refinement reads it.
_IMAGE_BYTES = 1
_ESTIMATE_BYTES = 9
_PAIRED_BYTES = 2
# Caches take what the costliest image leaves, with some room to spare.
_ROOM = 1.2

# Names, stations and row residuals, radians, of a view's partners; and whether it is refined at half its size.
_Partners = tuple[list[str], list[int], list[float], bool]

# Images of views, and estimates of their depth.
_loaded: LoadCache[NDArray[np.uint8] | DepthEstimate] = LoadCache(
    lambda loaded: _ESTIMATE_BYTES * loaded.depth.size if isinstance(loaded, DepthEstimate) else loaded.nbytes
)


@dataclass(frozen=True, eq=False)
class EstimateFile:
    """A view without its sparse points, its image, what tells how that was made, its photometric depth and the key
    of that, and its window.
    """

    whole: View
    window: Window
    image: Path
    record: Path
    estimate: Path
    key: str

    @property
    def view(self) -> View:
        """What of the view is worked on."""
        return self.window.view(self.whole)


@dataclass(frozen=True, eq=False)
class ConfirmTask:
    """A view and its partners, its sparse points and mask, and where its geometric maps go.

    `matched` are the images that it was matched with, also where these tell nothing of it. With `keep_blank` no
    depth is doubted for what the image shows, and with `half_size` it is refined at half its size.
    """

    reference: EstimateFile
    partners: tuple[EstimateFile, ...]
    stations: tuple[int, ...]
    residuals: tuple[float, ...]
    sights: SparseSights
    mask: Path
    keep_blank: bool
    confirm_options: ConfirmOptions
    normal_options: NormalOptions
    refinement_options: RefinementOptions
    depths: Depths | None
    focus: Focus | None
    matched: tuple[str, ...]
    half_size: bool
    maps: MapFiles
    key: str


def make_geometric_maps(task: ConfirmTask) -> Facts:
    """Confirm a view's depth by its partners' and refine it on their images; writes its geometric maps."""
    view = task.reference.view
    whole = task.reference.whole
    mask = read_view_mask(task.mask, whole)
    planes = _planes(task, view, mask)
    if view.original:
        drop_fringes(planes[1])
        drop_rims(planes[1], None if mask is None else task.reference.window.part(mask))
    drop_other_depths(planes[1], task.depths)
    drop_outside(view, planes[1], region_of(task.focus))
    shown = None
    if task.focus is not None:  # read again: there was no room for it meanwhile
        shown = count_shown(view, _estimate(task.reference).depth, planes[1], task.focus.near)
    normals, depth = (task.reference.window.padded(pixels, whole) for pixels in planes)
    agreement = Agreement(*compare_with_sparse(whole, depth, task.sights, mask))
    return task.maps.write(normals, depth, task.key, agreement, partners=task.matched, shown=shown)


def _planes(
    task: ConfirmTask, view: View, mask: NDArray[np.uint8] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normals and depth, confirmed and refined; what else that takes is free again afterwards."""
    others = ((partner.view, _estimate(partner)) for partner in task.partners)
    confirmed = confirm_depth(
        view, _estimate(task.reference), others, task.confirm_options, task.stations, task.residuals
    )
    if not task.keep_blank and confirmed.depth.any():
        drop_scattered(confirmed.depth, _faint(task.reference, mask))
    planes = fit_normals(view, confirmed, task.normal_options)
    if task.refinement_options.rounds and confirmed.depth.any():
        sources = [(partner.view, _image(partner)) for partner in task.partners]
        options = _refinement(task.refinement_options, view, task.residuals)
        image, usual = _image(task.reference), _usual(task.residuals)
        planes = refine_maps(view, image, confirmed, *planes, sources, options, usual, half_size=task.half_size)
    return planes


def _usual(residuals: Sequence[float]) -> float:
    return float(np.median(residuals)) if residuals else 0.0


def _refinement(options: RefinementOptions, view: View, residuals: Sequence[float]) -> RefinementOptions:
    """How a view is refined whose pairs have such row residuals, radians."""
    return options.for_residual(_usual(residuals) * float(view.K[0, 0]))


def _estimate(file: EstimateFile) -> DepthEstimate:
    key = f"estimate {file_stamp(file.estimate)} {file.key}"
    estimate = _loaded.get(key, lambda: read_estimate(file.estimate, file.view, file.key))
    assert isinstance(estimate, DepthEstimate)
    return estimate


def _whole_image(file: EstimateFile) -> NDArray[np.uint8]:
    return read_whole_grey(file.image, (file.whole.width, file.whole.height))


def _image(file: EstimateFile) -> NDArray[np.uint8]:
    size = (file.whole.width, file.whole.height)
    key = f"image {file_stamp(file.image)} {size} {file.window}"
    image = _loaded.get(key, lambda: file.window.part(_whole_image(file)))
    assert not isinstance(image, DepthEstimate)
    return image


def _faint(file: EstimateFile, mask: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """See `faint_rays`; found in the whole image, so that a region has no part in it."""
    is_whole = file.window == Window.whole(file.whole)
    image = _image(file) if is_whole else _whole_image(file)
    faint = faint_pixels(image, coarsest_jpeg_step(file.image, file.record))
    if mask is not None:
        faint[mask == 0] = 0
    return file.window.part(faint_rays(faint))


def confirm_seconds(
    partners: int, normals: NormalOptions, refinement: RefinementOptions, *, half_size: bool = False
) -> float:
    """Processor seconds per megapixel of an image that has so many partners."""
    seconds = normals_seconds(normals) + _FAINT_SECONDS + _CONFIRM_SECONDS * partners
    return seconds + _REFINE_SECONDS * refinement.images_used(partners, half_size=half_size)


class ConfirmStage(RememberingStage[str, ConfirmTask]):
    """Confirms and refines the depth of every image with a vote."""

    name = "confirm depth"
    remembered_as = "geometric"
    make = staticmethod(make_geometric_maps)
    caches = (_loaded,)

    @staticmethod
    def found(task: ConfirmTask) -> Facts | None:
        """See `Stage.found`."""
        return task.maps.facts(task.key)

    def __init__(self, context: "Context", matched: Mapping[Pair, Result], votes: Mapping[str, Result]) -> None:
        super().__init__(context, context.order.sorted(votes))
        self._vote_keys = keys_of(votes)
        self._voted = {name: result.facts.coverage for name, result in votes.items()}
        self._residuals = residuals_of(matched)
        self._all_partners = partners_of(matched)
        # Each is asked for by all partners of a view.
        self._files: dict[str, EstimateFile] = {}
        self._known_partners: dict[str, _Partners] = {}

    def input_key(self) -> str:
        """See `RememberingStage`."""
        context = self.context
        options = context.options
        given = (options.pairs, options.rectification, options.confirm, options.normals, options.refinement)
        matched = sorted((*pair, residual) for pair, residual in self._residuals.items())
        return context.keys.stage("geometric", context.scene_key, given, matched, self._vote_keys)

    def files(self, item: str) -> list[str]:
        """See `RememberingStage`."""
        return self.context.map_files(item, "geometric").paths

    def is_there(self, item: str, key: str) -> bool:
        """See `RememberingStage`."""
        return self.context.map_files(item, "geometric").facts(key) is not None

    def ask(self, item: str) -> Job[ConfirmTask]:
        """See `RememberingStage`."""
        options = self.context.options
        partners, stations, residuals, half_size = self._partners(item)
        votes = [self._vote_keys[name] for name in partners]
        sights = self.context.sparse_tracks.sights(item).between(options.rectification.depths)
        cut = self.context.cut(item)
        key = self.context.keys.geometric(
            self._vote_keys[item], votes, stations, residuals, sights, half_size, cut
        )
        maps = self.context.map_files(item, "geometric")
        task = ConfirmTask(
            self._estimate_file(item),
            tuple(map(self._estimate_file, partners)),
            tuple(stations),
            tuple(residuals),
            sights,
            self.context.workspace.mask_path(item),
            options.matching.keep_blank,
            options.confirm,
            options.normals,
            options.refinement,
            options.rectification.depths,
            self.context.focus,
            tuple(self._matched(item)),
            half_size,
            maps,
            key,
        )
        return Job(key, self.found(task), self._cost(item), task)

    def _partners(self, name: str) -> _Partners:
        """Partners of a view that stand elsewhere; and whether it is refined at half its size."""
        if name not in self._known_partners:
            context = self.context
            facing = chain(*context.facing.views(name, self._matched(name)))
            names, stations = context.stations.elsewhere(name, [o for o in facing if o in self._vote_keys])
            lead_of = context.lead
            residuals = [self._residuals[as_pair(lead_of(name), lead_of(other))] for other in names]
            # One whose image is not there yet is taken for sharp.
            pixels = _usual(residuals) * float(context.scene.view(name).K[0, 0])
            half_size = suits_half_size(context.details.get(name, 1.0), pixels)
            self._known_partners[name] = names, stations, residuals, half_size
        return self._known_partners[name]

    def _matched(self, name: str) -> list[str]:
        return self._all_partners.get(self.context.lead(name), [])

    def _estimate_file(self, name: str) -> EstimateFile:
        if name not in self._files:
            context = self.context
            self._files[name] = EstimateFile(
                context.scene.view(name).without_points(),
                context.window(name),
                context.workspace.image_path(name),
                undistorted_place(context.workspace, name).record,
                context.estimate_path(name),
                self._vote_keys[name],
            )
        return self._files[name]

    def _cost(self, name: str) -> Cost:
        pixels = self._pixels(name)
        partners, stations, residuals, half_size = self._partners(name)
        refinement = _refinement(self.context.options.refinement, self.context.scene.view(name), residuals)
        normals = self.context.options.normals
        seconds = confirm_seconds(len(partners), normals, refinement, half_size=half_size)
        memory = (_CONFIRM_BYTES + _STATION_BYTES * (len({*stations}) < len(stations))) * pixels
        if refinement.rounds:
            of_partners = (_IMAGE_BYTES + _PAIRED_BYTES) * sum(map(self._pixels, partners))
            refining = _REFINE_BYTES + _HALF_SIZE_BYTES * half_size + _IMAGE_BYTES
            memory = max(memory, refining * pixels + of_partners)
        memory += bytes_to_reduce(*map(self.context.scene.view, [name, *partners]))
        maps = MAP_BYTES * self.context.scene.view(name).num_pixels
        return Cost(seconds * pixels / 1e6, memory + maps - MAP_BYTES * pixels, maps)

    def _pixels(self, name: str) -> int:
        return self.context.window(name).num_pixels

    def kept_memory(self, gate: "MemoryGate") -> Kept:
        """See `Stage.kept_memory`."""
        most = max((self._cost(name).memory for name in self.items), default=0.0)
        filled = (_IMAGE_BYTES + _ESTIMATE_BYTES) * sum(map(self._pixels, self.items))
        # Half of what is spare goes to more workers at a time.
        cache = int(min(filled, gate.spare(_ROOM * most) / 2))
        return Kept(cache=cache, caches=1, filled=filled)

    def close(self, results: Mapping[str, Result]) -> None:
        """See `Stage.close`."""
        self.remember(results)
        report = self.context.report
        names = [view.name for view in self.context.scene.views]
        report.coverage = {name: results[name].facts.coverage if name in results else 0.0 for name in names}
        if self.context.focus is not None:
            report.in_region = {name: result.facts.in_region for name, result in results.items()}
        report.agreement = {name: result.facts.agreement.share for name, result in results.items()}
        report.agreement_of_found = {
            name: result.facts.agreement.share_of_found for name, result in results.items()
        }
        report.sparse_points = sum((result.facts.agreement for result in results.values()), Agreement())
        report.overall_agreement = report.sparse_points.share
        report.images = sum(share > 0 for share in report.coverage.values())
        failures = [report.skipped_images[name] for name in names if name in report.skipped_images]
        if failures and not report.images:
            raise NoResultError(f"No image has a depth map ({failures[0]})")
        for name in (name for name, share in report.coverage.items() if share == 0):
            if name in report.skipped_images or self._is_one_of_many(name):
                continue
            if self._shows_enough(name):
                report.skipped_images[name] = self._why_empty(name)
                self.context.progress.leave_out("image", name, report.skipped_images[name])
            else:
                report.out_of_region[name] = (
                    "it has no depth in the region, of which it sees too few sparse points"
                )
        if not report.images:
            raise NoResultError(self._why_nothing())

    def _is_one_of_many(self, name: str) -> bool:
        """Whether a view is cut from an image of which others have a depth: it may show the sky alone."""
        original = self.context.scene.view(name).original
        coverage = self.context.report.coverage
        views = self.context.scene.views
        return bool(original) and any(view.original == original and coverage[view.name] > 0 for view in views)

    def _shows_enough(self, name: str) -> bool:
        """Whether an image shows so much of the region, where there is one, that it ought to have some depth."""
        context = self.context
        scene = context.scene
        if context.region is None:
            return True
        view = scene.view(name)
        points = scene.points[view.point_indices] if scene.has_tracks else scene.points
        points = points[is_inside(context.region, points) & sees(view, points)]
        mask = read_view_mask(context.workspace.mask_path(name), view)
        if mask is not None:
            columns, rows = np.floor(view.project(points)[0]).astype(int).T
            points = points[mask[rows, columns] > 0]
        return len(points) >= context.options.pairs.min_shared_points

    def _why_empty(self, name: str) -> str:
        """Why an image has no depth, as far as it is known."""
        if not self._matched(name):
            return "no pair of it could be matched"
        if self._voted.get(name, 0.0) > 0:
            return "no depth of it is confirmed by another image"
        mask = self.context.workspace.mask_path(name)
        return "its mask may leave nothing of it" if mask.is_file() else "no pair of it found any depth"

    def _why_nothing(self) -> str:
        """Why no image has a depth, and what to look at first."""
        changed = self.context.changed("rectification", "matching", "vote", "confirm", "normals")
        found = any(share > 0 for share in self._voted.values())
        what = "No depth was confirmed by a second image" if found else "No pair of images found any depth"
        questions = ["are the model's poses right for these images"]
        if self.context.workspace.masks_dir.is_dir():
            questions.append("is black in the masks what is to be ignored")
        if changed:
            questions.insert(0, f"is it the same without {', '.join(changed)}")
        return f"{what}; {', and '.join(questions)}?"
