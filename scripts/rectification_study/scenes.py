"""Rendered scenes with exact depth for the study."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from colmap_sph import synthetic as syn

SceneName = Literal["walk", "drive", "town"]
"""A street passed with a picture every metre, and every 2.8; a convergent oblique block."""


@dataclass(frozen=True)
class StudyScene:
    """Files of a scene.

    Attributes
    ----------
    model : Path
    images : Path, optional
        Default: the folder `images` beside or above the model.
    exact_depth : Path
        Exact depth at pixel centres.
    depth_scale : float, optional
        Of integer depth maps.
    """

    model: Path
    images: Path | None
    exact_depth: Path
    depth_scale: float | None = None


def find_scene(name: SceneName, folder: Path, width: int, threads: int = 1) -> StudyScene:
    """Render a scene into a folder unless it is there."""
    scene = StudyScene(folder / "sparse" / "0", folder / "images", folder / "depth")
    if not (folder / "done").is_file():
        print(f"rendering {name}, {width} pixels wide, into {folder}", flush=True)
        capture = _RENDERED[name](folder, width, threads)
        write_exact_depth(capture.names, capture.cameras, capture.surfaces, scene.exact_depth)
        (folder / "done").touch()
    return scene


def write_exact_depth(
    names: Sequence[str], cameras: Sequence[syn.Camera], surfaces: Sequence[syn.Surface], folder: Path
) -> None:
    """Write exact depth at pixel centres, FOLDER/NAME.npy."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, camera in zip(names, cameras, strict=True):
        depth, _, _ = syn.exact_geometry(surfaces, camera, origin=0.5)
        np.save(folder / f"{name}.npy", depth.astype(np.float32))


def _canyon(step: float) -> Callable[[Path, int, int], syn.Capture]:
    def make(folder: Path, width: int, threads: int) -> syn.Capture:
        effects = syn.Imperfections(sky=True, clouds=0.4)
        options = syn.CanyonOptions(width=width, height=width * 2 // 3, step=step, effects=effects)
        return syn.make_canyon_block(folder, options, threads=threads)

    return make


def _town(folder: Path, width: int, threads: int) -> syn.Capture:
    # The same ground whatever the width.
    options = syn.TownOptions(
        width=width, height=width * 2 // 3, nadir_gsd=96 / width, oblique_gsd=110 / width, points=8000
    )
    return syn.make_town_block(folder, options, threads=threads)


_RENDERED: dict[str, Callable[[Path, int, int], syn.Capture]] = {
    "walk": _canyon(1.0),
    "drive": _canyon(2.8),
    "town": _town,
}
