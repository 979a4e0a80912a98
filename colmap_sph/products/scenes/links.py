"""Images of a workspace in a folder that is exported: as links, so that they take no room."""

import os
from pathlib import Path

from colmap_sph.project.files import real_path
from colmap_sph.project.workspace import Workspace


def link_images(workspace: Workspace, folder: Path, place: Path) -> None:
    """Link `folder`/images to the images of a workspace, as they will be seen from `place`, its last name."""
    (folder / "images").symlink_to(relative(workspace.images_dir, place))


def relative(target: Path, place: Path) -> str:
    """How a link in a folder names its target: relative, so that both can be moved together."""
    return os.path.relpath(real_path(target), real_path(place))
