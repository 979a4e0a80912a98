"""The polished model in its workspace: in the place of the one that was undistorted, which is kept beside it.

`sparse` holds the polished model, so that whoever goes on from the workspace finds the poses of its maps. The
given one lies in our own folder, and takes its place again when a run does not ask for polishing. The marker says
what each was when it was written. An interruption leaves a marker that is not finished, and the next run
undistorts the model anew.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from colmap_sph.errors import OutputError, reason_of
from colmap_sph.project.files import make_dir, scratch_folder
from colmap_sph.project.undistortion.marker import (
    Marker,
    is_model_changed,
    model_digests,
    publish_model,
    read_marker,
    write_marker,
)
from colmap_sph.project.workspace import Workspace


def starting_model(workspace: Workspace) -> Path:
    """Folder of the model that polishing starts from: the given one where that was set aside, else `sparse`."""
    marker = _unchanged(workspace)
    return workspace.given_model_dir if marker is not None and marker.given else workspace.sparse_dir


def is_users_model(workspace: Workspace) -> bool:
    """Whether the workspace has a model that is not as this program wrote it."""
    marker = read_marker(workspace)
    return marker is not None and is_model_changed(workspace, marker)


def known_outcome(workspace: Workspace, key: str) -> dict[str, Any] | None:
    """What polishing came to under a key, where the workspace's model is still that of it."""
    marker = _unchanged(workspace)
    if marker is None or marker.polish.get("key") != key:
        return None
    outcome = marker.polish.get("outcome")
    return outcome if isinstance(outcome, dict) else None


def publish_polished(workspace: Workspace, made: Path, key: str, outcome: dict[str, Any]) -> None:
    """Put a polished model in the place of the given one, which is kept.

    Parameters
    ----------
    workspace : Workspace
    made : Path
        Folder with the files of the model, on the same disk; they are moved.
    key : str
        What it was made under.
    outcome : dict
        What to say of it later: plain values.
    """
    marker = _finished_marker(workspace)
    if not marker.given:  # else it lies there, and what is to be replaced was polished, too
        _copy(workspace.sparse_dir, workspace.given_model_dir, marker)
    given = marker.given or marker.files
    marker = replace(marker, given=given, polish={"key": key, "outcome": outcome})
    publish_model(workspace, marker, made, marker.images)


def keep_given(workspace: Workspace, key: str, outcome: dict[str, Any]) -> None:
    """Write down that the given model stays, and why; see `publish_polished`."""
    restore_given(workspace)
    marker = _finished_marker(workspace)
    write_marker(workspace, replace(marker, polish={"key": key, "outcome": outcome}))


def restore_given(workspace: Workspace) -> None:
    """Put the given model back into its place, where a polished one has that."""
    marker = _unchanged(workspace)
    if marker is None or not marker.given:
        return
    with scratch_folder(workspace.polishing_scratch_dir):
        copy = workspace.polishing_scratch_dir / "given"
        _copy(workspace.given_model_dir, copy, marker)
        publish_model(workspace, replace(marker, given={}, polish={}), copy, marker.images)


def _unchanged(workspace: Workspace) -> Marker | None:
    """The marker of a workspace whose model is as this program wrote it; None of any other."""
    marker = read_marker(workspace)
    if marker is None or not marker.is_finished or is_model_changed(workspace, marker):
        return None
    return marker


def _finished_marker(workspace: Workspace) -> Marker:
    marker = read_marker(workspace)
    assert marker is not None and marker.is_finished
    return marker


def _copy(source: Path, target: Path, marker: Marker) -> None:
    """Copy the files of a model; others in the target are removed."""
    names = marker.given or marker.files
    try:
        shutil.rmtree(target, ignore_errors=True)
        make_dir(target)
        for name in names:
            shutil.copyfile(source / name, target / name)
    except OSError as error:
        raise OutputError(
            f"The model cannot be copied to {target} ({reason_of(error)}); check space and permissions."
        ) from error
    if model_digests(target) != names:
        raise OutputError(f"The model copied to {target} is not whole; check the disk.")
