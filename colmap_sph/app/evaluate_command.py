"""`colmap_sph evaluate`: clouds and a workspace's depth maps against LiDAR, a mesh, or exact depth maps.

The measuring is `colmap_sph.evaluation`'s, which reads no COLMAP model and no workspace; here are the files.
"""

import logging
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from colmap_sph.app.terminal import Terminal, output_width, print_result
from colmap_sph.errors import InputError, NoResultError, OptionError, OutputError
from colmap_sph.evaluation import (
    CloudScores,
    DepthMapScores,
    DepthView,
    EvaluationOptions,
    Reference,
    compare_depth_map,
    evaluate_cloud,
    format_clouds,
    format_depth_maps,
    make_reference,
    mean_of_depth_maps,
    read_geometry,
    truth_at_pixel_origin,
    truth_normals_at_pixel_origin,
    write_json,
)
from colmap_sph.evaluation.depth_files import DEPTH_ENDINGS, read_exact_depth
from colmap_sph.project.cameras import is_pinhole
from colmap_sph.project.map_files import is_map_there, read_depth_map, read_normal_map
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.workspace import MapKind, Workspace

logger = logging.getLogger(__name__)

_BEGIN = b'{\n  "reference": '
"""What every file of results begins with."""
_OTHER_UNIT = 3.0
"""Exact depth is so many times that of sparse points, of which the median may be hidden, in another unit alone."""
_SOME_VIEWS = 4
_FEWEST_POINTS = 30
_SAME_CAMERA = 1e-6
"""Largest relative difference of the calibrations of one camera in two files."""


@dataclass(frozen=True)
class EvaluateCommand:
    """Measure clouds against LiDAR or a mesh, or clouds and depth maps against exact depth.

    Prints accuracy, completeness and F-score for every --tau, and the mean distance to the reference as
    CloudCompare measures it. Clouds and meshes are PLY, OBJ, LAS or LAZ files, in metres, in one frame.
    """

    reference: Path
    """What is true: a cloud or mesh file, or a folder of exact depth maps, sampled at pixel centres and named as
    the images, with .png, .tif or .npy instead of, or after, the image's own ending; 0 = none."""
    clouds: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[CLOUD ...]")] = ()
    """Clouds to measure, such as dense/fused.ply; may be left out where --workspace is given."""
    model: Path | None = None
    """Sparse model with the cameras of the exact depth maps. Default: that of --workspace."""
    depth_scale: float | None = None
    """Metres (model units) of one unit of the exact depth maps. Must be given for integer maps; default for
    floating-point maps: 1."""
    workspace: Path | None = None
    """Dense workspace whose depth and normal maps are compared with the exact depth maps, too."""
    map_kind: MapKind = "geometric"
    """Which of the workspace's maps: those confirmed by other views, or the unchecked ones."""
    json: Path | None = None
    """File to write all results to, as JSON."""
    options: Annotated[EvaluationOptions, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = field(
        default_factory=EvaluationOptions
    )

    def check(self) -> None:
        """Raise `OptionError` for a value out of bounds or options that contradict each other, and
        `InputError` or `OutputError` for a path that is not there."""
        self.options.check()
        if not self.clouds and self.workspace is None:
            raise OptionError("give at least one cloud, or --workspace for its depth maps.")
        if self.depth_scale is not None and not 0 < self.depth_scale < float("inf"):
            raise OptionError(f"--depth-scale must be a positive number, not {self.depth_scale}.")
        if self.reference.is_dir():
            if self.model is None and self.workspace is None:
                raise OptionError("exact depth maps need --model, a sparse model with their cameras.")
        elif (self.model, self.depth_scale, self.workspace) != (None, None, None):
            raise OptionError(
                "--model, --depth-scale and --workspace go with a folder of exact depth maps as --reference, and "
                f"{self.reference} is not a folder; leave them out, or give that folder."
            )
        for cloud in self.clouds:
            if not cloud.is_file():
                lack = "is not a regular file" if cloud.exists() else "does not exist"
                raise InputError(f"The cloud {cloud} {lack}; check its path.")
        if self.json is not None:
            _check_target(self.json)
        for cloud in self.clouds:
            if self.reference.is_file() and cloud.samefile(self.reference):
                raise InputError(f"The cloud {cloud} is the reference itself; give another as --reference.")


def _check_target(path: Path) -> None:
    """Raise `OutputError` where results cannot go to a file, or would replace one that no evaluation wrote."""
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path} cannot be written: its folder does not exist; create it first.")
    if not path.exists():
        return
    if not path.is_file():
        raise OutputError(f"{path} cannot be written: it is not a regular file; name another.")
    with path.open("rb") as file:
        if file.read(len(_BEGIN)) not in (_BEGIN, b""):
            raise OutputError(f"{path} is there already, and no evaluation wrote it; name another for --json.")


