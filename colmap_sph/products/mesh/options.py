"""Options of a mesh."""

import math
from dataclasses import dataclass
from typing import Literal

from colmap_sph.errors import OptionError

MeshFormat = Literal["ply", "glb", "obj"]


@dataclass(frozen=True)
class MeshOptions:
    """How a workspace becomes a mesh, and in which files."""

    method: Literal["tsdf", "poisson"] = "tsdf"
    """What it is made of. tsdf: the depth maps, averaged in voxels, by Open3D; poisson: the cloud, smooth, by
    COLMAP."""
    formats: tuple[MeshFormat, ...] = ("ply", "glb")
    """Files to write."""
    texture: bool = False
    """Give glb and obj pictures, of the images that see each triangle best, instead of the colours of corners."""
    voxel: float = 0.0
    """Side of a voxel of tsdf, or of poisson's finest cell, in units of the model; 0: what a pixel covers, the
    median over all maps, and twice that for poisson."""
    simplify: float = 1.0
    """Keep this share of the faces."""
    min_images: int = 1
    """So many depth maps must meet in a voxel of tsdf; their depths are confirmed by other images already."""
    trim: float = 8.0
    """Cut off where poisson has fewer than 2 to this power points in a cell; 0: a closed surface."""

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds."""
        if not (math.isfinite(self.voxel) and self.voxel >= 0):
            raise OptionError(f"voxel must be a positive number, or 0, not {self.voxel}.", "voxel")
        if not 0 < self.simplify <= 1:
            raise OptionError(f"simplify must lie between 0 and 1, not {self.simplify}.", "simplify")
        if self.min_images < 1:
            raise OptionError(f"min_images must be at least 1, not {self.min_images}.", "min_images")
        if not 0 <= self.trim <= 20:
            raise OptionError(f"trim must lie between 0 and 20, not {self.trim}.", "trim")
        if self.texture and not {"glb", "obj"} & set(self.formats):
            raise OptionError(
                "texture is for glb and obj, neither of which is among formats.", "texture", "formats"
            )
        if not self.formats:
            raise OptionError("formats must name at least one of ply, glb and obj.", "formats")
