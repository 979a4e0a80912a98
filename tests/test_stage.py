"""The contract of the stages: a task can be pickled, and what it makes does not depend on where it is made."""

import pickle
import threading
import tracemalloc
from collections.abc import Callable, Hashable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from projects import FOUR_NAMES, copy_four_images, prepare

import colmap_sph
from colmap_sph.errors import InputError
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.known.remembering import RememberingStage
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages import pair_files
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.fuse import ColmapFuseStage, fuse_stage
from colmap_sph.pipeline.stages.fusion_parts import PartsStage
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.pair_files import read_pair, write_pair
from colmap_sph.pipeline.stages.stage import Cost, Job, Result, Stage, keys_of
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo import vote
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.partners.pairing import Pair
from colmap_sph.stereo.partners.pairs import select_pairs
from colmap_sph.stereo.partners.stations import OWN_STATION, Stations

NAMES = FOUR_NAMES
OPTIONS = RunOptions(threads=2)
# Of what is no array, in a stage's work.
SMALL_BYTES = 20_000
Item = TypeVar("Item", bound=Hashable)
Task = TypeVar("Task")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images, and what a run makes of them; not to be changed."""
    folder = tmp_path_factory.mktemp("stages")
    copy_four_images(folder)
    colmap_sph.run(folder / "sparse/0", options=OPTIONS)
    return folder


def context_of(project: Path, dense: Path) -> Context:
    """A run whose workspace is prepared."""
    workspace = prepare(project / "sparse/0", dense)
    scene = anchored(read_scene(workspace.sparse_dir))
    return with_good_images(Context(workspace, scene, OPTIONS, Keys(workspace, OPTIONS)), execute)


def made(dense: Path) -> dict[str, bytes]:
    files = [*dense.glob("stereo/*_maps/*.bin"), *dense.glob("fused*")]
    return {str(path.relative_to(dense)): path.read_bytes() for path in files}


def make_elsewhere(stage: Stage[Item, Task], pool: ProcessPoolExecutor) -> dict[Item, Result]:
    """All jobs of a stage, made by another process from their pickled tasks."""
    with stage.opened():
        jobs = {item: stage.job(item) for item in stage.items}
        assert all(job.done is None for job in jobs.values())
        facts = pool.map(type(stage).make, [job.task for job in jobs.values()])
        results = {
            item: Result(job.key, made=True, facts=found)
            for (item, job), found in zip(jobs.items(), facts, strict=True)
        }
        stage.close(results)
    assert all(stage.job(item).done is not None for item in stage.items)
    return results


def test_another_process_makes_the_same(project: Path, tmp_path: Path) -> None:
    """Every stage's tasks, sent to a process that knows nothing of the run."""
    context = context_of(project, tmp_path / "dense")
    context.workspace.create_stereo_dirs(NAMES)
    pairs = select_pairs(context.scene, OPTIONS.pairs).unique_pairs()
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        matched = make_elsewhere(MatchStage(context, pairs), pool)
        votes = make_elsewhere(VoteStage(context, matched), pool)
        maps = make_elsewhere(ConfirmStage(context, matched, votes), pool)
        make_elsewhere(fuse_stage(context, keys_of(matched), maps), pool)
    assert made(tmp_path / "dense") == made(project / "dense")
    assert len(made(project / "dense")) == 2 * len(NAMES) + 2
    # And a run that finds these results takes them for its own.
    report = colmap_sph.run(project / "sparse/0", output=tmp_path / "dense", options=OPTIONS)
    assert not any(report.made.values())


def finished_stages(project: Path) -> list[Stage[Any, Any]]:
    context = context_of(project, project / "dense")
    pairs = select_pairs(context.scene, OPTIONS.pairs).unique_pairs()
    stages: list[Stage[Any, Any]] = [MatchStage(context, pairs)]
    matched = execute(stages[-1])
    stages.append(VoteStage(context, matched))
    stages.append(ConfirmStage(context, matched, execute(stages[-1])))
    stages.append(fuse_stage(context, keys_of(matched), execute(stages[-1])))
    return stages


def asked(stage: Stage[Any, Any], item: Any) -> Job[Any]:
    """What a stage says of an item of which nothing is known yet."""
    return stage.ask(item) if isinstance(stage, RememberingStage) else PartsStage.job(stage, item)  # type: ignore[arg-type]


def test_a_task_is_small(project: Path) -> None:
    """It carries no pixels, and of sparse points no more than tell: a few kilobytes for every image it names."""
    for stage in finished_stages(project):
        task = asked(stage, stage.items[0]).task
        if isinstance(stage, ConfirmStage):
            assert len(task.sights.depth) <= 500
            task = replace(task, sights=None)
        assert len(pickle.dumps(task)) < 6000


def test_finished_jobs_are_done(project: Path) -> None:
    for stage in finished_stages(project):
        for item in stage.items:
            job = asked(stage, item)
            assert stage.job(item).done is not None
            assert isinstance(stage, PartsStage) or job.done == stage.job(item).done


