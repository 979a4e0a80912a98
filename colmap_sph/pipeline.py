"""The whole main job: order of the stages, worker threads, and the report.

Stages talk through files in the workspace: disparity maps of pairs, photometric maps with their standard
deviations, geometric maps, the cloud.
"""

import itertools
import json
import logging
import resource
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_sph.depth import DepthEstimate, PairDisparity, check_depth, estimate_depth
from colmap_sph.errors import ColmapSphError, InputError, NoResultError, OptionError, OutputError
from colmap_sph.fusion import explain_losses, fuse
from colmap_sph.load_cache import LoadCache
from colmap_sph.masks import read_mask
from colmap_sph.matching import RectifiedImage, match_pair
from colmap_sph.normals import fit_normals
from colmap_sph.options import RunOptions
from colmap_sph.pair_files import read_arrays, read_pair, write_pair
from colmap_sph.pairs import select_pairs
from colmap_sph.rectification import RectifiedPair, Side, rectify_pair, resample
from colmap_sph.report import Progress, RunReport, Silent
from colmap_sph.scene import Scene, View, load_model, read_scene
from colmap_sph.undistortion import UndistortionOptions, leave_out_bad_images, open_workspace, prepare_workspace
from colmap_sph.workspace import (
    MapKind,
    SourceImages,
    Workspace,
    atomic_file,
    make_dir,
    read_patch_match_cfg,
    write_depth_map,
    write_fusion_cfg,
    write_normal_map,
)

logger = logging.getLogger(__name__)

T = TypeVar("T")

# Fewer points than this share of the pixels with a geometric depth calls for an explanation.
_FEW_POINTS = 0.02
_CACHE_BYTES = 512 << 20
# Errors that no other item of a stage would be spared.
_FATAL = (OptionError, OutputError)