def _tell_exchanged(command: EvaluateCommand) -> None:
    """Warn where a fused cloud is the reference of what is none: accuracy and completeness change their places."""
    fused = [path for path in (command.reference, *command.clouds) if path.with_name(f"{path.name}.vis").is_file()]
    if fused == [command.reference]:
        logger.warning(
            "The reference %s is a fused cloud (%s.vis is beside it), and what is measured by it is none; are the "
            "two exchanged?",
            command.reference,
            command.reference.name,
        )


def evaluate_command(command: EvaluateCommand, terminal: Terminal) -> int:
    """`colmap_sph evaluate`: tables on the standard output, JSON where asked for."""
    command.check()
    _tell_exchanged(command)
    views: list[DepthView] = []
    if command.reference.is_dir():
        model = command.model or Workspace(command.workspace or Path()).sparse_dir
        views = exact_depth_views(command.reference, model, command.depth_scale)
    depth_maps: dict[str, DepthMapScores] = {}
    if command.workspace is not None:
        with terminal.status(f"depth maps of {command.workspace}"):
            workspace = Workspace(command.workspace)
            depth_maps = score_depth_maps(workspace, views, kind=command.map_kind, gsd=command.options.gsd)
    clouds = _score_clouds(command, views, terminal)
    width = output_width()
    blocks = [format_clouds(clouds, width)] if clouds else []
    if depth_maps:
        gsd = "depth / focal length" if command.options.gsd is None else f"{command.options.gsd:g} m"
        title = f"{command.map_kind} depth maps of {command.workspace}; GSD = {gsd}"
        blocks.append(f"{title}\n\n{format_depth_maps(depth_maps, width)}")
    if command.json is not None:
        write_json(command.json, as_plain_values(command, clouds, depth_maps))
    print_result("\n\n".join(blocks))
    return 0


def _score_clouds(command: EvaluateCommand, views: list[DepthView], terminal: Terminal) -> list[CloudScores]:
    if not command.clouds:
        return []
    with terminal.status("reference"):
        truth = views or read_geometry(command.reference)
        reference: Reference = make_reference(truth, command.options)
    scores = []
    for path in command.clouds:
        with terminal.status(path):
            scores.append(evaluate_cloud(read_geometry(path), reference, command.options))
    return scores


def as_plain_values(
    command: EvaluateCommand, clouds: list[CloudScores], depth_maps: dict[str, DepthMapScores]
) -> dict[str, object]:
    """Put all results of an evaluation into what `write_json` can write.

    Parameters
    ----------
    command : EvaluateCommand
        What was asked for.
    clouds : list of CloudScores
    depth_maps : dict
        Image name → scores of its depth map; may be empty.

    Returns
    -------
    dict
        Plain values by name.
    """
    content: dict[str, object] = {
        "reference": str(command.reference),
        "clouds": [cloud.as_dict() for cloud in clouds],
    }
    if depth_maps:
        content["depth_maps"] = {
            "workspace": str(command.workspace),
            "kind": command.map_kind,
            "gsd_m": command.options.gsd,
            "mean": mean_of_depth_maps(depth_maps).as_dict(),
            "images": {name: scores.as_dict() for name, scores in depth_maps.items()},
        }
    return content


# ---- exact depth maps ---------------------------------------------------------------------------------------


def exact_depth_views(folder: Path, model_dir: Path, depth_scale: float | None = None) -> list[DepthView]:
    """The images of a model that have an exact depth map in a folder, by name.

    Parameters
    ----------
    folder : Path
        Depth maps at pixel centres, named as the images; sub-folders of image names are sub-folders here.
    model_dir : Path
        COLMAP model of undistorted images.
    depth_scale : float, optional
        Model units per unit of the depth maps; see `read_exact_depth`.

    Returns
    -------
    list of DepthView
        Each reads its file when asked. Images without a file are left out with a warning.

    Raises
    ------
    InputError
        No readable model, no depth map for any of its images, or a distorted camera.
    """
    model = load_model(model_dir)
    views = []
    missing = []
    for image in sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: str(image.name)):
        path = _depth_file(folder, image.name)
        pose = np.array(image.cam_from_world().matrix(), dtype=np.float64)
        if path is None or not np.isfinite(pose).all():
            missing.append(image.name)
            continue
        camera = model.camera(image.camera_id)
        if not is_pinhole(camera):
            raise InputError(
                f"{image.name} in {model_dir} has a distorted {camera.model_name} camera, and exact depth maps "
                "belong to undistorted images; give the model of these, such as dense/sparse."
            )
        shape = (int(camera.height), int(camera.width))
        read_depth = partial(read_exact_depth, path, shape=shape, depth_scale=depth_scale)
        K = np.array(camera.calibration_matrix(), dtype=np.float64)
        views.append(DepthView(image.name, K, pose[:, :3], pose[:, 3], read_depth))
    if not views:
        raise InputError(
            f"{folder} has no depth map for any of the {len(missing)} images of {model_dir}: "
            f"{Path(missing[0]).with_suffix('.png')} (or .tif, .npy) is expected for {missing[0]}."
        )
    if missing:
        total = len(views) + len(missing)
        logger.warning(
            "%d of %d images have no exact depth, such as %s; left out", len(missing), total, missing[0]
        )
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    _check_unit(folder, model_dir, points, views, depth_scale or 1.0)
    return views


