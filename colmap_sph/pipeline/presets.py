"""Qualities of a run: named sets of options."""

from collections.abc import Mapping
from dataclasses import replace
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
