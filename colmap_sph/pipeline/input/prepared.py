"""A project → its dense workspace with undistorted images: made, or found as an earlier run has made it."""

from dataclasses import replace
from typing import TYPE_CHECKING

from colmap_sph.pipeline.input.start import Request
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.project.polishing.polished import restore_given, starting_model
from colmap_sph.project.project import Project
from colmap_sph.project.state.ownership import discard_results
from colmap_sph.project.workspace import Workspace

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor


def prepare(
    project: Project, options: RunOptions, workspace: Workspace, executor: "Executor", request: Request
) -> tuple[RunOptions, Request]:
    """Make the workspace of a project, which is held, with its undistorted images, where that is not the user's.

    Parameters
    ----------
    project, options, workspace, executor
    request : Request
        With `overwrite` what is there does not count, and is removed or forgotten.

    Returns
    -------
    options : RunOptions
        As given, but for a region that was to be drawn: they have what was.
    request : Request
        With the database of the project, the model that was given, and the images that were to come of it.
    """
    request = replace(request, database=project.database())
    if project.model is None:
        if request.overwrite:
            discard_results(workspace)
        return options, request
    preparation = Preparation(
        project,
        options,
        overwrite=request.overwrite,
        verify=request.verify,
        progress=request.progress,
        report=request.report,
    )
    preparation.run(executor)
    given = preparation.given_model()
    if given.reason_to_keep or not options.polish.is_wanted:
        restore_given(workspace)
    return preparation.options, replace(request, given=given, expected=preparation.expected())


def find_prepared(
    project: Project, options: RunOptions, workspace: Workspace, request: Request
) -> tuple[RunOptions, Request] | None:
    """What `prepare` would return, without a look at the originals; None where there is something left to do.

    Images that are missing are not expected: who prepared the workspace has told of them.
    """
    request = replace(request, database=project.database())
    if project.model is None:
        return options, request
    preparation = Preparation(project, options, progress=request.progress, report=request.report)
    given = preparation.given_model()
    is_polished = starting_model(workspace) != workspace.sparse_dir
    if not preparation.is_finished or is_polished > (options.polish.is_wanted and not given.reason_to_keep):
        return None
    return preparation.options, replace(request, given=given)
