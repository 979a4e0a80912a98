"""Poses of a model as others write them: rotations brought to length one, and those refused that look away."""

from pathlib import Path

import numpy as np
import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.wide.projection import PANORAMA

# Quaternions in single precision are off by less, which moves nothing.
_FAR_FROM_ONE = 1e-6
# Of so many images, and of each so many observations, points are looked at.
_MOST_IMAGES = 200
_MOST_OBSERVATIONS = 50
# Fewer say nothing of a model; of sound ones, nearly all points are in front of the image.
_FEWEST = 30
_LEAST_IN_FRONT = 0.1


def normalize_rotations(model: pycolmap.Reconstruction) -> None:
    """Give the quaternions of frames the length of one, as COLMAP before 3.12 did when it read them."""
    for frame in model.frames.values():
        if not frame.has_pose():
            continue
        pose = frame.rig_from_world
        with np.errstate(over="ignore"):  # impossible poses are told later
            length = float(np.linalg.norm(pose.rotation.quat))
        if abs(length - 1.0) > _FAR_FROM_ONE and 0.0 < length < np.inf:
            rotation = pycolmap.Rotation3d(pose.rotation.quat / length)
            frame.rig_from_world = pycolmap.Rigid3d(rotation, pose.translation)


def check_points_in_front(model: pycolmap.Reconstruction, sparse_dir: Path) -> None:
    """Raise `InputError` where hardly any point is in front of the images that observe it.

    Panoramas see as well what is behind them.
    """
    ids = model.reg_image_ids()
    observed = 0
    in_front = 0
    for image_id in ids[:: -(-len(ids) // _MOST_IMAGES)]:
        image = model.image(image_id)
        if model.camera(image.camera_id).model_name == PANORAMA:
            continue
        pose = image.cam_from_world().matrix()
        places = image.get_observation_point2D_idxs()
        places = places[:: -(-len(places) // _MOST_OBSERVATIONS) or 1]
        seen = [image.points2D[place].point3D_id for place in places]
        points = [model.point3D(point_id).xyz for point_id in seen if model.exists_point3D(point_id)]
        if not points or not np.isfinite(pose).all():
            continue
        with np.errstate(all="ignore"):  # impossible coordinates are told later
            depth = np.array(points) @ pose[2, :3] + pose[2, 3]
        observed += len(points)
        in_front += int((depth > 0).sum())
    if observed >= _FEWEST and in_front < _LEAST_IN_FRONT * observed:
        raise InputError(
            f"The sparse points of the model in {sparse_dir} lie behind the images that observe them: its poses "
            "are not COLMAP's (camera from world, z forward) or not those of its points; export the model again."
        )
