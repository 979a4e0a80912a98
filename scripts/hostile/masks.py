"""Masks: sound ones that must be obeyed, and files that are none."""

import os
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hostile.cases import Case, Stage, model_run, workspace_run
from hostile.damage import damage_bytes
from hostile.grounds import NAMES, depth_path, read_depth
from hostile.runs import Outcome

# Rows from the top that are masked, and those of them that no resampling of the mask's edge reaches.
_ROWS = 40
_SURE_ROWS = 35


def make(stage: Stage) -> Case:
    """Masks of some images, by either of COLMAP's two names, of which one may be hostile."""
    in_workspace = stage.chance(0.4)
    root = stage.copy_workspace(stage.grounds.prepared) if in_workspace else stage.copy_project()
    folder = stage.world / "masks"
    short = stage.chance(0.4)
    masked = [str(name) for name in stage.rng.permutation(NAMES)[: int(stage.rng.integers(1, 5))]]
    for name in masked:
        path = folder / (f"{name}.png" if not short else str(Path(name).with_suffix(".png")))
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, _mask(), str(stage.pick("L", "L", "RGB", "1", "P", "16", "RGBA", "JPEG")))
    word = "sound"
    if stage.chance(0.7):
        word = _spoil(stage, path)
    arguments = (workspace_run if in_workspace else model_run)(root, "--masks", str(folder))
    dense = root if in_workspace else root / "dense"
    kept = (
        tuple(path for part in ("images", "sparse") for path in (root / part).rglob("*")) if in_workspace else ()
    )
    sound = [name for name in masked if name != masked[-1] or word == "sound"]
    return Case(
        f"{'short' if short else 'long'} names, {len(masked)} masks, one {word}",
        arguments,
        dense,
        kept,
        names={name: name for name in NAMES},
        codes=frozenset({0, 5} if word == "sound" else {0, 2, 4, 5}),
        checks=tuple(partial(_shines_through, dense, name) for name in sound),
    )


def _mask() -> NDArray[np.uint8]:
    mask = np.full((90, 120), 255, np.uint8)
    mask[:_ROWS] = 0
    return mask


def _write(path: Path, mask: NDArray[np.uint8], mode: str) -> None:
    if mode == "16":
        path.write_bytes(cv2.imencode(".png", mask.astype(np.uint16) * 257)[1].tobytes())
    elif mode == "JPEG":  # whatever its name says
        Image.fromarray(mask).save(path, "JPEG", quality=100)
    else:
        Image.fromarray(mask).convert(mode).save(path, "PNG")


def _spoil(stage: Stage, path: Path) -> str:
    rng = stage.rng
    data = path.read_bytes()
    word = str(
        stage.pick("damaged", "cut", "empty", "black", "wrong size", "pipe", "folder", "link to zero", "text")
    )
    path.unlink()
    if word == "damaged":
        path.write_bytes(damage_bytes(data, rng))
    elif word == "cut":
        path.write_bytes(data[: int(rng.integers(1, len(data)))])
    elif word == "black":
        _write(path, np.zeros((90, 120), np.uint8), "L")
    elif word == "wrong size":
        _write(path, _mask()[:, :60], "L")
    elif word == "pipe":
        os.mkfifo(path)
    elif word == "folder":
        path.mkdir()
    elif word == "link to zero":
        path.symlink_to("/dev/zero")
    else:
        path.write_text("" if word == "empty" else "no mask")
    return word


def _shines_through(dense: Path, name: str, outcome: Outcome) -> str | None:
    """Whether a depth map has depth where its mask is black."""
    path = depth_path(dense, name)
    if outcome.code not in (0, 5) or not path.is_file():
        return None
    masked = np.count_nonzero(read_depth(path)[:_SURE_ROWS])
    return f"{name} has {masked} depths where its mask is black" if masked else None
