"""The whole main job on a small rendered block, against its exact depth; and every way it may end early."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import FinishedRun, keep_images
from projects import prepare

import colmap_sph
from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.errors import InputError, NoResultError, OptionError, OutputError
from colmap_sph.evaluation import compare_depth_map
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report import Silent
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.fuse import fuse_stage
from colmap_sph.pipeline.stages.match import _MATCH_BYTES, MatchStage
from colmap_sph.pipeline.stages.stage import keys_of
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.pair_lists import read_patch_match_cfg, write_patch_match_cfg
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import SourceImages
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.kernels import backend
from colmap_sph.stereo.partners.pairs import PairOptions, select_pairs
from colmap_sph.stereo.rectification import RectificationOptions
from colmap_sph.stereo.vote import VoteOptions
from colmap_sph.synthetic import DemoBlock

FEW_PAIRS = RunOptions(threads=2, pairs=PairOptions(num_pairs=2))
FRAME = replace(FEW_PAIRS, rectification=RectificationOptions(surface="frame"))
NADIR = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"]


def results(dense: Path) -> dict[str, bytes]:
    """Content of all depth and normal maps of a workspace, and of its cloud."""
    files = [*sorted((dense / "stereo").glob("*_maps/**/*.bin")), dense / "fused.ply", dense / "fused.ply.vis"]
    assert len(files) > 2
    return {str(path.relative_to(dense)): path.read_bytes() for path in files}


def median_scores(block: DemoBlock, dense: Path) -> tuple[float, float]:
    """Medians over the images of the coverage, and of the share within 1 GSD of the exact depth."""
    scores = []
    for name, camera in zip(block.names, block.cameras, strict=True):
        path = Workspace(dense).depth_map_path(name, "geometric")
        if path.exists():
            truth, _ = block.truth(name)
            scores.append(compare_depth_map(read_depth_map(path), truth, gsd=truth / camera.K[0, 0]))
    return float(np.median([s.coverage for s in scores])), float(np.median([s.within[0] for s in scores]))


# ---- what a run gives --------------------------------------------------------------------------------------


def test_every_image_has_maps_close_to_the_truth(block: DemoBlock, finished: FinishedRun) -> None:
    workspace = Workspace(finished.dense)
    for name, camera in zip(block.names, block.cameras, strict=True):
        truth, true_normals = block.truth(name)
        depth = read_depth_map(workspace.depth_map_path(name, "geometric"))
        normals = read_normal_map(workspace.normal_map_path(name, "geometric"))
        assert depth.shape == (camera.height, camera.width)
        length = np.linalg.norm(normals, axis=2)
        np.testing.assert_allclose(length, depth > 0, atol=1e-5)
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.K).T
        assert ((normals * rays).sum(axis=2)[depth > 0] < 0).all()
        scores = compare_depth_map(
            depth, truth, gsd=truth / camera.K[0, 0], normals=normals, truth_normals=true_normals
        )
        assert scores.coverage > 0.6, name
        assert scores.within[0] > 0.8, name
        assert scores.within[1] > 0.88, name
        assert scores.median_error < 0.25, name
        assert scores.median_normal_angle is not None and scores.median_normal_angle < 8, name
        assert finished.report.coverage[name] == np.mean(depth > 0)
    coverage, within = median_scores(block, finished.dense)
    assert coverage > 0.72
    assert within > 0.88


def test_depth_has_colmaps_pixel_origin(block: DemoBlock, finished: FinishedRun) -> None:
    """On the sloping ground of an oblique view a depth of pixel centres would be off by half a row's step."""
    name = "F_0.jpg"
    truth, _ = block.truth(name)
    depth = read_depth_map(Workspace(finished.dense).depth_map_path(name, "geometric"))
    step = truth[1:] - truth[:-1]
    # Ground all around, which rises or falls less than the line of sight: steps of depth without edges.
    ground = (depth[:-1] > 0) & (truth[:-1] > 0) & (truth[1:] > 0) & (step < 0) & (np.abs(step) < 2 * 0.22)
    assert ground.sum() > 5000
    rows_off = (depth[:-1] - truth[:-1])[ground] / step[ground]
    assert abs(np.median(rows_off)) < 0.1


