"""Fusion as a step of its own: the maps of a dense workspace, whoever made them → a cloud at any path."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_sph.errors import InputError, NoResultError
from colmap_sph.pipeline.checks.contradictions import check_fusion
from colmap_sph.pipeline.context import Context, timed_stage
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import check_fusion_masks
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.report_files import make_page
from colmap_sph.pipeline.stages.fuse_to import FuseToStage
from colmap_sph.pipeline.stages.fusion_partners import PartnersInFusion
from colmap_sph.pipeline.stages.fusion_parts import index_in_model
from colmap_sph.pipeline.stages.selection import choose_pairs
from colmap_sph.pipeline.stages.view_maps import MapSources, views_beside
from colmap_sph.pipeline.workers import room_for_workers
from colmap_sph.project.claim import check_links, claimed
from colmap_sph.project.cloud_output import CloudOutput
from colmap_sph.project.map_files import depth_if_readable, has_depth, is_map_there, map_size
from colmap_sph.project.pair_lists import read_lines
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.ownership import map_place, named
from colmap_sph.project.state.records import altered_files, read_record, whole_digests
from colmap_sph.project.workspace import MapKind, Workspace, mask_path
from colmap_sph.scene import Region, Scene, View
from colmap_sph.stereo.agreement import check_some_maps
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.pairing import Pair, as_pair

logger = logging.getLogger(__name__)


def fuse_maps(
    workspace: Workspace,
    output: CloudOutput,
    options: RunOptions,
    *,
    region: Region | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Fuse the maps of a dense workspace.

    Parameters
    ----------
    workspace : Workspace
        With images, model, and maps of any program. Images that ``stereo/fusion.cfg`` lists are fused, where it is
        there, and all that have maps otherwise. Maps may have fewer pixels than their images.
    output : CloudOutput
    options : RunOptions
        Those of fusion, the threads and the memory count; maps with more pixels on a side than `max_image_size` of
        the undistortion are reduced.
    region : Region, optional
        Where points are wanted, in the model's frame.
    progress : Progress, optional

    Returns
    -------
    RunReport

    Raises
    ------
    ColmapSphError
        There are no maps, the cloud cannot be written, or no point survives.
    """
    options.check()
    check_links(workspace, is_given=True)
    output.check(workspace)
    progress = Silent() if progress is None else progress
    report = RunReport()
    given = read_scene(workspace.sparse_dir)
    mapped = _with_maps(workspace, given, _listed(workspace, given), options.fusion.input)
    check_some_maps(
        given,
        sorted(mapped),
        lambda name: depth_if_readable(workspace.depth_map_path(name, options.fusion.input)),
        maps=str(workspace.stereo_dir),
        model=str(workspace.sparse_dir),
    )
    with claimed(workspace), room_for_workers():
        scene = _at_map_sizes(given, mapped, options.undistortion.max_image_size)
        context = Context(workspace, scene, options, Keys(workspace, options), progress, report)
        check_fusion(context)
        check_fusion_masks(context)
        with timed_stage("select pairs", 1, progress, report):
            pairs = _pairs_of_maps(context, mapped) or choose_pairs(workspace, scene, options, None).unique_pairs()
            progress.advance()
        names = sorted(mapped)
        partners = PartnersInFusion(context, pairs, names)
        own_region = None if region is None else region.moved(-scene.origin - scene.anchor)
        stage = FuseToStage(context, partners, _sources(context, mapped), output, own_region)
        execute(stage)
        if stage.is_the_workspaces:
            make_page(context)
    report.images = len(names)
    if not report.points:
        raise NoResultError(
            "No point survived fusion: no image agrees with enough others on any piece of surface."
        )
    return report


def _pairs_of_maps(context: Context, mapped: Mapping[str, View]) -> list[Pair]:
    """The pairs by which this program made the maps; there may be files of others, matched with other options."""
    pairs: dict[Pair, None] = {}
    for name in mapped:
        files = context.map_files(name, context.options.fusion.input)
        if not altered_files(read_record(files.record), (files.depth, files.normals)):
            pairs |= dict.fromkeys(as_pair(name, other) for other in files.partners() if other in mapped)
    logger.info("Pairs of the maps: %d", len(pairs))
    return list(pairs)


