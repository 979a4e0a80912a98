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
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.sparse_model import MODEL_FILES, RIG_FILES, image_names, load_model
from colmap_sph.project.workspace import MapKind, Workspace

# What COLMAP's undistortion makes; the model comes last, as it is what makes a folder look like a workspace.
_PARTS = ("images", "masks", "stereo", "run-colmap-photometric.sh", "run-colmap-geometric.sh", "sparse")
_MARKER = "undistortion.json"


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
    there = [part for part in _PARTS if (workspace.root / part).exists()]
    found = read_marker(workspace.state_dir)
    if found is None and not there:
        return False
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
    _remove(workspace.state_dir / "cloud.json")
    for name in ("state", "pairs", "photometric"):
        _remove(workspace.state_dir / name)


def check_discardable(workspace: Workspace) -> None:
    """Raise `InputError` where a workspace, or a file in its folders, was made by something else."""
    there = [part for part in _PARTS if (workspace.root / part).exists()]
    if there and read_marker(workspace.state_dir) is None:
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
    for name in ("fused.ply", "fused.ply.vis", *_PARTS):
        _remove(workspace.root / name)
    for name in (workspace.local_dir.name, "undistorting", _MARKER):
        _remove(workspace.state_dir / name)


def _foreign_files(workspace: Workspace) -> Iterator[Path]:
    """Files and links in the workspace's folders under names that neither COLMAP nor this program uses."""
    try:
        names = image_names(load_model(workspace.sparse_dir))
    except InputError:  # an interrupted removal has taken the model
        names = []
    known = {workspace.fusion_cfg_path, workspace.patch_match_cfg_path}
    known |= {
        workspace.sparse_dir / f"{stem}{end}" for stem in (*MODEL_FILES, *RIG_FILES) for end in (".bin", ".txt")
    }
    for name in names:
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


def _remove(path: Path) -> None:
    try:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{path} cannot be removed ({reason_of(error)}); check permissions.") from error


def move_into_place(scratch: Path, workspace: Workspace) -> None:
    """Move the finished parts from `scratch`, the marker last; can be repeated after an interruption."""
    try:
        for part in _PARTS:
            if (scratch / part).exists():
                (scratch / part).rename(workspace.root / part)
        (scratch / _MARKER).rename(workspace.state_dir / _MARKER)
    except OSError as error:
        raise OutputError(
            f"The undistorted images cannot be moved into {workspace.root} ({reason_of(error)}); "
            "choose another --output."
        ) from error
    shutil.rmtree(scratch, ignore_errors=True)


def write_marker(folder: Path, marker: dict[str, Any]) -> None:
    """Declare the contents of `folder` complete and made from the inputs that `marker` describes."""
    with atomic_file(folder / _MARKER) as file:
        file.write(json.dumps(marker, indent=1).encode())


def read_marker(folder: Path) -> dict[str, Any] | None:
    """Return the marker in `folder`, or None where there is no readable one."""
    try:
        marker = json.loads((folder / _MARKER).read_text())
    except (OSError, ValueError):
        return None
    return marker if isinstance(marker, dict) else None
