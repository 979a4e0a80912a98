"""The last stage: the maps of all images → the cloud, by our own fusion or by COLMAP's."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from colmap_sph.errors import InputError, NoResultError, OutputError, reason_of
from colmap_sph.pipeline.context import Context, Done
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.memory import MemoryGate, format_memory, resident
from colmap_sph.pipeline.records import forget, vouch, vouched_facts
from colmap_sph.pipeline.view_maps import read_view_maps
from colmap_sph.project.cloud_files import (
    check_places,
    join_parts,
    link_workspace,
    move_cloud_into_place,
    write_part,
)
from colmap_sph.project.colmap_fusion import fuse_by_colmap
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.pair_lists import write_fusion_cfg
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.staging import scratch_folder
from colmap_sph.stereo.fusion import MAX_PARTNERS, ViewMaps, fuse_view
from colmap_sph.stereo.fusion_losses import DepthAndNormals, explain_losses
from colmap_sph.stereo.pairs import Pair, overlapping_views, partners_of

logger = logging.getLogger(__name__)

# Fewer points than this share of the pixels with a geometric depth calls for an explanation.
_FEW_POINTS = 0.02
# Most of them can be confirmed, and the cloud is thin all the same, where many images see each piece of surface.
_MOSTLY = 0.5
_EXPLANATION_BYTES = 1 << 30  # of maps in memory
# Bytes per pixel: of the maps of a view with its image; largest in use while a view is fused; of all images
# together in COLMAP's fusion.
MAPS_BYTES, FUSE_BYTES = 19.0, 60.0
COLMAP_FUSION_BYTES = 80.0


@dataclass(frozen=True)
class CloudState:
    """Key of the cloud, and what is known of it where it is there.

    Attributes
    ----------
    names : tuple of str
        Images to fuse: those with any depth.
    partners : dict, optional
        For each image the images to look for agreement in; None where COLMAP's fusion finds them itself.
    key : str
    facts : dict, optional
        Its number of points and the advice to give; None where it must be made.
    """

    names: tuple[str, ...]
    partners: dict[str, list[str]] | None
    key: str
    facts: dict[str, Any] | None


def cloud_state(
    context: Context, pairs: Iterable[Pair], maps: Mapping[str, str], coverage: Mapping[str, float]
) -> CloudState:
    """See `CloudState`; `maps` and `coverage` are keys and coverage of the geometric maps by image name."""
    scene, options = context.scene, context.options.fusion
    names = tuple(view.name for view in scene.views if coverage.get(view.name, 0) > 0)
    partners: dict[str, list[str]] | None = None
    if options.method != "colmap":
        most = min(options.check_num_images, MAX_PARTNERS)
        # A pair that the user asked for may share no point.
        overlapping, matched, fused = overlapping_views(scene, most), partners_of(pairs), set(names)
        partners = {
            name: [o for o in dict.fromkeys([*overlapping[name], *matched.get(name, [])]) if o in fused][:most]
            for name in names
        }
    elif not any(len(view.point_indices) for view in scene.views):
        partners = partners_of(pairs)
    key = context.keys.cloud({name: maps[name] for name in names}, partners or {}, scene.origin)
    return CloudState(names, partners, key, vouched_facts(context.cloud_record, key, context.cloud_paths))


def fuse_views(context: Context, pairs: Iterable[Pair], maps: Mapping[str, str]) -> None:
    """Fuse the maps into the cloud; writes ``fused.ply`` and ``fused.ply.vis``.

    `maps` are what `check_views` returned.
    """
    report = context.report
    state = cloud_state(context, pairs, maps, report.coverage)
    facts = state.facts
    write_fusion_cfg(context.workspace.fusion_cfg_path, state.names)
    if facts is None:
        forget(context.cloud_record)
        by_colmap = context.options.fusion.method == "colmap"
        points, whole = _fuse_by_colmap(context, state) if by_colmap else _fuse_by_pixel(context, state)
        fused = [name for name in state.names if name not in report.skipped_images]
        facts = {"points": points, "advice": _advice(context, fused, points)}
        if whole:
            vouch(context.cloud_record, state.key, context.cloud_paths, **facts)
    context.count("fuse", [Done(state.key, made=state.facts is None)])
    report.points, report.advice = facts["points"], facts["advice"]
    if report.advice:
        logger.warning("Only %d points survived fusion. %s", report.points, report.advice)


def _fuse_by_colmap(context: Context, state: CloudState) -> tuple[int, bool]:
    options = context.options
    with context.stage("fuse", 1):
        _warn_of_memory(context, state.names)
        points = fuse_by_colmap(
            context.workspace,
            options.fusion.for_colmap(),
            threads=options.num_threads,
            kind=options.fusion_input,
            partners=state.partners,
        )
        context.progress.advance()
    return points, True


def _fuse_by_pixel(context: Context, state: CloudState) -> tuple[int, bool]:
    """Fuse every image into a part of the cloud, and join these; their points, and whether no image failed."""
    workspace, scene, options = context.workspace, context.scene, context.options
    overlapping = state.partners or {}
    check_places(workspace)
    gate = MemoryGate(options.memory_budget)
    pixels = [view.width * view.height for view in map(scene.view, state.names)]
    cache_bytes = int(min(MAPS_BYTES * sum(pixels), gate.spare(2 * FUSE_BYTES * max(pixels)) / 2))
    gate.keep(cache_bytes)
    index_of = {image_id: index for index, image_id in enumerate(scene.image_ids)}

    def load(name: str) -> ViewMaps:
        view = scene.view(name)
        masks = options.fusion.mask_path
        return read_view_maps(workspace, view, index_of[view.image_id], options.fusion_input, masks)

    maps = LoadCache(load, lambda view_maps: view_maps.nbytes, cache_bytes)
    scratch = workspace.fusion_scratch_dir
    with scratch_folder(scratch):
        stems = {name: scratch / f"{scene.view(name).image_id}" for name in state.names}

        def partners(name: str) -> Iterator[ViewMaps]:
            for partner in overlapping[name]:
                with suppress(InputError):  # reported where it is the reference
                    yield maps.get(partner)

        def work(name: str) -> Done:
            view = scene.view(name)
            with gate.reserve(FUSE_BYTES * view.width * view.height, name):
                bands = fuse_view(maps.get(name), partners(name), options.fusion, scene.anchor)
                return Done(state.key, made=True, points=write_part(stems[name], bands))

        done = context.for_all("fuse", work, state.names, context.skip_view)
        if not done:
            raise NoResultError(f"No image could be fused ({context.report.skipped_images[state.names[0]]})")
        points = sum(part.points for part in done.values())
        _put_together(context, scratch, [stems[name] for name in done], points)
    return points, len(done) == len(state.names)


def _put_together(context: Context, scratch: Path, stems: list[Path], points: int) -> None:
    """Make the cloud in the folder `scratch` of its parts, and move it to its place."""
    workspace, origin = context.workspace, context.scene.origin
    try:
        join_parts(stems, scratch, points)
        if origin.any():
            link_workspace(workspace, load_model(workspace.sparse_dir), origin, scratch)
        move_cloud_into_place(scratch, workspace, origin)
    except (OSError, RuntimeError) as error:
        raise OutputError(
            f"{workspace.fused_path} cannot be written ({reason_of(error)}); check space and permissions."
        ) from error


def _warn_of_memory(context: Context, names: Iterable[str]) -> None:
    """COLMAP's fusion holds all maps at once; its cache bounds that, but makes it many times slower."""
    total = context.options.memory_budget
    needed = resident() + COLMAP_FUSION_BYTES * sum(v.width * v.height for v in map(context.scene.view, names))
    if needed > total and not context.options.fusion.use_cache:
        logger.warning(
            "COLMAP's fusion will take about %s of memory, more than the %s allowed; "
            "--fusion.use-cache True bounds it, but takes hours.",
            format_memory(needed),
            format_memory(total),
        )


def _advice(context: Context, names: Iterable[str], points: int) -> str:
    """Which gate of the fusion to loosen, where few points of the fused images survived."""
    coverage, options = context.report.coverage, context.options
    scene = replace(context.scene, views=tuple(map(context.scene.view, names)))
    pixels = sum(coverage[view.name] * view.width * view.height for view in scene.views)
    if points >= _FEW_POINTS * pixels:
        return ""

    def load(name: str) -> DepthAndNormals:
        depth_path, normal_path = context.map_paths(name, options.fusion_input)
        return read_depth_map(depth_path), read_normal_map(normal_path)

    maps = LoadCache(load, lambda pair: pair[0].nbytes + pair[1].nbytes, _EXPLANATION_BYTES)
    losses = explain_losses(maps.get, scene, options.fusion)
    return "" if points and losses.kept > _MOSTLY else losses.sentence()
