"""Real images end to end: bounds, with some margin, that a broken stage would miss. Skipped without the data."""

import importlib
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from clouds import read_fused
from conftest import keep_images
from projects import read_picture

import colmap_sph
from colmap_sph.evaluation import compare_depth_map, mean_of_depth_maps, truth_at_pixel_origin
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.colmap_fusion import fuse_by_colmap
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.fusion import FusionOptions

# Six neighbouring vertical images of the aerial block and oblique ones, from all four sides, of the same place.
PENTA = [
    *("N_01_02.jpg", "N_01_03.jpg", "N_01_04.jpg", "N_02_02.jpg", "N_02_03.jpg", "N_02_04.jpg"),
    *("B_01_05.jpg", "F_01_01.jpg", "F_02_01.jpg", "L_03_03.jpg", "R_00_03.jpg", "R_01_03.jpg"),
]
PENTA_GSD = 0.141
PENTA_DEPTH_UNIT = 0.005
BRIGHTON = [f"DJI_00{number}.jpg" for number in (25, 26, 27, 32, 33)]


@dataclass(frozen=True)
class Result:
    """A run's workspace, report, and the folder its data come from."""

    workspace: Workspace
    report: colmap_sph.RunReport
    source: Path


def present(source: Path) -> Path:
    """The folder of a data set; the test is skipped where it is absent."""
    if not source.is_dir():
        pytest.skip(f"{source} is not among the real data")
    return source


def run_on(source: Path, root: Path, names: list[str] | None, options: RunOptions) -> Result:
    """Run on some images of a data set, from a copy of its model with links to its images."""
    shutil.copytree(present(source) / "sparse", root / "sparse")
    (root / "images").symlink_to(source / "images")
    if names is not None:
        keep_images(root, names)
    report = colmap_sph.run(root / "sparse" / "0", options=options)
    return Result(Workspace(root / "dense"), report, source)


STEREO_PAIRS = ("cloth3", "cones", "motorcycle", "reindeer", "wood2")


@pytest.mark.usefixtures("scripts_on_path")
@pytest.mark.parametrize("name", STEREO_PAIRS)
def test_a_pair_alone_is_matched_better_than_by_opencv(name: str, data_dir: Path) -> None:
    """More matched, and less of it wrong: with some margin, as OpenCV's matcher may change."""
    pairs = present(data_dir / "stereo_pairs")
    scores = importlib.import_module("bench_matching").measure(pairs / name)
    ours, peer, voting = scores.values()
    assert ours.matched > peer.matched - 0.002
    assert ours.wrong < peer.wrong + 0.001
    assert ours.median < peer.median
    if name == "motorcycle":  # the one whose truth is not in steps of a fraction
        assert ours.locked < 0.1 and voting.locked < 0.1
    # Where other pairs fill the gaps, fewer wrong ones are worth more.
    assert voting.matched < ours.matched and voting.median < peer.median


