"""A dense workspace → its page ``colmap_sph/report.html``, one file that shows what came out and loads nothing."""

import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.pages.block_map import Frame, Ground, footprint, frame_around, surface_points
from colmap_sph.pages.cloud_drawing import draw_cloud
from colmap_sph.pages.cloud_sample import cloud_of_maps, find_cloud
from colmap_sph.pages.content import CloudSample, Content
from colmap_sph.pages.image_facts import (
    ImageFacts,
    Picture,
    facts_of_image,
    find_blank,
    read_small_picture,
    small_pictures,
)
from colmap_sph.pages.markup import render
from colmap_sph.pages.originals import WideImage
from colmap_sph.pages.pair_facts import PairFacts, pairs_of
from colmap_sph.pages.products import products_of
from colmap_sph.pages.reasons import Partner, Reason, find_reasons
from colmap_sph.pages.run_facts import RunFacts, read_run_facts
from colmap_sph.pages.samples import MapSamples, read_normals, read_samples, samples_per_side
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.table import read_cuts
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Photograph, Scene, View
from colmap_sph.stereo.partners.facing import Facing
from colmap_sph.stereo.partners.pairs import overlapping_views
from colmap_sph.stereo.region.map_axes import map_axes

Bytes = NDArray[np.uint8]

# Points of an image's surface, to stand for it where there is no cloud; of the cloud, to frame the map.
_SURFACE_SAMPLE = 300
_FRAME_SAMPLE = 100_000
# Partners of a view to look from, where it is not known which were its.
_GUESSED_PARTNERS = 10
# Images whose pictures are shown: the least covered, and as many from all over the block.
_MOST_SHOWN = 1000


class Progress(Protocol):
    """What is told while a page is made."""

    def start(self, stage: str, total: int) -> None:
        """So many steps begin."""

    def advance(self) -> None:
        """One step is done."""


class _Silent:
    def start(self, stage: str, total: int) -> None:
        pass

    def advance(self) -> None:
        pass


def write_page(workspace: Workspace, progress: Progress | None = None, *, threads: int = 1) -> str:
    """Make the page of a workspace from what is on disk: model, images, maps, cloud, and ``report.json``.

    It also shows workspaces whose run was ended before its end, and what COLMAP's own programs made.

    Parameters
    ----------
    workspace : Workspace
    progress : Progress, optional
    threads : int, optional
        So many images are looked at at a time; each may be in memory at its full size. The page is the same.

    Returns
    -------
    str
        What is missing of a finished run, in a sentence; empty where nothing is.

    Raises
    ------
    InputError
        There is no readable model, or neither a depth map nor a cloud to show.
    OutputError
        The page cannot be written.
    """
    content = gather(workspace, progress or _Silent(), threads)
    page = render(content)
    make_dir(workspace.state_dir)
    with atomic_file(workspace.page_path) as file:
        file.write(page.encode("utf-8", "backslashreplace"))
    return content.missing


def gather(workspace: Workspace, progress: Progress, threads: int) -> Content:
    """Look at all of a workspace, a few images at a time; otherwise as `write_page`."""
    scene = read_scene(workspace.sparse_dir)
    facts = read_run_facts(workspace)
    progress.start("report", 2 * len(scene.views))
    told = facts or RunFacts()
    side = samples_per_side(len(scene.views))
    samples = {}

    def sample(view: View) -> MapSamples:
        return read_samples(workspace, view, side, told.kinds_of(view.name))

    with _pool(threads) as pool:
        found = pool.submit(find_cloud, workspace)  # first, as it takes longest
        for view, its_samples in zip(scene.views, pool.map(sample, scene.views), strict=True):
            samples[view.name] = its_samples
            progress.advance()
        cloud = cloud_of_maps(workspace, scene, samples, found.result())
        if not cloud.total and not any(each.has_maps for each in samples.values()):
            raise InputError(
                f"There is nothing to show of {workspace.root} yet: it has neither depth maps nor a cloud; "
                "run colmap_sph run first."
            )
        block = _Block(workspace, scene, told, samples, cloud)
        drawing = pool.submit(draw_cloud, cloud, block.frame)
        images = []
        for photograph, image in zip(block.photographs, pool.map(block.look_at, block.photographs), strict=True):
            images.append(image)
            for _ in photograph.views:
                progress.advance()
        return Content(
            workspace,
            scene,
            facts,
            block.photographs,
            images,
            block.pairs,
            cloud,
            drawing.result(),
            block.frame,
            block.ground,
            _missing(block, facts),
            *products_of(workspace),
        )