def test_a_finished_vote_is_found_without_a_look_at_its_pairs(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, voting, *_ = finished_stages(project)
    read = Mock(wraps=pair_files.read_head)
    monkeypatch.setattr(pair_files, "read_head", read)
    assert asked(voting, NAMES[0]).done is not None
    read.assert_called_once_with(voting.context.estimate_path(NAMES[0]))


def test_fusion_by_colmap_is_one_job(project: Path) -> None:
    options = replace(OPTIONS, fusion=FusionOptions(method="colmap"))
    context = replace(context_of(project, project / "dense"), options=options)
    maps = {name: Result("key", False, Facts(coverage=float(name != NAMES[0]))) for name in NAMES}
    stage = fuse_stage(context, {}, maps)
    assert isinstance(stage, ColmapFuseStage)
    (item,) = stage.items
    job = stage.job(item)
    assert job.done is None
    assert job.task.workspace == Workspace(project / "dense")
    pixels = 160 * 120
    assert job.cost.memory == 3 * 80 * pixels + 0.1 * 160 * 120**2


def test_fusion_by_colmap_runs_in_the_calling_thread(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only there COLMAP's library heeds Ctrl-C; and its failure is that of the run."""
    options = replace(OPTIONS, fusion=FusionOptions(method="colmap"))
    context = replace(context_of(project, project / "dense"), options=options)
    threads = []

    def refuse(*_: object, **__: object) -> int:
        threads.append(threading.current_thread())
        raise InputError("The map a.bin is missing.")

    monkeypatch.setattr("colmap_sph.pipeline.stages.fuse.fuse_by_colmap", refuse)
    maps = {name: Result("another", False, Facts(coverage=1.0)) for name in NAMES}
    with pytest.raises(InputError, match="The map a"):
        execute(fuse_stage(context, {}, maps))
    assert threads == [threading.current_thread()]
    assert context.report.skipped_images == {}


def test_what_is_made_follows_from_the_task_alone(project: Path, tmp_path: Path) -> None:
    """Not from a task before it in the same process, which had other masks."""
    masks = tmp_path / "masks"
    masks.mkdir()
    for name in NAMES:
        cv2.imwrite(str(masks / f"{name}.png"), np.zeros((120, 160), np.uint8))
    stage = finished_stages(project)[-1]
    task = replace(stage.job(NAMES[0]).task, partners=(), stem=tmp_path / "part")
    task = replace(task, options=replace(task.options, min_num_pixels=1))
    masked = replace(task, reference=replace(task.reference, mask=masks / f"{NAMES[0]}.png"))
    for _ in range(2):
        assert type(stage).make(task).points > 1000
        assert type(stage).make(masked).points == 0


def peak_of(make: Callable[[], object]) -> int:
    """Most bytes of arrays at a time."""
    tracemalloc.start()
    try:
        make()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def stretch_pair(path: Path, key: str, rows: float, right: float) -> None:
    """Give a pair many more rows and columns, and its right image again more columns; it matches nowhere."""
    pair = read_pair(path, key)
    geometry = pair.geometry.resampled(rows)
    geometry = replace(geometry, right_width=int(geometry.right_width * right))
    disparity = np.full((geometry.height, geometry.left_width), np.nan, np.float32)
    write_pair(path, replace(pair, geometry=geometry, disparity=disparity), key)


@pytest.mark.parametrize("band", [1 << 14, 8 << 20])  # far less than the image, and all of it
@pytest.mark.parametrize("is_masked", [False, True])
@pytest.mark.parametrize(("rows", "right"), [(1.0, 1.0), (4.0, 1.0), (3.0, 0.3), (2.0, 3.0)])
def test_a_vote_takes_what_is_reserved(
    project: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    rows: float,
    right: float,
    is_masked: bool,
    band: int,
) -> None:
    """Without maps that nobody asked for: measured; also where those of pairs are larger than the image."""
    monkeypatch.setattr(vote, "_BAND_BYTES", band)
    stage = finished_stages(project)[1]
    assert isinstance(stage, VoteStage)
    mask = tmp_path / "mask.png"
    if is_masked:
        cv2.imwrite(str(mask), np.full((120, 160), 255, np.uint8))
    tasks = {item: asked(stage, item).task for item in stage.items}
    keys = {path: key for task in tasks.values() for path, key in zip(task.pairs, task.pair_keys, strict=True)}
    as_matched = {path: path.read_bytes() for path in keys}
    try:
        for path, key in keys.items():
            stretch_pair(path, key, rows, right)
        for item in stage.items:
            task = replace(asked(stage, item).task, estimate=tmp_path / item, mask=mask)
            reserved = stage._cost(task).memory
            assert 0.7 * reserved < peak_of(partial(stage.make, task)) < reserved + SMALL_BYTES
    finally:
        for path, content in as_matched.items():
            path.write_bytes(content)


def test_partners_that_stand_beside_a_view_cost_it_nothing(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They tell nothing of its depth, and are not read: the others cost what they cost alone."""
    context = context_of(project, project / "dense")
    facts = Facts(coverage=1.0, row_residual=0.0)

    def cost(pairs: list[Pair]) -> Cost:
        matched = {pair: Result("", made=True, facts=facts) for pair in pairs}
        votes = {name: Result("", made=True, facts=facts) for name in NAMES}
        return asked(ConfirmStage(context, matched, votes), NAMES[0]).cost

    pairs = [(NAMES[0], name) for name in NAMES[1:]]
    alone, all_count = cost(pairs[1:]), cost(pairs)
    numbers = {name: number for number, name in enumerate(NAMES[1:])}
    monkeypatch.setattr(Stations, "numbers", lambda _self, _name, others: [numbers[name] for name in others])
    assert numbers[NAMES[1]] == OWN_STATION
    assert cost(pairs) == alone != all_count
