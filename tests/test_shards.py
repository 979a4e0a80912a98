"""Jobs that each make a part of a stage: the same bytes as one run, whoever works beside them."""

import contextlib
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from conftest import copy_block
from numpy.typing import NDArray
from projects import results

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.errors import InputError, OptionError, OutputError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.start import Request
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.shards import run_part as shards
from colmap_sph.pipeline.shards.part import Part, StageName
from colmap_sph.pipeline.shards.run_part import PartReport, run_part
from colmap_sph.pipeline.stages import maps as map_stage
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.maps import MapFiles
from colmap_sph.pipeline.stages.match import MatchStage, MatchTask
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.platforms.files import look_again
from colmap_sph.project.claim import claimed, shared
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.polishing import PolishOptions
from colmap_sph.project.project import Project
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.partners.pairs import PairOptions
from colmap_sph.synthetic import DemoBlock

IMAGES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_0.jpg", "N_1_1.jpg"]
OPTIONS = RunOptions(threads=1, pairs=PairOptions(num_pairs=3))
STAGES: tuple[StageName, ...] = ("match", "vote", "confirm")


@dataclass(frozen=True)
class Whole:
    """A sparse model, and what one run makes of it."""

    model: Path
    dense: Path


@pytest.fixture(scope="module")
def whole(block: DemoBlock, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """Five images of the block; not to be changed."""
    folder = tmp_path_factory.mktemp("whole")
    copy_block(block, folder, IMAGES)
    colmap_sph.run(folder / "sparse/0", output=folder / "dense", options=OPTIONS)
    return Whole(folder / "sparse/0", folder / "dense")


@pytest.fixture(scope="module")
def fresh(whole: Whole, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same project, prepared in another folder; not to be changed."""
    dense = tmp_path_factory.mktemp("fresh") / "dense"
    make(Project(whole.model, output=dense), "prepare")
    return dense


@pytest.fixture
def prepared(whole: Whole, fresh: Path, tmp_path: Path) -> Project:
    """The same project, prepared, to do with as a test likes."""
    shutil.copytree(fresh, tmp_path / "dense")
    return Project(whole.model, output=tmp_path / "dense")


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is waited for."""
    monkeypatch.setattr(shards, "PATIENCE", 0.0)


def make(project: Project, stage: StageName, number: int = 1, parts: int = 1) -> PartReport:
    return run_part(project, OPTIONS, stage, Part(number, parts))


def times(dense: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in dense.rglob("*") if path.suffix in (".sph", ".bin", ".jpg")}


# ---- parts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 2, 3, 7, 16, 50])
@pytest.mark.parametrize("number", [0, 1, 5, 16, 47])
def test_parts_are_neighbours_and_together_all(number: int, parts: int) -> None:
    items = list(range(number))
    cut = [list(Part(each, parts).of(items)) for each in range(1, parts + 1)]
    assert [item for part in cut for item in part] == items
    assert max(map(len, cut)) - min(map(len, cut)) <= 1
    assert list(Part(1, parts).all) == [Part(each, parts) for each in range(1, parts + 1)]


@pytest.mark.parametrize(
    "text", ["0/4", "5/4", "x", "4", "", "-1/4", "1/0", "0/0", "1/4/2", "1.0/4", "²/4", "1/99999999"]
)
def test_what_is_no_part(text: str) -> None:
    with pytest.raises(OptionError, match=r"shard must be I/N with I from 1 to N, such as 3/16, not '"):
        Part.parse(text)


# ---- the same results --------------------------------------------------------------------------------------


def test_shards_make_what_one_run_makes(whole: Whole, prepared: Project) -> None:
    """In any order; each its own, which no other makes again; the last run has but to fuse."""
    dense = prepared.root
    made = {}
    for stage, order in zip(STAGES, [(2, 3, 1), (1, 2), (4, 1, 3, 2)], strict=True):
        before = times(dense)
        reports = [make(prepared, stage, number, len(order)) for number in order]
        assert sum(report.made for report in reports) == reports[0].total
        assert all((report.made, report.reused, report.failed) == (report.items, 0, {}) for report in reports)
        assert {path: time for path, time in times(dense).items() if path in before} == before
        made[stage] = reports[0].total
    assert not (dense / "fused.ply").exists()
    assert not (dense / "colmap_sph/report.json").exists()
    kept = times(dense)
    report = colmap_sph.run(whole.model, output=dense, options=OPTIONS)
    assert results(dense) == results(whole.dense)
    assert len(results(dense)) > 20
    assert {path: time for path, time in times(dense).items() if path in kept} == kept
    assert report.made == {
        "undistort": 0,
        "match pairs": 0,
        "vote on depth": 0,
        "confirm depth": 0,
        "fuse": 1,
    }
    assert report.reused["match pairs"] == made["match"]


@pytest.mark.parametrize(
    "options",
    [
        RunOptions(threads=1, pairs=OPTIONS.pairs, region="auto"),
        RunOptions(threads=1, pairs=OPTIONS.pairs, polish=PolishOptions(poses="on")),
    ],
    ids=["region", "polish"],
)
def test_what_is_found_out_before_the_first_pair_is_found_once(options: RunOptions, prepared: Project) -> None:
    """What a region is, and poses: all shards have the same, and the last run."""
    run_part(prepared, options, "prepare", Part())
    for stage in STAGES:
        run_part(prepared, options, stage, Part())
    report = colmap_sph.run(prepared.model, output=prepared.root, options=options)
    assert [report.made[name] for name in ("match pairs", "vote on depth", "confirm depth")] == [0, 0, 0]
    assert report.points > 0


def test_shards_at_the_same_time(whole: Whole, prepared: Project) -> None:
    """Processes; afterwards all know what each has found out, and nothing is asked anew."""
    dense = prepared.root
    typed = [sys.executable, "-P", "-m", "colmap_sph", "run", "--model", str(whole.model), "--output", str(dense)]
    typed += ["--threads", "1", "--num-pairs", "3", "--progress", "none", "--stage", "match"]
    jobs = [subprocess.Popen([*typed, "--shard", f"{number}/3"], stderr=subprocess.PIPE) for number in (1, 2, 3)]
    for job in jobs:
        said = job.communicate(timeout=60)[1]
        assert job.returncode == 0, said
    expected = {name: content for name, content in results(whole.dense).items() if "/pairs/" in name}
    assert {name: content for name, content in results(dense).items() if "/pairs/" in name} == expected
    known = json.loads((dense / "colmap_sph/known/pairs.json").read_bytes())["content"]
    assert len(known) == len(expected)
    assert sorted(path.name for path in (dense / "colmap_sph/logs").iterdir()) == [
        f"match-{number}-of-3.txt" for number in (1, 2, 3)
    ]


def test_more_shards_than_items(prepared: Project) -> None:
    reports = [make(prepared, "match", number, 40) for number in range(1, 41)]
    assert {report.items for report in reports} == {0, 1}
    assert make(prepared, "match").reused == reports[0].total


def test_a_shard_again_makes_nothing(prepared: Project) -> None:
    make(prepared, "match", 1, 2)
    before = times(prepared.root)
    again = make(prepared, "match", 1, 2)
    assert (again.made, again.reused) == (0, again.items)
    assert times(prepared.root) == before


# ---- one after the other -----------------------------------------------------------------------------------


def test_nothing_is_prepared(whole: Whole, tmp_path: Path) -> None:
    """All shards at once on a fresh place: each says so, and leaves nothing behind."""
    dense = tmp_path / "dense"
    for stage in STAGES:
        with pytest.raises(
            InputError, match=r"dense is not prepared .* once with --stage prepare, without --shard"
        ):
            make(Project(whole.model, output=dense), stage, 1, 2)
    assert not dense.exists()


def test_a_users_workspace_is_to_be_prepared_too(whole: Whole, tmp_path: Path) -> None:
    dense = tmp_path / "dense"
    for folder in ("images", "sparse"):
        shutil.copytree(whole.dense / folder, dense / folder)
    project = Project(workspace=dense)
    with pytest.raises(InputError, match="is not prepared"):
        make(project, "match")
    assert not (dense / "colmap_sph").exists()
    make(project, "prepare")
    for stage in STAGES:
        make(project, stage)
    assert colmap_sph.run(workspace=dense, options=OPTIONS).made["confirm depth"] == 0


def test_undistortion_that_was_not_finished(prepared: Project) -> None:
    marker = Workspace(prepared.root).marker_path
    content = json.loads(marker.read_bytes())
    marker.write_text(json.dumps(content | {"images": []}))
    with pytest.raises(InputError, match="is not prepared"):
        make(prepared, "match")


def test_a_stage_before_is_not_complete(prepared: Project) -> None:
    make(prepared, "match", 1, 3)
    total = make(prepared, "match", 3, 3).total
    missing = len(Part(2, 3).of(range(total)))
    with pytest.raises(
        InputError,
        match=rf"--stage vote needs all of --stage match, of which {missing} of {total} pairs are missing",
    ) as error:
        make(prepared, "vote", 1, 3)
    assert "(of shards 2/3)" in str(error.value)
    assert not list(prepared.root.glob("colmap_sph/photometric/*"))
    make(prepared, "match", 2, 3)
    make(prepared, "vote", 2, 2)
    with pytest.raises(InputError, match=r"--stage confirm needs all of --stage vote, of which 2 of 5 images"):
        make(prepared, "confirm", 1, 1)


def test_what_other_machines_have_just_made_is_waited_for(
    prepared: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here a file appears when folders are looked at again."""
    make(prepared, "match")
    hidden = next(prepared.root.glob("colmap_sph/pairs/000/*.sph"))
    aside = hidden.with_suffix(".aside")
    hidden.rename(aside)
    Workspace(prepared.root).known_path("pairs").unlink()
    looks = []

    def look(folders: set[Path]) -> None:
        look_again(folders)
        looks.append(folders)
        if len(looks) == 2:
            assert hidden.parent in folders
            aside.rename(hidden)

    monkeypatch.setattr(shards, "PATIENCE", 5.0)
    monkeypatch.setattr(shards, "look_again", look)
    assert make(prepared, "vote").made == 5


def test_a_pair_that_cannot_be_made(prepared: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its shard says so; the plain run goes on without it."""
    make_pair = MatchStage.make

    def fails(task: MatchTask) -> Facts:
        if {task.left[0].view.name, task.right[0].view.name} == {"N_0_0.jpg", "N_0_1.jpg"}:
            raise InputError("the disk has a hole.")
        return make_pair(task)

    monkeypatch.setattr(MatchStage, "make", staticmethod(fails))
    report = make(prepared, "match")
    assert {*report.failed} == {"N_0_0.jpg", "N_0_1.jpg"}
    assert report.made == report.total - 1
    with pytest.raises(InputError, match=r"1 of .* pairs are missing, such as the pair N_0_0\.jpg - N_0_1\.jpg;"):
        make(prepared, "vote")
    assert colmap_sph.run(prepared.model, output=prepared.root, options=OPTIONS).points > 0


# ---- side by side ------------------------------------------------------------------------------------------


def test_a_run_keeps_shards_out_and_they_it(prepared: Project) -> None:
    workspace = Workspace(prepared.root)
    with claimed(workspace), pytest.raises(OutputError, match="Another run is at work in"):
        make(prepared, "match", 1, 2)
    with shared(workspace):
        make(prepared, "match", 1, 2)
        for alone in (
            lambda: make(prepared, "prepare"),
            lambda: colmap_sph.run(prepared.model, output=prepared.root, options=OPTIONS),
        ):
            with pytest.raises(OutputError, match="Another run is at work in"):
                alone()


def test_leftovers_of_others_stay_until_the_last_run(prepared: Project) -> None:
    """They may be another shard's, at work on another machine."""
    make(prepared, "match", 1, 2)
    leftover = prepared.root / "colmap_sph/pairs/000/.other-17-140000-0.tmp"
    leftover.write_bytes(b"half")
    for stage in STAGES:
        make(prepared, stage)
        assert leftover.exists()
    colmap_sph.run(prepared.model, output=prepared.root, options=OPTIONS)
    assert not leftover.exists()


def test_results_of_other_options_are_never_taken_for_ours(prepared: Project) -> None:
    """A job with other options makes pairs anew before they vote: no key vouches for a mixture."""
    make(prepared, "match")
    other = RunOptions(threads=1, pairs=OPTIONS.pairs, matching=MatchingOptions(p1=20))
    with opened(prepared, OPTIONS) as (context, pairs):
        stage = VoteStage(context, execute(MatchStage(context, pairs)))
        tasks = {name: stage.job(name).task for name in stage.items}
    run_part(prepared, other, "match", Part())
    with stage.opened():
        for name, task in tasks.items():
            with pytest.raises(InputError, match="was made anew with other options meanwhile"):
                stage.make(task)
            assert not context.estimate_path(name).exists()


@pytest.mark.parametrize("when", ["between both maps", "before they are vouched for"])
def test_maps_of_two_jobs_at_the_same_time_are_nobodys(
    when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job with other options writes the same maps; whichever is last, no key vouches for the other's files."""
    maps = MapFiles(tmp_path / "depth.bin", tmp_path / "normals.bin", tmp_path / "record.json")
    normals = np.zeros((40, 50, 3), np.float32)
    normals[..., 2] = -1
    write_normals = map_stage.write_normal_map

    def write_other() -> None:
        monkeypatch.undo()
        maps.write(normals, np.full((40, 50), 2, np.float32), "other")

    def write_normals_later(path: Path, values: NDArray[np.float32]) -> str:
        if when == "between both maps":
            write_other()
        digest = write_normals(path, values)
        if when == "before they are vouched for":
            write_other()
        return digest

    monkeypatch.setattr(map_stage, "write_normal_map", write_normals_later)
    with pytest.raises(OutputError, match=r"depth\.bin was written by another job at the same time"):
        maps.write(normals, np.full((40, 50), 1, np.float32), "ours")
    assert maps.facts("ours") is None
    assert maps.facts("other") is None
    # They are made anew without setting anything aside.
    maps.write(normals, np.full((40, 50), 1, np.float32), "ours")
    assert maps.facts("ours") is not None
    assert read_depth_map(maps.depth, (maps.digests() or ("",))[0]).max() == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["depth.bin", "normals.bin", "record.json"]


@contextlib.contextmanager
def opened(project: Project, options: RunOptions) -> Iterator[tuple[Context, list[tuple[str, str]]]]:
    """What stages work with, as the jobs find it."""
    workspace = Workspace(project.root)
    with shared(workspace):
        context, selection = shards.start(workspace, options, execute, Request())
        yield context, selection.unique_pairs()


# ---- typed -------------------------------------------------------------------------------------------------


def command(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    code = cli.main(["run", *arguments])
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return code, captured.out + captured.err


def test_what_a_user_sees(whole: Whole, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    typed = [
        "--model",
        str(whole.model),
        "--output",
        str(tmp_path / "dense"),
        "--num-pairs",
        "3",
        "--threads",
        "1",
    ]
    code, said = command(capsys, *typed, "--stage", "prepare")
    assert code == 0
    assert re.search(r"prepared +5 images, \d+ pairs", said) and re.search(r"next +--stage match", said)
    code, said = command(capsys, *typed, "--stage", "match", "--shard", "1/2", "--progress", "json")
    assert code == 0
    events = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    assert [each["event"] for each in events][:1] == ["begin"]
    assert (events[-1]["event"], events[-1]["exit_code"]) == ("end", 0)
    code, said = command(capsys, *typed, "--stage", "vote", "--shard", "1/2")
    assert code == 2
    assert said.splitlines()[-1].startswith("error: --stage vote needs all of --stage match, of which ")
    code, said = command(capsys, *typed, "--stage", "match", "--shard", "2/2")
    assert code == 0
    assert re.search(r"match, shard 2/2 +(\d+) of \d+ pairs: \1 made, 0 up to date", said)
    assert re.search(r"next +when all shards are done: --stage vote", said)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--shard", "1/4"], "--shard is a part of one stage; give --stage match, vote or confirm"),
        (["--shard", "4"], "--shard must be I/N with I from 1 to N, such as 3/16, not '4'."),
        (["--stage", "match", "--shard", "5/4"], "--shard must be I/N"),
        (["--stage", "match", "--shard", ""], "--shard must be I/N"),
        (["--stage", "prepare", "--shard", "1/4"], "--stage prepare is done once, as a whole; leave out --shard."),
        (["--stage", "match", "--dry-run"], "--dry-run is for whole runs; leave out it or --stage."),
        (["--stage", "vote", "--within", "1h"], "--within is for whole runs; leave out it or --stage."),
        (["--stage", "match", "--scheduler", "a.json"], "--stage is for jobs without a scheduler;"),
        (["--stage", "confirm", "--overwrite"], "--overwrite and --verify would take from other jobs"),
        (["--stage", "match", "--verify"], "--overwrite and --verify would take from other jobs"),
    ],
)
def test_what_does_not_go_together(
    options: list[str], words: str, whole: Whole, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = command(capsys, "--model", str(whole.model), "--output", str(tmp_path / "dense"), *options)
    assert code == 2
    (line,) = said.splitlines()
    assert line.startswith(f"error: {words}")
    assert not (tmp_path / "dense").exists()
