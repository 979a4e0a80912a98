"""What `evaluate` can be asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from colmap_sph.errors import OptionError
from colmap_sph.platforms.processors import usable_cores

_DEFAULT_TAU_GSD = (1.0, 2.0, 4.0)
_DEFAULT_TAU_METRES = (0.05, 0.1, 0.2, 0.5)


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of `evaluate`. Lengths are in metres, that is in the unit of the reference."""

    tau: tuple[float, ...] = ()
    """Distances up to which a point counts as right: in GSD where `gsd` is given, else in metres.
    Default: 1 2 4 GSD, or 0.05 0.1 0.2 0.5 m."""
    gsd: float | None = None
    """Ground sampling distance in metres; makes `tau` count in GSD."""
    definition: Literal["points", "tanks-and-temples", "eth3d"] = "points"
    """How shares are counted. points: every point counts alike. tanks-and-temples: both clouds are first
    thinned to the centroids of voxels of τ/2. eth3d: mean of the shares per voxel of `voxel_size`."""
    voxel_size: float | None = None
    """Voxel edge of the eth3d definition, in metres. Default: the smallest τ."""
    distance_cap: float | None = None
    """Distances above this count as this in the mean and standard deviation (CloudCompare's -MAX_DIST), in
    metres. Default: no cap."""
    register: bool = True
    """Move the cloud onto the reference by ICP before measuring; the motion is reported. Against exact depth
    maps nothing is ever moved: the cameras already tie the two."""
    registration_distance: float | None = None
    """ICP pairs points up to this distance, in metres; larger misalignments must be removed beforehand.
    Default: five times the largest τ."""
    crop: Literal["auto", "box", "horizontal", "none"] = "auto"
    """Which points are judged: those inside the reference's bounding box, enlarged by the largest τ (box),
    those inside its extent in x and y (horizontal), or all (none). auto: horizontal for LAS/LAZ, whose z
    points up, none for exact depth maps, which know what they see, box for everything else."""
    reference_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Subtracted from the reference's coordinates: the offset of a local model from map coordinates."""
    truth_spacing: float | None = None
    """Spacing of the surface samples taken from meshes and exact depth maps, in metres. Default: a quarter of
    the smallest τ."""
    min_view_count: int = 3
    """With exact depth maps: only surface that so many of them see counts for completeness."""
    threads: int = 0
    """Threads for the nearest-neighbour search; 0: one per core. The results do not depend on it."""

    @property
    def taus(self) -> tuple[float, ...]:
        """Every τ in metres, ascending."""
        default = _DEFAULT_TAU_METRES if self.gsd is None else _DEFAULT_TAU_GSD
        scale = 1.0 if self.gsd is None else self.gsd
        return tuple(sorted(value * scale for value in self.tau or default))

    @property
    def max_pair_distance(self) -> float:
        """`registration_distance` with its default filled in."""
        return 5.0 * self.taus[-1] if self.registration_distance is None else self.registration_distance

    @property
    def sample_spacing(self) -> float:
        """`truth_spacing` with its default filled in."""
        return 0.25 * self.taus[0] if self.truth_spacing is None else self.truth_spacing

    @property
    def worker_count(self) -> int:
        """`threads` with its default filled in."""
        return self.threads or usable_cores()

    def check(self) -> None:
        """Raise `OptionError` for the first option out of its bounds."""
        for value in self.tau:
            _check_positive("tau", value)
        _check_positive("gsd", self.gsd)
        _check_positive("voxel_size", self.voxel_size)
        _check_positive("distance_cap", self.distance_cap)
        _check_positive("registration_distance", self.registration_distance)
        _check_positive("truth_spacing", self.truth_spacing)
        if self.definition not in ("points", "tanks-and-temples", "eth3d"):
            message = f"definition must be 'points', 'tanks-and-temples' or 'eth3d', not {self.definition!r}."
            raise OptionError(message, "definition")
        if self.crop not in ("auto", "box", "horizontal", "none"):
            message = f"crop must be 'auto', 'box', 'horizontal' or 'none', not {self.crop!r}."
            raise OptionError(message, "crop")
        if len(self.reference_shift) != 3 or not all(math.isfinite(value) for value in self.reference_shift):
            message = f"reference_shift must be three finite numbers x y z, not {self.reference_shift}."
            raise OptionError(message, "reference_shift")
        if self.min_view_count < 1:
            raise OptionError(f"min_view_count must be at least 1, not {self.min_view_count}.", "min_view_count")
        if self.threads < 0:
            raise OptionError(f"threads must be 0 (one per core) or more, not {self.threads}.", "threads")


def _check_positive(name: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise OptionError(f"{name} must be a positive number, not {value}.", name)
