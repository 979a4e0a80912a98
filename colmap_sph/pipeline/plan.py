"""What a run would do and need, found without writing anything: ``colmap_sph run --dry-run``.

The same stages are asked that a run executes. Which pairs and images are to do is exact, but for pairs that fail
while they are matched, and, of more than a thousand of which nothing is there, for those that cannot be done: some
of these are asked, and stand for all. Time, memory and disk are sums of what the jobs say that they cost; the
constants stand in the stages, and ``scripts/calibrate_plan.py`` compares them with runs.
"""

import logging
from dataclasses import dataclass

from colmap_sph.pipeline.forecast.sizes import affordable_size
from colmap_sph.pipeline.forecast.survey import StagePlan, Survey, foresee
from colmap_sph.pipeline.forecast.time_limit import TimeLimit
from colmap_sph.pipeline.forecast.within import START_SECONDS, Within, page_seconds, widest
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.polishing import with_polished_poses
from colmap_sph.pipeline.reconstruct import check_input, go_through_stages
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages.wide.range_maps import RangeStage
from colmap_sph.project.files import free_space
from colmap_sph.project.project import Project
from colmap_sph.project.state.ownership import foreign_files, named

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """What a run would do, and what it would need.

    Attributes
    ----------
    undistort : bool
        Whether the undistorted images are to be made.
    pair_source : str
        Where the pairs come from.
    pairs, pairs_done : int
        Pairs of images, and those whose disparity map is there.
    images, images_done : int
        Images, and those whose geometric maps are there.
    fuse : bool
        Whether the cloud is to be made.
    seconds : float
        Estimated wall time, with that of the program's start and, where anything is to do, of its page.
    memory, disk : float
        Estimated largest memory in use, and space for files to be made, in bytes.
    free_disk : int
        Free space where these go, bytes.
    region : str
        See `RunReport`.
    stages : tuple of StagePlan
        Of each stage, in their order; with a sparse model the undistortion before them.
    choice : str
        Where a time is asked for: what would be chosen for it, if the machine is as fast as estimated.
    """

    undistort: bool
    pair_source: str
    pairs: int
    pairs_done: int
    images: int
    images_done: int
    fuse: bool
    seconds: float
    memory: float
    disk: float
    free_disk: int
    region: str
    stages: tuple[StagePlan, ...]
    choice: str = ""


def make_plan(
    project: Project, options: RunOptions, *, overwrite: bool = False, limit: TimeLimit | None = None
) -> Plan:
    """Find what `reconstruct.run_project` would do; raises what it would raise before its first stage.

    Parameters
    ----------
    project : Project
    options : RunOptions
    overwrite : bool
        Everything would be done again.
    limit : TimeLimit, optional
        The time to end within.

    Returns
    -------
    Plan
    """
    check_input(project, options, limit)
    survey = Survey(is_bounded=not options.scheduler)  # a cluster's workers have limits of their own
    report = RunReport()
    choice = ""
    if limit is not None:
        options, choice = affordable_size(project, options, limit, overwrite=overwrite)
        options = widest(options, limit)
    foreseen = foresee(project, options, survey, report, overwrite=overwrite)
    context, selection = (foreseen.context, foreseen.selection)
    foreign = foreign_files(context.places, overwrite=overwrite)
    if foreign:
        logger.warning("Would get another name, as this program did not make it: %s", named(foreign))
    if foreseen.given is not None and options.polish.is_wanted:
        context = with_polished_poses(context, selection.unique_pairs(), survey, foreseen.given)
    pairs_to_match = selection.unique_pairs()
    if limit is not None:
        within = Within(limit.begun(START_SECONDS + survey.seconds), context, selection, goes_on=not overwrite)
        context, pairs_to_match, chosen = within.planned()
        choice = f"{choice} {chosen.words}".lstrip()
    go_through_stages(context, pairs_to_match, survey, is_plan=True)
    stages = survey.stages
    pairs, _, maps, cloud = [stage for stage in stages if stage.name != RangeStage.name][-4:]
    return Plan(
        undistort=bool(foreseen.to_make),
        pair_source=selection.source,
        pairs=pairs.total,
        pairs_done=pairs.done,
        images=maps.total,
        images_done=maps.done,
        fuse=cloud.done < cloud.total,
        seconds=START_SECONDS + survey.seconds + (page_seconds(maps.total) if survey.seconds else 0.0),
        memory=max(stage.memory for stage in stages),
        disk=sum(stage.disk for stage in stages),
        free_disk=free_space(project.root),
        region=report.drawn_region,
        stages=tuple(stages),
        choice=choice,
    )
