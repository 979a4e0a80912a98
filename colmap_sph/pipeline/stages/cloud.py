"""What is known of a cloud: its record, its number of points, and advice where these are few."""

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.records import vouch, vouched_facts
from colmap_sph.project.map_files import read_depth_map, read_normal_planes
from colmap_sph.stereo.fusion_losses import DepthAndNormals, explain_losses

if TYPE_CHECKING:
    from colmap_sph.pipeline.context import Context

logger = logging.getLogger(__name__)

# Fewer points than this share of the pixels with a geometric depth calls for an explanation.
_FEW_POINTS = 0.02
# Most of them can be confirmed, and the cloud is thin all the same, where many images see each piece of surface.
_MOSTLY = 0.5
# Bytes of maps in memory meanwhile.
_CACHE_BYTES = 1 << 30


@dataclass(frozen=True)
class CloudFacts:
    """The number of points of a cloud, and what to advise where they are few."""

    points: int
    advice: str


def known_cloud(context: "Context", key: str) -> CloudFacts | None:
    """What is known of the cloud, or None where it must be made."""
    known = vouched_facts(context.workspace.cloud_record_path, key, context.cloud_paths)
    return None if known is None else CloudFacts(**known)


def vouch_for_cloud(context: "Context", key: str, facts: CloudFacts) -> None:
    """Record that the cloud is complete.

    Parameters
    ----------
    context : Context
    key : str
        Under which it was made.
    facts : CloudFacts
    """
    vouch(context.workspace.cloud_record_path, key, context.cloud_paths, **asdict(facts))


def report_cloud(context: "Context", facts: CloudFacts) -> None:
    """Report the cloud's facts."""
    context.report.points = facts.points
    context.report.advice = facts.advice
    if facts.advice:
        logger.warning("Only %d points survived fusion. %s", facts.points, facts.advice)


def facts_of_cloud(context: "Context", names: Sequence[str], points: int) -> CloudFacts:
    """Find out what is to be known of a cloud: where few pixels became points, which gate to loosen.

    Parameters
    ----------
    context : Context
        With the coverage of the images in its report.
    names : sequence of str
        Images that were fused.
    points : int
        Points of the cloud.

    Returns
    -------
    CloudFacts
    """
    coverage = context.report.coverage
    options = context.options.fusion
    scene = replace(context.scene, views=tuple(map(context.scene.view, names)))
    pixels = sum(coverage[view.name] * view.num_pixels for view in scene.views)
    if points >= _FEW_POINTS * pixels:
        return CloudFacts(points, "")
    maps: LoadCache[DepthAndNormals] = LoadCache(lambda pair: pair[0].nbytes + pair[1].nbytes)

    def read(name: str) -> DepthAndNormals:
        files = context.map_files(name, options.input)
        return read_depth_map(files.depth), read_normal_planes(files.normals)

    with maps.holding(_CACHE_BYTES):
        losses = explain_losses(lambda name: maps.get(name, lambda: read(name)), scene, options)
    many = points > 0 and losses.kept > _MOSTLY
    return CloudFacts(points, "" if many else losses.sentence())