@pytest.fixture(scope="module")
def penta(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return run_on(data_dir / "penta", tmp_path_factory.mktemp("penta"), PENTA, RunOptions())


@pytest.fixture(scope="module")
def fountain(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    options = RunOptions(undistortion=UndistortionOptions(max_image_size=768))
    return run_on(data_dir / "fountain", tmp_path_factory.mktemp("fountain"), None, options)


def test_penta_depth_maps(penta: Result) -> None:
    """Share of the truth's pixels with a depth, and of these within 1, 2 and 4 GSD."""
    scores = {}
    for name in PENTA:
        path = penta.source / "depth" / name.replace(".jpg", ".png")
        centres = read_picture(path, cv2.IMREAD_UNCHANGED).astype(np.float32) * PENTA_DEPTH_UNIT
        depth = read_depth_map(penta.workspace.depth_map_path(name, "geometric"))
        scores[name] = compare_depth_map(depth, truth_at_pixel_origin(centres), gsd=PENTA_GSD)
    mean = mean_of_depth_maps(scores)
    assert mean.coverage > 0.67
    assert mean.within[0] > 0.9
    assert mean.within[1] > 0.955
    assert mean.within[2] > 0.97
    assert mean.median_error < 0.2
    for name, one in scores.items():
        assert one.coverage > 0.45, name
        # At the rim of the block two oblique views alone confirm walls: more of them, less exact.
        assert one.within[0] > 0.7, name


def test_penta_cloud(penta: Result) -> None:
    assert penta.report.skipped_images == {}
    cloud = read_fused(penta.workspace.fused_path)
    assert len(cloud) == penta.report.points > 1_700_000
    np.testing.assert_allclose(np.linalg.norm(cloud["normal"], axis=1), 1, atol=1e-3)
    # A city seen from above: roofs and streets face the sky, and hardly anything the ground.
    assert np.mean(cloud["normal"][:, 2] > 0.7) > 0.85
    assert np.mean(cloud["normal"][:, 2] < -0.3) < 0.003


def test_fountain(fountain: Result) -> None:
    """Strongly convergent from end to end: every image gets maps, and COLMAP's own gates keep many points."""
    assert fountain.report.images == 11
    assert fountain.report.skipped_images == {}
    assert np.mean(list(fountain.report.coverage.values())) > 0.75
    assert min(fountain.report.coverage.values()) > 0.55
    kept = fountain.report.points
    colmaps = FusionOptions(min_num_pixels=5, max_reproj_error=2.0, max_normal_error=10.0)
    assert kept > fuse_by_colmap(fountain.workspace, colmaps.for_colmap()) > 90_000


def test_brighton(data_dir: Path, tmp_path: Path) -> None:
    """A distorted camera, and a model of incremental SfM with its own scale and orientation."""
    options = RunOptions(undistortion=UndistortionOptions(max_image_size=1000))
    result = run_on(data_dir / "brighton", tmp_path, BRIGHTON, options)
    assert list(result.report.coverage) == BRIGHTON
    # Five images overlap less than a whole block: the one in their middle tells.
    assert np.mean(list(result.report.coverage.values())) > 0.3
    assert result.report.coverage["DJI_0026.jpg"] > 0.4
    assert result.report.points > 200_000
    image = read_picture(result.workspace.image_path(BRIGHTON[0]))
    assert max(image.shape) <= 1000


def test_hand_held_frames(data_dir: Path, tmp_path: Path) -> None:
    """Soft images with imprecise poses: covered share of the sensor's depth, and of that within 1 and 5 %."""
    result = run_on(data_dir / "redkitchen_pinhole", tmp_path, None, RunOptions())
    assert result.report.row_residual is not None and 0.2 < result.report.row_residual < 0.6
    assert result.report.sampling is not None and 0.3 < result.report.sampling < 0.7
    seen = covered = near = close = 0
    for name in result.report.coverage:
        path = result.source / "depth" / f"{Path(name).stem}.png"
        truth = truth_at_pixel_origin(read_picture(path, cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000)
        depth = read_depth_map(result.workspace.depth_map_path(name, "geometric"))
        both = (depth > 0) & (truth > 0)
        error = np.abs(depth[both] / truth[both] - 1)
        seen += int(np.count_nonzero(truth > 0))
        covered += int(np.count_nonzero(both))
        near += int(np.count_nonzero(error < 0.01))
        close += int(np.count_nonzero(error < 0.05))
    assert covered > 0.78 * seen
    assert near > 0.44 * covered
    assert close > 0.9 * covered


def test_rotations_disturbed_by_half_a_pixel(data_dir: Path, tmp_path: Path) -> None:
    """Maps of neighbours still meet, and the run says by how much the rows of its pairs do not."""
    root = tmp_path / "disturbed"
    shutil.copytree(present(data_dir / "penta") / "sparse", root / "sparse")
    scene = pycolmap.Reconstruction(root / "sparse" / "0")
    rng = np.random.default_rng(17)
    for image in scene.images.values():
        pose = image.cam_from_world()
        turn = pycolmap.Rotation3d(rng.normal(0, 0.5 / image.camera.mean_focal_length(), 3))
        rotation = turn * pose.rotation
        moved = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ image.projection_center()))
        scene.frames[image.frame_id].rig_from_world = moved
    scene.write(root / "sparse" / "0")
    (root / "images").symlink_to(data_dir / "penta" / "images")
    keep_images(root, PENTA)
    report = colmap_sph.run(root / "sparse" / "0", options=RunOptions())
    assert report.row_residual is not None and 0.25 < report.row_residual < 0.6
    assert np.mean(list(report.coverage.values())) > 0.62
