"""The keys of a run's results: each names everything that its result depends on, and nothing else."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from colmap_sph.pipeline.digests import digest, file_digest, stamp_of
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.program import program_digest
from colmap_sph.project.sparse_model import model_files
from colmap_sph.project.workspace import Workspace, mask_path
from colmap_sph.scene import Photograph, Scene, View
from colmap_sph.stereo.agreement import SparseSights
from colmap_sph.stereo.rectified_pair import RectifiedPair
from colmap_sph.stereo.search.seeds import Seeds

# The modules whose code makes each kind of result.
_MAKERS = {
    kind: f"colmap_sph.pipeline.stages.{module}"
    for kind, module in {
        "known images": "check_images",
        "undistorted": "undistort",
        "selection": "selection",
        "pair": "match",
        "polish": "polish",
        "vote": "vote",
        "geometric": "confirm",
        "range": "wide.range_maps",
        "cloud": "fuse",
    }.items()
}


def program_digests() -> dict[str, str]:
    """Digest of the code that makes each kind of result.

    To be asked for when a run begins: what an update brings meanwhile has no part in the run.
    """
    return {kind: program_digest(module) for kind, module in _MAKERS.items()}


class Keys:
    """Makes the keys of one run; may be used by several threads.

    Parameters
    ----------
    workspace : Workspace
        The masks of its images are read once each. What else a key holds is passed in by the stage.
    options : RunOptions
    images : mapping of str to str, optional
        Digest of the content of each image in the workspace. One that is not there yet has none, and its results
        get keys that no result can have.
    fresh : bool
        Nothing of what there may be counts: so it is with all results.
    """

    def __init__(
        self,
        workspace: Workspace,
        options: RunOptions,
        images: Mapping[str, str] | None = None,
        *,
        fresh: bool = False,
    ) -> None:
        self.fresh = fresh
        self._workspace = workspace
        self._options = options
        self._images = images or {}
        self._programs = program_digests()
        self._masks: dict[Path, tuple[tuple[int, ...] | None, str | None]] = {}
        self._cameras: dict[View, str] = {}
        self._matching = digest(options.matching)

    def of(self, options: RunOptions) -> "Keys":
        """The same for a run with other options."""
        keys = Keys(self._workspace, options, self._images, fresh=self.fresh)
        keys._masks = self._masks
        return keys

    def _image(self, name: str) -> str | None:
        return self._images.get(name)

    def _mask(self, name: str) -> str | None:
        return self._mask_digest(self._workspace.mask_path(name))

    def _mask_digest(self, path: Path) -> str | None:
        if path not in self._masks:  # by two threads at a time, at worst
            self._masks[path] = (_stamp_if_there(path), None if self.fresh else _digest_if_there(path))
        return self._masks[path][1]

    def is_mask_changed(self, path: Path) -> bool:
        """Whether a mask is not as it was when a key was asked for."""
        if path not in self._masks:
            return False
        stamp, content = self._masks[path]
        return _stamp_if_there(path) != stamp and _digest_if_there(path) != content

    def _camera(self, view: View) -> str:
        """Digest of all that its camera is: of each there are many pairs."""
        if view not in self._cameras:
            self._cameras[view] = digest(view.name, view.width, view.height, view.K, view.R, view.t)
        return self._cameras[view]

    @property
    def _depths(self) -> tuple[float, ...]:
        """Depths that maps are cut to, if they are."""
        return self._options.rectification.depths or ()

    def _key(self, kind: str, *parts: object) -> str:
        return digest(kind, self._programs.get(kind), self.fresh, *parts)

    def contents(self, names: Sequence[str]) -> list[tuple[str | None, str | None]]:
        """Digests of each image's content and of its mask's, None where there is none."""
        return [(self._image(name), self._mask(name)) for name in names]

    def stage(self, kind: str, *parts: object) -> str:
        """Of all that goes into a stage whose results are of this kind."""
        return self._key(kind, "stage", *parts)

    def known_images(self) -> str:
        """Of what is known of images: how they were looked at. Their contents stand beside it."""
        return self._key("known images")

    def undistorted(self, image: str, camera: tuple[object, ...], values: object, mask: Path | None) -> str:
        """Of an undistorted image.

        Parameters
        ----------
        image : str
            Digest of the content of the original.
        camera : tuple
            All that its camera is.
        values : ValueRange or None
            What becomes black and white.
        mask : Path or None
            Of the original, where there is one.
        """
        mask_digest = None if mask is None else self._mask_digest(mask)
        size = self._options.undistortion.max_image_size
        return self._key("undistorted", image, camera, values, mask_digest, size)

    def pair(
        self,
        left: Photograph,
        right: Photograph,
        geometry: RectifiedPair,
        seeds: Seeds,
        trial: float,
        still: Mapping[str, Sequence[str]],
    ) -> str:
        """Of a disparity map.

        Parameters
        ----------
        left, right : Photograph
        geometry : RectifiedPair
            In which the options of rectification are, too.
        seeds : (n, 3) float32 ndarray
            Where its sparse points are expected to match.
        trial : float
            Share of its rows and columns that the pair is matched at first, see `MatchTask`; 1 without.
        still : mapping of str to sequence of str
            See `Context`.
        """
        views = [list(photograph.views) for photograph in (left, right)]
        images = [[self._image(view.name) for view in cut] for cut in views]
        masks = [[self._mask(view.name) for view in cut] for cut in views]
        cameras = [[self._camera(view) for view in cut] for cut in views]
        compared = [[self._image(name) for view in cut for name in still.get(view.name, ())] for cut in views]
        return self._key("pair", images, masks, cameras, geometry, seeds, trial, self._matching, compared)

    def both_ways(self, keys: Sequence[str]) -> str:
        """Of the disparity maps of a pair that is matched both ways, from the keys of each."""
        return self._key("pair", "both ways", keys)

    def polish(self, pairs: Sequence[tuple[str, str]], model_dir: Path) -> str:
        """Of the polished model, from the pairs to match and the folder of the given model."""
        names = sorted({name for pair in pairs for name in pair})
        return self._key(
            "polish",
            self._programs["known images"],  # their detail
            self._programs["pair"],
            [(name, self._image(name), self._mask(name)) for name in names],
            pairs,
            [] if self.fresh else [file_digest(path) for path in model_files(model_dir)],
            (self._options.rectification, self._options.matching, self._options.polish),
        )

    def vote(
        self,
        view: View,
        pair_keys: Sequence[str],
        stations: Sequence[int],
        residuals: Sequence[float],
        cut: Sequence[object] = (),
    ) -> str:
        """Of a photometric estimate, from the keys of its pairs as they vote, their stations and residuals.

        `cut` says where it is cut off, see `Context.cut`.
        """
        mask = self._mask(view.name)
        options = (self._options.vote, *self._depths, *cut)
        return self._key("vote", self._camera(view), mask, pair_keys, stations, residuals, *options)

    def photometric(self, vote: str) -> str:
        """Of the photometric maps of the view with this vote."""
        return self._key("photometric", vote, self._options.normals)

    def geometric(
        self,
        vote: str,
        partner_votes: Sequence[str],
        stations: Sequence[int],
        residuals: Sequence[float],
        sights: SparseSights,
        half_size: bool,
        cut: Sequence[object] = (),
    ) -> str:
        """Of the geometric maps of a view, from its own vote and its partners' votes, stations and row residuals.

        `cut` says where they are cut off, and `half_size` how they are refined. The sparse points have a part in
        what is known of the maps.
        """
        # The votes' keys stand for the images of the view and its partners, which are looked at, too, and for
        # whether blank pixels are kept.
        options = (self._options.confirm, self._options.normals, self._options.refinement, *self._depths)
        options += tuple(cut)
        return self._key("geometric", vote, partner_votes, stations, residuals, sights, half_size, *options)

    def range_map(self, maps: Sequence[str], cuts: Sequence[object]) -> str:
        """Of the range map of a wide image, from the keys of its views' geometric maps and how they were cut."""
        return self._key("range", maps, cuts)

    def cloud(self, maps: Mapping[str, str], pairs: object, scene: Scene) -> str:
        """Of the cloud, from the keys of the geometric maps of the images to fuse.

        The photometric maps need none of their own: the key of the geometric ones stands for them, too.

        Parameters
        ----------
        maps : mapping of str to str
            Key of the maps of each image.
        pairs : sequence
            All that tells, beside the model, in which others each image is looked up, and their stations.
        scene : Scene
            Where it lies, which images it has, and how the model numbers them.
        """
        folder = self._options.fusion.mask_path
        return self._key(
            "cloud",
            maps,
            [self._image(name) for name in maps],
            pairs,
            (scene.origin, scene.anchor, scene.image_ids, [(view.name, view.original) for view in scene.views]),
            [] if self.fresh else [file_digest(path) for path in model_files(self._workspace.sparse_dir)],
            replace(self._options.fusion, mask_path=None),  # wherever the masks lie
            [self._mask_digest(mask_path(folder, name)) for name in maps] if folder else [],
        )


def _stamp_if_there(path: Path) -> tuple[int, ...] | None:
    return stamp_of(path.stat()) if path.is_file() else None


def _digest_if_there(path: Path) -> str | None:
    return file_digest(path) if path.is_file() else None
