"""A dense workspace appears only when it is complete, with a marker that says what it was made from.

It is made in a scratch folder inside the workspace, marked there, and moved part by part with the marker
last: an interruption at any point leaves either a scratch folder to throw away or a move to finish, and
nothing that could be taken for a workspace.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from colmap_sph.errors import InputError, OutputError
from colmap_sph.workspace import Workspace, atomic_file, make_dir

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
    remedy = "choose another --output, or delete the folder first"
    if found is None:
        raise InputError(
            f"{workspace.root} already has {' and '.join(there)} which this program did not make; "
            f"{remedy}, or give it as --workspace if COLMAP undistorted it."
        )
    changed = [key for key in marker if found.get(key) != marker[key]]
    if changed:
        raise InputError(f"{workspace.root} was made with different {' and '.join(changed)}; {remedy}.")
    missing = [part for part in ("images", "sparse") if part not in there]
    if missing:
        raise InputError(f"{workspace.root} has lost its {' and '.join(missing)}; {remedy}.")
    return True


def move_into_place(scratch: Path, workspace: Workspace) -> None:
    """Move the finished parts from `scratch`, the marker last; can be repeated after an interruption."""
    try:
        for part in _PARTS:
            if (scratch / part).exists():
                (scratch / part).rename(workspace.root / part)
        (scratch / _MARKER).rename(workspace.state_dir / _MARKER)
    except OSError as error:
        raise OutputError(
            f"The undistorted images cannot be moved into {workspace.root} ({error.strerror or error}); "
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
