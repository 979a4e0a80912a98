"""A time limit → the size of images that it is enough for.

Below the lowest sampling images themselves must be smaller, as reading, normals and fusion take as long as before.
Their size is chosen before they are undistorted, and stays.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from colmap_sph.pipeline.forecast.pace import measured_speed
from colmap_sph.pipeline.forecast.survey import Survey, foresee
from colmap_sph.pipeline.forecast.time_limit import SIZE, TimeLimit, format_time
from colmap_sph.pipeline.forecast.within import Within, widest
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import RunReport
from colmap_sph.project.project import Project
from colmap_sph.project.undistortion.marker import read_marker
from colmap_sph.project.workspace import Workspace

logger = logging.getLogger(__name__)

# Each size has about seven tenths of the pixels of the one before.
_STEP = 0.84
# Longest side, pixels: smaller images show too little.
_SMALLEST = 320
# Step of the ladder that there must be time for: below it, a smaller size with a higher one is better.
_LEAST = 1


def with_affordable_size(
    project: Project, options: RunOptions, limit: TimeLimit, *, overwrite: bool = False
) -> RunOptions:
    """What `affordable_size` returns, with the speed of this machine measured; tells of it in the log."""
    options, words = affordable_size(project, options, limit, overwrite=overwrite, is_timed=True)
    if words:
        logger.info("%s", words)
    return options


def affordable_size(
    project: Project,
    options: RunOptions,
    limit: TimeLimit,
    *,
    overwrite: bool = False,
    is_timed: bool = False,
) -> tuple[RunOptions, str]:
    """Reduce the images as far as the time demands; those that are undistorted stay as they are.

    Parameters
    ----------
    project : Project
    options : RunOptions
    limit : TimeLimit
    overwrite : bool
        Everything would be done again.
    is_timed : bool
        Whether to measure the speed of this machine where that matters, and not to trust in estimates.

    Returns
    -------
    options : RunOptions
        With the size.
    words : str
        What was chosen, in a sentence; empty where images keep their size.
    """
    if project.model is None or SIZE in limit.kept:
        return options, ""
    there = None if overwrite else read_marker(Workspace(project.root))
    if there is not None:
        size = there.options.get("max_image_size")
    else:
        speed = measured_speed(options.num_busy) if is_timed else 1 / options.num_busy
        size = _size_for(project, options, limit, speed)
    if not isinstance(size, int) or size == -1:
        return options, ""
    undistortion = replace(options.undistortion, max_image_size=size)
    if there is not None:
        words = f"Images stay as an earlier run reduced them, to {size} pixels; --overwrite makes them anew."
    else:
        words = f"{format_time(limit.seconds)} is too little for whole images: they are reduced to {size} pixels."
    return replace(options, undistortion=undistortion), words


def _size_for(project: Project, options: RunOptions, limit: TimeLimit, speed: float) -> int:
    """Longest side of the images, pixels; -1 where they keep it."""
    survey = Survey()
    options = widest(options, limit)
    with _unheard():  # the run itself tells of what is wrong
        foreseen = foresee(project, options, survey, RunReport(), overwrite=True)
        begun = limit.begun(limit.elapsed + survey.seconds * options.num_busy * speed)
        whole = foreseen.context.scene
        largest = max((max(view.width, view.height) for view in whole.views), default=0)
        size = -1
        while True:
            context = replace(foreseen.context, scene=whole.no_larger_than(size))
            if Within(begun, context, foreseen.selection, goes_on=False, speed=speed).has_time_for(_LEAST):
                return size
            smaller = round(_STEP * (largest if size == -1 else size))
            if smaller < _SMALLEST:
                return size
            size = smaller


@contextmanager
def _unheard() -> Iterator[None]:
    package = logging.getLogger("colmap_sph")
    before = package.level
    package.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        package.setLevel(before)