def test_the_report_is_right(block: DemoBlock, finished: FinishedRun) -> None:
    report = finished.report
    workspace = Workspace(finished.dense)
    assert report.images == len(block.names)
    assert report.skipped_images == {}
    assert report.skipped_pairs == {}
    assert report.pair_source == "tracks"
    assert report.pairs == len(list((workspace.state_dir / "pairs").glob("*/*"))) > 30
    assert list(report.coverage) == sorted(block.names)
    header = workspace.fused_path.read_bytes()[:400]
    assert f"element vertex {report.points}\n".encode() in header
    assert report.points > 50_000
    assert workspace.fused_path.with_name("fused.ply.vis").is_file()
    assert workspace.fusion_cfg_path.read_text().split() == sorted(block.names)
    assert report.advice == ""
    stages = [
        "check originals",
        "undistort",
        "check images",
        "select pairs",
        "match pairs",
        "vote on depth",
        "confirm depth",
        "fuse",
    ]
    assert list(report.seconds) == stages
    assert 50 << 20 < report.peak_memory < 8 << 30
    written = json.loads((workspace.state_dir / "report.json").read_text())
    assert written["points"] == report.points
    assert written["coverage"] == report.coverage
    assert written["options"]["pairs"]["num_pairs"] == 10
    assert written["kernels"] == backend()
    assert not list(finished.dense.rglob("*.tmp"))


