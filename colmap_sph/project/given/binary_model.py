"""COLMAP binary model → pycolmap model, once its files are known to be whole.

COLMAP's own readers trust the counts in the files: a truncated ``cameras.bin`` gives an invented calibration
without a word, and a damaged ``points3D.bin`` or ``frames.bin`` keeps them busy for minutes. So each file is
walked record by record first, without looking at the numbers themselves. The layouts are those of COLMAP's
``src/colmap/scene/reconstruction_io_binary.cc``.
"""

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import open_regular
from colmap_sph.project.given.poses import check_written_poses, normalize_rotations

_POSE_BYTES = 7 * 8


def read_binary_model(files: list[Path]) -> pycolmap.Reconstruction:
    """Read a binary model.

    Parameters
    ----------
    files : list of Path
        ``cameras.bin``, ``images.bin`` and ``points3D.bin``, with or without ``rigs.bin`` and
        ``frames.bin``, of one folder.

    Raises
    ------
    InputError
        A file cannot be read, or does not hold exactly the records it announces.
    Exception
        COLMAP's own, where the records contradict each other; for the caller to put into a sentence.
    """
    for path in files:
        check_file(path)
    model = pycolmap.Reconstruction()
    model.read_binary(files[0].parent)
    normalize_rotations(model)
    if files[-1].stem == "frames":
        check_written_poses(model, _written_poses(files[1]), files)
    return model


def _written_poses(path: Path) -> dict[int, tuple[float, ...]]:
    """Quaternions and translations of ``images.bin``, which is whole, by the ids of images."""
    poses = {}
    with open_regular(path) as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        (count,) = struct.unpack_from("<Q", data)
        offset = 8
        for _ in range(count):
            image_id, *pose = struct.unpack_from("<I7d", data, offset)
            poses[image_id] = tuple(pose)
            offset = image_end(data, offset)
    return poses


def check_file(path: Path) -> None:
    """Raise `InputError` unless `path` holds exactly the records it announces."""
    try:
        with open_regular(path) as file:
            size = path.stat().st_size
            if size < 8:
                raise InputError(f"{path} is truncated; export the model from COLMAP again.")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                end = _walk(data, _RECORD_END[path.name])
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason_of(error)}); check the file.") from error
    if end != size:
        raise InputError(f"{path} is truncated or damaged; export the model from COLMAP again.")


def _walk(data: mmap.mmap, record_end: Callable[[mmap.mmap, int], int]) -> int:
    """Return the offset behind the last announced record, or -1 where a record does not fit."""
    (count,) = struct.unpack_from("<Q", data)
    size = len(data)
    offset = 8
    try:
        for _ in range(count):
            offset = record_end(data, offset)
            if offset > size:
                return -1
    except (struct.error, ValueError, IndexError):
        return -1
    return offset


def _camera_end(data: mmap.mmap, offset: int) -> int:
    (model_id,) = struct.unpack_from("<i", data, offset + 4)
    camera_model = pycolmap.CameraModelId(model_id)
    return offset + 24 + 8 * len(pycolmap.Camera.create_from_model_id(0, camera_model, 1, 1, 1).params)


def image_end(data: mmap.mmap, offset: int) -> int:
    """Offset behind a record of ``images.bin``."""
    end_of_name = data.find(b"\0", offset + 8 + _POSE_BYTES)
    if end_of_name < 0:
        raise ValueError("an image name that does not end")
    (num_points2D,) = struct.unpack_from("<Q", data, end_of_name + 1)
    return int(end_of_name + 9 + 24 * num_points2D)


def point3D_end(data: mmap.mmap, offset: int) -> int:
    """Offset behind a record of ``points3D.bin``."""
    (track_length,) = struct.unpack_from("<Q", data, offset + 43)
    return int(offset + 51 + 8 * track_length)


def _rig_end(data: mmap.mmap, offset: int) -> int:
    (num_sensors,) = struct.unpack_from("<I", data, offset + 4)
    # The reference sensor has no pose.
    offset += 8 + (8 if num_sensors else 0)
    for _ in range(1, num_sensors):
        offset += 9 + (_POSE_BYTES if data[offset + 8] else 0)
    return offset


def _frame_end(data: mmap.mmap, offset: int) -> int:
    (num_data_ids,) = struct.unpack_from("<I", data, offset + 8 + _POSE_BYTES)
    return int(offset + 12 + _POSE_BYTES + 16 * num_data_ids)


_RECORD_END: dict[str, Callable[[mmap.mmap, int], int]] = {
    "cameras.bin": _camera_end,
    "images.bin": image_end,
    "points3D.bin": point3D_end,
    "rigs.bin": _rig_end,
    "frames.bin": _frame_end,
}
