"""First part of a run with a sparse model: a dense workspace with its undistorted images.

What a dry run asks and what a run does are the same stages. An interruption at any point leaves a workspace that
says of itself that it is not finished, and that the next run goes on with.
"""

import logging
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Progress, RunReport, Silent
from colmap_sph.pipeline.stages.check_images import CheckStage, ImageFacts, ImagePlaces, tell_changed
from colmap_sph.pipeline.stages.polish import GivenModel
from colmap_sph.pipeline.stages.stage import Result, keys_of
from colmap_sph.pipeline.stages.undistort import UndistortStage
from colmap_sph.project.files import make_dir, scratch_folder
from colmap_sph.project.images.depth import common_ranges, describe_ranges
from colmap_sph.project.masks import check_masks
from colmap_sph.project.polishing.adjustment import reason_to_keep
from colmap_sph.project.polishing.polished import is_users_model
from colmap_sph.project.project import Project
from colmap_sph.project.sparse_model import cameras_of_images, has_model, image_names
from colmap_sph.project.state.ownership import (
    remove_empty_folders,
    remove_image,
    remove_recorded,
    remove_undistorted,
    undistorted_place,
)
from colmap_sph.project.state.records import claim
from colmap_sph.project.undistortion.foreseen import check_space, foreseen_scene
from colmap_sph.project.undistortion.marker import (
    Marker,
    adopt,
    check_made_from,
    check_ours,
    has_given_model,
    is_model_changed,
    names_in_model,
    publish_model,
    remove_model,
    set_model_aside,
    write_marker,
)
from colmap_sph.project.undistortion.model import ModelToUndistort, undistort_model
from colmap_sph.project.undistortion.originals import read_originals
from colmap_sph.project.undistortion.process import ChildProcess
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.table import read_cuts
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import NO_SCENE, Scene
from colmap_sph.stereo.anchor import anchored

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor

logger = logging.getLogger(__name__)


