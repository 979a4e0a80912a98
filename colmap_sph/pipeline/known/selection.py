"""The partners of all images as they were chosen, kept for the next run with the same scene and options."""

from math import isnan, nan
from pathlib import Path
from typing import Any

import msgspec

from colmap_sph.pipeline.known.kept import read_kept, write_kept
from colmap_sph.stereo.partners.pairs import PairSelection, PairSource, Partner


class _Selection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    source: PairSource
    partners: dict[str, list[tuple[str, int, float | None]]]


def read_selection(path: Path, key: str) -> PairSelection | None:
    """Read what `write_selection` wrote under this key; None where the file holds anything else."""
    found = read_kept(path, key, _Selection)
    if found is None:
        return None
    partners = {
        name: tuple(Partner(other, shared, nan if angle is None else angle) for other, shared, angle in others)
        for name, others in found.partners.items()
    }
    return PairSelection(partners, found.source)


def write_selection(path: Path, key: str, selection: PairSelection) -> None:
    """Keep a selection; `OutputError` where that fails."""
    partners: dict[str, Any] = {
        name: [(each.name, each.shared_points, None if isnan(each.angle) else each.angle) for each in others]
        for name, others in selection.partners.items()
    }
    write_kept(path, key, _Selection(selection.source, partners))
