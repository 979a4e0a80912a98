"""What a run would do and need, found without writing anything: ``colmap_sph run --dry-run``.

Which pairs and images are to do is exact, but for pairs that fail while they are matched. Time, memory and disk
are estimates, from pixel counts times the constants below.
"""

import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_sph.errors import ColmapSphError
from colmap_sph.pipeline.cloud_stage import COLMAP_FUSION_BYTES, FUSE_BYTES, MAPS_BYTES, cloud_state
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.reconstruct import check_arguments, choose_pairs, matches_for, wanted_scene
from colmap_sph.pipeline.stages import PairState, check_state, pair_state, vote_state
from colmap_sph.project.project import open_workspace
from colmap_sph.project.scene_reader import leave_out_bad_images, read_scene
from colmap_sph.project.undistortion import foresee_workspace
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.fusion import MAX_PARTNERS
from colmap_sph.stereo.pairs import Pair, overlapping_views, partners_of, select_pairs
from colmap_sph.stereo.rectification import rectify_pair

logger = logging.getLogger(__name__)

# Processor seconds per megapixel: measured on one core of a 2.5 GHz server with two scenes of 10 and 11 images of
# 0.1 to 0.4 megapixels, between which they differed by up to a third.
_UNDISTORT_SECONDS = 0.12  # of the original image
_MATCH_SECONDS = 0.14  # of both rectified images
_VOTE_SECONDS = 0.07  # of the image, per pair
_CHECK_SECONDS = 0.05  # of the image, per partner
_NORMALS_SECONDS = 0.25  # of the image, for each of its two kinds of maps
_REFINE_SECONDS = 0.13  # of the image, per partner in each round
_COLMAP_FUSE_SECONDS = 0.9
# With 33 images of 1.1 megapixels, each of which 32 others overlap.
_FUSE_SECONDS, _FUSE_PARTNER_SECONDS = 0.05, 0.011  # of the image, and per overlapping image
# Bytes per pixel on disk, measured at the same time.
_UNDISTORTED_BYTES = 1.0
_PAIR_BYTES = 2.0  # of the left rectified image
_ESTIMATE_BYTES = 9.0
_MAP_BYTES = 16.0  # depth and normals of one kind
_CLOUD_BYTES = 12.0
# Bytes in memory: of the libraries, per left rectified pixel and worker, and in COLMAP's fusion, for a moment,
# per width times squared height of one image.
_BASE_MEMORY = 200e6
_MATCH_MEMORY = 170.0
_FUSION_MASK_MEMORY = 0.1


@dataclass(frozen=True)
class Plan:
    """What a run would do, and what it would need.

    Attributes
    ----------
    undistort : bool
        Whether the undistorted images are to be made.
    pair_source : str
        Where the pairs come from.
    pairs, pairs_done : int
        Pairs of images, and those whose disparity map is there.
    images, images_done : int
        Images, and those whose maps are there.
    fuse : bool
        Whether the cloud is to be made.
    seconds : float
        Estimated wall time.
    memory, disk : float
        Estimated largest memory in use, and space for files to be made, in bytes.
    free_disk : int
        Free space where these go, bytes.
    """

    undistort: bool
    pair_source: str
    pairs: int
    pairs_done: int
    images: int
    images_done: int
    fuse: bool
    seconds: float
    memory: float
    disk: float
    free_disk: int


def make_plan(
    model: Path | str | None = None,
    *,
    images: Path | str | None = None,
    masks: Path | str | None = None,
    output: Path | str | None = None,
    workspace: Path | str | None = None,
    options: RunOptions | None = None,
    overwrite: bool = False,
) -> Plan:
    """Find what `pipeline.run` with these arguments would do; raises what it would raise before its first stage.

    Parameters
    ----------
    model, images, masks, output, workspace, options, overwrite
        As for `pipeline.run`.

    Returns
    -------
    Plan
    """
    options = options or RunOptions()
    project = check_arguments(
        model, images=images, masks=masks, output=output, workspace=workspace, options=options
    )
    root, database, foreseen = project.root, project.database(), None
    if project.model is None:
        dense = open_workspace(project)
    else:
        dense = Workspace(root)
        foreseen = foresee_workspace(project, options.undistortion, overwrite=overwrite)
    if foreseen is None:
        scene = leave_out_bad_images(anchored(read_scene(dense.sparse_dir)), dense)
        selection = choose_pairs(dense, scene, options, database)
    else:
        scene = anchored(foreseen.scene)
        selection = select_pairs(scene, options.pairs, matches=matches_for(scene, database))
    context = Context(dense, wanted_scene(scene, selection), options, Keys(dense, options))
    fresh = overwrite or foreseen is not None
    survey = _survey(context, selection.unique_pairs(), fresh=fresh)
    pixels = sum(view.width * view.height for view in context.scene.views)
    if foreseen is not None:
        survey.seconds += _UNDISTORT_SECONDS * foreseen.original_pixels / 1e6
        survey.disk += _UNDISTORTED_BYTES * pixels
    if survey.fuse:
        survey.seconds += _fuse_seconds(context)
        survey.disk += _CLOUD_BYTES * pixels
    return Plan(
        undistort=foreseen is not None,
        pair_source=selection.source,
        pairs=survey.pairs,
        pairs_done=survey.pairs_done,
        images=len(context.scene.views),
        images_done=survey.images_done,
        fuse=survey.fuse,
        seconds=survey.seconds / min(options.num_threads, len(os.sched_getaffinity(0))),
        memory=_memory(context, survey),
        disk=survey.disk,
        free_disk=shutil.disk_usage(next(path for path in (root, *root.absolute().parents) if path.exists())).free,
    )


