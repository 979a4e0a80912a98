"""``report.json`` and the records of the maps → what is known of the last run, and what of that is out of date."""

from collections.abc import Iterable
from typing import Annotated, Any, Literal, get_args

import msgspec
import numpy as np
from msgspec import Meta

from colmap_sph.project.state.ownership import map_place
from colmap_sph.project.state.records import read_json, read_record
from colmap_sph.project.workspace import MapKind, Workspace
from colmap_sph.scene import Region

_MAX_BYTES = 1 << 28
# As in COLMAP; what `--pairs.min-triangulation-angle` is where nobody asked for something else.
_USUAL_MIN_ANGLE = 1.0

# Numbers that are printed; nothing says that the file is this program's.
_MOST = 1e12
_MOST_CORNERS = 20_000
Positive = Annotated[float, Meta(ge=0, le=_MOST)]
Share = Annotated[float, Meta(ge=0, le=1)]
Count = Annotated[int, Meta(ge=0, le=int(_MOST))]
MatchedPair = tuple[str, str, Positive | None]
Coordinate = Annotated[float, Meta(ge=-_MOST, le=_MOST)]
Corner = tuple[Coordinate, Coordinate, Coordinate]
Ring = Annotated[list[tuple[Coordinate, Coordinate]], Meta(min_length=3, max_length=_MOST_CORNERS)]
Polygon = Annotated[list[Ring], Meta(min_length=1, max_length=_MOST_CORNERS)]


class RegionFacts(msgspec.Struct, frozen=True):
    """The region that a run worked on, in the model's coordinates; see `RunReport`."""

    box: tuple[Corner, Corner]
    polygons: Annotated[list[Polygon], Meta(max_length=_MOST_CORNERS)] = []
    axes: tuple[Corner, Corner, Corner] | None = None

    def as_region(self) -> Region:
        """The same in the words of the scene."""
        polygons = tuple(tuple(np.array(ring) for ring in rings) for rings in self.polygons)
        return Region(np.array(self.box), polygons, None if self.axes is None else np.array(self.axes))


class RunFacts(msgspec.Struct, frozen=True):
    """What the last run that came to its end said in ``report.json``; see `RunReport` for what is what."""

    command: str = ""
    versions: dict[str, str] = {}
    options: dict[str, Any] = {}
    images: Count = 0
    skipped_images: dict[str, str] = {}
    incomplete: dict[str, str] = {}
    drawn_region: str = ""
    stretched: str = ""
    pair_source: str = ""
    pairs: Count = 0
    matched_pairs: list[MatchedPair] = []
    skipped_pairs: dict[str, str] = {}
    polishing: str = ""
    row_residual: Positive | None = None
    row_residuals: dict[str, Positive] = {}
    until: Literal["cloud", "geometric", "photometric"] = "cloud"
    region: RegionFacts | None = None
    out_of_region: dict[str, str] = {}
    coverage: dict[str, Share] = {}
    originals: dict[str, Share] = {}
    views: dict[str, list[str]] = {}
    agreement: dict[str, Share | None] = {}
    overall_agreement: Share | None = None
    doubts: str = ""
    imprecision: str = ""
    still: str = ""
    refusal: str = ""
    points: Count = 0
    points_of: dict[str, Count] = {}
    advice: str = ""
    made: dict[str, Count] = {}
    reused: dict[str, Count] = {}
    seconds: dict[str, Positive] = {}
    total_seconds: Positive = 0.0
    peak_memory: Count = 0

    @property
    def last_maps(self) -> MapKind:
        """The kind of maps with which the run ended; others that are there are of another run."""
        return "photometric" if self.until == "photometric" else "geometric"

    def kinds_of(self, name: str) -> tuple[MapKind, ...]:
        """Kinds of maps of an image that may be of the run: none where its region was not looked for in it."""
        if self.region is not None and name not in self.coverage:
            return ()
        return ("photometric",) if self.until == "photometric" else get_args(MapKind)

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """What a user should know first: a word, and sentences."""
        told = [
            ("refused", self.refusal),
            ("disagreement", self.doubts),
            ("imprecise", self.imprecision),
            ("ignored", self.still),
            ("few points", self.advice),
        ]
        return [(word, sentences) for word, sentences in told if sentences]

    @property
    def min_angle(self) -> float:
        """Least parallax of a pair, degrees."""
        pairs = self.options.get("pairs")
        angle = pairs.get("min_triangulation_angle") if isinstance(pairs, dict) else None
        return float(angle) if isinstance(angle, int | float) else _USUAL_MIN_ANGLE


def read_run_facts(workspace: Workspace) -> RunFacts | None:
    """Read what is known of the last finished run; None where there was none, or its report cannot be read."""
    return read_json(workspace.report_path, RunFacts, max_bytes=_MAX_BYTES)


def changed_since(workspace: Workspace, facts: RunFacts, names: Iterable[str]) -> list[str]:
    """Those of the images `names` whose last maps are not those of which ``report.json`` tells.

    A run that was ended before its end has made some anew, and has not said so yet.
    """
    changed = []
    for name in names:
        coverage = facts.coverage.get(name)
        record = read_record(map_place(workspace, name, facts.last_maps).record)
        if coverage is not None and record is not None and record.facts.get("coverage", coverage) != coverage:
            changed.append(name)
    return changed
