"""Images of a workspace in a folder that is exported: as links, so that they take no room."""

from pathlib import Path

from colmap_sph.platforms.links import link
from colmap_sph.project.workspace import Workspace


def link_images(workspace: Workspace, folder: Path, place: Path) -> None:
    """Link `folder`/images to the images of a workspace, as they will be seen from `place`, its last name."""
    link(folder / "images", workspace.images_dir, seen_from=place)
