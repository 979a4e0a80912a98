"""A cloud at any path, in each of the kinds of COLMAP's ``stereo_fusion``: PLY, or a model, binary or text."""

import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError, OutputError, reason_of, unwritable
from colmap_sph.platforms.files import move_into_place
from colmap_sph.project.files import make_dir, open_regular, real_path, whole_digest
from colmap_sph.project.map_coordinates import move_cloud
from colmap_sph.project.sparse_model import MODEL_FILES, RIG_FILES, load_model, write_model
from colmap_sph.project.state.records import altered_files, begin, read_record, vouch
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import POINT

_PLY_START = b"ply"
_PLY_END = b"end_header\n"
_PLY_COUNT = re.compile(rb"^element vertex (\d{1,18})\s*$", re.MULTILINE)
_HEADER_BYTES = 4096
_MODEL_KINDS = ("bin", "txt")
# Of a model in map coordinates.
_FAR_POINT = np.dtype([("xyz", "<f8", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])


@dataclass(frozen=True)
class CloudOutput:
    """Where a cloud goes, and as what.

    Attributes
    ----------
    path : Path
        Of a PLY file, beside which ``.vis`` goes; or of the folder of a model.
    kind : {"ply", "bin", "txt"}
    """

    path: Path
    kind: Literal["ply", "bin", "txt"]

    @property
    def files(self) -> tuple[Path, Path]:
        """The two files of a PLY cloud."""
        return self.path, self.path.with_name(f"{self.path.name}.vis")

    def check(self, workspace: Workspace) -> None:
        """Raise `ColmapSphError` for a path where the cloud of a workspace cannot go, before anything is done."""
        _check_room(self.path.parent)
        if self.kind == "ply":
            for path in self.files:
                _check_file(path)
            is_own = real_path(self.path) == real_path(workspace.fused_path)  # where nothing of others is lost
            _check_is_cloud(*self.files, is_own=is_own)
            return
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path} is a file, and the cloud's model a folder; name a folder.")
        if real_path(self.path) == real_path(workspace.sparse_dir):
            raise InputError(f"{self.path} is the workspace's own model; name another folder for the cloud's.")
        if self.kind == "txt" and (self.path / "points3D.bin").exists():
            raise OutputError(
                f"{self.path} holds a binary model, which is read before a text one; name another folder."
            )
        for record, files in map(self._model, _MODEL_KINDS):
            foreign = altered_files(read_record(record), files)
            if foreign:
                raise OutputError(
                    f"{foreign[0]} is there already, and not as this program wrote a cloud's model there; name "
                    "another folder, or remove that model."
                )

    def _model(self, kind: str) -> tuple[Path, tuple[Path, ...]]:
        """The record of a cloud's model of this kind, and its files."""
        files = (f"{stem}.{kind}" for stem in (*MODEL_FILES, *RIG_FILES))
        return self.path / f"colmap_sph_{kind}.json", tuple(self.path / file for file in files)

    def write(self, made: Workspace, sparse_dir: Path, origin: NDArray[np.float64]) -> None:
        """Put a finished cloud there.

        Parameters
        ----------
        made : Workspace
            Scratch folder with ``fused.ply`` and ``fused.ply.vis``, relative to `origin`.
        sparse_dir : Path
            Model whose images saw the points.
        origin : (3,) float64 ndarray
            Added to the points.

        Raises
        ------
        OutputError
            It cannot be written.
        """
        make_dir(self.path.parent)
        try:
            if self.kind == "ply":
                self._move(made, origin)
            else:
                make_dir(self.path)
                model = cloud_as_model(made.cloud_paths, sparse_dir, origin)
                record, files = self._model(self.kind)
                begin(record, files)  # from here on they are ours, whatever happens
                write_model(model, self.path, as_text=self.kind == "txt")
                vouch(record, "", {file: whole_digest(file) for file in files})
        except (OSError, RuntimeError) as error:
            raise unwritable(self.path, error) from error

    def _move(self, made: Workspace, origin: NDArray[np.float64]) -> None:
        cloud, visible = made.cloud_paths
        if origin.any():
            moved = made.root / "moved.ply"
            move_cloud(cloud, moved, origin)
            cloud = moved
        # A kill in between must not leave a cloud beside the visibility of another.
        self.files[1].unlink(missing_ok=True)
        for source, file in zip((cloud, visible), self.files, strict=True):
            target = real_path(file)
            beside = target.with_name(f".{os.getpid()}.tmp")  # a disk of its own may be there
            shutil.move(source, beside)
            move_into_place(beside, target)