def run(
    model: Path | str | None = None,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    output: Path | str | None = None,
    workspace: Path | str | None = None,
    options: RunOptions | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """From a sparse model, or a dense workspace, to depth maps, normal maps and a fused cloud.

    Parameters
    ----------
    model : Path, optional
        COLMAP sparse model; its images are undistorted into `output`.
    images : Path, optional
        Original images; found by COLMAP's usual layouts if not given.
    masks : Path, optional
        Folder of masks ``NAME.png``, black where image NAME is to be ignored: of the original images, or with
        `workspace` of the undistorted ones.
    output : Path, optional
        Dense workspace to create; "dense" beside the model's project if not given.
    workspace : Path, optional
        An existing dense workspace, instead of `model`, `images` and `output`.
    options : RunOptions, optional
    progress : Progress, optional

    Returns
    -------
    RunReport

    Raises
    ------
    ColmapSphError
        Bad input or options, unwritable output, or nothing to reconstruct.
    """
    options, report = options or RunOptions(), RunReport()
    progress = Silent() if progress is None else progress
    options.check()
    root = workspace_root(model, images=images, output=output, workspace=workspace)
    masks = None if masks is None else Path(masks)
    if model is None:
        if options.undistortion != UndistortionOptions():
            raise OptionError("--workspace holds undistorted images; leave out --max-image-size.")
        with _stage(report, progress, "undistort", 1):
            dense = open_workspace(root, masks)
            progress.advance()
        return reconstruct(dense, options, progress=progress, report=report)
    model = Path(model)
    with _stage(report, progress, "undistort", 1):
        originals = None if images is None else Path(images)
        dense = prepare_workspace(model, originals, root, options.undistortion, masks)
        registered = load_model(model)
        names = [registered.image(image_id).name for image_id in registered.reg_image_ids()]
        progress.advance()
    return reconstruct(
        dense, options, progress=progress, report=report, database=find_database(model), expected=names
    )


def workspace_root(
    model: Path | str | None,
    *,
    images: Path | str | None,
    output: Path | str | None,
    workspace: Path | str | None,
) -> Path:
    """Folder of the dense workspace that `run` with these arguments works in; `OptionError` for contradictions."""
    if (model is None) == (workspace is None):
        raise OptionError("give either --model (a sparse model) or --workspace (a dense workspace), not both.")
    if workspace is not None:
        if output is not None or images is not None:
            raise OptionError("--workspace is complete in itself; leave out --images and --output.")
        return Path(workspace)
    assert model is not None
    if output is not None:
        return Path(output)
    project = Path(model).resolve()
    if project.name.isdigit():  # sparse/0, but not a project that is called 2024
        project = project.parent
    if project.name == "sparse":
        project = project.parent
    return project / "dense"


def find_database(model: Path) -> Path | None:
    """COLMAP's ``database.db`` beside or above the model, if there is one."""
    folders = [model, *model.resolve().parents[:2]]
    return next((f / "database.db" for f in folders if (f / "database.db").is_file()), None)


def reconstruct(
    workspace: Workspace,
    options: RunOptions,
    *,
    progress: Progress | None = None,
    report: RunReport | None = None,
    database: Path | None = None,
    expected: Iterable[str] = (),
) -> RunReport:
    """Match, fuse and check everything in a dense workspace; see `run`.

    Images whose names are `expected` and which the workspace does not have are reported as skipped.
    """
    progress, report = Silent() if progress is None else progress, report or RunReport()
    make_dir(workspace.state_dir)
    with _one_opencv_thread():
        whole = read_scene(workspace.sparse_dir)
        scene = leave_out_bad_images(whole, workspace)
        for name in sorted({*expected, *whole.index_of} - scene.index_of.keys()):
            report.skipped_images[name] = "its image is missing, damaged or not of its camera's size; see the log"
        with _stage(report, progress, "select pairs", 1):
            selection = select_pairs(
                scene,
                options.pairs,
                explicit=_written_pairs(workspace),
                database=database,
            )
            report.pair_source = selection.source
            progress.advance()
        wanted = {*selection.pairs, *itertools.chain(*selection.unique_pairs())}
        scene = replace(scene, views=tuple(view for view in scene.views if view.name in wanted))
        pairs = match_pairs(workspace, scene, selection.unique_pairs(), options, progress, report)
        partners = _partners(pairs)
        estimate_views(workspace, scene, partners, options, progress, report)
        check_views(workspace, scene, partners, options, progress, report)
    return fuse_views(workspace, scene, partners, options, progress, report)


# ---- stages -------------------------------------------------------------------------------------------------


def match_pairs(
    workspace: Workspace,
    scene: Scene,
    pairs: Sequence[tuple[str, str]],
    options: RunOptions,
    progress: Progress,
    report: RunReport,
) -> list[tuple[str, str]]:
    """Rectify and match pairs of image names, each once.

    Writes their disparity maps; returns the pairs that could be matched.
    """
    make_dir(_pairs_dir(workspace))
    images = LoadCache(lambda name: _read_grey(workspace, name), lambda image: image.nbytes, _CACHE_BYTES)
    masks = LoadCache(
        lambda name: _read_mask(workspace, scene.view(name)), lambda m: 0 if m is None else m.nbytes, _CACHE_BYTES
    )

    def rectified(view: View, geometry: RectifiedPair, side: Side) -> RectifiedImage:
        image, mask = images.get(view.name), masks.get(view.name)
        return RectifiedImage(*resample(image, view, geometry, side, mask=mask))

    def work(pair: tuple[str, str]) -> tuple[str, str]:
        left, right = (scene.view(name) for name in pair)
        geometry = rectify_pair(scene, left, right, options.rectification)
        disparity = match_pair(
            rectified(left, geometry, "left"),
            rectified(right, geometry, "right"),
            geometry.min_disparity,
            geometry.max_disparity,
            options.matching,
        )
        write_pair(
            _pair_path(workspace, left.name, right.name, scene),
            PairDisparity(left.name, right.name, geometry, disparity),
        )
        return pair

    def skip(pair: tuple[str, str], error: ColmapSphError) -> None:
        report.skipped_pairs[" - ".join(pair)] = str(error)
        logger.warning("%s - %s skipped: %s", *pair, error)

    with _stage(report, progress, "match pairs", len(pairs)):
        matched = _for_all(work, pairs, options.num_threads, progress, skip)
    if not matched:
        reason = next(iter(report.skipped_pairs.values()), "no pair")
        raise NoResultError(f"None of the {len(pairs)} pairs could be matched ({reason}).")
    report.pairs = len(matched)
    return sorted(matched)


def estimate_views(
    workspace: Workspace,
    scene: Scene,
    partners: dict[str, list[str]],
    options: RunOptions,
    progress: Progress,
    report: RunReport,
) -> None:
    """Vote the photometric depth of every view; writes depth, normal and sigma maps."""
    workspace.create_stereo_dirs(view.name for view in scene.views)
    for view in scene.views:
        make_dir(_sigma_path(workspace, view.name).parent)

    def work(view: View) -> None:
        files = (_pair_path(workspace, view.name, other, scene) for other in partners.get(view.name, []))
        estimate = estimate_depth(view, (read_pair(file) for file in files), options.depth)
        mask = _read_mask(workspace, view)
        if mask is not None:
            # A pixel next to the rim can see a neighbour's disparity. Fusion leaves out what has no depth.
            estimate.depth[mask == 0] = 0
        _write_maps(workspace, view, estimate, "photometric", options)
        with atomic_file(_sigma_path(workspace, view.name)) as file:
            np.savez(file, depth=estimate.depth, sigma=estimate.sigma, support=estimate.support)

    with _stage(report, progress, "estimate depth", len(scene.views)):
        _for_all(work, scene.views, options.num_threads, progress)


def check_views(
    workspace: Workspace,
    scene: Scene,
    partners: dict[str, list[str]],
    options: RunOptions,
    progress: Progress,
    report: RunReport,
) -> None:
    """Check every view's depth against its partners'; writes the geometric depth and normal maps."""
    estimates = LoadCache(lambda name: _read_estimate(workspace, name), lambda e: 9 * e.depth.size, _CACHE_BYTES)

    def work(view: View) -> None:
        names = partners.get(view.name, [])
        others = ((scene.view(name), estimates.get(name)) for name in names)
        # As in COLMAP, no more views need to confirm a depth than there are.
        depth_options = replace(options.depth, min_consistent=min(options.depth.min_consistent, len(names)))
        checked = check_depth(view, estimates.get(view.name), others, depth_options)
        depth = _write_maps(workspace, view, checked, "geometric", options)
        report.coverage[view.name] = float((depth > 0).mean())

    with _stage(report, progress, "check consistency", len(scene.views)):
        _for_all(work, scene.views, options.num_threads, progress)
    report.coverage = dict(sorted(report.coverage.items()))
    report.images = sum(share > 0 for share in report.coverage.values())
    for view in scene.views:
        if report.coverage[view.name] == 0:
            known = "no depth of it is confirmed by another image"
            report.skipped_images[view.name] = known if view.name in partners else "no pair of it could be matched"
    if not report.images:
        raise NoResultError(
            "No depth was confirmed by a second image; are the model's poses right for these images?"
        )


def fuse_views(
    workspace: Workspace,
    scene: Scene,
    partners: dict[str, list[str]],
    options: RunOptions,
    progress: Progress,
    report: RunReport,
) -> RunReport:
    """Fuse the maps into the cloud; writes ``fused.ply``, ``fused.ply.vis`` and the report."""
    names = [view.name for view in scene.views if report.coverage.get(view.name, 0) > 0]
    write_fusion_cfg(workspace.fusion_cfg_path, names)
    kind = options.fusion_input
    tracked = any(len(view.point_indices) for view in scene.views)
    with _stage(report, progress, "fuse", 1):
        report.points = fuse(
            workspace,
            options.fusion,
            threads=options.num_threads,
            kind=kind,
            partners=None if tracked else partners,
        )
        progress.advance()
    pixels = sum(report.coverage[view.name] * view.width * view.height for view in scene.views)
    if report.points < _FEW_POINTS * pixels:
        report.advice = explain_losses(workspace, scene, options.fusion, kind=kind).sentence()
        logger.warning("Only %d points survived fusion. %s", report.points, report.advice)
    report.peak_memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )
    with atomic_file(workspace.state_dir / "report.json") as file:
        file.write(json.dumps({"options": asdict(options), **asdict(report)}, indent=1, default=str).encode())
    if not report.points:
        raise NoResultError(f"No point survived fusion. {report.advice}")
    return report


