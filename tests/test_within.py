"""A time limit: how it is written, what is chosen for it, when a run arrives, and that it can be repeated."""

import json
import random
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from conftest import keep_images
from projects import make_context, prepare

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.errors import OptionError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.forecast import sizes, within
from colmap_sph.pipeline.forecast.foresight import estimate, estimated_fusion
from colmap_sph.pipeline.forecast.ladder import BEST, LADDER, NORMAL, Settings, choices
from colmap_sph.pipeline.forecast.ranks import ranks_of
from colmap_sph.pipeline.forecast.time_limit import SIZE, TimeLimit, format_time, parse_time
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.presets import preset
from colmap_sph.pipeline.reconstruct import go_through_stages_within
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.selection import choose_pairs
from colmap_sph.pipeline.stages.stage import Result, Stage
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.project.project import Project
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.partners.pairs import PairOptions, PairSelection, select_pairs
from colmap_sph.stereo.rectification import RectificationOptions
from colmap_sph.synthetic import DemoBlock

IMAGES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_0.jpg", "N_1_1.jpg", "N_1_2.jpg"]
OPTIONS = RunOptions(threads=1)

# ---- how it is written -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90s", 90),
        ("20min", 1200),
        ("20 MIN", 1200),
        ("20m", 1200),
        ("1.5h", 5400),
        ("1h30min", 5400),
        (" 1h 30min 10s ", 5410),
    ],
)
def test_a_time(text: str, seconds: float) -> None:
    assert parse_time(text) == seconds
    assert parse_time(format_time(seconds)) == pytest.approx(seconds, rel=0.01)


