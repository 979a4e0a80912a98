"""What a run works on: one record for all that the user brings."""

from dataclasses import dataclass
from pathlib import Path

from colmap_sph.errors import OptionError
from colmap_sph.project.database import find_database
from colmap_sph.project.sparse_model import model_files


@dataclass(frozen=True)
class Project:
    """A sparse model and its images, or a dense workspace that is there already."""

    model: Path | None = None
    """Sparse model (binary or text), such as sparse/0. Its images are undistorted into the output."""
    images: Path | None = None
    """Original images. Without it the folder `images` beside or above the model."""
    masks: Path | None = None
    """Masks: NAME.png for image NAME with its folders, black = ignored. They are of the original images, or with a
    workspace of the undistorted ones."""
    output: Path | None = None
    """Dense workspace to create. Without it the folder `dense` beside the model's `sparse`."""
    workspace: Path | None = None
    """Existing dense workspace, instead of model, images and output."""

    def check(self) -> None:
        """Raise `OptionError` for contradictions and what is missing."""
        if (self.model is None) == (self.workspace is None):
            raise OptionError("give either --model (a sparse model) or --workspace (a dense workspace), not both.")
        if self.workspace is not None and (self.output is not None or self.images is not None):
            raise OptionError("--workspace is complete in itself; leave out --images and --output.")
        if self.model is not None:
            model_files(self.model)

    @property
    def root(self) -> Path:
        """Folder of the dense workspace."""
        if self.workspace is not None:
            return self.workspace
        if self.output is not None:
            return self.output
        assert self.model is not None
        project = self.model.resolve()
        if project.name.isdigit():  # sparse/0, but not a project that is called 2024
            project = project.parent
        if project.name == "sparse":
            project = project.parent
        return project / "dense"

    def database(self) -> Path | None:
        """COLMAP's database beside the model; None with a workspace."""
        return None if self.model is None else find_database(self.model)
