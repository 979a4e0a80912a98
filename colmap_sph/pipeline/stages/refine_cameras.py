"""With polishing, on request: the original model and ties → cameras that fit better, as a model for another run.

First the distortion that an OPENCV camera can have, then a lens field. Each is taken where ties that had no part
in it fit clearly better, the field where better than with the distortion.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_sph.project.lens.files import read_lens_fields
from colmap_sph.project.polishing.adjustment import Observations
from colmap_sph.project.polishing.cameras import Lenses, straightened, with_distortion, with_fields
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.scene import Scene
from colmap_sph.stereo.poses.tracks import Tracks, track_errors, triangulated


@dataclass(frozen=True, eq=False)
class CamerasToRefine:
    """A model of original images, and ties in its undistorted ones.

    Attributes
    ----------
    model_dir : Path
        The original model.
    options : UndistortionOptions
        How these were undistorted.
    scene : Scene
        Of the undistorted images.
    used, held_out : Tracks
        To refine by, and to judge by.
    step : callable
        Called between the distortion and the fields.
    """

    model_dir: Path
    options: UndistortionOptions
    scene: Scene
    used: Observations
    held_out: Tracks
    step: Callable[[], None]


def refine_cameras(task: CamerasToRefine, before: float, least_gain: float, target: Path) -> str:
    """Refine cameras; writes the model with those that fit clearly better.

    Parameters
    ----------
    task : CamerasToRefine
    before : float
        What ties that have no part in it miss by, pixels (median), with the given cameras.
    least_gain : float
        By which share this must fall.
    target : Path
        Folder to write.

    Returns
    -------
    str
        What came of it, in a sentence.
    """
    if read_lens_fields(task.model_dir):
        return "The cameras are kept as given: they have lens fields already."
    given = Lenses(load_model(task.model_dir))
    best = given
    error = before
    tried = np.inf
    options = task.options.for_colmap()
    for refine in (with_distortion, with_fields):
        if refine is with_fields:
            task.step()
        refined = refine(given, task.used, options)
        if refined is None:
            continue
        fits = _error(task, given, refined)
        tried = min(tried, fits)
        if fits <= (1 - least_gain) * error:
            best = refined
            error = fits
    if best is given:
        found = f"({tried:.2f} px)" if np.isfinite(tried) else "(none could be found)"
        return f"The cameras are kept as given: refined ones are not clearly better {found}."
    best.write(target)
    return (
        f"Cameras were refined ({best.words(given)}): ties that had no part in it fit to {error:.2f} px, "
        f"with the given cameras to {before:.2f} px."
    )


def _error(task: CamerasToRefine, given: Lenses, refined: Lenses) -> float:
    """What ties that had no part in it miss by with refined cameras, pixels (median)."""
    views = task.scene.views
    held_out = Observations(
        task.used.names, task.held_out.track, task.held_out.view, task.held_out.pixels, task.used.points, 0.0
    )
    calibrations = [view.K for view in views]
    poses, pixels = straightened(given, refined, held_out, calibrations, task.options.for_colmap())
    moved = Tracks(task.held_out.track, task.held_out.view, pixels)
    posed = [replace(view, R=pose[:, :3], t=pose[:, 3]) for view, pose in zip(views, poses, strict=True)]
    return float(np.nanmedian(track_errors(moved, triangulated(moved, posed), posed)))
