"""The undistorted images that can be worked with, and what they hold."""

import logging
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING

from colmap_sph.pipeline.checks.self_check import judge_copies, misplaced_views, refuse_cameras
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.input.standing import with_still_pixels
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.stages.check_images import CheckStage, ImagePlaces, details_of, tell_changed
from colmap_sph.pipeline.stages.stage import keys_of
from colmap_sph.project.masks import check_mask_names
from colmap_sph.project.workspace import Workspace, mask_path
from colmap_sph.stereo.rectification import sampling_of

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor

logger = logging.getLogger(__name__)

# Views cut from a wide photograph are finer than it towards their borders, and seem soft for that: together they
# hold so many times what each says.
_CUT_DETAIL = 1.3
# Fewer points say nothing of an image's pose.
_ENOUGH = 10


def check_fusion_masks(context: Context) -> None:
    """See `check_mask_names`; before hours of work, though fusion alone reads them."""
    folder = context.options.fusion.mask_path
    if folder is not None:
        check_mask_names(folder, context.scene.index_of, context.workspace.images_dir)


def with_good_images(
    context: Context, executor: "Executor", *, verify: bool = False, to_come: Collection[str] = ()
) -> Context:
    """Check the undistorted images, and return a context with the good ones alone, whose contents its keys know.

    Parameters
    ----------
    context : Context
    executor : callable
    verify : bool
        Whether what is known of them from earlier runs does not count.
    to_come : collection of str
        Images that are not there yet, or will be made anew: they are taken for good.

    Returns
    -------
    Context
    """
    workspace = context.workspace
    there = [view for view in context.scene.views if view.name not in to_come]
    sizes = {view.name: view.file_size for view in there}
    worked_at = {view.name: (view.width, view.height) for view in there}
    places = _places(workspace)
    checked = executor(CheckStage(context, sizes, places, worked_at, verify=verify)) if there else {}
    images = keys_of(checked)
    judge_copies(context.report, context.scene, images)
    details = {
        name: _CUT_DETAIL * detail if context.scene.view(name).original else detail
        for name, detail in details_of(checked).items()
    }
    if details:
        _report_detail(context, details)
    keys = Keys(workspace, context.options, images, fresh=context.keys.fresh)
    good = replace(context, scene=context.scene.only({*images, *to_come}), keys=keys, details=details)
    return with_still_pixels(good, images)


@contextmanager
def telling_changed(context: Context) -> Iterator[None]:
    """Report images that were changed while something was made of them, however that ends; see `tell_changed`."""
    workspace, folder = context.workspace, context.options.fusion.mask_path

    def masks_of(name: str) -> list[Path | None]:
        return [workspace.mask_path(name), None if folder is None else mask_path(folder, name)]

    try:
        yield
    finally:
        tell_changed(context, _places(workspace), context.scene.index_of, masks_of)


def _places(workspace: Workspace) -> ImagePlaces:
    return ImagePlaces("images", workspace.sparse_dir, workspace.images_dir)


def without_misplaced(context: Context) -> Context:
    """Leave out a few images of which the model contradicts itself: their depth would be wrong, and spoil others'.

    Where half of the images that observe any points are such, it may be the points or the image coordinates, see
    `judge_reprojection`; where it can only be cameras or poses, `NoResultError` is raised. All views of one
    photograph have its pose.
    """
    refuse_cameras(context.scene)
    errors_of = misplaced_views(context.scene)
    judged = 0
    misplaced: dict[str, float] = {}
    for photograph in context.scene.photographs:
        telling = [view.name for view in photograph.views if len(view.point_indices) >= _ENOUGH]
        errors = [errors_of[name] for name in telling if name in errors_of]
        judged += bool(telling)
        if errors and 2 * len(errors) >= len(telling):
            misplaced |= {view.name: max(errors) for view in photograph.views}
    left_out = {context.scene.view(name).photograph for name in misplaced}
    if not left_out or 2 * len(left_out) >= judged:
        return context
    for name, error in misplaced.items():
        reason = (
            f"sparse points project {error:.0f} pixels from where it observes them: its camera or pose is wrong"
        )
        context.skip_view(name, reason)
    return replace(context, scene=context.scene.only(context.scene.index_of.keys() - misplaced.keys()))


def _report_detail(context: Context, details: Mapping[str, float]) -> None:
    """Tell how much the images hold, and how finely they are therefore matched."""
    sampling = context.options.rectification.sampling * mean(map(sampling_of, details.values()))
    detail = mean(details.values())
    context.report.detail = round(detail, 3)
    context.report.sampling = round(sampling, 3)
    logger.info("Images hold %.2f of their pixels' detail: pairs are sampled at %.2f", detail, sampling)
