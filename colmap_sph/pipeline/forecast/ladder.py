"""What a run does with its time: settings from the quickest to the best, and what they are worth.

The settings are those that gave the most for their time on several scenes, see docs/usage.md.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from colmap_sph.pipeline.forecast.time_limit import format_time
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.presets import preset
from colmap_sph.stereo.normals import NormalOptions


@dataclass(frozen=True)
class Settings:
    """The options that cost most time, and bring most.

    Attributes
    ----------
    sampling : float
        `--rectification.sampling`.
    partners : int
        `--num-pairs`.
    rounds : int
        `--refinement.rounds`.
    radius : int
        `--normals.radius`.
    """

    sampling: float
    partners: int
    rounds: int
    radius: int = NormalOptions().radius

    @classmethod
    def of(cls, options: RunOptions) -> "Settings":
        """Those of options."""
        return cls(
            options.rectification.sampling,
            options.pairs.num_pairs,
            options.refinement.rounds,
            options.normals.radius,
        )

    def applied(self, options: RunOptions) -> RunOptions:
        """The options with these settings."""
        return replace(
            options,
            rectification=replace(options.rectification, sampling=self.sampling),
            pairs=replace(options.pairs, num_pairs=self.partners),
            refinement=replace(options.refinement, rounds=self.rounds),
            normals=replace(options.normals, radius=self.radius),
        )

    @property
    def flags(self) -> str:
        """What to type for them."""
        return " ".join(self.words())

    def words(self, kept: Collection[str] = ()) -> list[str]:
        """What to type for them, less for options that are given already."""
        values = {
            "pairs.num_pairs": ("--num-pairs", self.partners),
            "rectification.sampling": ("--rectification.sampling", self.sampling),
            "refinement.rounds": ("--refinement.rounds", self.rounds),
            "normals.radius": ("--normals.radius", self.radius),
        }
        return [str(word) for place, words in values.items() if place not in kept for word in words]


NORMAL = Settings.of(RunOptions())
BEST = Settings.of(preset("best"))
QUICK_RADIUS = 2
"""Of the windows in which normals are fitted, where time is short: they are noisier, and the cloud as good."""

LADDER: tuple[Settings, ...] = (
    Settings(0.35, 2, 0, QUICK_RADIUS),
    Settings(0.35, 3, 0, QUICK_RADIUS),
    Settings(0.5, 3, 0, QUICK_RADIUS),
    Settings(0.5, 3, 1, QUICK_RADIUS),
    Settings(0.5, 4, 1, QUICK_RADIUS),
    Settings(0.6, 4, 1, QUICK_RADIUS),
    Settings(0.7, 4, 1),
    Settings(0.7, 5, 2),
    Settings(0.85, 5, 2),
    Settings(0.85, 6, 2),
    Settings(1.0, 6, 2),
    Settings(1.0, 8, 2),
    NORMAL,
    Settings(1.15, 12, 2),
    BEST,
)
"""From the quickest to the best."""


_MEASURED: dict[Settings, tuple[int, int]] = {
    Settings(0.35, 2, 0, QUICK_RADIUS): (81, 79),
    Settings(0.5, 3, 0, QUICK_RADIUS): (86, 88),
    Settings(0.5, 3, 1, QUICK_RADIUS): (86, 91),
    Settings(0.7, 4, 1): (89, 94),
    Settings(0.7, 5, 2): (90, 94),
    Settings(0.7, 8, 2): (91, 94),
    Settings(1.0, 4, 2): (88, 95),
    Settings(1.0, 6, 2): (90, 96),
    NORMAL: (91, 96),
}
"""Of some settings coverage of the maps and F-score of the cloud at two pixels on the ground, both in percent, on
an aerial block of 33 images."""


def worth_of(settings: Settings) -> str:
    """What settings cost in quality, in a sentence: by the best that were measured and are better in nothing."""
    known = [
        worth
        for each, worth in _MEASURED.items()
        if each.sampling <= settings.sampling
        and each.partners <= settings.partners
        and each.rounds <= settings.rounds
        and each.radius <= settings.radius
    ]
    coverage, score = max(known, key=sum, default=_MEASURED[LADDER[0]])
    if (coverage, score) == _MEASURED[NORMAL]:
        return "That is normal quality or better."
    usual_coverage, usual_score = _MEASURED[NORMAL]
    return (
        f"What that costs, measured on an aerial block: maps cover {coverage} % (with normal quality "
        f"{usual_coverage} %), and the cloud's F-score at two pixels on the ground is {score} % ({usual_score} %)."
    )


def choices(options: RunOptions, kept: Collection[str]) -> Sequence[Settings]:
    """The ladder for a run, with what the user chose in each of its settings.

    Parameters
    ----------
    options : RunOptions
    kept : collection of str
        Options that stay as they are, see `DIALS`.
    """
    given = Settings.of(options)
    fixed = {
        field: getattr(given, field)
        for field, place in (
            ("sampling", "rectification.sampling"),
            ("partners", "pairs.num_pairs"),
            ("rounds", "refinement.rounds"),
            ("radius", "normals.radius"),
        )
        if place in kept
    }
    return list(dict.fromkeys(replace(each, **fixed) for each in LADDER))


@dataclass(frozen=True)
class Choice:
    """What is chosen for a time.

    Attributes
    ----------
    settings : Settings
    asked : float
        Seconds.
    expected : float
        Estimated seconds of the whole run, what has passed of it already among them.
    is_reduced : bool
        Whether images were reduced for it: what settings are worth was measured with whole ones.
    """

    settings: Settings
    asked: float
    expected: float
    is_reduced: bool = False

    @property
    def is_too_little(self) -> bool:
        """Whether the time is less than what the quickest settings take."""
        return self.expected > self.asked

    @property
    def words(self) -> str:
        """What is chosen and what it costs, in sentences."""
        asked, expected = format_time(self.asked), format_time(self.expected)
        worth = "" if self.is_reduced else worth_of(self.settings)
        if self.is_too_little:
            return (
                f"{asked} is too little: the run takes about {expected} even with {self.settings.flags}. It goes "
                f"on with these; a smaller --max-image-size would be faster. {worth}"
            ).rstrip()
        if self.settings == BEST:
            return f"{asked} is enough for the best quality, which takes about {expected}: {self.settings.flags}."
        return f"Chosen for {asked}: {self.settings.flags}, about {expected}. {worth}".rstrip()
