"""What every stage of a run works with: workspace, scene, options, keys, progress and report."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.workers import for_all
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import Scene, View

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass(frozen=True)
class Done:
    """Outcome of one item of a stage.

    Attributes
    ----------
    key : str
        Key of its result.
    made : bool
        Whether this run worked it out; else an earlier run had.
    coverage : float
        Share of pixels with a depth, where the stage gives one.
    points : int
        Points of the cloud, where the stage gives them.
    """

    key: str
    made: bool
    coverage: float = 0.0
    points: int = 0


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
    """

    workspace: Workspace
    scene: Scene
    options: RunOptions
    keys: Keys
    progress: Progress = field(default_factory=Silent)
    report: RunReport = field(default_factory=RunReport)

    def pair_path(self, a: str, b: str) -> Path:
        """Disparity map of a pair: named by COLMAP's image ids, since names may hold anything."""
        low, high = sorted((self.scene.view(a).image_id, self.scene.view(b).image_id))
        return self.workspace.pairs_dir / f"{low:06d}-{high:06d}.npz"

    def estimate_path(self, name: str) -> Path:
        """Photometric depth of an image with its standard deviation and support."""
        return self.workspace.photometric_dir / f"{name}.npz"

    def map_paths(self, name: str, kind: MapKind) -> list[Path]:
        """Depth and normal map of an image."""
        return [self.workspace.depth_map_path(name, kind), self.workspace.normal_map_path(name, kind)]

    def maps_record(self, name: str, kind: MapKind) -> Path:
        """Record that vouches for the maps of an image."""
        return self.workspace.records_dir / f"{name}.{kind}.json"

    @property
    def cloud_paths(self) -> list[Path]:
        """The cloud and its visibility, and for a model in map coordinates the cloud near its origin."""
        local = [Workspace(self.workspace.local_dir).fused_path] if self.scene.origin.any() else []
        return [*self.workspace.cloud_paths, *local]

    @property
    def cloud_record(self) -> Path:
        """Record that vouches for the cloud."""
        return self.workspace.cloud_record_path

    def stage(self, name: str, total: int) -> AbstractContextManager[None]:
        """Announce a stage of `total` steps, and report its wall time."""
        return timed_stage(name, total, self.progress, self.report)

    def for_all(
        self, stage: str, work: Callable[[T], Done], items: Sequence[T], skip: Callable[[T, str], None]
    ) -> dict[T, Done]:
        """`work` on all items of a stage in worker threads; see `workers.for_all`."""
        with self.stage(stage, len(items)):
            results = for_all(work, items, threads=self.options.num_threads, progress=self.progress, skip=skip)
        self.count(stage, results.values())
        return results

    def skip_view(self, item: View | str, reason: str) -> None:
        """Report that a view could not be done."""
        name = item if isinstance(item, str) else item.name
        self.report.skipped_images[name] = reason
        logger.warning("%s skipped: %s", name, reason)

    def count(self, stage: str, results: Iterable[Done]) -> None:
        """Report how many results of a stage are new, and how many an earlier run had made."""
        made = [done.made for done in results]
        self.report.made[stage], self.report.reused[stage] = sum(made), len(made) - sum(made)
        if self.report.reused[stage]:
            logger.info("%s: %d were up to date", stage.capitalize(), self.report.reused[stage])


@contextmanager
def timed_stage(name: str, total: int, progress: Progress, report: RunReport) -> Iterator[None]:
    """Announce a stage of `total` steps, and report its wall time."""
    logger.info("%s (%d)", name.capitalize(), total)
    progress.start(name, total)
    start = time.perf_counter()
    yield
    report.seconds[name] = round(time.perf_counter() - start, 3)
    logger.info("%s: %.1f s", name.capitalize(), report.seconds[name])
