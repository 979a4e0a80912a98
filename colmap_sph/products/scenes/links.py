"""Images of a workspace in a folder that is exported: as links, so that they take no room."""

from collections.abc import Iterable
from pathlib import Path

from colmap_sph.errors import InputError
from colmap_sph.platforms.links import link
from colmap_sph.project.images.reading import image_problem
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View


def link_images(workspace: Workspace, folder: Path, place: Path) -> None:
    """Link `folder`/images to the images of a workspace, as they will be seen from `place`, its last name."""
    link(folder / "images", workspace.images_dir, seen_from=place)


def check_images(workspace: Workspace, views: Iterable[View]) -> None:
    """Raise `InputError` where an image is not whole: who reads the folder may take what is left of it for all."""
    for view in views:
        path = workspace.image_path(view.name)
        problem = image_problem(path, *view.file_size)
        if problem is not None:
            raise InputError(f"The image {path} {problem}; mend it, and run `colmap_sph run` again.")
