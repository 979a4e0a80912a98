"""The keys of a run's results: each names everything that its result depends on, and nothing else."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_sph.pipeline.digests import digest, file_digest
from colmap_sph.pipeline.load_cache import LoadCache
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.program import program_digest
from colmap_sph.project.sparse_model import model_files
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View
from colmap_sph.stereo.rectified_pair import RectifiedPair

# The modules whose code makes each kind of result.
_MATCH = "colmap_sph.pipeline.stages.match"
_VOTE = "colmap_sph.pipeline.stages.vote"
_CONFIRM = "colmap_sph.pipeline.stages.confirm"
_FUSE = "colmap_sph.pipeline.stages.fuse"


class Keys:
    """Makes the keys of one run; may be used by several threads.

    Parameters
    ----------
    workspace : Workspace
        Its images and their masks are read once each.
    options : RunOptions
    foreseen : bool
        The images are not there yet, so that no result is either: keys do without them.
    """

    def __init__(self, workspace: Workspace, options: RunOptions, *, foreseen: bool = False) -> None:
        self._workspace = workspace
        self._options = options
        self._foreseen = foreseen
        self._images: LoadCache[str | None] = LoadCache(lambda _: 0)
        self._masks: LoadCache[str | None] = LoadCache(lambda _: 0)

    def _image(self, name: str) -> str | None:
        path = self._workspace.image_path(name)
        return self._images.get(name, lambda: None if self._foreseen else file_digest(path))

    def _mask(self, name: str) -> str | None:
        path = self._workspace.mask_path(name)
        return self._masks.get(name, lambda: None if self._foreseen else _digest_if_there(path))

    def pair(self, left: View, right: View, geometry: RectifiedPair) -> str:
        """Of a disparity map. The sparse points and the options of rectification are in `geometry`."""
        images = [self._image(view.name) for view in (left, right)]
        masks = [self._mask(view.name) for view in (left, right)]
        cameras = [_camera(view) for view in (left, right)]
        return digest("pair", program_digest(_MATCH), images, masks, cameras, geometry, self._options.matching)

    def vote(self, view: View, pair_keys: Sequence[str]) -> str:
        """Of a photometric estimate, from the keys of its pairs in the order in which they vote."""
        mask = self._mask(view.name)
        return digest("vote", program_digest(_VOTE), _camera(view), mask, pair_keys, self._options.vote)

    def photometric(self, vote: str) -> str:
        """Of the photometric maps of the view with this vote."""
        return digest("photometric", vote, self._options.normals)

    def geometric(self, vote: str, partner_votes: Sequence[str]) -> str:
        """Of the geometric maps of a view, from its own vote and those of its partners, in their order."""
        # The votes' keys stand for the images of the view and its partners, which refinement looks at, too.
        options = (self._options.confirm, self._options.normals, self._options.refinement)
        return digest("geometric", program_digest(_CONFIRM), vote, partner_votes, *options)

    def cloud(
        self, maps: Mapping[str, str], partners: Mapping[str, Sequence[str]], origin: NDArray[np.float64]
    ) -> str:
        """Of the cloud, from the keys of the geometric maps of the images to fuse, and the scene's origin.

        The photometric maps need none of their own: the key of the geometric ones stands for them, too.
        """
        folder = self._options.fusion.mask_path
        masks = [folder / f"{name}.png" for name in maps] if folder else []
        return digest(
            "cloud",
            program_digest(_FUSE),
            maps,
            [self._image(name) for name in maps],
            partners,
            origin,
            [] if self._foreseen else [file_digest(path) for path in model_files(self._workspace.sparse_dir)],
            self._options.fusion,
            [_digest_if_there(path) for path in masks],
        )


def _camera(view: View) -> tuple[object, ...]:
    return view.name, view.width, view.height, view.K, view.R, view.t


def _digest_if_there(path: Path) -> str | None:
    return file_digest(path) if path.is_file() else None