def test_results_do_not_depend_on_threads_or_kernels(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_images(project, NADIR)
    found = {}
    for threads, kernels in [(1, "scalar"), *((threads, _native.backends()[0]) for threads in (1, 2, 4))]:
        monkeypatch.setenv("COLMAP_SPH_KERNELS", kernels)
        dense = project / f"dense {threads} {kernels}"
        colmap_sph.run(project / "sparse/0", output=dense, options=replace(FEW_PAIRS, threads=threads))
        found[threads, kernels] = results(dense)
    first = found.pop((1, "scalar"))
    assert len(first) == 2 * len(NADIR) + 2
    for which, result in found.items():
        assert result == first, which


def test_stages_one_by_one(project: Path) -> None:
    """The public stages give what `run` gives."""
    keep_images(project, NADIR)
    whole = colmap_sph.run(project / "sparse/0", output=project / "whole", options=FEW_PAIRS)
    workspace = prepare(project / "sparse/0", project / "stages")
    scene = anchored(read_scene(workspace.sparse_dir))
    selection = select_pairs(scene, FEW_PAIRS.pairs)
    context = with_good_images(Context(workspace, scene, FEW_PAIRS, Keys(workspace, FEW_PAIRS)), execute)
    matched = execute(MatchStage(context, selection.unique_pairs()))
    assert list(matched) == selection.unique_pairs()
    votes = execute(VoteStage(context, matched))
    maps = execute(ConfirmStage(context, matched, votes))
    execute(fuse_stage(context, keys_of(matched), maps))
    report = context.report
    assert results(project / "stages") == results(project / "whole")
    assert report.coverage == whole.coverage
    assert report.points == whole.points


def test_progress_tells_every_step(project: Path) -> None:
    class Steps(Silent):
        def __init__(self) -> None:
            self.told: list = []

        def start(self, stage: str, total: int) -> None:
            self.told.append([stage, total, 0])

        def advance(self, seconds: float = 0.0) -> None:
            self.told[-1][2] += 1

    keep_images(project, NADIR)
    steps = Steps()
    colmap_sph.run(project / "sparse/0", options=FEW_PAIRS, progress=steps)
    assert all(total == done for _, total, done in steps.told)
    assert {stage: total for stage, total, _ in steps.told}["vote on depth"] == len(NADIR)


def test_a_run_can_be_repeated(project: Path) -> None:
    """Paths may be strings; a second run finds the undistorted images and gives the same."""
    keep_images(project, NADIR)
    model = str(project / "sparse/0")
    dense = project / "dense"
    colmap_sph.run(model, images=str(project / "images"), output=str(dense), options=FEW_PAIRS)
    before = results(dense)
    image = (dense / "images" / NADIR[0]).stat()
    colmap_sph.run(model, options=FEW_PAIRS)
    assert results(dense) == before
    assert (dense / "images" / NADIR[0]).stat() == image
    smaller = replace(FEW_PAIRS, undistortion=UndistortionOptions(max_image_size=200))
    with pytest.raises(InputError, match="made with --max-image-size -1, not 200"):
        colmap_sph.run(model, options=smaller)
    assert results(dense) == before


# ---- other ways to begin -----------------------------------------------------------------------------------


def test_workspace_of_colmap(project: Path) -> None:
    """A workspace that COLMAP undistorted gives the maps that the model itself gives."""
    keep_images(project, NADIR)
    colmap_sph.run(project / "sparse/0", options=FEW_PAIRS)
    pycolmap.undistort_images(project / "theirs", project / "sparse/0", project / "images")
    report = colmap_sph.run(workspace=project / "theirs", options=FEW_PAIRS)
    assert report.images == len(NADIR)
    assert results(project / "theirs") == results(project / "dense")


def test_explicit_patch_match_cfg_is_obeyed(project: Path) -> None:
    dense = project / "dense"
    workspace = prepare(project / "sparse/0", dense)
    sources: dict[str, SourceImages] = {
        "N_0_1.jpg": ["N_0_0.jpg", "N_0_2.jpg"],
        "N_1_1.jpg": ["N_0_1.jpg"],
        "R_0.jpg": 1,
    }
    write_patch_match_cfg(workspace.patch_match_cfg_path, sources)
    report = colmap_sph.run(workspace=dense, options=FEW_PAIRS)
    assert report.pair_source == "patch-match.cfg"
    ids = {view.name: view.image_id for view in read_scene(workspace.sparse_dir).views}
    listed = [("N_0_1.jpg", "N_0_0.jpg"), ("N_0_1.jpg", "N_0_2.jpg"), ("N_1_1.jpg", "N_0_1.jpg")]
    expected = {frozenset((ids[a], ids[b])) for a, b in listed}
    found = {
        frozenset(int(number) for number in path.stem.split("-"))
        for path in (workspace.state_dir / "pairs").glob("*/*")
    }
    assert expected < found
    # "__auto__" leaves the choice, and how many, to the options.
    chosen = found - expected
    assert 1 <= len(chosen) <= FEW_PAIRS.pairs.num_pairs
    assert all(ids["R_0.jpg"] in pair for pair in chosen)
    # The file is left as it was, and an image it does not ask for is neither processed nor missed.
    assert read_patch_match_cfg(workspace.patch_match_cfg_path) == sources
    assert "L_0.jpg" not in report.coverage
    assert "L_0.jpg" not in report.skipped_images
    assert not workspace.depth_map_path("L_0.jpg", "geometric").exists()
    assert report.coverage["N_0_1.jpg"] > 0.5


def test_frame_rectification(project: Path, block: DemoBlock) -> None:
    report = colmap_sph.run(project / "sparse/0", options=FRAME)
    assert report.images == len(block.names)
    coverage, within = median_scores(block, project / "dense")
    assert coverage > 0.5
    assert within > 0.8


def forward_project(root: Path) -> Path:
    """Two cameras behind one another and one beside them, in a yard; returns the model."""
    pair = syn.forward_motion_pair(1.0, focal_length=200.0, size=(200, 150))
    beside = replace(pair.left, t=pair.left.t - np.array([0.8, 0, 0]))
    cameras = (pair.left, beside, pair.right)
    names = ("a_left.png", "b_beside.png", "c_ahead.png")
    (root / "images").mkdir()
    for name, camera in zip(names, cameras, strict=True):
        picture = replace(pair, left=camera).render("left").image
        assert cv2.imwrite(str(root / "images" / name), picture[..., ::-1])
    sparse = syn.sample_sparse_points(pair.surfaces, cameras, 600, np.random.default_rng(0), min_track_length=2)
    model = syn.build_reconstruction(names, cameras, sparse)
    syn.write_reconstruction(model, root / "sparse" / "0")
    return root / "sparse" / "0"


def test_forward_motion_stops_the_frame_alone(tmp_path: Path) -> None:
    model = forward_project(tmp_path)
    report = colmap_sph.run(model, output=tmp_path / "frame", options=FRAME)
    assert "a_left.png - c_ahead.png" in report.skipped_pairs
    assert report.pairs + len(report.skipped_pairs) == 3
    assert report.coverage["a_left.png"] > 0.3
    assert (tmp_path / "frame" / "fused.ply").is_file()
    report = colmap_sph.run(model, output=tmp_path / "sphere", options=FEW_PAIRS)
    assert report.skipped_pairs == {}
    assert min(report.coverage.values()) > 0.3


def test_only_a_forward_pair_and_frame(tmp_path: Path) -> None:
    model = forward_project(tmp_path)
    keep_images(tmp_path, ["a_left.png", "c_ahead.png"])
    with pytest.raises(NoResultError, match=r"None of the 1 pairs could be matched \(.+\)"):
        colmap_sph.run(model, options=FRAME)
    assert colmap_sph.run(model, options=FEW_PAIRS).images == 2


@pytest.mark.parametrize("kept", [0, 20])
def test_model_with_next_to_no_tracks(project: Path, block: DemoBlock, kept: int) -> None:
    """Poses, and a few points: pairs by viewing frusta, and a cloud all the same."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    for point_id in sorted(model.points3D)[kept:]:
        model.delete_point3D(point_id)
    model.write(project / "sparse/0")
    report = colmap_sph.run(project / "sparse/0", options=FEW_PAIRS)
    assert report.pair_source == "frusta"
    assert report.points > 20_000
    coverage, within = median_scores(block, project / "dense")
    assert coverage > 0.4
    assert within > 0.8


def test_two_images(project: Path, block: DemoBlock) -> None:
    """As in COLMAP, one view confirms a depth where there is no second."""
    keep_images(project, NADIR[:2])
    report = colmap_sph.run(project / "sparse/0", options=FEW_PAIRS)
    assert report.images == 2
    assert report.points > 5_000
    assert median_scores(block, project / "dense")[1] > 0.8


def test_photometric_maps_can_be_fused(project: Path, block: DemoBlock) -> None:
    keep_images(project, NADIR)
    report = colmap_sph.run(
        project / "sparse/0", options=replace(FEW_PAIRS, fusion=FusionOptions(input="photometric"))
    )
    assert report.points > 10_000
    workspace = Workspace(project / "dense")
    for name in NADIR:
        truth, true_normals = block.truth(name)
        depth = read_depth_map(workspace.depth_map_path(name, "photometric"))
        normals = read_normal_map(workspace.normal_map_path(name, "photometric"))
        np.testing.assert_allclose(np.linalg.norm(normals, axis=2), depth > 0, atol=1e-5)
        gsd = truth / block.cameras[block.names.index(name)].K[0, 0]
        scores = compare_depth_map(depth, truth, gsd=gsd, normals=normals, truth_normals=true_normals)
        assert scores.coverage > 0.5, name
        assert scores.within[1] > 0.85, name


# ---- what goes wrong ---------------------------------------------------------------------------------------


def test_one_unreadable_image_is_skipped(project: Path, caplog: pytest.LogCaptureFixture) -> None:
    keep_images(project, NADIR)
    path = project / "images" / NADIR[0]
    path.write_bytes(path.read_bytes()[:3000])
    for _ in range(2):  # the second run finds the workspace that the first made
        report = colmap_sph.run(project / "sparse/0", options=FEW_PAIRS)
        assert list(report.skipped_images) == [NADIR[0]]
        assert report.images == 3
        assert sorted(report.coverage) == NADIR[1:]
    assert any(NADIR[0] in message and "is damaged" in message for message in caplog.messages)


def test_one_unreadable_image_of_a_workspace_is_skipped(project: Path) -> None:
    keep_images(project, NADIR)
    dense = project / "dense"
    prepare(project / "sparse/0", dense)
    (dense / "images" / NADIR[3]).write_bytes(b"\xff\xd8 not an image")
    report = colmap_sph.run(workspace=dense, options=FEW_PAIRS)
    assert list(report.skipped_images) == [NADIR[3]]
    assert sorted(report.coverage) == NADIR[:3]
    assert (dense / "fused.ply").is_file()


def test_an_image_without_overlap_is_reported(project: Path) -> None:
    """An image that shares no point with any other gets no depth; the rest go on."""
    keep_images(project, NADIR)
    model = pycolmap.Reconstruction(project / "sparse/0")
    (image,) = (image for image in model.images.values() if image.name == NADIR[3])
    for index in list(image.get_observation_point2D_idxs()):
        model.delete_observation(image.image_id, index)
    model.write(project / "sparse/0")
    report = colmap_sph.run(project / "sparse/0", options=FEW_PAIRS)
    assert list(report.skipped_images) == [NADIR[3]]
    assert "no pair" in report.skipped_images[NADIR[3]]
    assert report.coverage[NADIR[3]] == 0
    fused = Workspace(project / "dense").fusion_cfg_path.read_text().split()
    assert fused == NADIR[:3]


def test_images_of_noise_have_no_result(project: Path) -> None:
    keep_images(project, NADIR)
    rng = np.random.default_rng(0)
    for name in NADIR:
        noise = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
        cv2.imwrite(str(project / "images" / name), noise)
    with pytest.raises(
        NoResultError, match=r"found any depth; is it the same without --vote\.min-support 3, and are"
    ):
        strict = VoteOptions(min_support=3)
        colmap_sph.run(project / "sparse/0", options=replace(FEW_PAIRS, vote=strict))
    assert not (project / "dense" / "fused.ply").exists()


def test_fusion_without_a_point_names_the_gate(project: Path) -> None:
    keep_images(project, NADIR)
    options = replace(FEW_PAIRS, fusion=FusionOptions(min_num_pixels=4, max_normal_error=0.01))
    with pytest.raises(NoResultError, match=r"loosen --fusion\.max-normal-error"):
        colmap_sph.run(project / "sparse/0", options=options)
    assert json.loads((project / "dense/colmap_sph/report.json").read_text())["points"] < 10


def test_few_points_are_explained(project: Path) -> None:
    keep_images(project, NADIR)
    options = replace(FEW_PAIRS, fusion=FusionOptions(min_num_pixels=3, max_normal_error=0.2))
    report = colmap_sph.run(project / "sparse/0", options=options)
    assert report.points > 0
    assert "loosen --fusion.max-normal-error" in report.advice


def test_a_map_that_cannot_be_written(project: Path) -> None:
    keep_images(project, NADIR)
    in_the_way = project / f"dense/stereo/normal_maps/{NADIR[1]}.geometric.bin"
    prepare(project / "sparse/0", project / "dense")
    in_the_way.mkdir()
    with pytest.raises(OutputError, match=in_the_way.name):
        colmap_sph.run(project / "sparse/0", options=FEW_PAIRS)
    assert not list((project / "dense").rglob("*.tmp"))
    assert not (project / "dense" / "fused.ply").exists()


def test_the_number_of_opencv_threads_is_restored(project: Path) -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with pytest.raises(NoResultError):
            few = PairOptions(min_shared_points=10**6)
            colmap_sph.run(project / "sparse/0", options=replace(FEW_PAIRS, pairs=few))
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"model": Path("sparse/0"), "workspace": Path("dense")},
        {"workspace": Path("dense"), "images": Path("images")},
        {"workspace": Path("dense"), "output": Path("dense")},
        {"images": Path("images")},
        {"workspace": Path("dense"), "options": RunOptions(undistortion=UndistortionOptions(1000))},
        {"model": Path("sparse/0"), "options": RunOptions(threads=-1)},
        {"model": Path("sparse/0"), "options": RunOptions(threads=2000)},
        {"model": Path("sparse/0"), "options": RunOptions(fusion=FusionOptions(input="depth"))},  # type: ignore[arg-type]  # as untyped code may
        {"model": Path("sparse/0"), "options": RunOptions(pairs=PairOptions(num_pairs=0))},
        {"model": Path("sparse/0"), "options": RunOptions(fusion=FusionOptions(min_num_pixels=0))},
        {"model": Path("sparse/0"), "options": RunOptions(vote=VoteOptions(min_support=0))},
    ],
)
def test_contradictions_and_bad_values(arguments: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OptionError):
        colmap_sph.run(**arguments)
    assert not list(tmp_path.iterdir())


def test_all_cores_by_default() -> None:
    assert RunOptions().num_threads == len(os.sched_getaffinity(0))
    assert RunOptions(threads=3).num_threads == 3


def test_a_pair_may_take_most_of_the_budget(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Caches and scratch memory take of what the largest pair leaves: it is matched in twice its bytes."""
    keep_images(project, NADIR[:2])
    monkeypatch.setattr("colmap_sph.pipeline.memory.resident", lambda: 0)
    workspace = prepare(project / "sparse/0", project / "dense")
    options = replace(FEW_PAIRS, memory=f"{int(1.8 * _MATCH_BYTES * 320 * 240)}")
    scene = anchored(read_scene(workspace.sparse_dir))
    pairs = select_pairs(scene, options.pairs).unique_pairs()
    context = with_good_images(Context(workspace, scene, options, Keys(workspace, options)), execute)
    assert list(execute(MatchStage(context, pairs))) == pairs == [tuple(NADIR[:2])]
