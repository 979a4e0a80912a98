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
    images = [image for image in map(model.image, written) if image.has_pose]
    found = np.array([image.cam_from_world().params for image in images]).reshape(-1, 7)
    w, x, y, z, *translation = np.array([written[image.image_id] for image in images]).reshape(-1, 7).T
    told = np.array([x, y, z, w, *translation]).T
    with np.errstate(all="ignore"):  # impossible poses are told later
        for poses in (found, told):
            poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
        # Both signs of a quaternion are the same rotation.
        found[:, :4] *= np.copysign(1.0, (found[:, :4] * told[:, :4]).sum(axis=1, keepdims=True))
        off = np.abs(found - told)
    is_possible = np.isfinite(told).all(axis=1)
    far = np.abs(told[is_possible, 4:]).max(initial=0.0)
    is_same = (off <= _SAME_POSE * np.array([1.0] * 4 + [far] * 3)).all(axis=1)
    if (is_possible & ~is_same).any():
        name = images[int(np.argmax(is_possible & ~is_same))].name
        in_rigs, in_frames, in_images = (there[stem].name for stem in ("rigs", "frames", "images"))
        raise InputError(
            f"The model in {there['images'].parent} has two poses of {name!r}, one in {in_images} and another in "
            f"{in_frames}; delete {in_rigs} and {in_frames} if {in_images} is right, or export the model from "
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
