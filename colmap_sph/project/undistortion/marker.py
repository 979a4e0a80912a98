"""The marker of a workspace: what its images were undistorted from, and what its model was when it was written.

It is there before the first undistorted image, and says that the workspace is finished when the model is in its
place. A model file that is not as the marker says is the user's: it is neither removed nor replaced.
"""

import hashlib
import json
import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.platforms.files import move_into_place
from colmap_sph.project.files import atomic_file, make_dir, open_regular, remove, set_aside
from colmap_sph.project.pair_lists import read_patch_match_cfg, write_fusion_cfg, write_patch_match_cfg
from colmap_sph.project.sparse_model import MODEL_FILES, RIG_FILES, image_names, load_model
from colmap_sph.project.state.ownership import fusion_cfg_place
from colmap_sph.project.state.records import claim, read_json
from colmap_sph.project.wide.table import TABLE_NAME
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)

_VERSION = 2
_MAX_BYTES = 256 << 20
# What undistortion makes.
_PARTS = ("images", "masks", "stereo", "sparse")
# COLMAP's scripts, which would write over our maps. Earlier versions left them there.
_SCRIPTS = ("run-colmap-photometric.sh", "run-colmap-geometric.sh")
_SOURCES = 20


@dataclass(frozen=True)
class Marker:
    """What is known of a workspace that this program made.

    Attributes
    ----------
    model : str
        Digest of the files of the original model.
    options : dict
        How its images were undistorted: plain values.
    images : tuple of str
        Sorted names of the images in the model of the workspace; empty until that is complete.
    files : dict
        Digest of each file of the workspace's model as it was written, by its name.
    given : dict
        Where that is a polished model: the same of the one it was made from, which is kept.
    polish : dict
        The key under which the model was polished last, and the outcome; see `polishing.polished`.
    version : int
        Of the program's marker: what version 1 lists is other things.
    has_masks : bool
        Of version 1: whether masks were undistorted, too.
    """

    model: str
    options: dict[str, Any]
    images: tuple[str, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    given: dict[str, str] = field(default_factory=dict)
    polish: dict[str, Any] = field(default_factory=dict)
    version: int = _VERSION
    has_masks: bool = False

    @property
    def is_finished(self) -> bool:
        """Whether model and lists are complete."""
        return bool(self.images) or self.version == 1


# What there is instead of a damaged one: a workspace of which nothing is known.
_DAMAGED = Marker("", {}, images=("",))


def _old_scratch(workspace: Workspace) -> Path:
    """Where earlier versions undistorted."""
    return workspace.state_dir / "undistorting"


@dataclass(frozen=True)
class _OldMarker:
    """What is needed of a marker of version 1, whose `images` is a digest."""

    version: Literal[1]
    model: str
    options: dict[str, Any]
    masks: Any = None


def read_marker(workspace: Workspace) -> Marker | None:
    """Return the marker, or None where there is no readable one."""
    # Earlier versions had it in the scratch folder until all was in its place.
    for path in (workspace.marker_path, _old_scratch(workspace) / workspace.marker_path.name):
        marker = read_json(path, Marker, max_bytes=_MAX_BYTES)
        if marker is not None and marker.version == _VERSION:
            return marker
        old = read_json(path, _OldMarker, max_bytes=_MAX_BYTES)
        if old is not None:
            return Marker(old.model, old.options, version=1, has_masks=old.masks is not None)
    return None


def write_marker(workspace: Workspace, marker: Marker) -> None:
    """Write the marker; `OutputError` where that fails."""
    make_dir(workspace.state_dir)
    with atomic_file(workspace.marker_path) as file:
        file.write(json.dumps(asdict(marker), indent=1).encode())


def check_made_from(workspace: Workspace, marker: Marker) -> Marker | None:
    """Return the marker of a workspace that was made, or begun, from these inputs; None where there is nothing.

    Raises
    ------
    InputError
        Something else made it, or it was made from other inputs.
    """
    found = check_ours(workspace)
    if found is _DAMAGED:
        raise InputError(
            f"{workspace.marker_path} is damaged, which says what the workspace was made from; start afresh with "
            "--overwrite, or choose another --output."
        )
    if found is None or not found.is_finished:
        return found
    again = "choose another --output, or start afresh with --overwrite"
    if found.model != marker.model:
        raise InputError(f"{workspace.root} was made from another sparse model than the one given; {again}.")
    for name in sorted({*found.options, *marker.options}):
        was, now = found.options.get(name), marker.options.get(name)
        if was != now:
            flag = "--max-image-size" if name == "max_image_size" else f"--undistortion.{name.replace('_', '-')}"
            raise InputError(f"{workspace.root} was made with {flag} {was}, not {now}; give that, {again}.")
    return found


def check_ours(workspace: Workspace) -> Marker | None:
    """Return the marker, or one of nothing where it is damaged.

    Raises
    ------
    InputError
        The folder has none, and holds a workspace of something else; or the system does not let it be read.
    """
    found = read_marker(workspace)
    if found is None and workspace.marker_path.is_file():
        try:
            open_regular(workspace.marker_path).close()
        except OSError as error:  # to begin anew would cost what is there
            raise InputError(
                f"{workspace.marker_path} cannot be read ({reason_of(error)}); check permissions, or run again."
            ) from error
        return _DAMAGED
    there = [part for part in _PARTS if (workspace.root / part).exists()]
    if found is None and there:
        raise InputError(
            f"{workspace.root} already has {' and '.join(there)} which this program did not make; choose another "
            "--output, or delete the folder first, or give it as --workspace if COLMAP undistorted it."
        )
    return found


def refuse_unfinished(workspace: Workspace) -> None:
    """Raise `InputError` for a workspace whose undistortion was begun, but is not complete."""
    marker = read_marker(workspace)
    if marker is not None and not marker.is_finished:
        raise InputError(
            f"The undistortion into {workspace.root} was not finished; run with --model, as it was begun."
        )


# ---- the workspace's model -----------------------------------------------------------------------------------


def adopt(workspace: Workspace, marker: Marker) -> Marker:
    """Make the marker of an earlier version one of this, which names the model's files; return it.

    COLMAP's scripts are removed, and what that version was undistorting.
    """
    for path in (*(workspace.root / name for name in _SCRIPTS), _old_scratch(workspace)):
        remove(path)
    names = tuple(names_in_model(workspace))
    marker = replace(
        marker, images=names, files=model_digests(workspace.sparse_dir), version=_VERSION, has_masks=False
    )
    write_marker(workspace, marker)
    return marker


def names_in_model(workspace: Workspace) -> list[str]:
    """Names of the images in the workspace's model; none where it has no readable one."""
    with suppress(InputError):
        return image_names(load_model(workspace.sparse_dir))
    return []


def is_model_changed(workspace: Workspace, marker: Marker) -> bool:
    """Whether the workspace has model files which are not as this program wrote them."""
    return marker.is_finished and not model_digests(workspace.sparse_dir).items() <= marker.files.items()


def set_model_aside(workspace: Workspace, marker: Marker) -> None:
    """Give model files that are not as this program wrote them other names."""
    for name, digest in model_digests(workspace.sparse_dir).items():
        if marker.is_finished and marker.files.get(name) != digest:
            path = workspace.sparse_dir / name
            logger.warning("%s is not what this program wrote there; it is now %s", path, set_aside(path).name)


def remove_model(workspace: Workspace) -> None:
    """Remove the model, which is this program's, and the list of pairs unless the user wrote it."""
    for path in (*_model_files(workspace.sparse_dir), *_model_files(workspace.given_model_dir)):
        remove(path)
    if _is_default_pair_list(workspace.patch_match_cfg_path):
        remove(workspace.patch_match_cfg_path)


def publish_model(workspace: Workspace, marker: Marker, made: Path, names: Sequence[str]) -> None:
    """Put a new model into its place, with COLMAP's lists of its images, and write the finished marker.

    An interruption leaves an unfinished marker, and is made good by the next run.

    Parameters
    ----------
    workspace : Workspace
    marker : Marker
        Unfinished.
    made : Path
        Folder with the files of the model, on the same disk; they are moved.
    names : sequence of str
        Sorted names of its images.
    """
    write_marker(workspace, replace(marker, images=(), files={}, given={}, polish={}))
    files = model_digests(made)
    make_dir(workspace.sparse_dir)
    make_dir(workspace.stereo_dir)
    for path in _model_files(workspace.sparse_dir):
        if path.name not in files:
            remove(path)
    try:
        for name in sorted(files):
            move_into_place(made / name, workspace.sparse_dir / name)
    except OSError as error:
        raise OutputError(
            f"The model cannot be moved into {workspace.sparse_dir} ({reason_of(error)}); check permissions."
        ) from error
    if not workspace.patch_match_cfg_path.exists() or _is_default_pair_list(workspace.patch_match_cfg_path):
        write_patch_match_cfg(workspace.patch_match_cfg_path, dict.fromkeys(names, _SOURCES))
    if not workspace.fusion_cfg_path.exists():
        write_fusion_cfg(workspace.fusion_cfg_path, names)
        place = fusion_cfg_place(workspace)
        claim(place.record, place.files)
    write_marker(workspace, replace(marker, images=tuple(names), files=files))


def _is_default_pair_list(path: Path) -> bool:
    """Whether a list of pairs leaves the choice to the program for every image, as it was written."""
    try:
        sources = read_patch_match_cfg(path)
    except InputError:
        return False
    return all(source == _SOURCES for source in sources.values())


def has_given_model(workspace: Workspace, marker: Marker) -> bool:
    """Whether the model from which the workspace's was polished is there; so it is without any polishing."""
    return not marker.given or model_digests(workspace.given_model_dir) == marker.given


def _model_files(folder: Path) -> list[Path]:
    names = [f"{stem}{end}" for stem in (*MODEL_FILES, *RIG_FILES) for end in (".bin", ".txt")]
    return [folder / name for name in (*names, TABLE_NAME) if (folder / name).is_file()]


def model_digests(folder: Path) -> dict[str, str]:
    """Digests of the model's files in a folder, by name."""
    digests = {}
    for path in _model_files(folder):
        with path.open("rb") as file:
            digests[path.name] = hashlib.file_digest(file, "blake2b").hexdigest()[:32]
    return digests
