"""What is known of a cloud: its record, its number of points, and advice where these are few."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta

from colmap_sph.errors import counted, percent
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.memory import MemoryGate
from colmap_sph.platforms.memory import give_back_freed_memory
from colmap_sph.project.cloud_tiles import missing_tiles, read_index, retire_tiles
from colmap_sph.project.files import read_small, whole_digest
from colmap_sph.project.map_files import read_depth_map, read_normal_planes
from colmap_sph.project.masks import read_view_mask
from colmap_sph.project.pair_lists import fusion_cfg, write_fusion_cfg
from colmap_sph.project.sparse_model import image_names, load_model
from colmap_sph.project.state.cloud_marks import map_mark
from colmap_sph.project.state.ownership import fusion_cfg_place, tiles_place
from colmap_sph.project.state.records import begin, claim, vouch, vouch_when_on_disk, vouched_facts
from colmap_sph.project.workspace import mask_path
from colmap_sph.stereo.fusion_losses import DepthAndNormals, explain_losses

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

logger = logging.getLogger(__name__)

# Fewer points than this share of the pixels with a geometric depth calls for an explanation.
_FEW_POINTS = 0.02
# Most of them can be confirmed, and the cloud is thin all the same, where many images see each piece of surface.
_MOSTLY = 0.5
# So large a share of pixels under the user's masks explains it; poses whose depth maps agree with so large a share
# of the sparse points do not.
_MOSTLY_MASKED = 0.9
_FITTING = 0.5
# Bytes of maps that are kept meanwhile, at most; and per pixel of the largest image, of its maps and those of
# another beside it.
_CACHE_BYTES = 1 << 30
_LOOKED_AT_BYTES = 36.0
_MAX_LIST_BYTES = 1 << 26


@dataclass(frozen=True)
class CloudFacts:
    """The number of points of a cloud, what to advise where they are few, and how many each image made.

    The last is in the order of the images' names, and empty where that is not known. `of_maps` are the marks of
    the maps that were fused, see `map_mark`. `tiles` is the number of files, of a cloud that is not in one.
    """

    points: Annotated[int, Meta(ge=0)]
    advice: str
    of_images: tuple[Annotated[int, Meta(ge=0)], ...] = ()
    of_maps: tuple[str, ...] = ()
    tiles: Annotated[int, Meta(ge=0)] = 0


def known_cloud(context: "Context", key: str) -> CloudFacts | None:
    """What is known of the cloud, or None where it must be made."""
    place = context.cloud_place
    known = vouched_facts(place.record, key, place.files, CloudFacts)
    return known or _known_tiles(context, key)


def _known_tiles(context: "Context", key: str) -> CloudFacts | None:
    place = tiles_place(context.workspace)
    known = vouched_facts(place.record, key, place.files, CloudFacts)
    index = None if known is None else read_index(context.workspace.tiles_dir)
    if index is None or missing_tiles(context.workspace.tiles_dir, index):
        return None
    return known


def begin_cloud(context: "Context") -> None:
    """Say that the cloud is about to be replaced; what is not ours in its place is set aside."""
    place = context.cloud_place
    begin(place.record, place.files)
    retire_tiles(context.workspace)


def vouch_for_cloud(
    context: "Context",
    key: str,
    facts: CloudFacts,
    names: Sequence[str],
    *,
    is_complete: bool,
    digests: Sequence[str] = (),
) -> None:
    """Record that the cloud is ours, and that it is complete, if it is: otherwise the next run makes it again.

    Parameters
    ----------
    context : Context
    key : str
        Under which it was made.
    facts : CloudFacts
        Without the marks.
    names : sequence of str
        Images that were fused.
    is_complete : bool
        Whether nothing that belongs to it could not be read.
    digests : sequence of str
        Of the first of its files, as far as they are known.
    """
    place = tiles_place(context.workspace) if facts.tiles else context.cloud_place
    known = dict(zip(place.files, digests, strict=False))
    digests_of = {
        path: known[path] if path in known else whole_digest(path) if path.exists() else "" for path in place.files
    }
    kind = context.options.fusion.input
    facts = replace(facts, of_maps=tuple(map_mark(context.workspace, name, kind) for name in names))
    vouch_when_on_disk(place.record, key, digests_of, facts, state="done" if is_complete else "void")


def list_fused_images(context: "Context", names: Sequence[str]) -> None:
    """Write ``fusion.cfg``, where it says something else; what the user made of it is set aside.

    Parameters
    ----------
    context : Context
    names : sequence of str
        Images that are fused.
    """
    workspace = context.workspace
    place = fusion_cfg_place(workspace)
    found = _found_list(workspace.fusion_cfg_path)
    if found == fusion_cfg(names):
        return
    if found is not None and set(found.decode(errors="replace").split("\n")) - {""} == _all_images(context):
        claim(place.record, place.files)  # as COLMAP's undistortion writes it
    begin(place.record, place.files)
    vouch(place.record, "", {workspace.fusion_cfg_path: write_fusion_cfg(workspace.fusion_cfg_path, names)})


def _found_list(path: Path) -> bytes | None:
    try:
        return read_small(path, _MAX_LIST_BYTES)
    except OSError:
        return None


def _all_images(context: "Context") -> set[str]:
    return set(image_names(load_model(context.workspace.sparse_dir)))


def report_cloud(context: "Context", facts: CloudFacts, names: Sequence[str] = ()) -> None:
    """Report the cloud's facts, of which those of images are of images `names`."""
    context.report.points = facts.points
    context.report.tiles = facts.tiles
    if len(facts.of_images) == len(names):
        context.report.points_of = dict(zip(names, facts.of_images, strict=True))
    context.report.advice = facts.advice
    if facts.advice:
        logger.warning("Only %s survived fusion. %s", counted(facts.points, "point"), facts.advice)


