"""A model in map coordinates gives the maps that the same model gives at its origin, to the bit, and its cloud."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from clouds import read_fused, read_points, read_visibility
from conftest import keep_images
from projects import prepare
from test_undistortion import make_project

import colmap_sph
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project import map_coordinates
from colmap_sph.project.map_coordinates import local_origin, move_cloud
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.ownership import remove_recorded
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.partners.pairs import PairOptions

UTM = (5e5 + 1 / 3, 5e6 + 1 / 7, 300.0)
ECEF = (4201575.762, 168864.183, 4780229.051)
SOUTH_WEST = (-8765432.1, -3456789.012, -123.4567)
NADIR = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"]
OPTIONS = RunOptions(threads=1, pairs=PairOptions(num_pairs=2))


def move(sparse: Path, offset: tuple[float, ...], target: Path) -> Path:
    """Copy of a model with `offset` added to its coordinates."""
    model = pycolmap.Reconstruction(sparse)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(offset)))
    target.mkdir(parents=True)
    model.write_binary(target)
    return target


@dataclass(frozen=True)
class Near:
    """Four images reconstructed at the origin, with the project they come from."""

    project: Path
    dense: Path
    report: colmap_sph.RunReport


@pytest.fixture(scope="module")
def near(block, tmp_path_factory: pytest.TempPathFactory) -> Near:
    root = tmp_path_factory.mktemp("near")
    (root / "images").symlink_to(block.images_dir)
    move(block.sparse_dir, (0.0, 0.0, 0.0), root / "sparse" / "0")
    keep_images(root, NADIR)
    return Near(root, root / "dense", colmap_sph.run(root / "sparse" / "0", options=OPTIONS))


def assert_same_maps(near: Path, far: Path, names: list[str]) -> None:
    """Every map is the same to the bit, and there is something in it."""
    workspaces = [Workspace(dense) for dense in (near, far)]
    for name in names:
        expected, found = (read_depth_map(w.depth_map_path(name, "geometric")) for w in workspaces)
        np.testing.assert_array_equal(found, expected, err_msg=name)
        assert (expected > 0).mean() > 0.3
        expected, found = (read_normal_map(w.normal_map_path(name, "geometric")) for w in workspaces)
        np.testing.assert_array_equal(found, expected, err_msg=name)


def assert_same_cloud(near: Path, far: Path, offset: tuple[float, ...]) -> None:
    """Every point lies where it lies in the other cloud, once `offset` is taken away, but for 32-bit rounding."""
    expected, found = (read_points(dense / "fused.ply") for dense in (near, far))
    assert len(found) == len(expected) > 1000
    assert np.abs(found - offset - expected).max() < 1e-3
    visible = [(dense / "fused.ply.vis").read_bytes() for dense in (near, far)]
    assert visible[0] == visible[1]


@pytest.mark.parametrize("offset", [UTM, ECEF, SOUTH_WEST], ids=["UTM", "ECEF", "south-west"])
def test_map_coordinates_change_nothing(near: Near, offset: tuple[float, ...], tmp_path: Path) -> None:
    (tmp_path / "images").symlink_to(near.project / "images")
    model = move(near.project / "sparse" / "0", offset, tmp_path / "sparse" / "0")
    report = colmap_sph.run(model, options=OPTIONS)
    dense = tmp_path / "dense"
    assert report.images == near.report.images == len(NADIR)
    assert_same_maps(near.dense, dense, NADIR)
    assert_same_cloud(near.dense, dense, offset)
    assert len(read_visibility(dense / "fused.ply.vis")) == report.points
    # The model is given back in map coordinates.
    theirs, ours = pycolmap.Reconstruction(model), pycolmap.Reconstruction(dense / "sparse")
    for image_id in theirs.reg_image_ids():
        difference = theirs.image(image_id).projection_center() - ours.image(image_id).projection_center()
        assert np.abs(difference).max() < 1e-7


def test_local_workspace_serves_colmap(near: Near, tmp_path: Path) -> None:
    """COLMAP itself makes nothing of the far workspace and the whole cloud of the local one."""
    (tmp_path / "images").symlink_to(near.project / "images")
    colmap_sph.run(move(near.project / "sparse" / "0", UTM, tmp_path / "sparse" / "0"), options=OPTIONS)
    dense = tmp_path / "moved"
    (tmp_path / "dense").rename(dense)
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.max_reproj_error, options.max_normal_error = 2, 0.5, 30
    local = dense / "colmap_sph" / "local"
    counts = [
        pycolmap.stereo_fusion(
            tmp_path / "cloud.ply", folder, input_type="geometric", options=options, output_type="PLY"
        ).num_points3D()
        for folder in (dense, local, near.dense)
    ]
    assert counts[1] == pytest.approx(counts[2], rel=0.01)
    assert counts[0] < 0.5 * counts[1]
    origin = np.array([float(word) for word in (local / "origin.txt").read_text().split()])
    cloud, whole = read_fused(local / "fused.ply"), read_points(dense / "fused.ply")
    np.testing.assert_allclose(cloud["xyz"] + origin, whole, rtol=0, atol=1e-9)
    assert (local / "fused.ply.vis").read_bytes() == (dense / "fused.ply.vis").read_bytes()


def test_local_workspace_is_made_again(near: Near, tmp_path: Path) -> None:
    """Where it is lost or its model was moved; --overwrite removes it, and a near model leaves none."""
    (tmp_path / "images").symlink_to(near.project / "images")
    model = move(near.project / "sparse" / "0", UTM, tmp_path / "sparse" / "0")
    local, sparse = tmp_path / "dense/colmap_sph/local", tmp_path / "dense/sparse"
    colmap_sph.run(model, options=OPTIONS)
    assert not any(colmap_sph.run(model, options=OPTIONS).made.values())
    shutil.rmtree(local)
    assert colmap_sph.run(model, options=OPTIONS).made["fuse"] == 1
    assert pycolmap.Reconstruction(local / "sparse").num_reg_images() == len(NADIR)
    remove_recorded(Workspace(tmp_path / "dense"))
    assert not local.exists()
    colmap_sph.run(model, options=OPTIONS)
    shutil.rmtree(sparse)
    move(near.dense / "sparse", (0.0, 0.0, 0.0), sparse)
    colmap_sph.run(workspace=tmp_path / "dense", options=OPTIONS)
    assert not local.exists()
    assert_same_cloud(near.dense, tmp_path / "dense", (0.0, 0.0, 0.0))


def test_a_local_cloud_that_the_user_cleaned_is_kept(near: Near, tmp_path: Path) -> None:
    sparse = move(near.project / "sparse" / "0", UTM, tmp_path / "sparse" / "0")
    (tmp_path / "images").symlink_to(near.project / "images")
    colmap_sph.run(sparse, options=OPTIONS)
    workspace = Workspace(tmp_path / "dense")
    cloud = Workspace(workspace.local_dir).fused_path
    cloud.write_bytes(b"cleaned")
    assert remove_recorded(workspace) == [cloud]
    assert cloud.read_bytes() == b"cleaned"


def test_far_model_without_tracks(near: Near, tmp_path: Path) -> None:
    """Pairs by viewing frusta and fusion by partners do not mind the coordinates either."""
    model = pycolmap.Reconstruction(near.project / "sparse" / "0")
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    (tmp_path / "bare").mkdir()
    model.write(tmp_path / "bare")
    images = near.project / "images"
    expected = colmap_sph.run(tmp_path / "bare", images=images, output=tmp_path / "near", options=OPTIONS)
    far = move(tmp_path / "bare", UTM, tmp_path / "far model")
    found = colmap_sph.run(far, images=images, output=tmp_path / "far", options=OPTIONS)
    assert found.pair_source == expected.pair_source == "frusta"
    assert_same_maps(tmp_path / "near", tmp_path / "far", list(found.coverage))
    assert_same_cloud(tmp_path / "near", tmp_path / "far", UTM)


def test_undistortion_keeps_the_digits(tmp_path: Path) -> None:
    sparse = make_project(tmp_path, "OPENCV", (0.1, 0.01, 1e-3, -1e-3))
    far = move(sparse, ECEF, tmp_path / "far" / "0")
    scenes = [
        read_scene(prepare(model, output).sparse_dir)
        for model, output in ((sparse, tmp_path / "dense"), (far, tmp_path / "far dense"))
    ]
    assert not scenes[0].origin.any()
    np.testing.assert_allclose(scenes[1].origin, ECEF, rtol=0, atol=10)
    shift = np.array(ECEF) - scenes[1].origin
    np.testing.assert_allclose(scenes[1].points - shift, scenes[0].points, rtol=0, atol=1e-8)
    for expected, found in zip(*(scene.views for scene in scenes), strict=True):
        np.testing.assert_allclose(found.center - shift, expected.center, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(found.R, expected.R)


@pytest.mark.parametrize(
    ("offset", "far"),
    [((0, 0, 0), False), ((1, -1, 0), False), ((100, 0, 0), True), (UTM, True), (ECEF, True)],
)
def test_origin_is_moved_only_when_far(tmp_path: Path, offset: tuple[float, ...], far: bool) -> None:
    """Half of what is in the scene of `make_project` lies within a quarter unit of its middle, at (0, 0, 3)."""
    model = move(make_project(tmp_path), offset, tmp_path / "moved")
    origin = local_origin(pycolmap.Reconstruction(model))
    assert origin.any() == far
    if far:
        assert np.linalg.norm(origin - offset) < 5
        # Few digits: a tenth of the scene's size, rounded down to a power of ten.
        np.testing.assert_allclose(origin * 10, np.round(origin * 10), rtol=0, atol=1e-6)


def test_a_pose_that_is_not_finite_has_no_say(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(move(make_project(tmp_path), UTM, tmp_path / "moved"))
    expected = local_origin(model)
    frame = model.frame(model.image(1).frame_id)
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.full(3, np.nan))
    np.testing.assert_allclose(local_origin(model), expected, rtol=0, atol=1)


@pytest.mark.parametrize("count", [0, 1, 6, 7])
def test_move_cloud_is_exact(tmp_path: Path, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In chunks of three points; numbers that floats hold exactly."""
    monkeypatch.setattr(map_coordinates, "_CHUNK_POINTS", 3)
    rng = np.random.default_rng(count)
    points = np.empty(count, [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    points["xyz"] = rng.integers(-1000, 1000, (count, 3)) / 8
    points["normal"] = rng.standard_normal((count, 3))
    points["rgb"] = rng.integers(0, 256, (count, 3))
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    (tmp_path / "near.ply").write_bytes("\n".join([*header, "end_header\n"]).encode() + points.tobytes())
    offset = np.array([500000.125, 5e6, -0.25])
    move_cloud(tmp_path / "near.ply", tmp_path / "far.ply", offset)
    wide = np.dtype([("xyz", "<f8", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    text, _, body = (tmp_path / "far.ply").read_bytes().partition(b"end_header\n")
    assert text.decode() == "\n".join([*header, ""]).replace("float x", "double x").replace(
        "float y", "double y"
    ).replace("float z", "double z")
    found = np.frombuffer(body, wide)
    np.testing.assert_array_equal(found["xyz"], points["xyz"] + offset)
    np.testing.assert_array_equal(found["normal"], points["normal"])
    np.testing.assert_array_equal(found["rgb"], points["rgb"])


def test_fountain_in_map_coordinates(data_dir: Path, tmp_path: Path) -> None:
    """Real images; the model's unit is the metre, a pixel here about 2 cm."""
    source = data_dir / "fountain"
    if not source.is_dir():
        pytest.skip(f"{source} is not among the real data")
    options = replace(
        OPTIONS, undistortion=UndistortionOptions(max_image_size=384), pairs=PairOptions(num_pairs=3)
    )
    far = move(source / "sparse" / "0", UTM, tmp_path / "model")
    images = source / "images"
    expected = colmap_sph.run(source / "sparse" / "0", images=images, output=tmp_path / "near", options=options)
    found = colmap_sph.run(far, images=images, output=tmp_path / "far", options=options)
    assert found.images == expected.images == 11
    assert_same_maps(tmp_path / "near", tmp_path / "far", list(found.coverage))
    assert_same_cloud(tmp_path / "near", tmp_path / "far", UTM)