@dataclass
class _Survey:
    """What is done and to do; processor seconds, and bytes on disk, of what is to do."""

    pairs: int = 0
    pairs_done: int = 0
    images_done: int = 0
    fuse: bool = True
    seconds: float = 0.0
    disk: float = 0.0
    largest_pair: int = 0


def _survey(context: Context, pairs: Sequence[Pair], *, fresh: bool) -> _Survey:
    """Ask for every result whether it is there; `fresh`: nothing is, nor are the images."""
    survey = _Survey()
    keys = _survey_pairs(context, pairs, survey, fresh=fresh)
    votes = _survey_votes(context, keys, survey)
    maps, coverage = {}, {}
    partners = partners_of(keys)
    for view in context.scene.views:
        names = partners.get(view.name, [])
        state = check_state(context, names, votes, view)
        maps[view.name], megapixels = state.key, view.width * view.height / 1e6
        if state.coverage is None:
            refined = context.options.refinement.images_used(len(names))
            seconds = _CHECK_SECONDS * len(names) + _REFINE_SECONDS * refined + _NORMALS_SECONDS
            survey.seconds += seconds * megapixels
            survey.disk += _MAP_BYTES * megapixels * 1e6
        else:
            coverage[view.name] = state.coverage
    survey.images_done = len(coverage)
    if len(coverage) == len(maps):
        survey.fuse = cloud_state(context, keys, maps, coverage).facts is None
    return survey


def _survey_pairs(context: Context, pairs: Sequence[Pair], survey: _Survey, *, fresh: bool) -> dict[Pair, str]:
    """Keys of the pairs that can be rectified."""
    keys: dict[Pair, str] = {}
    for pair in pairs:
        left, right = (context.scene.view(name) for name in pair)
        try:
            if fresh:  # a key would need the images
                state = PairState(
                    rectify_pair(context.scene, left, right, context.options.rectification), "", False
                )
            else:
                state = pair_state(context, pair)
        except ColmapSphError as error:
            logger.info("%s - %s: %s", *pair, error)
            continue
        keys[pair], geometry = state.key, state.geometry
        if state.is_done:
            survey.pairs_done += 1
            continue
        left_pixels = geometry.height * geometry.left_width
        survey.seconds += _MATCH_SECONDS * (left_pixels + geometry.height * geometry.right_width) / 1e6
        survey.disk += _PAIR_BYTES * left_pixels
        survey.largest_pair = max(survey.largest_pair, left_pixels)
    survey.pairs = len(keys)
    return keys


def _survey_votes(context: Context, keys: Mapping[Pair, str], survey: _Survey) -> dict[str, str]:
    votes = {}
    for view in context.scene.views:
        state = vote_state(context, keys, view)
        votes[view.name], megapixels = state.key, view.width * view.height / 1e6
        if not state.is_voted:
            num_pairs = sum(view.name in pair for pair in keys)
            survey.seconds += _VOTE_SECONDS * num_pairs * megapixels
            survey.disk += _ESTIMATE_BYTES * megapixels * 1e6
        if not state.is_done:
            survey.seconds += _NORMALS_SECONDS * megapixels
            survey.disk += _MAP_BYTES * megapixels * 1e6
    return votes


def _fuse_seconds(context: Context) -> float:
    scene, options = context.scene, context.options.fusion
    if options.method == "colmap":
        return _COLMAP_FUSE_SECONDS * sum(view.width * view.height for view in scene.views) / 1e6
    overlapping = overlapping_views(scene, min(options.check_num_images, MAX_PARTNERS))
    return sum(
        (_FUSE_SECONDS + _FUSE_PARTNER_SECONDS * len(overlapping[view.name])) * view.width * view.height / 1e6
        for view in scene.views
    )


def _memory(context: Context, survey: _Survey) -> float:
    threads, views = context.options.num_threads, context.scene.views
    most, options = context.options.memory_budget, context.options.fusion
    pixels = [view.width * view.height for view in views]
    matching = _MATCH_MEMORY * survey.largest_pair * min(threads, max(survey.pairs, 1))
    fusion = FUSE_BYTES * max(pixels) * min(threads, len(pixels)) + MAPS_BYTES * sum(pixels)
    if not survey.fuse:
        fusion = 0
    elif options.method == "colmap":
        fusion = COLMAP_FUSION_BYTES * sum(pixels)
        if options.use_cache:
            fusion = min(fusion, options.cache_size * 1e9)
        fusion += _FUSION_MASK_MEMORY * max(view.width * view.height**2 for view in views)
        # The budget bounds all but COLMAP's fusion.
        most = max(most, int(_BASE_MEMORY + fusion))
    return min(_BASE_MEMORY + max(matching, fusion), most)
