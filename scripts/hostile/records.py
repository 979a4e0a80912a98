"""Records of a finished run that are valid JSON with a right checksum, and say something else."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
from numpy.typing import NDArray

from colmap_sph.project.state.array_file import Head, read_arrays, read_head, write_arrays
from hostile.cases import Case, Stage, all_names, files_below, model_run, workspace_run
from hostile.damage import NUMBERS, damage_text, damage_value


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
    files = files_below(dense / "colmap_sph", "*.json", "*.sph")
    chosen = stage.rng.choice(len(files), int(stage.rng.integers(1, 4)), replace=False)
    changed = [files[int(number)] for number in chosen]
    for path in changed:
        (_change_container if path.suffix == ".sph" else _change_record)(stage, path)
    # A record of the undistortion that says something else is of another project, for all that can be known; and a
    # content that is a possible one, under its right checksum, is what was found.
    is_believed = any(path.name == "undistortion.json" or path.suffix == ".sph" for path in changed)
    return Case(
        "record " + ", ".join(str(path.relative_to(dense)) for path in changed),
        arguments,
        dense,
        names=all_names(),
        same_as=None if is_believed else clean,
        again=() if is_believed else arguments,
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
        return changed | {"check": xxhash.xxh3_128_hexdigest(json.dumps(changed, sort_keys=True).encode())}
    except (TypeError, RecursionError):
        return changed | {"check": value["check"]}


def _change_container(stage: Stage, path: Path) -> None:
    """Write a file of arrays with another text, number or array, and right checksums."""
    head, arrays = _read_container(path)
    texts = list(head.texts)
    numbers = list(head.numbers)
    what = str(stage.pick("text", "number", "array", "array", "arrays", "kind"))
    kind = head.kind
    if what == "text" and texts:
        texts[int(stage.rng.integers(len(texts)))] = str(
            stage.pick("", "x", "../x", "N_0_0.png", "\x1b[31m\n", "x" * 9999)
        )
    elif what == "number" and numbers:
        numbers[int(stage.rng.integers(len(numbers)))] = float(stage.pick(*NUMBERS))
    elif what == "array":
        place = int(stage.rng.integers(len(arrays)))
        arrays[place] = stage.pick(*_odd_arrays(arrays[place]))
    elif what == "arrays":
        arrays = [*arrays, arrays[0]] if stage.chance(0.5) else arrays[1:]
    else:
        kind = str(stage.pick("pair", "estimate", "", "other"))
    write_arrays(path, kind, head.key, arrays, texts=texts, numbers=numbers)


def _read_container(path: Path) -> tuple[Head, list[NDArray[Any]]]:
    head = read_head(path)
    assert head is not None
    return read_arrays(path, head.kind, lambda head: head.arrays)


def _odd_arrays(array: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    most = np.iinfo(array.dtype).max if array.dtype.kind == "u" else np.nan
    return (
        array[..., :-1],
        array[None],
        array.ravel(),
        array.astype("<f4"),
        array.astype("<u1"),
        np.zeros((1, 1), array.dtype),
        np.full_like(array, most),
        np.zeros(1 << 20, "<u1"),
    )
