"""A view's depth and normal map on disk, vouched for by a record."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.pipeline.records import forget, vouch, vouched_facts
from colmap_sph.pipeline.stages.facts import Agreement, Facts
from colmap_sph.project.map_files import write_depth_map, write_normal_map

MAP_BYTES = 16.0
"""Bytes on disk per pixel, of a depth and a normal map."""


@dataclass(frozen=True)
class MapFiles:
    """Where both maps of a view lie, and the record that vouches for them."""

    depth: Path
    normals: Path
    record: Path

    def write(
        self,
        normals: NDArray[np.float32],
        depth: NDArray[np.float32],
        key: str,
        agreement: Agreement | None = None,
    ) -> Facts:
        """Write both maps.

        Parameters
        ----------
        normals, depth : (H, W, 3) and (H, W) float32 ndarray
            See `write_normal_map` and `write_depth_map`.
        key : str
            Under which they are vouched for.
        agreement : Agreement, optional
            Of the depth map with the sparse points.

        Returns
        -------
        Facts
            With the share of pixels with a depth, and the agreement.
        """
        forget(self.record)
        write_depth_map(self.depth, depth)
        write_normal_map(self.normals, normals)
        coverage = float((depth > 0).mean())
        agreement = agreement or Agreement()
        vouch(self.record, key, [self.depth, self.normals], coverage=coverage, **asdict(agreement))
        return Facts(coverage, agreement)

    def facts(self, key: str) -> Facts | None:
        """What is known of the maps, or None where they must be made."""
        known = vouched_facts(self.record, key, [self.depth, self.normals])
        if known is None:
            return None
        return Facts(known["coverage"], Agreement(known["tested"], known["found"], known["agreeing"]))
