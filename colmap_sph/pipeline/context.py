"""What every stage of a run works with: workspace, scene, options, keys, progress and report."""

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import counted
from colmap_sph.pipeline.digests import digest
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.presets import changed_options
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.stages.maps import MapFiles
from colmap_sph.project.region_file import AUTO, as_given, read_region
from colmap_sph.project.state.array_file import SUFFIX
from colmap_sph.project.state.ownership import Place, cloud_place, estimate_path, map_place, range_place
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import Region, Scene
from colmap_sph.stereo.agreement import SparseTracks
from colmap_sph.stereo.extent import outline_of
from colmap_sph.stereo.partners.facing import Facing
from colmap_sph.stereo.partners.places import Places
from colmap_sph.stereo.partners.stations import Stations
from colmap_sph.stereo.region.core import core_of
from colmap_sph.stereo.region.focus import Focus, focused, region_of
from colmap_sph.stereo.region.inside import is_inside
from colmap_sph.stereo.region.window import Window

logger = logging.getLogger(__name__)

# Images whose pairs' disparity maps share a folder.
_IMAGES_IN_FOLDER = 1000

Until = Literal["photometric", "geometric", "cloud"]
"""The last results that a run makes."""


@dataclass(frozen=True, eq=False)
class Context:
    """One run in one workspace, and where its own files lie there.

    Attributes
    ----------
    workspace : Workspace
    scene : Scene
        The images to reconstruct.
    options : RunOptions
    keys : Keys
    progress : Progress
    report : RunReport
    details : mapping of str to float
        Of each image that is there, see `image_detail`.
    still : mapping of str to tuple of str
        Image in which something stands still while the camera turns → those that tell, see `still_pixels`.
    focus : Focus or None
        The region that is asked for; None: all.
    """

    workspace: Workspace
    scene: Scene
    options: RunOptions
    keys: Keys
    progress: Progress = field(default_factory=Silent)
    report: RunReport = field(default_factory=RunReport)
    details: Mapping[str, float] = field(default_factory=dict)
    still: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    focus: Focus | None = None

    @cached_property
    def scene_key(self) -> str:
        """Digest of all that stages look at in the scene and in the region, and of what is known of the images."""
        views = self.scene.views
        return digest(
            [(view.name, view.image_id, view.width, view.height, view.full_size, view.original) for view in views],
            [np.array([getattr(view, name) for view in views]) for name in ("K", "R", "t", "reprojection_error")],
            [view.point_indices for view in views],
            self.scene.points,
            self.focus,
            [self.details.get(view.name) for view in views],
            sorted(self.still.items()),
            self.keys.contents([view.name for view in views]),
        )

    @cached_property
    def stations(self) -> Stations:
        """Which images stand side by side: what is too near to be matched."""
        return Stations(self.scene, self.options.pairs.min_triangulation_angle)

    def lead(self, name: str) -> str:
        """What pairs call an image by: itself, or the first of those that were cut from the same photograph."""
        return self.scene.photograph(name).lead.name

    def changed(self, *stages: str) -> list[str]:
        """See `changed_options`."""
        return changed_options(self.options, *stages)

    @cached_property
    def facing(self) -> Facing:
        """Which views of a photograph that was cut up see what others see."""
        return Facing(self.scene)

    @cached_property
    def order(self) -> Places:
        """The order of place, in which images and pairs are worked on."""
        return Places(self.scene)

    def in_region(self) -> "Context":
        """The same with what of the scene shows the region that the options ask for, if they do; it is reported.

        Where one is to be drawn, they then ask for what was drawn. Raises `InputError` where nothing shows it.
        """
        if self.options.region == AUTO:
            return self._with_drawn_region().in_region()
        given = self.options.region
        if not given:
            return self
        least = self.options.pairs.min_shared_points
        scene, focus, too_few = focused(self.scene, read_region(given), least, f"--region {given}")
        logger.info("%d of %d images show the region", len(scene.views), len(self.scene.views))
        near = focus.near.moved(self.scene.origin + self.scene.anchor)
        self.report.region = {
            "box": near.box.tolist(),
            "polygons": [[ring.tolist() for ring in rings] for rings in near.polygons],
            "axes": None if near.axes is None else near.axes.tolist(),
        }
        for name, number in too_few.items():
            self.report.out_of_region[name] = (
                f"it sees {counted(number, 'sparse point')} in the region and near it, fewer than {least} "
                "(--pairs.min-shared-points)"
            )
            logger.info("%s left out: %s", name, self.report.out_of_region[name])
        return replace(self, scene=scene, focus=focus)

    def _with_drawn_region(self) -> "Context":
        origin = self.scene.origin + self.scene.anchor
        drawn = as_given(core_of(self.scene).moved(origin))
        inside = is_inside(read_region(drawn), self.scene.points + origin)
        self.report.drawn_region = (
            f"{drawn} was drawn, with {inside.sum():,} of {len(inside):,} sparse points in it; give it as "
            "--region to repeat or to change it"
        )
        logger.info("Region: %s", self.report.drawn_region)
        return replace(self, options=replace(self.options, region=drawn))

    @property
    def region(self) -> Region | None:
        """What results are cut to; None: nothing."""
        return region_of(self.focus)

    @cached_property
    def _outlines(self) -> dict[str, NDArray[np.float64]]:
        show = outline_of if self.focus is None else self.focus.outline
        return {view.name: show(view) for view in self.scene.views}

    def outline(self, name: str) -> NDArray[np.float64]:
        """Of the part of an image that is matched: what shows the region, or all; (n, 2) corners."""
        return self._outlines[name]

    def window(self, name: str) -> Window:
        """The part of an image that is worked on: the pixels around its outline."""
        return Window.around(self._outlines[name])

    def cut(self, name: str) -> tuple[object, ...]:
        """Where the results of an image are cut off, as a part of their keys: nothing, where they are not."""
        return () if self.focus is None else (self.focus.region, self.window(name), self.focus.box)

    @cached_property
    def sparse_tracks(self) -> SparseTracks:
        """Which images observe each sparse point."""
        return SparseTracks(self.scene, self.region)

    def pair_paths(self, a: str, b: str) -> list[Path]:
        """Disparity maps of a pair: two where one of its images was cut up, so that each sees half of it finer."""
        path = self.pair_path(a, b)
        if all(len(self.scene.photograph(name).views) == 1 for name in (a, b)):
            return [path]
        return [path, path.with_name("-".join(reversed(path.stem.split("-"))) + SUFFIX)]

    def pair_path(self, a: str, b: str) -> Path:
        """Disparity map of a pair: named by COLMAP's image ids, since names may hold anything.

        Those of so many images share a folder that no folder holds more than some thousands.
        """
        low, high = sorted((self.scene.view(a).image_id, self.scene.view(b).image_id))
        folder = f"{low // _IMAGES_IN_FOLDER:03d}"
        return self.workspace.pairs_dir / folder / f"{low:06d}-{high:06d}{SUFFIX}"

    def estimate_path(self, name: str) -> Path:
        """Photometric depth of an image with its standard deviation and support."""
        return estimate_path(self.workspace, name)

    def map_files(self, name: str, kind: MapKind) -> MapFiles:
        """Depth and normal map of an image, and the record that vouches for them."""
        place = map_place(self.workspace, name, kind)
        depth, normals = place.files
        return MapFiles(depth, normals, place.record)

    @property
    def cloud_place(self) -> Place:
        """The cloud, and the record that vouches for it."""
        return cloud_place(self.workspace, local=bool(self.scene.origin.any()))

    @property
    def places(self) -> list[Place]:
        """All that the run writes in COLMAP's formats."""
        until = self.report.until
        kinds: list[MapKind] = ["photometric"] if self.wants_photometric else []
        kinds += ["geometric"] if until != "photometric" else []
        maps = [map_place(self.workspace, view.name, kind) for view in self.scene.views for kind in kinds]
        return [*maps, self.cloud_place] if until == "cloud" else maps

    def written_files(self) -> Iterator[Path]:
        """All files that the run writes for single images, and those of the cloud."""
        originals = {view.original for view in self.scene.views if view.original}
        for place in (*self.places, *(range_place(self.workspace, name) for name in originals)):
            yield from (place.record, *place.files)
        yield from (self.estimate_path(view.name) for view in self.scene.views)
        if self.report.until == "cloud":
            yield self.workspace.fusion_cfg_path

    @property
    def wants_photometric(self) -> bool:
        """Whether photometric maps are made: where they are fused, or a run ends with maps, as COLMAP's do."""
        return self.report.until != "cloud" or self.options.fusion.input == "photometric"

    def stage(self, name: str, total: int) -> AbstractContextManager[None]:
        """Announce a stage of `total` steps, and report its wall time."""
        return timed_stage(name, total, self.progress, self.report)

    def leave_incomplete(self, name: str, reason: str) -> None:
        """Report that a view's results, or the cloud, had to do without something; the next run tries again."""
        self.report.incomplete[name] = reason
        self.progress.leave_out("incomplete", name, reason)
        logger.warning("%s incomplete: %s", name, reason)

    def skip_view(self, name: str, reason: str) -> None:
        """Report that a view could not be done."""
        self.report.skipped_images[name] = reason
        self.progress.leave_out("image", name, reason)
        logger.warning("%s skipped: %s", name, reason)


@contextmanager
def timed_stage(name: str, total: int, progress: Progress, report: RunReport) -> Iterator[None]:
    """Announce a stage, and report its wall time.

    Parameters
    ----------
    name : str
    total : int
        Steps that will be told by `progress.advance`.
    progress : Progress
    report : RunReport
        Whose `seconds` get the time, in all where there is a stage of this name more than once.
    """
    logger.info("%s (%d)", name.capitalize(), total)
    progress.start(name, total)
    start = time.perf_counter()
    yield
    seconds = time.perf_counter() - start
    report.seconds[name] = round(report.seconds.get(name, 0.0) + seconds, 3)
    logger.info("%s: %.1f s", name.capitalize(), seconds)
