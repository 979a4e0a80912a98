"""The options of COLMAP's `patch_match_stereo` and `stereo_fusion`: names, defaults, and what they do here."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Value = bool | int | float | str


@dataclass(frozen=True)
class ColmapOption:
    """An option of a command.

    Attributes
    ----------
    name : str
        As in COLMAP's classes; with a section in front it is what is typed.
    default : bool, int, float or str
        COLMAP's; its type is that of the values.
    text : str
        What it does here.
    target : str
        The option of ours that it sets, by its place in `RunOptions`; empty where a command reads it itself.
    acts : bool
        Whether it has an effect.
    """

    name: str
    default: Value
    text: str
    target: str = ""
    acts: bool = True


def _idle(name: str, default: Value, text: str) -> ColmapOption:
    return ColmapOption(name, default, text, acts=False)


_PATCHES = "there are no patches and no samples here: pairs are matched by census and semi-global matching"
_CACHE = "what is kept in memory follows from what is free"

PATCH_MATCH_STEREO = (
    ColmapOption(
        "max_image_size", -1, "images are reduced to it when they are read, and so are the maps", "undistortion."
    ),
    _idle("gpu_index", "-1", "no GPU is used"),
    ColmapOption("depth_min", -1.0, "least depth to look for; with depth_max", "rectification.min_depth"),
    ColmapOption("depth_max", -1.0, "largest depth", "rectification.max_depth"),
    _idle("window_radius", 5, _PATCHES),
    _idle("window_step", 1, _PATCHES),
    _idle("sigma_spatial", -1.0, _PATCHES),
    _idle("sigma_color", 0.2, _PATCHES),
    _idle("num_samples", 15, _PATCHES),
    _idle("ncc_sigma", 0.6, _PATCHES),
    ColmapOption(
        "min_triangulation_angle", 1.0, "least parallax of a pair, degrees", "pairs.min_triangulation_angle"
    ),
    _idle("incident_angle_sigma", 0.9, _PATCHES),
    _idle("num_iterations", 5, _PATCHES),
    ColmapOption("geom_consistency", True, "false: photometric maps only; true: geometric ones, too"),
    _idle("geom_consistency_regularizer", 0.3, "images confirm each other's depth after matching, not during it"),
    _idle("geom_consistency_max_cost", 3.0, "images confirm each other's depth after matching, not during it"),
    _idle("filter", True, "what no other image confirms is always left out of the geometric maps"),
    _idle("filter_min_ncc", 0.1, _PATCHES),
    _idle(
        "filter_min_triangulation_angle",
        3.0,
        "depth with little parallax has a large standard deviation",
    ),
    ColmapOption(
        "filter_min_num_consistent", 2, "images that must confirm a geometric depth", "confirm.min_consistent"
    ),
    ColmapOption(
        "filter_geom_consistency_max_cost",
        1.0,
        "depths of two images agree when the point projects back within so many pixels; 2 where it is not given",
        "confirm.max_reprojection_error",
    ),
    _idle("cache_size", 32.0, _CACHE),
    ColmapOption("allow_missing_files", False, "false: an image that is missing or damaged ends the command"),
    _idle("write_consistency_graph", False, "no consistency graphs are written"),
    ColmapOption("num_threads", -1, "worker threads; -1: all cores", "threads"),
)
"""`PatchMatchStereo.*`, `pycolmap.PatchMatchOptions`."""

STEREO_FUSION = (
    ColmapOption("mask_path", "", "folder of masks, black = left out of the cloud", "fusion.mask_path"),
    ColmapOption("num_threads", -1, "worker threads; -1: all cores", "threads"),
    ColmapOption("max_image_size", -1, "larger maps are reduced to it", "undistortion."),
    ColmapOption("min_num_pixels", 5, "images that must agree on a point; 2 where it is not given", "fusion."),
    _idle("max_num_pixels", 10000, "a point is made of one pixel"),
    _idle("max_traversal_depth", 100, "a point is made of one pixel"),
    ColmapOption(
        "max_reproj_error",
        2.0,
        "how near to a finer image's pixel a pixel makes no point of its own; 0.35 where it is not given",
        "fusion.",
    ),
    ColmapOption("max_depth_error", 0.01, "largest relative difference of depths that agree", "fusion."),
    ColmapOption(
        "max_normal_error", 10.0, "largest angle of normals that agree; 30 where it is not given", "fusion."
    ),
    ColmapOption("check_num_images", 50, "images to look for agreement in, 64 at most", "fusion."),
    _idle("cache_size", 32.0, _CACHE),
    _idle("use_cache", False, _CACHE),
)
"""`StereoFusion.*`, `pycolmap.StereoFusionOptions` but for its bounding box."""

_COMMON = (
    ColmapOption("workspace_path", "", "the dense workspace, as image_undistorter makes it"),
    ColmapOption("workspace_format", "COLMAP", "COLMAP"),
    _idle("pmvs_option_name", "option-all", "for workspaces of PMVS"),
)
_RUNTIME = (
    _idle("default_random_seed", 0, "nothing is random here"),
    _idle("random_seed", 0, "nothing is random here"),
    *(
        _idle(name, default, "messages go to the standard error stream, and the log to colmap_sph/log.txt")
        for name, default in (
            ("log_target", "stderr_and_file"),
            ("log_path", ""),
            ("log_to_stderr", False),
            ("log_level", 0),
            ("log_severity", 0),
            ("log_color", True),
        )
    ),
)


@dataclass(frozen=True)
class ColmapCommand:
    """A command: its name, the section of its options, its options, and those without which it does not begin."""

    name: str
    section: str
    plain: tuple[ColmapOption, ...]
    sectioned: tuple[ColmapOption, ...]
    required: tuple[str, ...]

    def flags(self) -> dict[str, ColmapOption]:
        """All options by what is typed, less the two dashes."""
        return {option.name: option for option in (*self.plain, *_RUNTIME)} | {
            f"{self.section}.{option.name}": option for option in self.sectioned
        }


COMMANDS: Mapping[str, ColmapCommand] = {
    command.name: command
    for command in (
        ColmapCommand(
            "patch_match_stereo",
            "PatchMatchStereo",
            (*_COMMON, ColmapOption("config_path", "", "pairs to match, instead of stereo/patch-match.cfg")),
            PATCH_MATCH_STEREO,
            ("workspace_path",),
        ),
        ColmapCommand(
            "stereo_fusion",
            "StereoFusion",
            (
                *_COMMON,
                ColmapOption("input_type", "geometric", "geometric or photometric: which maps"),
                ColmapOption("output_type", "PLY", "PLY, or BIN or TXT: a model with tracks, in a folder"),
                ColmapOption("output_path", "", "where the cloud goes"),
                ColmapOption("bbox_path", "", "file of two corners, x y z and x y z: points outside are left out"),
            ),
            STEREO_FUSION,
            ("workspace_path", "output_path"),
        ),
    )
}


def differing(options: Any, table: tuple[ColmapOption, ...]) -> dict[str, Value]:
    """What an object of pycolmap's class sets, read by the names of attributes: what is not at COLMAP's default.

    Parameters
    ----------
    options : pycolmap.PatchMatchOptions, pycolmap.StereoFusionOptions, or any object with their attributes
    table : tuple of ColmapOption
    """
    chosen = {}
    for option in table:
        value = getattr(options, option.name)
        if isinstance(option.default, str):
            value = str(value) if str(value) != "." else ""  # what pycolmap makes of an empty path
        if not is_default(option, value):
            chosen[option.name] = value
    return chosen


def is_default(option: ColmapOption, value: Value) -> bool:
    """Whether a value is COLMAP's default, which is a 32-bit float for some."""
    if isinstance(option.default, float):
        return abs(float(value) - option.default) <= 1e-6 * abs(option.default)
    return value == option.default