def _listed(workspace: Workspace, scene: Scene) -> list[View]:
    """The views that the user's ``fusion.cfg`` lists; all where there is none."""
    path = workspace.fusion_cfg_path
    if not path.exists():
        return list(scene.views)
    views = []
    registered = scene.index_of
    for name in dict.fromkeys(filter(None, read_lines(path, "list the images in it"))):
        if name not in registered:
            raise InputError(f"{path} names {name!r}, which is not in the model; remove it.")
        views.append(scene.view(name))
    return views


def _with_maps(workspace: Workspace, scene: Scene, views: Sequence[View], kind: MapKind) -> dict[str, View]:
    """The views that have both maps, and any depth, with as many pixels as these."""
    mapped = {}
    missing = []
    empty = 0
    for view in views:
        depth, normals = map_place(workspace, view.name, kind).files
        if not (is_map_there(depth) and is_map_there(normals)):
            missing.append(depth)
        elif not has_depth(depth):
            empty += 1
        else:
            mapped[view.name] = _map_view(view, depth, normals)
    if missing and (mapped or empty):
        logger.warning("%s or the normals of it are missing: fused without", named(missing))
    if not mapped:
        raise InputError(_why_no_maps(workspace, views, kind, are_missing=bool(missing)))
    return mapped


def _why_no_maps(workspace: Workspace, views: Sequence[View], kind: MapKind, *, are_missing: bool) -> str:
    if not views:
        return f"{workspace.fusion_cfg_path} lists no image; list them in it, one a line, or delete it."
    if not are_missing:
        lack = f"no depth in any of its {kind} maps"
    else:
        other: MapKind = "photometric" if kind == "geometric" else "geometric"
        if all(path.is_file() for path in map_place(workspace, views[0].name, other).files):
            return (
                f"The workspace {workspace.root} has {other} maps, not {kind} ones; fuse those by --input_type "
                f"{other}, or make these by patch_match_stereo."
            )
        lack = f"no {kind} maps"
    return f"The workspace {workspace.root} has {lack}; make them by patch_match_stereo first."


def _map_view(view: View, depth: Path, normals: Path) -> View:
    """The view with the pixels of its maps; `InputError` where these do not fit."""
    width, height = map_size(depth)
    if map_size(normals, 3) != (width, height):
        raise InputError(f"The maps {depth} and {normals} are not of one size; compute them again.")
    if not view.may_be_reduced_to(width, height):
        raise InputError(
            f"The map {depth} has {width} x {height} pixels, but its image {view.width} x {view.height}; "
            "delete it and compute it again."
        )
    return view.resized(width, height)


def _at_map_sizes(scene: Scene, mapped: dict[str, View], max_image_size: int) -> Scene:
    """The scene as it was worked on: views with the pixels of their maps, or with at most so many on a side."""
    views = tuple(mapped.get(view.name, view).no_larger_than(max_image_size) for view in scene.views)
    return anchored(replace(scene, views=views)).only(mapped)


def _sources(context: Context, mapped: dict[str, View]) -> dict[str, MapSources]:
    indices = index_in_model(context)
    folder = context.options.fusion.mask_path
    sources = {}
    for view in context.scene.views:
        place = map_place(context.workspace, view.name, context.options.fusion.input)
        depth, normals = place.files
        # Of maps that another program has put in the place of ours we know nothing.
        is_ours = not altered_files(read_record(place.record), place.files)
        map_view = mapped[view.name]
        sources[view.name] = MapSources(
            view.without_points(),
            indices[view.name],
            depth,
            normals,
            context.workspace.image_path(view.name),
            None if folder is None else mask_path(folder, view.name),
            whole_digests(place.record, 2) if is_ours else None,
            place.record if is_ours else None,
            None if (map_view.width, map_view.height) == (view.width, view.height) else map_view.without_points(),
            views_beside(context.scene, view.name),
        )
    return sources
