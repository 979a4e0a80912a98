"""A project → its dense workspace with undistorted images: made, or found as an earlier run has made it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.preparation import Preparation
from colmap_sph.pipeline.report import Progress, RunReport
from colmap_sph.pipeline.stages.polish import GivenModel
from colmap_sph.project.polishing.polished import restore_given, starting_model
from colmap_sph.project.project import Project
from colmap_sph.project.state.ownership import discard_results
from colmap_sph.project.workspace import Workspace

if TYPE_CHECKING:
    from colmap_sph.pipeline.execute import Executor


@dataclass(frozen=True)
class Prepared:
    """What a run has to know of a project whose dense workspace is there.

    Attributes
    ----------
    options : RunOptions
        As given, but for a region that was to be drawn: they have what was.
    names : tuple of str
        Images that the workspace was to have, as far as it is this program's.
    given : GivenModel or None
        The model that it was undistorted from; None: the workspace is the user's.
    """

    options: RunOptions
    names: tuple[str, ...] = ()
    given: GivenModel | None = None


def prepare(
    project: Project,
    options: RunOptions,
    workspace: Workspace,
    executor: "Executor",
    *,
    overwrite: bool,
    verify: bool,
    progress: Progress,
    report: RunReport,
) -> Prepared:
    """Make the workspace of a project, which is held, with its undistorted images, where that is not the user's.

    Parameters
    ----------
    project, options, workspace, executor
    overwrite : bool
        What is there does not count, and is removed or forgotten.
    verify, progress, report
        See `Preparation`.

    Returns
    -------
    Prepared
    """
    if project.model is None:
        if overwrite:
            discard_results(workspace)
        return Prepared(options)
    preparation = Preparation(
        project, options, overwrite=overwrite, verify=verify, progress=progress, report=report
    )
    preparation.run(executor)
    given = preparation.given_model()
    if given.reason_to_keep or not options.polish.is_wanted:
        restore_given(workspace)
    return Prepared(preparation.options, preparation.expected(), given)


def find_prepared(
    project: Project, options: RunOptions, workspace: Workspace, progress: Progress, report: RunReport
) -> Prepared | None:
    """What `prepare` would return, without looking at the originals; None where there is something left to do."""
    if project.model is None:
        return Prepared(options)
    preparation = Preparation(project, options, progress=progress, report=report)
    given = preparation.given_model()
    is_polished = starting_model(workspace) != workspace.sparse_dir
    if not preparation.is_finished or is_polished > (options.polish.is_wanted and not given.reason_to_keep):
        return None
    return Prepared(preparation.options, preparation.expected(), given)