# ---- helpers ------------------------------------------------------------------------------------------------


@contextmanager
def _stage(report: RunReport, progress: Progress, name: str, total: int) -> Iterator[None]:
    logger.info("%s (%d)", name.capitalize(), total)
    progress.start(name, total)
    start = time.perf_counter()
    yield
    report.seconds[name] = round(time.perf_counter() - start, 3)
    logger.info("%s: %.1f s", name.capitalize(), report.seconds[name])


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Our workers are the threads; OpenCV's own would fight them for the cores."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _for_all(
    work: Callable[[T], object],
    items: Iterable[T],
    threads: int,
    progress: Progress,
    skip: Callable[[T, ColmapSphError], None] | None = None,
) -> list:  # type: ignore[type-arg]
    """`work` on all items in worker threads; results in the items' order.

    An item that raises a `ColmapSphError` is handed to `skip` and has no result; any other error, a wrong option
    and an output that cannot be written end the stage.
    """
    lock = threading.Lock()
    with ThreadPoolExecutor(threads) as pool:
        futures: dict[Future[object], T] = {pool.submit(work, item): item for item in items}
        try:
            for future in as_completed(futures):
                error = future.exception()
                if error is not None:
                    if skip is None or not isinstance(error, ColmapSphError) or isinstance(error, _FATAL):
                        raise error
                    with lock:
                        skip(futures[future], error)
                progress.advance()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
        return [future.result() for future in futures if future.exception() is None]


