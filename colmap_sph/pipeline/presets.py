"""Qualities of a run: named sets of options."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, Literal

from colmap_sph.errors import OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.stereo.fusion import FusionOptions

Quality = Literal["preview", "normal", "best"]

# Chosen by measurement, see docs/usage.md. None changes the undistorted images, so that a workspace can go from
# one quality to another.
PRESETS: Mapping[Quality, Mapping[str, Any]] = {
    "preview": {
        "pairs.num_pairs": 3,
        "rectification.sampling": 0.5,
        "refinement.rounds": 0,
    },
    "normal": {},
    "best": {
        "pairs.num_pairs": 15,
        "rectification.sampling": 1.3,
        "fusion.max_reproj_error": 0.25,
    },
}
"""What each sets, by the options' place in the records; all others are as always."""


FusionMethod = Literal["best-pixel", "colmap"]


def values_of(quality: Quality, fusion_method: str = "best-pixel") -> dict[str, Any]:
    """What a quality sets, by the options' place, for runs that fuse by one method."""
    values = dict(PRESETS[quality])
    if fusion_method == "colmap":
        # COLMAP's fusion merges what is as near as this: with less it finds less that agrees.
        values.pop("fusion.max_reproj_error", None)
    return values


def preset(quality: Quality, *, fusion_method: FusionMethod = "best-pixel") -> RunOptions:
    """The options of a quality.

    Parameters
    ----------
    quality : {"preview", "normal", "best"}
    fusion_method : {"best-pixel", "colmap"}
        `FusionOptions.method` of the options, on which depends what the quality sets for fusion.

    Raises
    ------
    OptionError
        There is no such quality or method.

    Examples
    --------
    >>> preset("preview").rectification.sampling
    0.5
    """
    if quality not in PRESETS:
        raise OptionError(f"quality must be one of {', '.join(PRESETS)}, not {quality!r}.", "quality")
    options = RunOptions(fusion=FusionOptions(method=fusion_method))
    options.fusion.check()
    for place, value in values_of(quality, fusion_method).items():
        stage, name = place.split(".")
        options = replace(options, **{stage: replace(getattr(options, stage), **{name: value})})
    return options


def changed_options(options: RunOptions, *stages: str) -> list[str]:
    """Options of some stages that are not at their defaults, as they are typed: "--vote.tolerance 1.0".

    What a quality sets, where all of it is so, is told as this quality: "--quality preview".
    """
    chosen, usual = asdict(options), asdict(RunOptions())
    different = {
        f"{stage}.{name}": value
        for stage in stages
        for name, value in chosen[stage].items()
        if value != usual[stage][name]
    }
    changed = []
    for quality in PRESETS:
        values = values_of(quality, options.fusion.method)
        places = [place.split(".") for place in values]
        if values and all(chosen[stage][name] == values[f"{stage}.{name}"] for stage, name in places):
            changed.append(f"--quality {quality}")
            different = {place: value for place, value in different.items() if place not in values}
    return changed + [f"--{place.replace('_', '-')} {value}" for place, value in different.items()]