def _check_unit(
    folder: Path, model_dir: Path, points: NDArray[np.float64], views: list[DepthView], depth_scale: float
) -> None:
    """Raise `InputError` where exact depth counts in another unit than the sparse points of its model, if any."""
    ratios = []
    for view in views[:: -(-len(views) // _SOME_VIEWS)]:
        exact = view.read_depth()
        homogeneous = (points @ view.R.T + view.t) @ view.K.T
        sparse = homogeneous[:, 2]
        in_front = sparse > 0
        columns, rows = np.floor(homogeneous[in_front, :2] / sparse[in_front, None]).T
        inside = (columns >= 0) & (columns < exact.shape[1]) & (rows >= 0) & (rows < exact.shape[0])
        seen = exact[rows[inside].astype(int), columns[inside].astype(int)]
        ratios.append((seen / sparse[in_front][inside])[seen > 0])
    found = np.concatenate(ratios)
    ratio = float(np.median(found)) if len(found) >= _FEWEST_POINTS else 1.0
    if not 1 / _OTHER_UNIT < ratio < _OTHER_UNIT:
        raise InputError(
            f"The exact depth maps in {folder} count in another unit than {model_dir}: at its sparse points they "
            f"are {ratio:.3g} times as deep; give --depth-scale {depth_scale / ratio:.2g}, or another --model."
        )


def _depth_file(folder: Path, name: str) -> Path | None:
    """The depth map of image `name`: its ending replaced or followed by that of a depth format."""
    stems = (Path(name).with_suffix(""), Path(name))
    candidates = (folder / f"{stem}{ending}" for stem in stems for ending in DEPTH_ENDINGS)
    return next((path for path in candidates if path.is_file()), None)


# ---- depth maps of a workspace ------------------------------------------------------------------------------


def score_depth_maps(
    workspace: Workspace, views: list[DepthView], *, kind: MapKind = "geometric", gsd: float | None = None
) -> dict[str, DepthMapScores]:
    """Compare a workspace's depth and normal maps with exact depth, at COLMAP's pixel origin.

    Parameters
    ----------
    workspace : Workspace
    views : list of DepthView
        Images with exact depth; those without a map in the workspace are left out with a warning.
    kind : {"geometric", "photometric"}
    gsd : float, optional
        Ground sampling distance, model units; None: of every pixel, its exact depth / focal length.

    Returns
    -------
    dict
        Image name → scores.

    Raises
    ------
    InputError
        No map for any view, a damaged map, or a camera that differs from that of the exact depth.
    """
    model = load_model(workspace.sparse_dir)
    cameras = {model.image(i).name: model.camera(model.image(i).camera_id) for i in model.reg_image_ids()}
    scores = {}
    for view in views:
        path = workspace.depth_map_path(view.name, kind)
        if view.name not in cameras or not is_map_there(path):
            logger.warning("%s has no %s depth map in %s; left out", view.name, kind, workspace.root)
            continue
        if not np.allclose(cameras[view.name].calibration_matrix(), view.K, rtol=_SAME_CAMERA):
            raise InputError(
                f"The camera of {view.name} in {workspace.sparse_dir} is not that of its exact depth map; "
                "give exact depth of the undistorted images."
            )
        try:
            scores[view.name] = _score_depth_map(workspace, view, kind, gsd)
        except NoResultError:
            logger.warning("%s: its exact depth map is empty; left out", view.name)
    if not scores:
        raise InputError(
            f"{workspace.root} has no {kind} depth map to compare with exact depth; run colmap_sph on it first."
        )
    return scores


def _score_depth_map(workspace: Workspace, view: DepthView, kind: MapKind, gsd: float | None) -> DepthMapScores:
    centre_depth = view.read_depth()
    truth = truth_at_pixel_origin(centre_depth)
    path, normal_path = (of(view.name, kind) for of in (workspace.depth_map_path, workspace.normal_map_path))
    depth = read_depth_map(path)
    if depth.shape != truth.shape:
        raise InputError(f"{path} has another size than its image; delete it and compute it again.")
    has_normals = is_map_there(normal_path)
    return compare_depth_map(
        depth,
        truth,
        gsd=truth / np.float32(view.K[0, 0]) if gsd is None else gsd,
        normals=read_normal_map(normal_path) if has_normals else None,
        truth_normals=truth_normals_at_pixel_origin(centre_depth, view.K) if has_normals else None,
    )
