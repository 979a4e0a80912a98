"""Sparse models with numbers that cannot be, and sound ones of every size and place."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from hostile.cases import Case, Stage, all_names, model_run, workspace_run
from hostile.damage import WORDS, damage_text


def make(stage: Stage) -> Case:
    """A model moved and scaled, with a wrong number, without a part of itself, or with one twice."""
    kinds = (_moved, _wrong_number, _wrong_number, _wrong_number, _wrong_line, _wrong_model)
    return kinds[int(stage.rng.integers(len(kinds)))](stage)


def _moved(stage: Stage) -> Case:
    """The same in other units, and elsewhere: what comes out must be as right."""
    root = stage.copy_project()
    scale = float(stage.pick(1e-6, 1e-3, 0.3, 1.0, 1.0, 7.0, 1e3, 1e6, 1e9, 1e-9))
    shift = scale * np.array(
        stage.pick((0, 0, 0), (0, 0, 0), (3e5, 5e6, 300), (-1e3, 10, 0), (4e6, 1e6, -5e6)), float
    )
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    axis = stage.rng.normal(size=3)
    turn = pycolmap.Rotation3d(axis * stage.rng.uniform(0, 3) / np.linalg.norm(axis))
    model.transform(pycolmap.Sim3d(scale, turn, shift))
    model.write_binary(root / "sparse" / "0")
    # Beyond a certain size floats of 32 bits do not hold what COLMAP's formats must.
    is_usual = 1e-4 < scale < 1e5
    return Case(
        f"scale {scale:g}, shift {shift.tolist()}",
        model_run(root),
        root / "dense",
        names=all_names(),
        whole=is_usual,
        codes=frozenset({0} if is_usual else {0, 2, 4}),
        scale=scale,
        in_place=False,
    )


def _text_model(stage: Stage) -> Path:
    root = stage.copy_project()
    shutil.rmtree(root / "sparse" / "0")
    shutil.copytree(root / "text", root / "sparse" / "0")
    return root


def _wrong_number(stage: Stage) -> Case:
    """One number of a line, or of all lines, of a text model."""
    root = _text_model(stage)
    name, columns = _FIELDS[int(stage.rng.integers(len(_FIELDS)))]
    path = root / "sparse" / "0" / name
    lines = path.read_text().splitlines()
    first = next(n for n, line in enumerate(lines) if not line.startswith("#"))
    step = 2 if name == "images.txt" else 1
    rows = range(first, len(lines), step)
    chosen = rows if stage.chance(0.3) else [rows[int(stage.rng.integers(len(rows)))]]
    column = int(stage.rng.integers(columns))
    word = WORDS[int(stage.rng.integers(len(WORDS)))]
    for row in chosen:
        words = lines[row].split(" ")
        words[min(column, len(words) - 1)] = word
        lines[row] = " ".join(words)
    path.write_text("\n".join(lines) + "\n")
    return Case(
        f"{name}: {word!r} in column {column} of {len(chosen)}", model_run(root), root / "dense", names=all_names()
    )


# Files, and how many of a line's words are numbers that matter.
_FIELDS = (
    ("cameras.txt", 8),
    ("images.txt", 9),
    ("images.txt", 9),
    ("points3D.txt", 12),
    ("rigs.txt", 4),
    ("frames.txt", 14),
)


def _wrong_line(stage: Stage) -> Case:
    root = _text_model(stage)
    name, _ = _FIELDS[int(stage.rng.integers(len(_FIELDS)))]
    path = root / "sparse" / "0" / name
    path.write_bytes(damage_text(path.read_bytes(), stage.rng))
    return Case(f"a line of {name}", model_run(root), root / "dense", names=all_names())


def _wrong_model(stage: Stage) -> Case:
    """What no number of one line can say."""
    in_workspace = stage.chance(0.3)
    root = stage.copy_workspace(stage.grounds.prepared) if in_workspace else stage.copy_project()
    folder = root / "sparse" if in_workspace else root / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    word = str(stage.pick(*_CHANGES))
    _CHANGES[word](model)
    model.write_binary(folder)
    arguments = workspace_run(root) if in_workspace else model_run(root)
    return Case(word, arguments, root if in_workspace else root / "dense", names=all_names())


def _change_points(
    model: pycolmap.Reconstruction, value: Callable[[np.ndarray], np.ndarray], share: float
) -> None:
    points = list(model.points3D.values())
    for point in points[: max(1, int(share * len(points)))]:
        point.xyz = value(point.xyz)


def _remove_points(model: pycolmap.Reconstruction, keep: int) -> None:
    for number in list(model.points3D)[keep:]:
        model.delete_point3D(number)


def _change_pose(model: pycolmap.Reconstruction, translation: tuple[float, float, float], share: float) -> None:
    frames = list(model.frames.values())
    for frame in frames[: max(1, int(share * len(frames)))]:
        turn = frame.rig_from_world.rotation
        frame.rig_from_world = pycolmap.Rigid3d(turn, np.array(translation))


def _change_cameras(model: pycolmap.Reconstruction, width: int, height: int, focal: float) -> None:
    for camera in model.cameras.values():
        camera.width = width
        camera.height = height
        camera.params = [focal, focal, width / 2, height / 2]


_CHANGES: dict[str, Callable[[pycolmap.Reconstruction], None]] = {
    "points that are not a number": lambda model: _change_points(model, lambda xyz: xyz * np.nan, 1),
    "a point that is not a number": lambda model: _change_points(model, lambda xyz: xyz * np.nan, 0),
    "points at infinity": lambda model: _change_points(model, lambda xyz: xyz * np.inf, 0.5),
    "points far away": lambda model: _change_points(model, lambda xyz: xyz * 1e200, 0.5),
    "points behind": lambda model: _change_points(model, lambda xyz: xyz + np.array([0, 0, 1000]), 1),
    "half of the points elsewhere": lambda model: _change_points(
        model, lambda xyz: xyz + np.array([0, 0, 30]), 0.5
    ),
    "points in one place": lambda model: _change_points(model, lambda xyz: np.zeros(3), 1),
    "no point": lambda model: _remove_points(model, 0),
    "one point": lambda model: _remove_points(model, 1),
    "nine points": lambda model: _remove_points(model, 9),
    "all cameras in one place": lambda model: _change_pose(model, (0, 0, 100), 1),
    "one camera elsewhere": lambda model: _change_pose(model, (0, 0, 1e4), 0),
    "one camera nowhere": lambda model: _change_pose(model, (float("nan"), 0, 0), 0),
    "one camera at infinity": lambda model: _change_pose(model, (float("inf"), 0, 0), 0),
    "huge cameras": lambda model: _change_cameras(model, 2**31, 2**31, 1e3),
    "cameras without size": lambda model: _change_cameras(model, 0, 0, 200),
    "cameras of another size": lambda model: _change_cameras(model, 240, 180, 400),
    "a focal length of nothing": lambda model: _change_cameras(model, 120, 90, 0),
    "a negative focal length": lambda model: _change_cameras(model, 120, 90, -200),
    "a tiny focal length": lambda model: _change_cameras(model, 120, 90, 1e-9),
    "a huge focal length": lambda model: _change_cameras(model, 120, 90, 1e12),
    "a wrong focal length": lambda model: _change_cameras(model, 120, 90, 150),
}
