"""A finished workspace → files for other programs, each in the format it reads."""

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from colmap_sph.errors import OptionError, OutputError
from colmap_sph.products.clouds.source import Cloud
from colmap_sph.products.clouds.spread import measured_cloud
from colmap_sph.products.clouds.thinning import ThinCloud, thinned
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.maps.files import write_exr, write_npz, write_png
from colmap_sph.products.maps.reading import MappedScene, mapped_scene
from colmap_sph.products.places import check_no_input
from colmap_sph.products.publishing import alone_in, clear_leftovers
from colmap_sph.products.scenes.mvsnet import write_mvsnet
from colmap_sph.products.scenes.nerfstudio import write_nerfstudio
from colmap_sph.products.scenes.splats import write_splats
from colmap_sph.project.claim import check_ways_out
from colmap_sph.project.workspace import Workspace

if TYPE_CHECKING:
    from colmap_sph.products.clouds.las_points import Extent

ExportFormat = Literal["las", "laz", "copc", "exr", "png", "npz", "nerfstudio", "splats", "mvsnet"]

Status = Callable[[object], AbstractContextManager[None]]
"""Shows what is being made, as `Terminal.status`."""


@dataclass(frozen=True)
class ExportOptions:
    """What is made of a workspace, and how."""

    formats: tuple[ExportFormat, ...] = ("laz",)
    """What to write. The cloud: las, laz, or copc, which map viewers and web pages stream. Depth maps: exr, png
    (16 bits), npz. Folders for other programs: nerfstudio, splats (Gaussian splatting), mvsnet."""
    las_scale: float | None = None
    """Step between coordinates in LAS, LAZ and COPC files, in units of the map, such as 0.001: coarser files are
    smaller. Default: so fine that nothing is lost."""
    splat_points: int = 500_000
    """Points that splats and nerfstudio begin with, at most: the cloud is thinned to one point of each voxel."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of its bounds."""
        if not self.formats:
            raise OptionError("formats must name at least one format, such as laz.", "formats")
        if self.las_scale is not None and not 1e-9 <= self.las_scale <= 1e3:
            raise OptionError(f"las_scale must be from 1e-9 to 1000, not {self.las_scale:g}.", "las_scale")
        if self.splat_points < 1:
            raise OptionError(f"splat_points must be at least 1, not {self.splat_points}.", "splat_points")


@dataclass(frozen=True, eq=False)
class Exporter:
    """A workspace, where it lies on the map, and where its products go."""

    workspace: Workspace
    options: ExportOptions
    georeference: Georeference
    folder: Path

    @cached_property
    def cloud(self) -> Cloud:
        """The fused cloud, measured."""
        return measured_cloud(self.workspace)

    @cached_property
    def extent(self) -> "Extent":
        """Of the cloud, on the map."""
        # Here and below not before: laspy takes its time to load, and every command knows this module.
        from colmap_sph.products.clouds.las_points import extent_of

        return extent_of(self.cloud, self.georeference)

    @cached_property
    def thin_cloud(self) -> ThinCloud:
        """The cloud, thinned."""
        return thinned(self.cloud, self.options.splat_points)

    @cached_property
    def mapped(self) -> MappedScene:
        """The views that have maps."""
        return mapped_scene(self.workspace)

    def las(self, path: Path) -> None:
        """The cloud as LAS or LAZ."""
        from colmap_sph.products.clouds.las import write_las

        write_las(self.cloud, self.extent, self.georeference, path, scale=self.options.las_scale)

    def copc(self, path: Path) -> None:
        """The cloud as COPC."""
        from colmap_sph.products.clouds.copc import write_copc

        write_copc(self.cloud, self.extent, self.georeference, path, scale=self.options.las_scale)

    def exr(self, path: Path) -> None:
        """Depth maps as EXR."""
        write_exr(self.mapped, self.georeference, path)

    def png(self, path: Path) -> None:
        """Depth maps as PNG."""
        write_png(self.mapped, self.georeference, path)

    def npz(self, path: Path) -> None:
        """Depth and normal maps as NPZ."""
        write_npz(self.mapped, self.georeference, path)

    def nerfstudio(self, path: Path) -> None:
        """A folder for nerfstudio."""
        write_nerfstudio(self.mapped, self.thin_cloud, path)

    def splats(self, path: Path) -> None:
        """A folder for Gaussian splatting."""
        write_splats(self.workspace, self.thin_cloud, path)

    def mvsnet(self, path: Path) -> None:
        """A folder for MVSNet."""
        write_mvsnet(self.workspace, path)


_MAKERS: dict[ExportFormat, tuple[str, Callable[[Exporter, Path], None]]] = {
    "las": ("cloud.las", Exporter.las),
    "laz": ("cloud.laz", Exporter.las),
    "copc": ("cloud.copc.laz", Exporter.copc),
    "exr": ("depth_exr", Exporter.exr),
    "png": ("depth_png", Exporter.png),
    "npz": ("depth_npz", Exporter.npz),
    "nerfstudio": ("nerfstudio", Exporter.nerfstudio),
    "splats": ("splats", Exporter.splats),
    "mvsnet": ("mvsnet", Exporter.mvsnet),
}


def export(exporter: Exporter, status: Status, *, overwrite: bool = False) -> Sequence[Path]:
    """Make all formats that are asked for.

    Parameters
    ----------
    exporter : Exporter
    status : callable
    overwrite : bool
        Whether files of earlier exports are replaced.

    Returns
    -------
    sequence of Path
        What was made: a file or a folder for each format.

    Raises
    ------
    InputError, NoResultError
        The workspace lacks what is asked for.
    OptionError
        An option is out of its bounds.
    OutputError
        Something cannot be written, or is there already.
    """
    exporter.options.check()
    formats = list(dict.fromkeys(exporter.options.formats))
    paths = [exporter.folder / _MAKERS[each][0] for each in formats]
    check_no_input(exporter.workspace, exporter.folder)
    if exporter.folder.is_relative_to(exporter.workspace.root):
        check_ways_out(exporter.workspace.root, [exporter.folder], unlinked={exporter.folder})
    with alone_in(exporter.folder):
        for name, _ in _MAKERS.values():
            clear_leftovers(exporter.folder / name)
        for path in paths:
            if os.path.lexists(path) and not overwrite:
                raise OutputError(f"{path} is there already; give --overwrite, or another --output.")
        for each, path in zip(formats, paths, strict=True):
            with status(path):
                _MAKERS[each][1](exporter, path)
    return paths
