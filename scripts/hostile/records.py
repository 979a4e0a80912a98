"""Records of a finished run that are valid JSON with a right checksum, and say something else."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from colmap_sph.pipeline.digests import digest
from hostile.cases import Case, Stage, all_names, files_below, model_run, workspace_run
from hostile.damage import damage_text, damage_value


def make(stage: Stage) -> Case:
    """Change a value of one to three of our records, or of what our containers hold."""
    by_model = stage.chance(0.5)
    if by_model:
        dense = stage.copy_project(finished=True) / "dense"
        arguments = model_run(dense.parent)
        clean = stage.grounds.project("plain") / "dense"
    else:
        dense = stage.copy_workspace(stage.grounds.adopted)
        arguments = workspace_run(dense)
        clean = stage.grounds.adopted
    files = files_below(dense / "colmap_sph", "*.json", "*.npz")
    chosen = stage.rng.choice(len(files), int(stage.rng.integers(1, 4)), replace=False)
    changed = [files[int(number)] for number in chosen]
    for path in changed:
        (_change_container if path.suffix == ".npz" else _change_record)(stage, path)
    # A record of the undistortion that says something else is of another project, for all that can be known.
    is_marker = any(path.name == "undistortion.json" for path in changed)
    more = ("--overwrite",) if is_marker else ()
    return Case(
        "record " + ", ".join(str(path.relative_to(dense)) for path in changed),
        arguments,
        dense,
        names=all_names(),
        same_as=clean,
        again=(*arguments, *more),
        attempts=2,
    )


def _change_record(stage: Stage, path: Path) -> None:
    text = path.read_bytes()
    if stage.chance(0.15):
        path.write_bytes(damage_text(text, stage.rng))
        return
    value = _damaged(stage, json.loads(text))
    try:
        path.write_text(json.dumps(value, indent=1), encoding="utf-8")
    except RecursionError:
        path.write_text("[" * 100_000)


def _damaged(stage: Stage, value: Any) -> Any:
    """Another value, with the checksum that belongs to it."""
    if not isinstance(value, dict) or "check" not in value:
        return damage_value(value, stage.rng)
    inner = {name: each for name, each in value.items() if name != "check"}
    changed = damage_value(inner, stage.rng)
    if not isinstance(changed, dict):
        return changed
    try:
        return changed | {"check": digest(changed)}
    except (TypeError, RecursionError):
        return changed | {"check": value["check"]}


def _change_container(stage: Stage, path: Path) -> None:
    with np.load(path) as arrays:
        content = {name: arrays[name] for name in arrays.files}
    name = str(stage.pick(*content))
    array = content[name]
    if name == "metadata":
        try:
            array = np.array(json.dumps(damage_value(json.loads(str(array)), stage.rng)))
        except RecursionError:
            array = np.array("[" * 100_000)
    elif name != "key":
        odd: tuple[Any, ...] = (
            array[..., :-1],
            array[None],
            array.astype(np.float64),
            array.astype(str),
            np.zeros((0, 0), array.dtype),
            np.full_like(array, np.iinfo(array.dtype).max if array.dtype.kind in "iu" else np.nan),
            array.ravel(),
            np.zeros(1 << 20, bool),
        )
        array = odd[int(stage.rng.integers(len(odd)))]
    np.savez(path, **(content | {name: array}))
