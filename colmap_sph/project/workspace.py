"""COLMAP's dense workspace: where things lie in it."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

from colmap_sph.errors import InputError, OutputError
from colmap_sph.platforms.names import longest_path, name_problem
from colmap_sph.project.files import make_dir

MapKind = Literal["photometric", "geometric"]
KnownFile = Literal["selection", "pairs", "photometric", "geometric", "page"]

PREVIEW_PREFIX = "preview_"
"""What small pictures of products, for the page, are called at first."""
PREVIEW_SIDE = 640
"""Longest side of these, pixels."""

# Folders are made one inside the other, and a path has an end.
_MAX_FOLDERS = 200
# What a file system takes, less the longest ending: ``.photometric.json``.
_MAX_NAME_BYTES = 255 - 17


@dataclass(frozen=True)
class Workspace:
    """Paths of one dense workspace.

    Attributes
    ----------
    root : Path
        The workspace's folder, usually called ``dense``.
    given_masks : Path, optional
        Where the masks of its images are, if not in the workspace itself.
    """

    root: Path
    given_masks: Path | None = None

    @cached_property
    def images_dir(self) -> Path:
        """Undistorted images."""
        return self.root / "images"

    @cached_property
    def sparse_dir(self) -> Path:
        """Sparse model of the undistorted images."""
        return self.root / "sparse"

    @cached_property
    def stereo_dir(self) -> Path:
        """Depth maps, normal maps and COLMAP's configuration files."""
        return self.root / "stereo"

    @property
    def fused_path(self) -> Path:
        """The fused point cloud."""
        return self.root / "fused.ply"

    @property
    def visibility_path(self) -> Path:
        """Which images see each point of the cloud; COLMAP derives its name from the cloud's."""
        return self.root / "fused.ply.vis"

    @property
    def tiles_dir(self) -> Path:
        """The cloud, where it is in tiles."""
        return self.root / "fused_tiles"

    @property
    def cloud_paths(self) -> tuple[Path, Path]:
        """The two files of the cloud."""
        return self.fused_path, self.visibility_path

    @property
    def fusion_cfg_path(self) -> Path:
        """Names of the images that take part in fusion."""
        return self.stereo_dir / "fusion.cfg"

    @property
    def patch_match_cfg_path(self) -> Path:
        """Source images of every reference image."""
        return self.stereo_dir / "patch-match.cfg"

    @cached_property
    def state_dir(self) -> Path:
        """Our own state, report and log, which COLMAP never looks at."""
        return self.root / "colmap_sph"

    @property
    def log_path(self) -> Path:
        """The log of all runs."""
        return self.state_dir / "log.txt"

    def part_log_path(self, name: str) -> Path:
        """The log of one of the jobs that share the workspace."""
        return self.state_dir / "logs" / f"{name}.txt"

    @property
    def report_path(self) -> Path:
        """What the last run did."""
        return self.state_dir / "report.json"

    @property
    def page_path(self) -> Path:
        """The same for people: a page to open in a browser."""
        return self.state_dir / "report.html"

    @property
    def marker_path(self) -> Path:
        """What the undistorted images and their model were made from."""
        return self.state_dir / "undistortion.json"

    @property
    def within_path(self) -> Path:
        """What was chosen for a time."""
        return self.state_dir / "within.json"

    @property
    def georeference_path(self) -> Path:
        """Where the model lies on the map, where that is known."""
        return self.state_dir / "georeference.json"

    @property
    def surface_dir(self) -> Path:
        """Surface model and orthophoto, unless another place is given."""
        return self.root / "surface"

    @property
    def mesh_dir(self) -> Path:
        """The mesh, unless another place is given."""
        return self.root / "mesh"

    @property
    def export_dir(self) -> Path:
        """Files for other programs, unless another place is given."""
        return self.root / "export"

    @property
    def product_dirs(self) -> tuple[Path, Path, Path]:
        """All of these."""
        return self.surface_dir, self.mesh_dir, self.export_dir

    @property
    def given_model_dir(self) -> Path:
        """The model of the undistorted images as it was given, where `sparse` holds a polished one."""
        return self.state_dir / "given"

    @property
    def refined_model_dir(self) -> Path:
        """The original model with refined cameras, where that was asked for."""
        return self.state_dir / "refined"

    @property
    def polishing_scratch_dir(self) -> Path:
        """While poses are polished: the model so far."""
        return self.state_dir / ".polishing.tmp"

    @property
    def token_path(self) -> Path:
        """While other machines work for a run: which run that is."""
        return self.state_dir / ".workers.tmp"

    @property
    def undistortion_scratch_dir(self) -> Path:
        """While images are undistorted: what there is of the workspace so far."""
        return self.state_dir / ".undistorting.tmp"

    @cached_property
    def known_dir(self) -> Path:
        """What is known of results, so that it need not be found out again."""
        return self.state_dir / "known"

    def known_path(self, of: KnownFile) -> Path:
        """What is known of results of a kind, of the pairs that were chosen, or of the page."""
        return self.known_dir / f"{of}.json"

    @property
    def known_paths(self) -> list[Path]:
        """All of these; need not exist."""
        return [self.known_path(of) for of in get_args(KnownFile)]

    def images_known_path(self, what: Literal["originals", "images"]) -> Path:
        """What is known of the contents of the original or the undistorted images."""
        return self.state_dir / f"{what}.json"

    @property
    def state_files(self) -> list[Path]:
        """Files of our state that are of all images together; need not exist."""
        return [
            *self.known_paths,
            self.images_known_path("originals"),
            self.images_known_path("images"),
            self.marker_path,
            self.report_path,
            self.within_path,
            self.cloud_record_path,
            self.tiles_record_path,
            self.fusion_cfg_record_path,
        ]

    @cached_property
    def pairs_dir(self) -> Path:
        """Disparity maps of the pairs."""
        return self.state_dir / "pairs"

    @cached_property
    def photometric_dir(self) -> Path:
        """Photometric depth of the images, with its standard deviation and number of votes."""
        return self.state_dir / "photometric"

    @cached_property
    def records_dir(self) -> Path:
        """Records that vouch for depth and normal maps."""
        return self.state_dir / "state"

    @property
    def cloud_record_path(self) -> Path:
        """Record that vouches for the cloud; its name is none of an image's."""
        return self.state_dir / "cloud.json"

    @property
    def tiles_record_path(self) -> Path:
        """Record that vouches for the index of a cloud in tiles."""
        return self.state_dir / "tiles.json"

    @property
    def fusion_cfg_record_path(self) -> Path:
        """Record of ``fusion.cfg`` as this program wrote it."""
        return self.state_dir / "fusion_cfg.json"

    @property
    def fusion_scratch_dir(self) -> Path:
        """While maps are fused: parts of the cloud."""
        return self.state_dir / ".fusion.tmp"

    @property
    def local_dir(self) -> Path:
        """For a model in map coordinates: a workspace near its origin, for COLMAP's own programs to go on."""
        return self.state_dir / "local"

    @property
    def local_origin_path(self) -> Path:
        """Map coordinates of that origin."""
        return self.local_dir / "origin.txt"

    def image_path(self, name: str) -> Path:
        """Undistorted image `name`."""
        return self.images_dir / checked_name(name)

    @cached_property
    def masks_dir(self) -> Path:
        """Masks of the undistorted images; need not exist."""
        return self.given_masks or self.root / "masks"

    def mask_path(self, name: str) -> Path:
        """Mask of undistorted image `name`; need not exist."""
        return mask_path(self.masks_dir, name)

    def made_mask_path(self, name: str) -> Path:
        """Where an undistorted mask of image `name` is written."""
        return self.root / "masks" / f"{checked_name(name)}.png"

    def depth_map_path(self, name: str, kind: MapKind) -> Path:
        """Depth map of image `name`."""
        return self.stereo_dir / "depth_maps" / f"{checked_name(name)}.{kind}.bin"

    def normal_map_path(self, name: str, kind: MapKind) -> Path:
        """Normal map of image `name`."""
        return self.stereo_dir / "normal_maps" / f"{checked_name(name)}.{kind}.bin"

    def range_map_path(self, original: str) -> Path:
        """Map of the range of wide image `original`, of which views were cut."""
        return self.stereo_dir / "range_maps" / f"{checked_name(original)}.exr"

    def create_stereo_dirs(self, names: Iterable[str]) -> None:
        """Create the folders that the maps of images `names` and our own state go to.

        Raises
        ------
        OutputError
            A folder cannot be created, or a path is longer than this system is set up for.
        """
        folders = {
            self.stereo_dir / "depth_maps",
            self.stereo_dir / "normal_maps",
            self.stereo_dir / "consistency_graphs",
            self.state_dir,
        }
        for name in names:
            folders.add(self.depth_map_path(name, "geometric").parent)
            folders.add(self.normal_map_path(name, "geometric").parent)
            self._check_length(self.normal_map_path(name, "photometric"))
        for folder in sorted(folders):
            make_dir(folder)

    def _check_length(self, path: Path) -> None:
        limit = longest_path()
        if limit is not None and len(str(path.absolute())) > limit:
            raise OutputError(
                f"{path} has more than the {limit} characters that Windows allows here: choose a shorter "
                "--output, or have an administrator turn on its long paths (LongPathsEnabled)."
            )


