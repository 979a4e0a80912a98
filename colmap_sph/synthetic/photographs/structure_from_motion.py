"""Models as structure from motion leaves them: poses disturbed, or adjusted to what the images show."""

from __future__ import annotations

import numpy as np
import pycolmap

from colmap_sph.synthetic.photographs.imperfections import Imperfections
from colmap_sph.synthetic.primitives import FloatArray

_DISTURBED = 401


def disturb(model: pycolmap.Reconstruction, effects: Imperfections, seed: int) -> None:
    """Give a model the errors that the effects ask for, in place; its points stay, but for an adjustment.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        With exact poses.
    effects : Imperfections
    seed : int
    """
    centres = {number: image.projection_center() for number, image in model.images.items()}
    if effects.rotation_error > 0 or effects.centre_error > 0:
        rng = np.random.default_rng((seed, _DISTURBED))
        for number in sorted(model.images):
            _disturb_pose(model, model.images[number], effects, rng)
    if effects.bundle_adjusted:
        _adjust(model)
        _align(model, centres)
    model.update_point_3d_errors()


def _disturb_pose(
    model: pycolmap.Reconstruction, image: pycolmap.Image, effects: Imperfections, rng: np.random.Generator
) -> None:
    pose = image.cam_from_world()
    focal_length = model.cameras[image.camera_id].mean_focal_length()
    seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
    depth = np.median((np.array(seen) @ pose.rotation.matrix().T + pose.translation)[:, 2]) if seen else 0.0
    turn = pycolmap.Rotation3d(rng.normal(0, effects.rotation_error / focal_length, 3))
    centre = image.projection_center() + rng.normal(0, effects.centre_error * depth / focal_length, 3)
    rotation = turn * pose.rotation
    # Every camera is the only one of its rig: the rig's pose is the camera's.
    model.frames[image.frame_id].rig_from_world = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ centre))


def _adjust(model: pycolmap.Reconstruction) -> None:
    """Bundle adjustment of poses and points, robustly; on one thread, so that it can be repeated."""
    options = pycolmap.BundleAdjustmentOptions()
    # A small block over nearly flat ground hardly knows its focal lengths: wrong ones would hide all else.
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.images:
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _align(model: pycolmap.Reconstruction, centres: dict[int, FloatArray]) -> None:
    """Similarity that brings the cameras' centres to the true ones, by least squares (Umeyama 1991)."""
    target = np.array(list(centres.values()))
    source = np.array([model.images[number].projection_center() for number in centres])
    target_mean = target.mean(axis=0)
    source_mean = source.mean(axis=0)
    U, singular, Vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    turn = U @ np.diag(signs) @ Vt
    scale = float(singular @ signs / np.sum((source - source_mean) ** 2))
    shift = target_mean - scale * turn @ source_mean
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), shift))
