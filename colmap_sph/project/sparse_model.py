"""COLMAP sparse models: found on disk, checked, read, and reduced to some of their images."""

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.project.files import make_dir, open_regular
from colmap_sph.project.given.binary_model import check_file, read_binary_model
from colmap_sph.project.given.image_names import check_names
from colmap_sph.project.given.text_model import read_text_model

MODEL_FILES = ("cameras", "images", "points3D")
# Files that COLMAP 3.12 added; older models do not have them.
RIG_FILES = ("rigs", "frames")
_EXTENSIONS = (".bin", ".txt")


def load_model(sparse_dir: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model with any camera model, binary preferred to text as COLMAP does.

    Parameters
    ----------
    sparse_dir : Path
        Folder holding ``cameras``, ``images`` and ``points3D``, all ``.bin`` or all ``.txt``.

    Returns
    -------
    pycolmap.Reconstruction
        With at least one registered image.

    Raises
    ------
    InputError
        The folder or its model is missing, empty or damaged, or has no registered image.
    """
    sparse_dir = Path(sparse_dir)
    files = model_files(sparse_dir)
    try:
        model = read_text_model(files) if is_text(files) else read_binary_model(files)
        registered = model.reg_image_ids()
        names = [model.image(image_id).name for image_id in registered]
    except UnicodeDecodeError as error:
        raise InputError(
            f"The model in {sparse_dir} has the image name {error.object!r}, which is not UTF-8; "
            "rename the image, and export the model from COLMAP again."
        ) from error
    except (RuntimeError, ValueError, IndexError, KeyError, MemoryError) as error:
        rigs = " and ".join(path.name for path in files if path.stem in RIG_FILES)
        stale = f", or delete {rigs} if they are of another model" if rigs else ""
        raise InputError(
            f"The model in {sparse_dir} is damaged ({reason_of(error)}); export it from COLMAP again{stale}."
        ) from error
    if not registered:
        raise InputError(
            f"The model in {sparse_dir} has no registered image; run COLMAP's mapper or give another model."
        )
    check_names(names, sparse_dir)
    return model


def write_model(model: pycolmap.Reconstruction, folder: Path, *, as_text: bool = False) -> None:
    """Write a model, and make sure that the disk has taken it: COLMAP does not notice that one is full.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    folder : Path
        Created where missing.
    as_text : bool
        Whether as text, not binary.

    Raises
    ------
    OutputError
        A file cannot be written, or not to its end.
    """
    make_dir(folder)
    try:
        if as_text:
            model.write_text(folder)
            _check_lines(model, folder)
        else:
            model.write_binary(folder)
            for stem in (*MODEL_FILES, *RIG_FILES):
                check_file(folder / f"{stem}.bin")
    except (InputError, RuntimeError, OSError) as error:
        why = "" if isinstance(error, InputError) else f" ({reason_of(error)})"
        raise OutputError(
            f"The model written to {folder} is not whole{why}; check space and permissions."
        ) from error


def _check_lines(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Raise `InputError` where the files of a text model do not have all lines, each to its end."""
    numbers = {
        "cameras": model.num_cameras(),
        "images": 2 * model.num_reg_images(),
        "points3D": model.num_points3D(),
        "rigs": model.num_rigs(),
        "frames": model.num_reg_frames(),
    }
    for stem, number in numbers.items():
        with open_regular(folder / f"{stem}.txt") as file:
            found = sum(line.endswith(b"\n") and not line.startswith(b"#") for line in file)
        if found != number:
            raise InputError(f"{folder / stem}.txt is cut off.")


def is_text(files: Sequence[Path]) -> bool:
    """Whether the files of a model are text: COLMAP must be given what `load_model` read, not these files."""
    return files[0].suffix == ".txt"


def image_names(model: pycolmap.Reconstruction) -> list[str]:
    """Sorted names of the registered images of a model."""
    return sorted(model.image(image_id).name for image_id in model.reg_image_ids())


def cameras_of_images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Camera]:
    """Cameras of the registered images of a model, by the image's name."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {image.name: model.camera(image.camera_id) for image in images}


def model_files(sparse_dir: Path) -> list[Path]:
    """Return the files that make up the model in a folder; `InputError` where they are not complete."""
    if not sparse_dir.is_dir():
        is_file = sparse_dir.is_file()
        raise InputError(
            f"The model folder {sparse_dir} {'is a file' if is_file else 'does not exist'}; "
            "give the folder of a COLMAP model."
        )
    files = _files_in(sparse_dir)
    if not files:
        inside = models_inside(sparse_dir)
        if not inside:
            _refuse_incomplete(sparse_dir)
        meant = " or ".join(str(path) for path in inside if path.parent == inside[0].parent)
        hint = f"did you mean {meant}?" if inside else "give the folder of a COLMAP model, such as sparse/0."
        raise InputError(
            f"No COLMAP model in {sparse_dir}: cameras, images and points3D (.bin or .txt) are needed; {hint}"
        )
    rigs = [path for path in files if path.stem in RIG_FILES]
    if len(rigs) == 1:
        other = rigs[0].with_stem(next(stem for stem in RIG_FILES if stem != rigs[0].stem))
        raise InputError(
            f"The model in {sparse_dir} has {rigs[0].name} and no {other.name}; copy both from where it was made, "
            f"or remove {rigs[0].name} if it has no rigs."
        )
    return files


def _refuse_incomplete(folder: Path) -> None:
    """Name the files that a model lacks, where the others are there."""
    for extension in _EXTENSIONS:
        names = [f"{stem}{extension}" for stem in MODEL_FILES]
        there = [name for name in names if (folder / name).exists()]
        if 2 * len(there) > len(names):
            (lacking,) = set(names) - set(there)
            empty = " (an empty one where it has no points)" if lacking == "points3D.txt" else ""
            raise InputError(
                f"The model in {folder} has {' and '.join(there)}, but no {lacking}; "
                f"copy it from where the model was made{empty}."
            )


def has_model(folder: Path) -> bool:
    """Whether a folder has all files of a model."""
    return bool(_files_in(folder))


def models_inside(folder: Path) -> list[Path]:
    """Folders with models, one or two levels below a folder; first the one that is most likely meant."""
    names = [f"{depth}/cameras{extension}" for depth in ("*", "*/*") for extension in _EXTENSIONS]
    folders = {path.parent for name in names for path in folder.glob(name) if has_model(path.parent)}
    # A workspace's own model, `dense/sparse`, last: it is what undistortion made of the one that is meant.
    return sorted(folders, key=lambda path: (path.name == "sparse" and path.parent != folder, path))


def _files_in(folder: Path) -> list[Path]:
    """The files of the model in a folder, binary preferred to text; none where they are not complete."""
    for extension in _EXTENSIONS:
        if all((folder / f"{stem}{extension}").exists() for stem in MODEL_FILES):
            files = [folder / f"{stem}{extension}" for stem in (*MODEL_FILES, *RIG_FILES)]
            return [path for path in files if path.exists()]
    return []


def submodel(model: pycolmap.Reconstruction, names: set[str]) -> pycolmap.Reconstruction:
    """Return the model of images `names` alone, with the tracks of two or more observations they share.

    Points that nobody observes, as of imported models, stay.
    """
    part = pycolmap.Reconstruction()
    # In this order COLMAP reads frames again; those of rigs are registered in another, which the file would have.
    images = [model.image(i) for i in sorted(model.reg_image_ids()) if model.image(i).name in names]
    for camera_id in sorted({image.camera_id for image in images}):
        part.add_camera_with_trivial_rig(model.camera(camera_id))
    for image in images:
        keypoints = [point.xy for point in image.points2D]
        copy = pycolmap.Image(image.name, keypoints, image.camera_id, image.image_id)
        part.add_image_with_trivial_frame(copy, image.cam_from_world())
    ids = {image.image_id for image in images}
    for point_id, point in model.points3D.items():
        elements = [element for element in point.track.elements if element.image_id in ids]
        if len(elements) >= 2 or not point.track.length():
            kept = pycolmap.Point3D()
            kept.xyz = point.xyz
            kept.color = point.color
            kept.error = point.error
            kept.track = pycolmap.Track(elements)
            part.add_point3D_with_id(point_id, kept)
    return part