@contextmanager
def _pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Worker threads; what they have not begun when this ends is left."""
    with ThreadPoolExecutor(threads) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)


@dataclass(eq=False)
class _Block:
    """All views' samples, and what is worked out of them together."""

    workspace: Workspace
    scene: Scene
    facts: RunFacts
    samples: dict[str, MapSamples]
    cloud: CloudSample
    photographs: list[Photograph] = field(init=False)
    pairs: list[PairFacts] = field(init=False)
    frame: Frame = field(init=False)
    ground: Ground = field(init=False)

    def __post_init__(self) -> None:
        self.photographs = sorted(self.scene.photographs, key=lambda photograph: photograph.name)
        self._cuts = read_cuts(self.workspace.sparse_dir)
        surfaces = {view.name: self._surface(view) for view in self.scene.views}
        surface = self.cloud.points[:: -(-len(self.cloud.points) // _FRAME_SAMPLE) or 1]
        surface = surface if len(surface) else np.concatenate(list(surfaces.values()))
        self.pairs = pairs_of(self.workspace, self.scene, self.photographs, self.facts, surfaces)
        region = self.facts.region
        self._region = None if region is None else region.as_region().moved(-self.scene.origin)
        self._partners = self._find_partners()
        self._as_partner = {view.name: Partner(view, self.samples[view.name]) for view in self.scene.views}
        self._shown = self._choose_shown()
        centers = np.array([view.center for view in self.scene.views])
        axes = map_axes(self.scene.views, surface, origin=self.scene.origin)
        self.frame = frame_around(surface, centers, axes)
        self.ground = Ground(self.frame)

    def look_at(self, photograph: Photograph) -> ImageFacts:
        """Work out what became of a photograph's pixels, make its pictures, put it on the map; in any thread."""
        cuts = [(view, self._cuts[view.name]) for view in photograph.views if view.name in self._cuts]
        return self._look_at_cut(photograph.name, cuts) if cuts else self._look_at_whole(photograph.lead)

    def _look_at_whole(self, view: View) -> ImageFacts:
        samples, picture = self.samples[view.name], read_small_picture(self.workspace, view)
        reasons, depth = self._reasons(view, picture)
        self.ground.add(view, samples, reasons, depth)
        pictures: tuple[Picture, ...] = ()
        if view.name in self._shown:
            pictures = small_pictures(self.workspace, view, samples, reasons, picture, len(self._shown))
        corners = footprint(view, samples, depth, self.frame) if depth.any() else None
        return facts_of_image(view, samples, reasons, pictures, corners)

    def _look_at_cut(self, name: str, cuts: Sequence[tuple[View, Cut]]) -> ImageFacts:
        is_shown = name in self._shown
        image = WideImage(name, cuts[0][1].lens, samples_per_side(len(self.photographs)), is_shown)
        for view, cut in cuts:
            samples, picture = self.samples[view.name], read_small_picture(self.workspace, view)
            reasons, depth = self._reasons(view, picture)
            normals = read_normals(self.workspace, view, samples) if is_shown else None
            image.add(view, cut, samples, reasons, depth, normals, picture)
        image.put_on(self.ground)
        return image.facts(len(self._shown))

    def _reasons(self, view: View, picture: Bytes | None) -> tuple[Bytes, NDArray[np.float32]]:
        """See `find_reasons`."""
        samples = self.samples[view.name]
        reasons, depth = find_reasons(
            view,
            samples,
            [self._as_partner[name] for name in self._partners[view.name]],
            blank=find_blank(self.workspace, view.name, picture, samples.geometric.shape),
            min_angle=self.facts.min_angle,
            region=self._region,
        )
        if not self.facts.kinds_of(view.name):
            reasons[:] = Reason.OUTSIDE
        return reasons, depth

    def _surface(self, view: View) -> NDArray[np.float64]:
        """Some points that a view sees."""
        samples = self.samples[view.name]
        depth = np.where(samples.geometric > 0, samples.geometric, samples.photometric)
        points = surface_points(view, samples, depth)[depth.ravel() > 0]
        return points[:: -(-len(points) // _SURFACE_SAMPLE) or 1]

    def _find_partners(self) -> dict[str, list[str]]:
        """The images that each was matched with, or else those that share most points with it."""
        if not self.pairs:
            return overlapping_views(self.scene, _GUESSED_PARTNERS)
        matched: dict[str, list[str]] = {photograph.name: [] for photograph in self.photographs}
        for pair in self.pairs:
            left, right = self.photographs[pair.left], self.photographs[pair.right]
            matched[left.name].append(right.lead.name)
            matched[right.name].append(left.lead.name)
        facing = Facing(self.scene)
        return {
            view.name: list(itertools.chain(*facing.views(view.name, matched[photograph.name])))
            for photograph in self.photographs
            for view in photograph.views
        }

    def _choose_shown(self) -> set[str]:
        """Images whose pictures the page has room for."""
        names = [photograph.name for photograph in self.photographs]
        if len(names) <= _MOST_SHOWN:
            return set(names)
        by_coverage = sorted(self.photographs, key=self._share)
        worst = [photograph.name for photograph in by_coverage[: _MOST_SHOWN // 2]]
        rest = sorted(set(names) - set(worst))
        return {*worst, *(rest[k] for k in np.linspace(0, len(rest) - 1, _MOST_SHOWN - len(worst)).astype(int))}

    def _share(self, photograph: Photograph) -> float:
        """Share of samples with a geometric depth, of an image or on average of its views."""
        return float(np.mean([(self.samples[view.name].geometric > 0).mean() for view in photograph.views]))


def _missing(block: _Block, facts: RunFacts | None) -> str:
    """What is missing of a finished run, in a sentence."""
    lacks = []
    names = block.samples if facts is None else [name for name, share in facts.coverage.items() if share > 0]
    told = block.facts
    known = [name for name in names if name in block.samples]
    photograph_of = {name: block.scene.photograph(name).name for name in known}
    expected = {photograph_of.get(name, name) for name in names}
    without = {photograph_of[name] for name in known if not block.samples[name].has(told.last_maps)}
    if without:
        what = "views without a" if any(view.original for view in block.scene.views) else "no"
        lacks.append(f"{len(without)} of {len(expected)} images have {what} {told.last_maps} depth map")
    if not block.cloud.total and told.until == "cloud":
        lacks.append("the cloud is of other depth maps" if block.cloud.is_of_others else "there is no cloud")
    if facts is None:
        lacks.append("no run of this program has come to its end here, so that its numbers are not known")
    return f"{', '.join(lacks[:-1])}{' and ' if len(lacks) > 1 else ''}{lacks[-1]}" if lacks else ""
