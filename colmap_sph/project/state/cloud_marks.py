"""Which depth maps a cloud was made of: a mark of each in the cloud's record."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import get_args

import xxhash

from colmap_sph.project.cloud_tiles import INDEX
from colmap_sph.project.state.records import content_stamp, recorded_facts
from colmap_sph.project.workspace import MapKind, Workspace


@dataclass(frozen=True)
class _Marked:
    """What of the facts of a cloud says of what it was made."""

    of_maps: tuple[str, ...] = ()


def map_mark(workspace: Workspace, name: str, kind: MapKind) -> str:
    """16 digits that tell the depth map of an image from others of it, and from those of other images."""
    stamp = content_stamp(workspace.depth_map_path(name, kind))
    return xxhash.xxh3_64_hexdigest(f"{name}\0{kind}\0{stamp}".encode("utf-8", "surrogateescape"))


def is_cloud_of(workspace: Workspace, maps: Iterable[tuple[str, MapKind]]) -> bool | None:
    """Whether the cloud of a workspace was made of depth maps that are there, of some of them or all.

    Parameters
    ----------
    workspace : Workspace
    maps : iterable of (str, kind)
        Names of images with a map of that kind.

    Returns
    -------
    bool or None
        None where that is not known: another program made it, or an earlier version.
    """
    marks = _marks(workspace)
    return marks <= {map_mark(workspace, name, kind) for name, kind in maps} if marks else None


def images_of_cloud(workspace: Workspace, names: Iterable[str]) -> set[str] | None:
    """Those of the images `names` of whose depth maps, as they are now, the cloud was made; None: not known."""
    marks = _marks(workspace)
    if not marks:
        return None
    return {name for name in names if any(map_mark(workspace, name, kind) in marks for kind in get_args(MapKind))}


def _marks(workspace: Workspace) -> frozenset[str]:
    """Marks of the depth maps that the cloud was made of; none where these are not known."""
    if workspace.fused_path.exists():
        known = recorded_facts(workspace.cloud_record_path, _Marked, workspace.cloud_paths)
    else:
        known = recorded_facts(workspace.tiles_record_path, _Marked, [workspace.tiles_dir / INDEX])
    return frozenset(known.of_maps if known else ())