@pytest.mark.parametrize(
    "text",
    ["20", "0s", "0h0min", "-5min", "min", "1e3s", "nan s", "infmin", "5min1h", "1d", "２０min", "9" * 300 + "h"],
)
def test_what_is_no_time(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--model", "nowhere", f"--within={text}"]) == 2
    assert re.fullmatch(r"error: --within must be a time such as .*", " ".join(capsys.readouterr().err.split()))


def sentence(capsys: pytest.CaptureFixture[str], *typed: str) -> str:
    assert cli.main(["run", "--model", "nowhere", *typed]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said.startswith("error: --")
    return said


def test_contradictions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    limited = ("--within", "20min")
    assert "leave out it or --quality" in sentence(capsys, *limited, "--quality", "normal")
    dials = ("--num-pairs", "10", "--sampling", "1.0", "--refinement.rounds", "2")
    assert "--num-pairs, --rectification.sampling and --refinement.rounds" in sentence(capsys, *limited, *dials)
    assert "polish in a run of its own" in sentence(capsys, *limited, "--polish-poses")
    (tmp_path / "report.json").write_text('{"options": {}}')
    assert "--within has no effect" in sentence(capsys, *limited, "--config", str(tmp_path / "report.json"))
    (tmp_path / "run.toml").write_text('within = "20min"\nquality = "best"\n')
    assert "leave out it or --quality" in sentence(capsys, "--config", str(tmp_path / "run.toml"))


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_what_is_no_time_in_python(seconds: float) -> None:
    with pytest.raises(OptionError, match="within must be"):
        colmap_sph.run("nowhere", within=seconds)


# ---- what is chosen ----------------------------------------------------------------------------------------


def test_the_ladder_goes_from_the_least_to_the_best() -> None:
    assert LADDER[-1] == BEST == Settings.of(preset("best"))
    assert NORMAL in LADDER
    for less, more in pairwise(LADDER):
        assert less.sampling <= more.sampling and less.partners <= more.partners and less.rounds <= more.rounds
        less.applied(RunOptions()).check()


def test_what_the_user_chose_stays() -> None:
    options = RunOptions(rectification=RectificationOptions(sampling=0.77), matching=MatchingOptions(p1=16))
    ladder = choices(options, {"rectification.sampling"})
    assert {each.sampling for each in ladder} == {0.77}
    assert ladder[0].partners < ladder[-1].partners
    assert ladder[0].applied(options).matching.p1 == 16


@pytest.fixture(scope="module")
def prepared(block: DemoBlock, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten images, undistorted, of which nothing is matched; not to be changed."""
    return prepare(block.sparse_dir, tmp_path_factory.mktemp("within") / "dense").root


@pytest.fixture
def context(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Context:
    """Ten images, undistorted and checked, of which nothing is matched.

    The page of so few small images would take longer than all else.
    """
    monkeypatch.setattr(within, "_PAGE_SECONDS", 0.02)
    monkeypatch.setattr(within, "_PAGE_SECONDS_EACH", 0.01)
    workspace = Workspace(shutil.copytree(prepared, tmp_path / "dense"))
    context = with_good_images(make_context(workspace), execute)
    return replace(context, options=within.widest(OPTIONS, TimeLimit(1)))


def selected(context: Context) -> PairSelection:
    return choose_pairs(context.workspace, context.scene, context.options, None)


def test_ranks_are_the_pairs_of_fewer_partners(context: Context) -> None:
    ranks = ranks_of(selected(context))
    for number in range(1, 7):
        pairs = {pair for rank in ranks[:number] for pair in rank}
        assert pairs == set(select_pairs(context.scene, PairOptions(num_pairs=number)).unique_pairs())


# ---- when it arrives ---------------------------------------------------------------------------------------


class Simulation:
    """Goes through stages by a clock of its own: a job takes as long as estimated, times its stage's factor."""

    def __init__(self, context: Context, speed: Callable[[str, float], float]) -> None:
        self.now = 0.0
        self.matched = 0
        self._context = context
        self._speed = speed
        self._rng = random.Random(1)

    def __call__(self, stage: Stage[Any, Any], /) -> dict[Any, Result]:
        started = self.now
        results = {}
        for item in stage.items:
            if stage.is_wanted(item):
                job = stage.job(item)
                taken = job.cost.seconds * self._speed(stage.name, self.now) * self._rng.uniform(0.7, 1.3)
                self.now += taken
                results[item] = Result(job.key, True, Facts(coverage=1.0), job.cost.seconds, taken)
        self._context.report.seconds[stage.name] = self.now - started
        return results

    def run(self, seconds: float, kept: frozenset[str] = frozenset()) -> Settings:
        """Return what was chosen in the end."""
        limit = TimeLimit(seconds, kept, 0.0, lambda: self.now)
        choosing = within.Within(limit, self._context, selected(self._context))
        chosen = go_through_stages_within(choosing, self)
        self.now += within.page_seconds(len(self._context.scene.views)) * self._speed("page", self.now)
        return Settings.of(chosen.options)


def steady(factor: float) -> Callable[[str, float], float]:
    return lambda stage, now: factor


_SPANS: dict[float, tuple[float, float]] = {}


def span(context: Context, factor: float) -> tuple[float, float]:
    """Seconds of the least and the best, by simulation of runs with so much or so little time; once a factor."""
    if factor not in _SPANS:
        _SPANS[factor] = _simulated_span(context, factor)
    return _SPANS[factor]


def _simulated_span(context: Context, factor: float) -> tuple[float, float]:
    least, most = Simulation(context, steady(factor)), Simulation(context, steady(factor))
    assert least.run(1e-3) == LADDER[0]
    assert most.run(1e6).sampling == BEST.sampling
    (context.workspace.within_path).unlink()
    return least.now, most.now


@pytest.mark.parametrize("factor", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("share", [0.15, 0.4, 0.8])
def test_it_arrives_whatever_the_speed(factor: float, share: float, context: Context) -> None:
    least, most = span(context, factor)
    asked = least + share * (most - least)
    simulation = Simulation(context, steady(factor))
    settings = simulation.run(asked)
    assert simulation.now == pytest.approx(asked, rel=0.15)
    assert LADDER[0] != settings != BEST


def test_it_arrives_when_the_machine_slows_down(context: Context) -> None:
    """Others take half of it when a third of the time has passed."""
    least, most = span(context, 1.0)
    asked = least + 0.9 * (most - least)

    def speed(stage: str, now: float) -> float:
        return 2.0 if now > asked / 3 else 1.0

    simulation = Simulation(context, speed)
    simulation.run(asked)
    assert simulation.now == pytest.approx(asked, rel=0.15)


def test_it_uses_what_is_left_when_the_machine_gets_faster(context: Context) -> None:
    least, most = span(context, 1.0)
    asked = least + 0.4 * (most - least)
    steadily = Simulation(context, steady(1.0))
    faster = Simulation(context, lambda _, now: 1.0 if now < asked / 8 else 0.3)
    before = steadily.run(asked)
    context.workspace.within_path.unlink()
    after = faster.run(asked)
    assert faster.now <= 1.15 * asked
    assert (after.sampling, after.partners, after.rounds) > (before.sampling, before.partners, before.rounds)


def test_stages_that_take_longer_than_estimated(context: Context) -> None:
    """All after the matching takes half as long again as thought."""
    least, most = span(context, 1.0)
    asked = least + 0.6 * (most - least)
    later = ("vote on depth", "confirm depth", "fuse")
    simulation = Simulation(context, lambda stage, _: 1.5 if stage in later else 1.0)
    simulation.run(asked)
    assert simulation.now <= 1.15 * asked


def test_stages_that_take_less_than_estimated(context: Context) -> None:
    """Matching takes half as long again as thought, and all after it half: what is left is used."""
    least, most = span(context, 1.0)
    asked = least + 0.6 * (most - least)
    simulation = Simulation(context, lambda stage, _: 1.5 if "pairs" in stage else 0.5)
    simulation.run(asked)
    assert simulation.now == pytest.approx(asked, rel=0.15)


@pytest.mark.parametrize("pixels", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("detail", [0.4, 1.0])
def test_the_forecast_knows_how_views_are_refined(detail: float, pixels: float, context: Context) -> None:
    """What comes after the matching takes what its stages say: less for precise poses, and for soft images."""
    context = replace(context, details=dict.fromkeys(context.scene.index_of, detail))
    pairs = selected(context).unique_pairs()
    facts = Facts(coverage=1.0, row_residual=pixels / float(context.scene.views[0].K[0, 0]))
    matched = {pair: Result("", made=True, facts=facts) for pair in pairs}
    votes = {view.name: Result("", made=True, facts=facts) for view in context.scene.views}
    stages = (VoteStage(context, matched), ConfirmStage(context, matched, votes))
    expected = sum(estimate(stage).seconds for stage in stages) + estimated_fusion(context).seconds
    choosing = within.Within(TimeLimit(60.0), context, selected(context))
    choosing._note_residuals(matched)
    settings = Settings.of(context.options)
    assert choosing._later_work(len(ranks_of(selected(context))), settings) == pytest.approx(expected, rel=0.02)


def test_too_little_is_told_beforehand(context: Context, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", "colmap_sph"):
        assert Simulation(context, steady(1.0)).run(0.1) == LADDER[0]
    (warning,) = (record.message for record in caplog.records if "is too little" in record.message)
    assert "the run takes about" in warning and LADDER[0].flags in warning


def test_partners_of_the_user_are_all_matched(context: Context) -> None:
    pairs = replace(context.options.pairs, num_pairs=3)
    context = replace(context, options=replace(context.options, pairs=pairs))
    simulation = Simulation(context, steady(1.0))
    assert simulation.run(0.5, frozenset({"pairs.num_pairs"})).partners == 3


# ---- the size of images ------------------------------------------------------------------------------------


@pytest.fixture
def small_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the small images of the tests be reduced, and their page take no time."""
    monkeypatch.setattr(sizes, "_SMALLEST", 40)
    monkeypatch.setattr(within, "_PAGE_SECONDS", 0.02)
    monkeypatch.setattr(within, "_PAGE_SECONDS_EACH", 0.01)


def size_for(project: Path, seconds: float, *kept: str, overwrite: bool = False) -> int:
    """Longest side that is chosen by the estimates alone, as no clock moves."""
    limit = TimeLimit(seconds, frozenset(kept), 0.0, lambda: 0.0)
    given = Project(model=project / "sparse/0", output=project / "dense")
    options, words = sizes.affordable_size(given, OPTIONS, limit, overwrite=overwrite)
    size = options.undistortion.max_image_size
    assert words == "" if size == -1 else str(size) in words
    return size


@pytest.mark.usefixtures("small_images")
def test_images_are_reduced_where_time_is_short(project: Path) -> None:
    assert size_for(project, 100) == -1
    assert 320 > size_for(project, 1.2) > size_for(project, 0.9) >= 40
    assert size_for(project, 1e-6) >= 40
    assert size_for(project, 1e-6, SIZE) == -1


@pytest.mark.usefixtures("small_images")
def test_images_stay_as_an_earlier_run_reduced_them(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_images(project, IMAGES)
    command = ["run", "--model", str(project / "sparse/0"), "--threads", "2"]
    assert cli.main([*command, "--max-image-size", "100"]) == 0
    for seconds in (1e-6, 100):
        assert size_for(project, seconds) == 100
    assert size_for(project, 100, overwrite=True) == -1
    assert cli.main([*command, "--within", "10h", "--num-pairs", "2"]) == 0
    assert report_of(project / "dense")["options"]["undistortion"]["max_image_size"] == 100
    assert "--max-image-size 100" in " ".join(capsys.readouterr().err.split())


# ---- real runs ---------------------------------------------------------------------------------------------


def report_of(dense: Path) -> dict[str, Any]:
    report = json.loads((dense / "colmap_sph/report.json").read_text())
    assert isinstance(report, dict)
    return report


@pytest.mark.parametrize("asked", ["10h", "1s"])
def test_it_can_be_repeated(asked: str, project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With more time than needed and with too little: the result is that of the options which the report names."""
    keep_images(project, IMAGES)
    command = ["run", "--model", str(project / "sparse/0"), "--threads", "2"]
    dense, fresh = project / "dense", project / "fresh"
    assert cli.main([*command, "--within", asked]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert ("late: it took" in said) == ("is too little" in said) == (asked == "1s")
    report = report_of(dense)
    chosen = Settings(
        report["options"]["rectification"]["sampling"],
        report["options"]["pairs"]["num_pairs"],
        report["options"]["refinement"]["rounds"],
        report["options"]["normals"]["radius"],
    )
    assert (chosen.sampling, chosen.rounds) == (
        (BEST.sampling, BEST.rounds) if asked == "10h" else (LADDER[0].sampling, LADDER[0].rounds)
    )
    assert chosen.flags in report["command"] and chosen.flags in report["within"]

    config = str(dense / "colmap_sph/report.json")
    assert cli.main([*command, "--output", str(fresh), "--config", config]) == 0
    assert (fresh / "fused.ply").read_bytes() == (dense / "fused.ply").read_bytes()
    for again in ([*report["command"].split()[1:]], [*command, "--within", asked]):
        assert cli.main(again) == 0
        assert not any(report_of(dense)["made"].values()), again


def test_a_dry_run_tells_what_would_be_chosen(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_images(project, IMAGES)
    command = ["run", "--model", str(project / "sparse/0"), "--threads", "2", "--dry-run", "--within"]
    assert cli.main([*command, "10h"]) == 0
    assert BEST.flags in " ".join(capsys.readouterr().err.split())
    assert cli.main([*command, "1s"]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "1s is too little" in said and LADDER[0].flags in said
    assert not (project / "dense").exists()
