"""A view's depth and normal map on disk, vouched for by a record."""

import logging
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from colmap_sph.pipeline.stages.facts import Agreement, Facts
from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.state.ownership import Place, remove_place
from colmap_sph.project.state.records import (
    altered_files,
    begin,
    read_record,
    recorded_facts,
    vouch_when_on_disk,
    vouched_facts,
    whole_digests,
)

logger = logging.getLogger(__name__)

MAP_BYTES = 16.0
"""Bytes on disk per pixel, of a depth and a normal map."""


@dataclass(frozen=True)
class MapFacts:
    """What the record of maps says of them: see `Facts`, `Agreement`, and with which images it was matched."""

    coverage: Annotated[float, Meta(ge=0, le=1)]
    tested: Annotated[int, Meta(ge=0)]
    found: Annotated[int, Meta(ge=0)]
    agreeing: Annotated[int, Meta(ge=0)]
    in_region: Annotated[float, Meta(ge=0, le=1)] = 1.0
    partners: tuple[str, ...] = ()

    def as_facts(self) -> Facts:
        """The same as facts of a stage."""
        return Facts(self.coverage, self.in_region, Agreement(self.tested, self.found, self.agreeing))


@dataclass(frozen=True)
class MapFiles:
    """Where both maps of a view lie, and the record that vouches for them."""

    depth: Path
    normals: Path
    record: Path

    @property
    def paths(self) -> list[str]:
        """Paths of all three."""
        return [str(self.depth), str(self.normals), str(self.record)]

    def write(
        self,
        normals: NDArray[np.float32],
        depth: NDArray[np.float32],
        key: str,
        agreement: Agreement | None = None,
        *,
        partners: Sequence[str] = (),
        shown: int | None = None,
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
        partners : sequence of str
            Names of the images that the view was matched with.
        shown : int, optional
            Pixels that show the region, where one is asked for; see `count_shown`.

        Returns
        -------
        Facts
            Without those of other stages.
        """
        begin(self.record, [self.depth, self.normals], sync=False)
        digests = {self.depth: write_depth_map(self.depth, depth)}
        digests[self.normals] = write_normal_map(self.normals, normals)
        of_depth = Facts.of_map(int(np.count_nonzero(depth > 0)), depth.size, shown)
        facts = MapFacts(
            of_depth.coverage,
            **asdict(agreement or Agreement()),
            in_region=of_depth.in_region,
            partners=tuple(partners),
        )
        vouch_when_on_disk(self.record, key, digests, facts)
        return facts.as_facts()

    def facts(self, key: str) -> Facts | None:
        """What is known of the maps, or None where they must be made."""
        known = vouched_facts(self.record, key, [self.depth, self.normals], MapFacts)
        return None if known is None else known.as_facts()

    def are_outdated(self, key: str) -> bool:
        """Whether there are maps of ours that were made under another key."""
        record = read_record(self.record)
        if record is None or record.state != "done" or record.key == key:
            return False
        files = [path for path in (self.depth, self.normals) if os.path.lexists(path)]
        return not files or len(altered_files(record, files)) < len(files)

    def remove(self) -> None:
        """Remove maps that this program made, where there are any; those that others put there stay."""
        if os.path.lexists(self.record):
            for path in remove_place(Place(self.record, (self.depth, self.normals))):
                logger.warning("%s is not what this program wrote there; it stays", path)

    def partners(self) -> tuple[str, ...]:
        """Names of the images that the view was matched with, as far as that is known."""
        known = recorded_facts(self.record, MapFacts)
        return () if known is None else known.partners

    def digests(self) -> tuple[str, ...] | None:
        """Of the whole depth map and the whole normal map, as they were written; None of maps of others."""
        return whole_digests(self.record, 2)
