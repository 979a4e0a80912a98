"""A dense workspace appears only when it is complete, with a marker that says what it was made from.

It is made in a scratch folder inside the workspace, marked there, and moved part by part with the marker
last: an interruption at any point leaves either a scratch folder to throw away or a move to finish, and
nothing that could be taken for a workspace.

To start afresh, a workspace is discarded: only one that this program made, and only where nobody has put files
of his own into its folders.
"""

import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, get_args

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.project.files import atomic_file, make_dir, open_regular, remove
from colmap_sph.project.sparse_model import MODEL_FILES, RIG_FILES, image_names, load_model
from colmap_sph.project.workspace import MapKind, Workspace

# What COLMAP's undistortion makes; the model comes last, as it is what makes a folder look like a workspace.
_PARTS = ("images", "masks", "stereo", "run-colmap-photometric.sh", "run-colmap-geometric.sh", "sparse")


@contextmanager
def scratch_folder(scratch: Path) -> Iterator[None]:
    """Start with an empty scratch folder and leave nothing behind, on success as on failure."""
    created = [folder for folder in (scratch, *scratch.parents[:2]) if not folder.exists()]
    shutil.rmtree(scratch, ignore_errors=True)
    make_dir(scratch)
    try:
        yield
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        for folder in created:
            with suppress(OSError):  # not empty: the workspace is complete
                folder.rmdir()


def is_finished(workspace: Workspace, marker: dict[str, Any]) -> bool:
    """Whether the workspace was made from these inputs; `InputError` where it was made from others."""
    there = _parts_in(workspace)
    found = _read_marker(workspace.marker_path)
    if found is None and (not there or is_being_moved(workspace, marker)):
        return False
    found = found or _read_marker(_scratch_marker(workspace))
    if found is None:
        raise InputError(_foreign_workspace(workspace, there))
    remedy = "choose another --output, or start afresh with --overwrite"
    changed = [key for key in marker if found.get(key) != marker[key]]
    if changed:
        raise InputError(f"{workspace.root} was made with different {' and '.join(changed)}; {remedy}.")
    missing = [part for part in ("images", "sparse") if part not in there]
    if missing:
        raise InputError(f"{workspace.root} has lost its {' and '.join(missing)}; {remedy}.")
    return True


def _foreign_workspace(workspace: Workspace, there: Iterable[str]) -> str:
    return (
        f"{workspace.root} already has {' and '.join(there)} which this program did not make; choose another "
        "--output, or delete the folder first, or give it as --workspace if COLMAP undistorted it."
    )


def discard_results(workspace: Workspace) -> None:
    """Make a run in a workspace forget what earlier ones computed there; maps and cloud stay until replaced."""
    # The records first: nothing may vouch for what is no longer whole.
    remove(workspace.cloud_record_path)
    for folder in (workspace.records_dir, workspace.pairs_dir, workspace.photometric_dir):
        remove(folder)


def check_discardable(workspace: Workspace) -> None:
    """Raise `InputError` where a workspace, or a file in its folders, was made by something else."""
    there = _parts_in(workspace)
    if there and not any(map(_read_marker, (workspace.marker_path, _scratch_marker(workspace)))):
        raise InputError(_foreign_workspace(workspace, there))
    foreign = next(_foreign_files(workspace), None)
    if foreign is not None:
        raise InputError(f"{foreign} was not made by this program; move it away before you use --overwrite.")


def discard_workspace(workspace: Workspace) -> None:
    """Remove all that this program made in a workspace; the log stays, and so do files of others beside it.

    Raises
    ------
    InputError
        See `check_discardable`.
    OutputError
        Something cannot be removed.
    """
    check_discardable(workspace)
    discard_results(workspace)
    for path in (*workspace.cloud_paths, *(workspace.root / part for part in _PARTS)):
        remove(path)
    for path in (workspace.local_dir, workspace.undistortion_scratch_dir, workspace.marker_path):
        remove(path)


def _foreign_files(workspace: Workspace) -> Iterator[Path]:
    """Files and links in the workspace's folders under names that neither COLMAP nor this program uses."""
    known = {workspace.fusion_cfg_path, workspace.patch_match_cfg_path}
    known |= {
        workspace.sparse_dir / f"{stem}{end}" for stem in (*MODEL_FILES, *RIG_FILES) for end in (".bin", ".txt")
    }
    for name in _names_of_images(workspace):
        known |= {workspace.image_path(name), workspace.mask_path(name)}
        for kind in get_args(MapKind):
            known |= {workspace.depth_map_path(name, kind), workspace.normal_map_path(name, kind)}
            known.add(workspace.stereo_dir / "consistency_graphs" / f"{name}.{kind}.bin")
    for part in (workspace.images_dir, workspace.masks_dir, workspace.stereo_dir, workspace.sparse_dir):
        if part.is_symlink():
            yield part
            continue
        for path in part.rglob("*"):
            if path not in known and (path.is_symlink() or not path.is_dir()):
                yield path


def _names_of_images(workspace: Workspace) -> list[str]:
    # The model comes last: an interrupted move has left it behind, an interrupted removal has taken it.
    for folder in (workspace.sparse_dir, Workspace(workspace.undistortion_scratch_dir).sparse_dir):
        with suppress(InputError):
            return image_names(load_model(folder))
    return []


def move_workspace_into_place(workspace: Workspace, marker: dict[str, Any]) -> None:
    """Declare what is in the scratch folder complete, and move it to its place, the marker last.

    Parameters
    ----------
    workspace : Workspace
    marker : dict
        The inputs from which it was made: plain values.

    Raises
    ------
    OutputError
        The marker cannot be written, or a part cannot be moved.
    """
    with atomic_file(_scratch_marker(workspace)) as file:
        file.write(json.dumps(marker, indent=1).encode())
    _move(workspace)


def finish_move(workspace: Workspace, marker: dict[str, Any]) -> None:
    """Finish a move of what was made from these inputs, where it was interrupted."""
    if is_being_moved(workspace, marker):
        _move(workspace)


def is_being_moved(workspace: Workspace, marker: dict[str, Any]) -> bool:
    """Whether a workspace made from these inputs is complete, but not, or not wholly, in its place."""
    return _read_marker(_scratch_marker(workspace)) == marker


def _move(workspace: Workspace) -> None:
    scratch = workspace.undistortion_scratch_dir
    try:
        for part in _PARTS:
            if (scratch / part).exists():
                (scratch / part).rename(workspace.root / part)
        _scratch_marker(workspace).rename(workspace.marker_path)
    except OSError as error:
        raise OutputError(
            f"The undistorted images cannot be moved into {workspace.root} ({reason_of(error)}); "
            "choose another --output."
        ) from error
    shutil.rmtree(scratch, ignore_errors=True)


def _parts_in(workspace: Workspace) -> list[str]:
    return [part for part in _PARTS if (workspace.root / part).exists()]


def _scratch_marker(workspace: Workspace) -> Path:
    return workspace.undistortion_scratch_dir / workspace.marker_path.name


def _read_marker(path: Path) -> dict[str, Any] | None:
    """Return what a marker says, or None where there is no readable one."""
    try:
        with open_regular(path) as file:
            marker = json.loads(file.read())
    except (OSError, ValueError):
        return None
    return marker if isinstance(marker, dict) else None
