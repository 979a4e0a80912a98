"""What a run tells while it works and when it is done."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from colmap_sph.pipeline.stages.facts import Agreement

Left = Literal["image", "pair", "incomplete"]
"""What is left out: an image, a pair of images, or something that an image has to do without for now."""


@dataclass(frozen=True)
class StageEstimate:
    """What a stage that is to come is expected to take.

    Attributes
    ----------
    name : str
    items : int
        Its steps.
    seconds : float
        Processor seconds of those that are to be made.
    item_seconds : float
        Of a step that is to be made, on average.
    """

    name: str
    items: int
    seconds: float
    item_seconds: float


class Progress(Protocol):
    """What the pipeline tells a progress display. Derive from `Silent` to hear some of it only."""

    def engage(self, threads: int, words: str) -> None:
        """Other machines work for the run, with so many threads; words about them, where they are new."""

    def foresee(self, stages: Sequence[StageEstimate]) -> None:
        """These stages are to come, and no others; told once pairs are selected, and again where that changes."""

    def start(self, stage: str, total: int) -> None:
        """A stage of `total` steps begins."""

    def advance(self, seconds: float = 0.0) -> None:
        """One step is done, which was expected to take that many processor seconds; 0: it was there already."""

    def leave_out(self, what: Left, name: str, reason: str) -> None:
        """Something is left out; may be told from any thread."""


class Silent:
    """A display that shows nothing."""

    def engage(self, threads: int, words: str) -> None:
        """Nothing."""

    def foresee(self, stages: Sequence[StageEstimate]) -> None:
        """Nothing."""

    def start(self, stage: str, total: int) -> None:
        """Nothing."""

    def advance(self, seconds: float = 0.0) -> None:
        """Nothing."""

    def leave_out(self, what: Left, name: str, reason: str) -> None:
        """Nothing."""


@dataclass
class RunReport:
    """What a run did.

    Attributes
    ----------
    started : float
        When the command began, as `time.monotonic` tells; not in ``report.json``.
    command : str
        What to type to do the same again.
    images : int
        Images with depth maps.
    skipped_images : dict
        Image name → why it has no depth map, or is not in the cloud.
    incomplete : dict
        Image name → what its results, or the cloud, had to do without for a reason that may pass, such as a file
        that could not be read. The next run makes them again.
    drawn_region : str
        Where a region was to be drawn: what was, and what it holds.
    stretched : str
        Which values became black and white in images of more than 8 bits, where these were changed.
    within : str
        Where a time was asked for: which, and what was chosen for it.
    detail : float or None
        Samples per pixel that hold what the images show, on average, see `image_detail`.
    sampling : float or None
        Rectified pixels per pixel at which pairs are therefore matched.
    still : str
        Where parts of images stand still while the camera turns: how much, and what that means.
    pair_source : str
        Where the pairs come from.
    pairs : int
        Pairs matched.
    matched_pairs : list of (str, str, float or None)
        Names of the images of each, and how far their rows disagree, pixels; None where too few ties tell.
    skipped_pairs : dict
        "left - right" → why the pair was not matched.
    polishing : str
        Where polished poses were asked for: what was done, or why not.
    pose_movement : dict
        Image name → how far polishing moved it, pixels (median over its points); empty without.
    row_residual : float or None
        How far the rows of rectified pairs disagree, pixels: the median of all pairs; None where no pair
        has enough ties to tell.
    row_residuals : dict
        Image name → the same of its pairs.
    until : {"cloud", "geometric", "photometric"}
        The last results that were asked for.
    region : dict or None
        Where a region was asked for: the ``box`` of its surfaces, ``polygons`` in it, and
        the ``axes`` along which these are counted, rows of a rotation, or null; model coordinates.
    in_region : dict
        Image name → share of its pixels that show the region; empty without one.
    out_of_region : dict
        Image name → why the region is not looked for in it, though it may see some of it.
    coverage : dict
        Image name → share of its pixels with a geometric depth (photometric, where these are the last results): of
        those that show the region, where one is asked for.
    originals : dict
        Fisheye image or panorama → share of what its lens shows that has a range; empty without any.
    views : dict
        Fisheye image or panorama → names of the views that were cut from it, by which it is called elsewhere.
    agreement : dict
        Image name → share of the sparse points it observes that agree with its geometric depth map; None where
        fewer than ten tell.
    overall_agreement : float or None
        The same of all images together.
    agreement_of_found : dict
        Image name → share of those sparse points that have a depth; None where these are fewer than thirty.
    sparse_points : Agreement
        The numbers behind it.
    doubts : str
        Which images agree with few sparse points, and what that means.
    imprecision : str
        Where rows of pairs disagree by more than pixels are worth: what that means, and what helps.
    refusal : str
        Where hardly any point agrees over all: why the results mean nothing.
    points : int
        Points of the fused cloud.
    tiles : int
        Its files, where it is in tiles; 0: it is in one.
    points_of : dict
        Image name → how many of them it made; empty where COLMAP fused.
    advice : str
        Where few points survived: which gate took them.
    made, reused : dict
        Stage → how many of its results this run worked out, and how many an earlier run had left ready.
    seconds : dict
        Stage → wall time.
    total_seconds : float
        Wall time from the start of the command until this report is written, before the page is made: more than
        the stages take.
    peak_memory : int
        Largest resident set of the process, or of a worker on another machine, bytes.
    """

    started: float = field(default_factory=time.monotonic)
    command: str = ""
    images: int = 0
    skipped_images: dict[str, str] = field(default_factory=dict)
    incomplete: dict[str, str] = field(default_factory=dict)
    drawn_region: str = ""
    stretched: str = ""
    within: str = ""
    detail: float | None = None
    sampling: float | None = None
    still: str = ""
    pair_source: str = ""
    pairs: int = 0
    matched_pairs: list[tuple[str, str, float | None]] = field(default_factory=list)
    skipped_pairs: dict[str, str] = field(default_factory=dict)
    polishing: str = ""
    pose_movement: dict[str, float] = field(default_factory=dict)
    row_residual: float | None = None
    row_residuals: dict[str, float] = field(default_factory=dict)
    until: str = "cloud"
    region: dict[str, list[Any] | None] | None = None
    in_region: dict[str, float] = field(default_factory=dict)
    out_of_region: dict[str, str] = field(default_factory=dict)
    coverage: dict[str, float] = field(default_factory=dict)
    originals: dict[str, float] = field(default_factory=dict)
    views: dict[str, list[str]] = field(default_factory=dict)
    agreement: dict[str, float | None] = field(default_factory=dict)
    agreement_of_found: dict[str, float | None] = field(default_factory=dict)
    overall_agreement: float | None = None
    sparse_points: Agreement = field(default_factory=Agreement)
    doubts: str = ""
    imprecision: str = ""
    refusal: str = ""
    points: int = 0
    tiles: int = 0
    points_of: dict[str, int] = field(default_factory=dict)
    advice: str = ""
    made: dict[str, int] = field(default_factory=dict)
    reused: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    total_seconds: float = 0.0
    peak_memory: int = 0
