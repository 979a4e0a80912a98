"""`stereo_fusion` in COLMAP's place: the maps of a dense workspace → a cloud at any path."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_sph.app.colmap.options import STEREO_FUSION, Value
from colmap_sph.app.colmap.settings import WrongOptionError, check_workspace, run_options, spelled_as_colmap
from colmap_sph.errors import InputError, reason_of
from colmap_sph.pipeline.fuse_maps import fuse_maps
from colmap_sph.pipeline.report import Progress, RunReport
from colmap_sph.project.cloud_output import CloudOutput
from colmap_sph.project.files import read_small
from colmap_sph.project.project import Project, open_workspace

_MAX_BOX_BYTES = 4096

Box = NDArray[np.float64]


def make_cloud(
    plain: Mapping[str, Value],
    chosen: Mapping[str, Value],
    *,
    box: Box | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Fuse the maps of a dense workspace.

    Parameters
    ----------
    plain : mapping of str to value
        Options without a section, by COLMAP's names.
    chosen : mapping of str to value
        Those of `StereoFusion` that the user chose; ours are at their own defaults otherwise.
    box : (2, 3) float64 ndarray, optional
        Least and most coordinates of the points that are wanted, where no file has them.
    progress : Progress, optional

    Returns
    -------
    RunReport
    """
    check_workspace(plain)
    output = output_of(plain)
    kind = str(plain["input_type"]).lower()
    if kind not in ("photometric", "geometric"):
        raise WrongOptionError(f"--input_type must be photometric or geometric, not {plain['input_type']!r}.")
    options = run_options(chosen, STEREO_FUSION, "StereoFusion", {"fusion.input": kind})
    if plain.get("bbox_path"):
        box = read_box(Path(str(plain["bbox_path"])))
    project = Project(workspace=Path(str(plain["workspace_path"])))
    project.check()
    workspace = open_workspace(project)
    with spelled_as_colmap(STEREO_FUSION, "StereoFusion"):
        return fuse_maps(workspace, output, options, box=box, progress=progress)


def output_of(plain: Mapping[str, Value]) -> CloudOutput:
    """Where the cloud goes, and as what."""
    kinds: dict[str, Literal["ply", "bin", "txt"]] = {"ply": "ply", "bin": "bin", "txt": "txt"}
    kind = kinds.get(str(plain["output_type"]).lower())
    if kind is None:
        raise WrongOptionError(f"--output_type must be PLY, BIN or TXT, not {plain['output_type']!r}.")
    return CloudOutput(Path(str(plain["output_path"])), kind)


def read_box(path: Path) -> Box:
    """Read a bounding box: six numbers, least x, y and z, and most; `InputError` for anything else."""
    try:
        words = read_small(path, _MAX_BOX_BYTES).decode().split()
        numbers = np.array([float(word) for word in words])
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"The box {path} cannot be read ({reason_of(error)}); check --bbox_path.") from None
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != 6 or np.isnan(numbers).any() or not (numbers[:3] < numbers[3:]).all():
        raise InputError(
            f"The bounding box {path} does not hold the least x y z and the largest x y z of a box; mend it."
        )
    return numbers.reshape(2, 3)
