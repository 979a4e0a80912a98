"""Qualities of a run: named sets of options."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from colmap_sph.pipeline.options import RunOptions

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


def preset(quality: Quality) -> RunOptions:
    """The options of a quality.

    Examples
    --------
    >>> preset("preview").rectification.sampling
    0.5
    """
    options = RunOptions()
    for place, value in PRESETS[quality].items():
        stage, name = place.split(".")
        options = replace(options, **{stage: replace(getattr(options, stage), **{name: value})})
    return options