def _partners(pairs: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    partners: dict[str, list[str]] = {}
    for left, right in pairs:
        partners.setdefault(left, []).append(right)
        partners.setdefault(right, []).append(left)
    return {name: sorted(others) for name, others in partners.items()}


def _written_pairs(workspace: Workspace) -> dict[str, SourceImages] | None:
    path = workspace.patch_match_cfg_path
    return read_patch_match_cfg(path) if path.exists() else None


def _pairs_dir(workspace: Workspace) -> Path:
    return workspace.state_dir / "pairs"


def _pair_path(workspace: Workspace, a: str, b: str, scene: Scene) -> Path:
    """File of a pair's disparity map: named by COLMAP's image ids, since names may hold anything."""
    low, high = sorted((scene.view(a).image_id, scene.view(b).image_id))
    return _pairs_dir(workspace) / f"{low:06d}-{high:06d}.npz"


def _sigma_path(workspace: Workspace, name: str) -> Path:
    return workspace.state_dir / "photometric" / f"{name}.npz"


def _read_grey(workspace: Workspace, name: str) -> NDArray[np.uint8]:
    path = workspace.image_path(name)
    # Undistorted images have their camera's orientation; an EXIF tag must not turn them.
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"{path} cannot be read as an image; undistort it again or remove it from the model.")
    return np.asarray(image, dtype=np.uint8)


def _read_mask(workspace: Workspace, view: View) -> NDArray[np.uint8] | None:
    return read_mask(workspace.mask_path(view.name), view.width, view.height)


def _read_estimate(workspace: Workspace, name: str) -> DepthEstimate:
    return DepthEstimate(**read_arrays(_sigma_path(workspace, name), ("depth", "sigma", "support")))


def _write_maps(
    workspace: Workspace, view: View, estimate: DepthEstimate, kind: MapKind, options: RunOptions
) -> NDArray[np.float32]:
    """Fit normals, write both maps, return the depth written (that of the fitted planes)."""
    normals, depth = fit_normals(view, estimate, options.normals)
    write_depth_map(workspace.depth_map_path(view.name, kind), depth)
    write_normal_map(workspace.normal_map_path(view.name, kind), normals)
    return depth