def facts_of_cloud(
    context: "Context",
    names: Sequence[str],
    points: int,
    partners: Mapping[str, tuple[Sequence[str], Sequence[int]]] | None = None,
) -> CloudFacts:
    """Find out what is to be known of a cloud: where few pixels became points, which gate to loosen.

    Parameters
    ----------
    context : Context
        With the coverage of the images in its report.
    names : sequence of str
        Images that were fused.
    points : int
        Points of the cloud.
    partners : mapping, optional
        See `explain_losses`.

    Returns
    -------
    CloudFacts
    """
    coverage = context.report.coverage
    options = context.options.fusion
    scene = replace(context.scene, views=tuple(map(context.scene.view, names)))
    shares = context.report.in_region
    pixels = sum(coverage[view.name] * shares.get(view.name, 1.0) * view.num_pixels for view in scene.views)
    if points >= _FEW_POINTS * pixels:
        return CloudFacts(points, "")
    maps: LoadCache[DepthAndNormals] = LoadCache(lambda pair: pair[0].nbytes + pair[1].nbytes)

    with_depth: dict[str, int] = {}
    left: dict[str, int] = {}

    def read(name: str) -> DepthAndNormals:
        files = context.map_files(name, options.input)
        depth = read_depth_map(files.depth)
        if options.mask_path is not None:
            with_depth[name] = int(np.count_nonzero(depth > 0))
            view = context.scene.view(name)
            mask = read_view_mask(mask_path(options.mask_path, name), view)
            if mask is not None:
                depth[mask == 0] = 0
            left[name] = int(np.count_nonzero(depth > 0))
        return depth, read_normal_planes(files.normals)

    give_back_freed_memory()  # what fusion kept for its own sizes
    largest = max((view.num_pixels for view in scene.views), default=0)
    room = MemoryGate(context.options.memory_budget).spare(_LOOKED_AT_BYTES * largest)
    with maps.holding(int(min(_CACHE_BYTES, room))):
        losses = explain_losses(lambda name: maps.get(name, lambda: read(name)), scene, options, partners=partners)
    found = sum(with_depth.values())
    masked = found - sum(left.values())
    if masked > _MOSTLY_MASKED * found:
        share = masked / found
        return CloudFacts(points, f"Of the pixels with a depth --fusion.mask-path leaves out {percent(share, 0)}.")
    many = points > 0 and losses.kept > _MOSTLY
    if many:
        return CloudFacts(points, "")
    lacking = _lacking(context, len(names))
    return CloudFacts(points, losses.sentence(options, poses_fit=_poses_fit(context), lacking=lacking))


def _lacking(context: "Context", num_fused: int) -> str:
    """How many images are without maps, with the first's reason; empty where more were fused."""
    skipped = context.report.skipped_images
    if len(skipped) <= num_fused:
        return ""
    name, reason = min(skipped.items())
    images = f"{len(skipped)} of {len(skipped) + num_fused} images"
    return f"{images} without maps: {name}, as {reason.removesuffix('.')}"


def _poses_fit(context: "Context") -> bool:
    agreement = context.report.overall_agreement
    return agreement is not None and agreement > _FITTING
