"""COLMAP's commands: which of them this program does itself, and the others handed over to COLMAP."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from colmap_sph.errors import InputError
from colmap_sph.platforms.processes import become

OWN = ("patch_match_stereo", "stereo_fusion")
"""Those that this program does itself."""

OTHERS = frozenset(
    (
        "advancing_front_mesher",
        "automatic_reconstructor",
        "bundle_adjuster",
        "color_extractor",
        "database_cleaner",
        "database_creator",
        "database_merger",
        "delaunay_mesher",
        "exhaustive_matcher",
        "feature_extractor",
        "feature_importer",
        "geometric_verifier",
        "global_mapper",
        "gui",
        "guided_geometric_verifier",
        "help",
        "hierarchical_mapper",
        "image_deleter",
        "image_filterer",
        "image_rectifier",
        "image_registrator",
        "image_undistorter",
        "image_undistorter_standalone",
        "mapper",
        "matches_importer",
        "mesh_simplifier",
        "mesh_texturer",
        "model_aligner",
        "model_analyzer",
        "model_clusterer",
        "model_comparer",
        "model_converter",
        "model_cropper",
        "model_merger",
        "model_orientation_aligner",
        "model_splitter",
        "model_transformer",
        "point_filtering",
        "point_triangulator",
        "poisson_mesher",
        "pose_prior_mapper",
        "project_generator",
        "rig_bundle_adjuster",
        "rig_configurator",
        "rotation_averager",
        "sequential_matcher",
        "spatial_matcher",
        "transitive_matcher",
        "version",
        "view_graph_calibrator",
        "vocab_tree_builder",
        "vocab_tree_matcher",
        "vocab_tree_retriever",
    )
)
"""Those of COLMAP 3.8 to 4.2 that are handed over."""

# Programs that were tried: one called `colmap` may be this program, or a script that calls it.
_TRIED = "COLMAP_SPH_TRIED"


def is_colmap_command(name: str) -> bool:
    """Whether COLMAP has a command of this name."""
    return name in OWN or name in OTHERS


def is_handed_over(arguments: Sequence[str]) -> bool:
    """Whether a command line is for COLMAP."""
    return bool(arguments) and arguments[0] in OTHERS


def hand_over(arguments: Sequence[str]) -> None:
    """Become COLMAP, with these arguments.

    Raises
    ------
    InputError
        It is not there.
    """
    tried = [path for path in os.environ.get(_TRIED, "").split(os.pathsep) if path]
    colmap = _next_colmap(tried)
    if colmap is None:
        raise InputError(_not_there(arguments[0]))
    os.environ[_TRIED] = os.pathsep.join([*tried, colmap])
    try:
        become(colmap, ["colmap", *arguments])
    except OSError as error:
        raise InputError(f"{colmap} cannot be started ({error.strerror}); install COLMAP again.") from error


def _next_colmap(tried: Sequence[str]) -> str | None:
    """The first `colmap` on the path that was not tried."""
    for folder in os.get_exec_path():
        found = shutil.which("colmap", path=folder)
        if found is not None and str(Path(found).absolute()) not in tried:
            return str(Path(found).absolute())
    return None


def _not_there(command: str) -> str:
    words = (
        f"{command} is a command of COLMAP, which is not installed (no program `colmap` on the PATH); "
        "install it, for example by `sudo apt install colmap`"
    )
    if command == "image_undistorter":
        words += ", or give the sparse model to `colmap_sph run --model`, which undistorts its images itself"
    return f"{words}."
