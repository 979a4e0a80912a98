"""Poses of a model as others write them: rotations brought to length one; those that look away, or that there are
two of, are refused."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from colmap_sph.errors import InputError
from colmap_sph.project.wide.projection import PANORAMA

# Quaternions in single precision are off by less, which moves nothing.
_FAR_FROM_ONE = 1e-6
# Of rotations, and of translations as a share of the largest: what is written with six digits is off by less.
_SAME_POSE = 1e-5
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


def check_written_poses(
    model: pycolmap.Reconstruction, written: Mapping[int, Sequence[float]], files: Sequence[Path]
) -> None:
    """Raise `InputError` where an image has another pose in the frames, which COLMAP takes, than beside its name.

    So it is where a program that knows no frames, such as COLMAP before 3.12, has written a changed model over one
    that has them.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        As it was read.
    written : mapping of int to sequence of float
        Quaternion (w, x, y, z) and translation of images by their ids, as the file of images has them.
    files : sequence of Path
        The model's files.
    """
    there = {path.stem: path for path in files}
    if "frames" not in there:
        return
    far = max((abs(value) for pose in written.values() for value in pose[4:] if np.isfinite(value)), default=0.0)
    for image_id, (w, x, y, z, *translation) in written.items():
        image = model.image(image_id)
        if not image.has_pose:
            continue
        rotation = pycolmap.Rotation3d(np.array([x, y, z, w]))
        rotation.normalize()
        pose = np.column_stack([rotation.matrix(), translation])
        with np.errstate(all="ignore"):  # impossible poses are told later
            off = np.abs(image.cam_from_world().matrix() - pose)
        if np.isfinite(pose).all() and not (off <= _SAME_POSE * np.array([1.0, 1.0, 1.0, far])).all():
            rigs, frames, images = (there[stem].name for stem in ("rigs", "frames", "images"))
            raise InputError(
                f"The model in {there['images'].parent} has two poses of {image.name!r}, one in {images} and "
                f"another in {frames}; delete {rigs} and {frames} if {images} is right, or export the model from "
                "COLMAP again."
            )


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