class Preparation:
    """The undistortion of one project; writes nothing before it is asked to.

    Parameters
    ----------
    project : Project
        With a model, of any camera model that has a pinhole equivalent.
    options : RunOptions
    overwrite : bool
        What there is does not count.
    verify : bool
        What is known of images from earlier runs does not count.
    is_plan : bool
        The stages will only be asked: with `overwrite`, whatever is there then does not count.
    progress, report : optional
        See `Context`.

    Attributes
    ----------
    workspace : Workspace
    options : RunOptions
        As given, but for a region that was to be drawn: they have what was.
    names : tuple of str
        Sorted names of the registered images of the original model, and of the views that are cut from wide ones;
        where a region is asked for of those that show it.

    Raises
    ------
    InputError
        No usable model, a mask that does not fit its image, or the folder holds a workspace of something else or
        made from something else.
    """

    def __init__(
        self,
        project: Project,
        options: RunOptions,
        *,
        overwrite: bool = False,
        verify: bool = False,
        is_plan: bool = False,
        progress: Progress | None = None,
        report: RunReport | None = None,
    ) -> None:
        self.workspace = Workspace(project.root)
        self._originals = read_originals(project, options.undistortion)
        self._originals.check_outside(self.workspace)
        self._places = ImagePlaces("originals", self._originals.model_dir, self._originals.image_dir)
        self.options = options
        self._report = report or RunReport()
        self._overwrite = overwrite
        self._verify = verify
        self._marker = Marker(self._originals.model_digest(), options.undistortion.of_marker(self._originals.cuts))
        # Scratch of its own for each run, as the process of one that was killed may still be at work.
        self._child = ChildProcess(self.workspace.undistortion_scratch_dir / str(os.getpid()))
        self._found = check_ours(self.workspace) if overwrite else check_made_from(self.workspace, self._marker)
        self.names = self._names()
        originals = self._originals
        if originals.mask_dir is not None:
            check_masks(originals.mask_dir, cameras_of_images(originals.model), originals.image_dir)
        self._context = Context(
            self.workspace,
            NO_SCENE,
            self.options,
            Keys(self.workspace, options, fresh=overwrite and is_plan),
            progress or Silent(),
            self._report,
        )

    def _names(self) -> tuple[str, ...]:
        names = tuple(self._originals.cuts.names(image_names(self._originals.model)))
        if not self.options.region:
            return names
        scene = anchored(foreseen_scene(self._originals, names, self.options.undistortion))
        keys = Keys(self.workspace, self.options)
        whole = Context(self.workspace, scene, self.options, keys, report=self._report)
        part = whole.in_region()
        self.options = part.options
        return tuple(view.name for view in part.scene.views)

    def expected(self) -> tuple[str, ...]:
        """Of `names`, those whose original images were not left out."""
        left_out = self._report.skipped_images
        original = self._originals.cuts.original
        return tuple(name for name in self.names if name == original(name) or original(name) not in left_out)

    def run(self, executor: "Executor") -> None:
        """Make the workspace.

        Parameters
        ----------
        executor : callable
            What is done with each stage, see `Executor`.
        """
        if self._originals.cuts.views or (self.is_finished and not self._overwrite):
            self._make(executor)
            return
        # COLMAP is likely to be asked for the model: its process loads while images are looked at.
        self._child.start_for(undistort_model)
        try:
            self._make(executor)
        finally:
            self._child.close()

    def _make(self, executor: "Executor") -> None:
        images = self.check(executor)
        self.begin(images)
        try:
            undistorted = self.undistort(executor, images)
        finally:
            tell_changed(self._context, self._places, images, lambda name: [self._originals.mask_of(name)])
        self.finish(undistorted)

    def check(self, executor: "Executor") -> dict[str, Result]:
        """Go through the first stage: check the original images; return the results of the good ones."""
        originals = self._originals
        cameras = cameras_of_images(originals.model)
        names = sorted(set(map(originals.cuts.original, self.names)))
        sizes = {name: (cameras[name].width, cameras[name].height) for name in names if name in cameras}
        return executor(CheckStage(self._context, sizes, self._places, verify=self._verify or self._overwrite))

    def begin(self, images: Collection[str]) -> None:
        """Declare the workspace this program's, and with `overwrite` remove what is as this program made it."""
        found = self._found
        images = self._wanted(images)
        missing = [name for name in images if self._overwrite or not self.workspace.image_path(name).exists()]
        if missing:  # a workspace that is there needs no more space
            check_space(self._originals, missing, self.workspace.root, self.options.undistortion)
        if found is not None and found.version == 1:
            if names_in_model(self.workspace) != sorted(images):  # it will be replaced, and may be the user's
                set_model_aside(self.workspace, found)
            self._adopt_images(has_masks=found.has_masks)
            found = adopt(self.workspace, found)
        if found is not None and self._overwrite:
            self._discard(found)
            found = None
        if found is None or not found.is_finished:
            write_marker(self.workspace, self._marker)
        self._found = found

    def _wanted(self, originals: Iterable[str]) -> list[str]:
        """What is wanted of what comes in place of original images."""
        wanted = set(self.names)
        return [name for name in self._originals.cuts.names(originals) if name in wanted]

    def undistort(self, executor: "Executor", images: Mapping[str, Result]) -> dict[str, Result]:
        """Go through the second stage: undistort the images that `check` found good; return their results."""
        samples = {
            name: result.facts.sample
            for name, result in images.items()
            if isinstance(result.facts, ImageFacts) and result.facts.sample is not None
        }
        ranges = common_ranges(samples.values())
        self._context.report.stretched = "; ".join(describe_ranges(ranges))
        values = {name: ranges[sample.kind] for name, sample in samples.items()}
        return executor(
            UndistortStage(self._context, self._originals, keys_of(images), values, verify=self._verify)
        )

    def finish(self, results: Mapping[str, Result]) -> None:
        """Give the workspace its model, where that is not there for these images."""
        names = sorted(results)
        if self._is_model_there(names):
            logger.info("The undistorted images in %s are up to date", self.workspace.root)
            return
        self._remove_former_views()
        self.workspace.create_stereo_dirs(names)
        scratch = self.workspace.undistortion_scratch_dir
        with scratch_folder(scratch):
            folder = self._child.folder
            make_dir(folder)
            made = self._undistort_model(folder, names)
            if self._found is not None:
                set_model_aside(self.workspace, self._found)  # one that is damaged, see `_is_model_there`
            publish_model(self.workspace, self._marker, made, names)
        logger.info("Undistorted %d of %d images into %s", len(names), len(self.names), self.workspace.root)

    def _remove_former_views(self) -> None:
        """Remove views that are no longer cut: another version of the program cut wide images otherwise."""
        former = self._cut_before().keys() - self._originals.cuts.views.keys()
        for name in former:
            remove_image(self.workspace, name)
        if former:
            remove_empty_folders(self.workspace.images_dir, self.workspace.masks_dir, self.workspace.stereo_dir)

    def _cut_before(self) -> Mapping[str, Cut]:
        """How the views of the workspace were cut; a damaged table of it is replaced."""
        with suppress(InputError):
            return read_cuts(self.workspace.sparse_dir)
        return {}

    def given_model(self) -> GivenModel:
        """What polishing has to know of the model as it was given."""
        originals = self._originals
        return GivenModel(originals.model_dir, originals.image_dir, self._reason_to_keep_poses())

    def _reason_to_keep_poses(self) -> str:
        if self._originals.cuts.views:
            return "views that are cut from one image have its pose"
        is_replaced = self._found is None or self._overwrite
        if not is_replaced and is_users_model(self.workspace):
            return f"{self.workspace.sparse_dir} was changed since this program made it"
        return reason_to_keep(self._originals.model, self.options.polish.poses)

    @property
    def is_finished(self) -> bool:
        """Whether the workspace is there, as far as can be told without looking at its images."""
        found = self._found
        return found is not None and found.is_finished and self._is_model_there(found.images)

    def scene(self, results: Mapping[str, Result]) -> Scene | None:
        """Return the scene of a workspace that is not there yet; None where it is there as it will be."""
        if not self._overwrite and self._is_model_there(sorted(results)):
            return None
        return foreseen_scene(self._originals, results, self.options.undistortion)

    def _is_model_there(self, names: Sequence[str]) -> bool:
        """Whether the workspace has the model of these images, or one that the user has changed."""
        found = self._found
        if found is None or found.version == 1 or not has_model(self.workspace.sparse_dir):
            return False
        if is_model_changed(self.workspace, found):
            if not names_in_model(self.workspace):
                return False  # nobody changed it so
            logger.warning(
                "%s was changed since this program made it; it is used as it is", self.workspace.sparse_dir
            )
            return True
        if list(found.images) != list(names) or not has_given_model(self.workspace, found):
            return False
        before, cuts = self._cut_before(), self._originals.cuts.views
        return all(before.get(name) == cuts.get(name) for name in names)

    def _undistort_model(self, scratch: Path, names: Sequence[str]) -> Path:
        """Undistort the model, where COLMAP does it in a process of its own; return the folder where it is."""
        task = ModelToUndistort(self._originals.model_dir, tuple(names), self.options.undistortion, scratch)
        try:
            if self._originals.cuts.views:
                undistort_model(task)
            else:
                self._child.call(undistort_model, task, f"the model in {self.workspace.root}")
        except InputError as error:
            self._refuse_changed_model()
            # The model was read before: what can go wrong is that the disk does not take the new one.
            raise OutputError(
                f"The model of the undistorted images cannot be written ({reason_of(error)}); check space and "
                "permissions."
            ) from error
        finally:
            self._child.close()
        self._refuse_changed_model()
        return task.final_dir

    def _refuse_changed_model(self) -> None:
        """Raise `InputError` where the model is not the one that images were undistorted by: it was read again."""
        if self._originals.model_digest() != self._marker.model:
            raise InputError(
                f"The model in {self._originals.model_dir} was changed while the run was at work; run again once "
                "it is complete."
            )

    def _adopt_images(self, *, has_masks: bool) -> None:
        """Take what an earlier version undistorted for this program's, so that it may be replaced.

        Masks in a workspace for which it was given none are the user's.
        """
        for name in self.names:
            place = undistorted_place(self.workspace, name)
            claim(place.record, place.files if has_masks else place.files[:1])

    def _discard(self, found: Marker) -> None:
        """Make room for all anew: once begun, the next run goes on with it, whether it is told to or not."""
        workspace = self.workspace
        set_model_aside(workspace, found)
        write_marker(workspace, self._marker)
        remove_undistorted(workspace)
        remove_recorded(workspace)
        remove_model(workspace)
        remove_empty_folders(workspace.images_dir, workspace.masks_dir, workspace.stereo_dir, workspace.sparse_dir)
