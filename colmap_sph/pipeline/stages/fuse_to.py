"""The maps of a workspace, whoever made them → a cloud at any path: fusion as a step of its own."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_sph.errors import NoResultError
from colmap_sph.pipeline.stages.cloud import CloudFacts, vouch_for_cloud
from colmap_sph.pipeline.stages.fusion_parts import Partners, PartsStage
from colmap_sph.pipeline.stages.stage import Result
from colmap_sph.pipeline.stages.view_maps import MapSources
from colmap_sph.project.cloud_files import join_parts
from colmap_sph.project.cloud_output import CloudOutput
from colmap_sph.project.cloud_tiles import retire_tiles
from colmap_sph.project.files import real_path
from colmap_sph.project.state.records import begin
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Region

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context


class FuseToStage(PartsStage):
    """Fuses images into their parts of a cloud, and joins these where they are wanted.

    Parameters
    ----------
    context : Context
    partners, sources
        See `PartsStage`; of the images to fuse.
    output : CloudOutput
    region : Region, optional
        See `FuseTask`.
    """

    def __init__(
        self,
        context: "Context",
        partners: Partners,
        sources: Mapping[str, MapSources],
        output: CloudOutput,
        region: Region | None = None,
    ) -> None:
        super().__init__(context, list(sources))
        self._partners = partners
        self._sources = sources
        self.region = region
        self._output = output

    @property
    def partners(self) -> Partners:
        """See `PartsStage`."""
        return self._partners

    @property
    def sources(self) -> Mapping[str, MapSources]:
        """See `PartsStage`."""
        return self._sources

    @contextmanager
    def opened(self) -> Iterator[None]:
        """The parts of the cloud are there until this ends."""
        with self.in_scratch():
            yield

    def close(self, results: Mapping[str, Result]) -> None:
        """Join the parts to the cloud."""
        context = self.context
        results = self.in_order(results)
        if not results:
            raise NoResultError(f"No image could be fused ({context.report.skipped_images[self._names[0]]})")
        points = sum(result.facts.points for result in results.values())
        join_parts(self._stems(results), self._scratch, points)
        self._put_into_place()
        if self.is_the_workspaces:
            # Ours, but not what a run would make: the next one makes it anew.
            vouch_for_cloud(context, "", CloudFacts(points, ""), list(results), is_complete=False)
        self._report_unread(results)
        context.report.points = points

    @property
    def is_the_workspaces(self) -> bool:
        """Whether the cloud goes where a run puts its own."""
        fused = self.context.workspace.fused_path
        return self._output.kind == "ply" and real_path(self._output.path) == real_path(fused)

    def _put_into_place(self) -> None:
        context = self.context
        if self.is_the_workspaces:
            # Nothing of others is lost there. The cloud near the origin of a model in map coordinates goes.
            begin(context.cloud_place.record, context.cloud_place.files)
            for path in context.cloud_place.files[2:]:
                Path(path).unlink(missing_ok=True)
            retire_tiles(context.workspace)
        made = Workspace(self._scratch)
        self._output.write(made, context.workspace.sparse_dir, context.scene.origin)
