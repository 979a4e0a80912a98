"""What a run works on, as the user gives it: one record, checked; a dense workspace given is opened."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Optional

from colmap_sph.errors import InputError, OptionError, reason_of, shell_word
from colmap_sph.platforms.files import plain_path
from colmap_sph.project.database import find_database
from colmap_sph.project.files import real_path
from colmap_sph.project.masks import check_masks
from colmap_sph.project.sparse_model import cameras_of_images, has_model, load_model, model_files, models_inside
from colmap_sph.project.undistortion.marker import refuse_unfinished
from colmap_sph.project.workspace import Workspace


@dataclass(frozen=True)
class Project:
    """What a run works on: a sparse model and its images, or a dense workspace that is there already."""

    # Not `Path | None`: to check a default against that, the command line's parser would load a library of a tenth
    # of a second.
    model: Optional[Path] = None  # noqa: UP045
    """Sparse model (binary or text), such as sparse/0. Its images are undistorted into --output."""
    images: Optional[Path] = None  # noqa: UP045
    """Original images. Default: the folder "images" beside or above the model."""
    masks: Optional[Path] = None  # noqa: UP045
    """Masks: a.jpg.png or a.png for image a.jpg, with its folders; black = ignored. Of the original images, or
    with --workspace of the undistorted ones."""
    output: Optional[Path] = None  # noqa: UP045
    """Dense workspace to create. Default: `dense` beside `sparse`, for sparse/1 `dense-1`."""
    workspace: Optional[Path] = None  # noqa: UP045
    """Existing dense workspace, instead of --model, --images and --output."""

    def check(self) -> None:
        """Raise for what is wrong before anything is read or written.

        Raises
        ------
        OptionError
            Nothing to work on, options that contradict each other, or a workspace where a model belongs and the
            other way round.
        InputError
            The sparse model is not there, or not complete; or the folder may not be looked into.
        """
        if self.model is not None and self.workspace is not None:
            raise OptionError(
                "--model and --workspace are both given; give a sparse model to begin with, or a dense workspace "
                "that is there already, not both."
            )
        if self.workspace is not None:
            self._check_workspace(self.workspace)
        elif self.model is not None:
            _check_model(self.model)
        else:
            raise OptionError(f"There is nothing to work on: {_what_to_give()}")

    def _check_workspace(self, workspace: Path) -> None:
        check_open(workspace)
        given = {"--images": self.images, "--output": self.output}
        surplus = [option for option, value in given.items() if value is not None]
        if surplus:
            raise OptionError(f"--workspace is complete in itself; leave out {' and '.join(surplus)}.")
        if has_model(workspace) and not Workspace(workspace).sparse_dir.is_dir():
            raise OptionError(
                f"{workspace} is a sparse model, not a dense workspace; give it as --model "
                f"{shell_word(workspace)}."
            )

    def absolute(self) -> "Project":
        """The same, whatever the current folder is."""
        given = {each.name: getattr(self, each.name) for each in fields(self)}
        return Project(**{name: path and Path(path).absolute() for name, path in given.items()})

    @property
    def is_named(self) -> bool:
        """Whether it says which dense workspace it is of."""
        return any(path is not None for path in (self.workspace, self.output, self.model))

    @property
    def root(self) -> Path:
        """Folder of the dense workspace, of a project without contradictions."""
        if self.workspace is not None:
            return self.workspace
        if self.output is not None:
            return self.output
        assert self.model is not None
        project = plain_path(self.model)
        if "sparse" not in (project.name, project.parent.name if project.name.isdigit() else ""):
            project = real_path(self.model)  # a link to a model, such as sparse/best, says nothing of its project
        number = project.name if project.name.isdigit() else ""
        if number:  # sparse/0, but not a project that is called 2024
            project = project.parent
        is_one_of_many = project.name == "sparse" and number.strip("0")
        if project.name == "sparse":
            project = project.parent
        # COLMAP's mapper leaves sparse/0, and sparse/1 of images that do not connect with it.
        return project / (f"dense-{number}" if is_one_of_many else "dense")

    def database(self) -> Path | None:
        """COLMAP's ``database.db`` beside or above the model, if there is one; None with a workspace."""
        return None if self.model is None else find_database(self.model)


def open_workspace(project: Project) -> Workspace:
    """Open a dense workspace that is there already, and write nothing there.

    Parameters
    ----------
    project : Project
        With a workspace, which COLMAP's ``image_undistorter`` or this program made. Without masks of its own those
        in the workspace's ``masks`` are used.

    Returns
    -------
    Workspace

    Raises
    ------
    InputError
        The folder is missing or is not a dense workspace, or its undistortion was not finished, or a mask does not
        fit its image.
    """
    workspace = Workspace(project.root, project.masks)
    _check_folders(workspace)
    refuse_unfinished(workspace)
    model = load_model(workspace.sparse_dir)
    if project.masks is not None or workspace.masks_dir.is_dir():
        check_masks(workspace.masks_dir, cameras_of_images(model), workspace.images_dir)
    return workspace


def check_open(folder: Path) -> None:
    """Raise `InputError` where permissions keep us out of a folder; what else is wrong with it is told later."""
    try:
        (folder / "..").stat()  # who may not enter it is not told even that
    except PermissionError as error:
        raise InputError(f"{folder} cannot be read ({reason_of(error)}); check its permissions.") from error
    except OSError:
        return


def _check_folders(workspace: Workspace) -> None:
    root = workspace.root
    if not root.is_dir():
        wrong = "is a file" if root.is_file() else "does not exist"
        raise InputError(f"The workspace {root} {wrong}; give the folder COLMAP undistorted into.")
    for folder in (workspace.images_dir, workspace.sparse_dir):
        if not folder.is_dir():
            raise InputError(_no_workspace(root, f"it has no {folder.name} folder"))
    if not has_model(workspace.sparse_dir) and models_inside(workspace.sparse_dir):
        raise InputError(_no_workspace(root, "its sparse folder holds no model itself"))


def _no_workspace(root: Path, lack: str) -> str:
    found = models_inside(root)
    how = f"as --model {shell_word(found[0])}" if found else "with --model"
    return (
        f"{root} is not a dense workspace: {lack}; run COLMAP's image_undistorter, or give the sparse model {how}."
    )


def _check_model(model: Path) -> None:
    check_open(model)
    if _is_dense_workspace(model) and not has_model(model):
        raise OptionError(
            f"{model} is a dense workspace, not a sparse model; give it as --workspace {shell_word(model)}."
        )
    model_files(model)


def _is_dense_workspace(folder: Path) -> bool:
    """Whether COLMAP or this program has undistorted into a folder."""
    workspace = Workspace(folder)
    # A project with its model in `sparse` itself has no `stereo`.
    return workspace.images_dir.is_dir() and workspace.stereo_dir.is_dir() and has_model(workspace.sparse_dir)


def _what_to_give() -> str:
    """The end of a sentence: options, where possible with what the current folder has for them."""
    models = [Path("sparse", "0"), Path("sparse")]
    workspaces = [Path(), Path("dense")]
    found = [f"--workspace {folder}" for folder in workspaces if _is_dense_workspace(folder)][:1]
    if found != [f"--workspace {Path()}"]:  # whose `sparse` is no model to begin with
        found = [f"--model {folder}" for folder in models if has_model(folder)][:1] + found
    words = "--model names a sparse model such as sparse/0, --workspace a dense workspace"
    return f"{words}; did you mean {' or '.join(found)}?" if found else f"{words}; give one of them."
