"""What a run foresees of its stages, against what a dry run counts and what the run then does."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import keep_images
from projects import make_context, prepare

import colmap_sph
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.forecast.foresight import foreseen_stages
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.report import Silent, StageEstimate
from colmap_sph.pipeline.stages.selection import choose_pairs
from colmap_sph.project.project import Project

NAMES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_0.jpg"]
OPTIONS = RunOptions(threads=2)


class Foreseen(Silent):
    """Keeps what a run foresees, and the steps of each stage with their work."""

    def __init__(self) -> None:
        self.stages: list[StageEstimate] = []
        self.steps: dict[str, list[float]] = {}
        self._stage = ""

    def foresee(self, stages) -> None:
        self.stages = list(stages)

    def start(self, stage: str, total: int) -> None:
        self._stage = stage
        self.steps[stage] = []

    def advance(self, seconds: float = 0.0) -> None:
        self.steps[self._stage].append(seconds)


def test_a_run_foresees_what_it_then_does(project: Path) -> None:
    """Of so few pairs and images all are asked: nothing is left to chance."""
    keep_images(project, NAMES)
    told = Foreseen()
    colmap_sph.run(project / "sparse/0", options=OPTIONS, progress=told)
    assert [stage.name for stage in told.stages] == ["match pairs", "vote on depth", "confirm depth", "fuse"]
    for stage in told.stages:
        steps = told.steps[stage.name]
        assert stage.items == len(steps)
        # Disparity maps, whose sizes count for votes, are not there when these are foreseen.
        assert stage.seconds == pytest.approx(sum(steps), rel=0.02)
        assert stage.item_seconds == pytest.approx(stage.seconds / stage.items)


def test_what_is_there_is_no_work(project: Path) -> None:
    keep_images(project, NAMES)
    model = project / "sparse/0"
    colmap_sph.run(model, options=OPTIONS)
    told = Foreseen()
    colmap_sph.run(model, options=OPTIONS, progress=told)
    assert told.stages[0].seconds == 0
    assert {step for name in ("match pairs", "vote on depth", "confirm depth") for step in told.steps[name]} == {
        0.0
    }


def test_many_pairs_are_estimated_by_a_few(project: Path) -> None:
    """Within a tenth of what a dry run finds, which asks for all of them."""
    workspace = prepare(project / "sparse/0", project / "dense")
    context = with_good_images(make_context(workspace), execute)
    pairs = choose_pairs(workspace, context.scene, context.options, None).unique_pairs()
    assert len(pairs) > 16
    planned = {stage.name: stage for stage in make_plan(Project(workspace=workspace.root), RunOptions()).stages}
    for stage in foreseen_stages(context, pairs):
        assert stage.items == planned[stage.name].total or stage.name == "fuse"
        assert stage.seconds == pytest.approx(planned[stage.name].seconds, rel=0.1)


def test_what_cannot_be_done_is_told_by_the_stage_alone(project: Path) -> None:
    keep_images(project, NAMES)
    workspace = prepare(project / "sparse/0", project / "dense")
    context = with_good_images(make_context(workspace), execute)
    impossible = replace(context.options.rectification, max_pixels_ratio=1e-6)
    context = replace(context, options=replace(context.options, rectification=impossible))
    pairs = choose_pairs(workspace, context.scene, context.options, None).unique_pairs()
    matching = foreseen_stages(context, pairs)[0]
    assert (matching.items, matching.seconds) == (len(pairs), 0.0)
    assert context.report.skipped_pairs == {}