def mask_path(folder: Path, name: str) -> Path:
    """Where COLMAP finds the mask of image `name` in a folder of masks: ``a.jpg.png``, or else ``a.png``.

    Where there is none, the first of them.
    """
    usual = folder / f"{checked_name(name)}.png"
    other = folder / PurePosixPath(name).with_suffix(".png")
    return other if PurePosixPath(name).suffix and other.exists() and not usual.exists() else usual


def checked_name(name: str) -> str:
    """Return the name of an image that may be the name of files.

    Raises
    ------
    InputError
        It would lead out of the workspace, leaves no room for the endings of our files, or is none that a file
        can have on this system.
    """
    parts = PurePosixPath(name)
    if not name or parts.is_absolute() or ".." in parts.parts:
        raise InputError(f"The image name {name!r} leads out of the workspace; rename the image in the model.")
    problem = name_problem(name)
    if problem is not None:
        raise InputError(f"The image name {name!r} {problem}; rename the image, its file and in the model.")
    if len(parts.parts) > _MAX_FOLDERS:
        raise InputError(
            f"The image name '{name[:20]}…' has more than {_MAX_FOLDERS} folders; rename the image in the model."
        )
    if len(parts.name.encode()) > _MAX_NAME_BYTES:
        raise InputError(
            f"The image name '{parts.name[:20]}…' is longer than the {_MAX_NAME_BYTES} bytes for which the names "
            "of its maps fit the disk; rename the image."
        )
    return name