def _check_room(folder: Path) -> None:
    """Raise `OutputError` where a file cannot be made in a folder that need not exist: fusion may take hours."""
    there = next(each for each in (folder, *folder.absolute().parents) if each.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise OutputError(f"Nothing can be written in {there}; choose another --output_path.")


def _check_file(path: Path) -> None:
    """Raise `OutputError` for a path at which there is something else than an ordinary file."""
    if path.is_dir():
        raise OutputError(f"{path} is a folder, and the cloud is a file; name a file in it.")
    if path.exists() and not path.is_file():
        raise OutputError(f"{path} is a device or a pipe, and the cloud is a file; name a file.")


def _check_is_cloud(path: Path, visibility: Path, *, is_own: bool) -> None:
    """Raise `OutputError` for a file that no fusion made: a slip must not cost an image, a map, or a scan.

    Fusion, ours and COLMAP's, puts a file beside its cloud that begins with the number of its points.
    """
    if not path.is_file():
        return
    try:
        start = _start_of(path)
        count = _start_of(visibility)[:8] if visibility.is_file() else b""
    except OSError as error:
        raise OutputError(f"{path} cannot be replaced ({reason_of(error)}); name another file.") from error
    if not start:
        return
    if not start.startswith(_PLY_START):
        raise OutputError(f"{path} is there already, and is no cloud; name another file, or remove this one.")
    found = _PLY_COUNT.search(start)
    if not is_own and (found is None or int(found[1]) != int.from_bytes(count, "little")):
        raise OutputError(
            f"{path} is there already, and is not from fusion, which would have put {visibility.name} beside it; "
            "name another file, or remove this one."
        )


def _start_of(path: Path) -> bytes:
    with open_regular(path) as file:
        return file.read(_HEADER_BYTES)


def read_back(output: CloudOutput, workspace: Workspace) -> pycolmap.Reconstruction:
    """Read a cloud that was written, with the images and cameras of its workspace."""
    if output.kind == "ply":
        return cloud_as_model(output.files, workspace.sparse_dir, np.zeros(3))
    return pycolmap.Reconstruction(output.path)


def cloud_as_model(
    files: tuple[Path, Path], sparse_dir: Path, origin: NDArray[np.float64]
) -> pycolmap.Reconstruction:
    """Return the model of a workspace with the points of a cloud in place of its own.

    Each point's track holds the images that agree on it, where it projects in them: COLMAP's own fusion leaves the
    points without tracks, and the images with references to the sparse points.

    Parameters
    ----------
    files : pair of Path
        The cloud, as this program writes it, and its visibility.
    sparse_dir, origin
        See `CloudOutput.write`.
    """
    points = _read_points(files[0])
    owners, images = _read_visibility(files[1], len(points))
    source = load_model(sparse_dir)
    model = pycolmap.Reconstruction()
    for camera in source.cameras.values():
        model.add_camera_with_trivial_rig(camera)
    ids = source.reg_image_ids()
    places = np.empty(len(images), np.int64)
    for index, image_id in enumerate(ids):
        mine = np.flatnonzero(images == index)
        places[mine] = np.arange(len(mine))
        xyz = points["xyz"][owners[mine]].astype(np.float64)
        _add_image(model, source, image_id, xyz, origin)
    _add_points(model, points, origin, np.array(ids)[images], places, np.bincount(owners, minlength=len(points)))
    return model


def _add_image(
    model: pycolmap.Reconstruction,
    source: pycolmap.Reconstruction,
    image_id: int,
    points: NDArray[np.float64],
    origin: NDArray[np.float64],
) -> None:
    """Add an image with the projections of points, which are relative to `origin`, as its key points."""
    image = source.image(image_id)
    pose = image.cam_from_world().matrix()
    camera = points @ pose[:, :3].T + (pose[:, 3] + pose[:, :3] @ origin)
    pixels = camera @ source.camera(image.camera_id).calibration_matrix().T
    copy = pycolmap.Image(image.name, pixels[:, :2] / pixels[:, 2:], image.camera_id, image.image_id)
    model.add_image_with_trivial_frame(copy, image.cam_from_world())


def _add_points(
    model: pycolmap.Reconstruction,
    points: NDArray[np.void],
    origin: NDArray[np.float64],
    image_ids: NDArray[np.int64],
    places: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Add points, with the key points (images and places in them) of one after the other."""
    elements = map(pycolmap.TrackElement, image_ids.tolist(), places.tolist())
    xyz = points["xyz"] + origin
    for place, colour, count in zip(xyz, points["rgb"], counts.tolist(), strict=True):
        model.add_point3D(place, pycolmap.Track([next(elements) for _ in range(count)]), colour)


def _read_points(path: Path) -> NDArray[np.void]:
    """The points of a cloud as this program writes it."""
    with path.open("rb") as file:
        start = file.read(1000)
    header = start[: start.find(_PLY_END) + len(_PLY_END)]
    kind = _FAR_POINT if b"double" in header else POINT
    return np.fromfile(path, kind, offset=len(header))


def _read_visibility(path: Path, num_points: int) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """For all that is seen, one point after the other: the number of the point, and the index of the image."""
    words = np.fromfile(path, dtype="<u4")[2:]  # behind the number of points
    starts = np.empty(num_points, np.int64)
    position = 0
    steps = words.data
    for index in range(num_points):
        starts[index] = position
        position += 1 + steps[position]
    owners = np.repeat(np.arange(num_points), words[starts])
    return owners, np.delete(words, starts)
