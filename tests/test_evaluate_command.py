"""`colmap_sph evaluate` on planes: distances and shares that arithmetic gives, and every kind of bad input."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
import trimesh
from laspy.vlrs.known import WktCoordinateSystemVlr

from colmap_sph import synthetic as syn
from colmap_sph.app.cli import main
from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.workspace import Workspace

WIDTH, HEIGHT, FOCAL = 120, 90, 100.0
# The ground n · x = 10 m, seen from three places above it: a ground sampling distance of about 0.1 m.
NORMAL = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
DISTANCE = 10.0
K = np.array([[FOCAL, 0, 60.0], [0, FOCAL, 45.0], [0, 0, 1]])
CAMERAS = [syn.Camera(K, np.eye(3), np.array([-x, 0.0, 0.0]), WIDTH, HEIGHT) for x in (-1.0, 0.0, 1.0)]
NAMES = ["a.jpg", "north/b.jpg", "north/c.jpg"]
UP = np.array([0, 0, 1.0])
EAST = np.array([1.0, 0, 0])
UTM = np.array([455_000.0, 5_400_000.0, 100.0])
EXACT = dict(zip(NAMES, CAMERAS, strict=True))


def plane_depth(camera: syn.Camera, origin: float) -> np.ndarray:
    """z-depth of the ground along K⁻¹ (column + origin, row + origin, 1)."""
    column, row = np.meshgrid(np.arange(WIDTH) + origin, np.arange(HEIGHT) + origin)
    rays = np.stack([(column - 60) / FOCAL, (row - 45) / FOCAL, np.ones_like(row)], axis=2)
    return (DISTANCE - NORMAL @ camera.centre) / (rays @ NORMAL)


def ground(camera: syn.Camera) -> np.ndarray:
    """Points of the ground behind all pixel centres."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    image = np.stack([column.ravel(), row.ravel()], axis=1)
    return camera.back_project(image, plane_depth(camera, 0.5).ravel())


def write_ply(path: Path, points: np.ndarray) -> Path:
    trimesh.PointCloud(points).export(path)
    return path


def write_las(path: Path, points: np.ndarray, wkt: str | None = None) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(points.min(axis=0))
    if wkt is not None:
        header.vlrs.append(WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.xyz = points
    las.write(path)
    return path


def write_model(folder: Path, camera_model: str = "PINHOLE", focal: float = FOCAL) -> Path:
    nothing = (np.empty((0, 2)),) * 3
    sparse = syn.SparsePoints(np.empty((0, 3)), nothing, (np.empty(0, np.int64),) * 3)
    model = syn.build_reconstruction(NAMES, CAMERAS, sparse)
    for camera in model.cameras.values():
        distortion = [] if camera_model == "PINHOLE" else [0.1, 0.02, 0, 0]
        camera.model, camera.params = camera_model, [focal, focal, 60, 45, *distortion]
    syn.write_reconstruction(model, folder)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A model, exact depth as 16-bit PNG in half millimetres, and a cloud of the ground 0.03 m too deep."""
    write_model(tmp_path / "sparse")
    for name, camera in EXACT.items():
        path = (tmp_path / "depth" / name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.round(plane_depth(camera, 0.5) / 0.0005).astype(np.uint16))
    write_ply(tmp_path / "deep.ply", ground(CAMERAS[1]) + 0.03 * NORMAL)
    return tmp_path


def write_workspace(root: Path, error_in_gsd: float = 0.0) -> Workspace:
    """Depth maps at COLMAP's pixel origin, the left half of each without depth, and exact normals."""
    workspace = Workspace(root)
    write_model(workspace.sparse_dir)
    workspace.create_stereo_dirs(NAMES)
    for name, camera in EXACT.items():
        depth = plane_depth(camera, 0.0) * (1 + error_in_gsd / FOCAL)
        depth[:, : WIDTH // 2] = 0
        write_depth_map(workspace.depth_map_path(name, "geometric"), depth.astype(np.float32))
        normals = np.broadcast_to((-NORMAL).astype(np.float32), (HEIGHT, WIDTH, 3))
        write_normal_map(workspace.normal_map_path(name, "geometric"), normals)
    return workspace


def evaluate(*arguments: object) -> int:
    return main(["evaluate", *map(str, arguments)])


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    """The error that was printed: one line on standard error, nothing on standard output."""
    out, err = capsys.readouterr()
    lines = err.strip().splitlines()
    assert out == "" and len(lines) == 1 and lines[0].startswith("error: "), err
    return lines[0]


@pytest.mark.parametrize("ending", ["ply", "las", "laz"])
def test_a_lifted_cloud_is_its_height_away(tmp_path, capsys, ending):
    x, y = np.meshgrid(np.arange(80) * 0.1, np.arange(60) * 0.1)
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    reference = tmp_path / f"lidar.{ending}"
    (write_ply if ending == "ply" else write_las)(reference, plane)
    half = plane[plane[:, 0] < 3.95]
    low, high = write_ply(tmp_path / "low.ply", plane), write_ply(tmp_path / "high.ply", half + UP * 0.04)
    result = tmp_path / "scores.json"
    code = evaluate(
        low, high, "--reference", reference, "--register", "False", "--tau", 0.02, 0.09, "--json", result
    )
    assert code == 0
    out, err = capsys.readouterr()
    assert err == "" and "low.ply" in out and "high.ply" in out and "0.0400" in out
    scores = json.loads(result.read_text())
    assert scores["reference"] == str(reference) and "depth_maps" not in scores
    first, second = scores["clouds"]
    assert first["cloud_to_reference"]["mean_m"] == pytest.approx(0, abs=1e-6)
    assert [one["f_score"] for one in first["thresholds"]] == [1, 1]
    assert second["cloud_to_reference"]["mean_m"] == pytest.approx(0.04, abs=1e-6)
    assert [one["accuracy"] for one in second["thresholds"]] == [0, 1]
    assert second["thresholds"][1]["completeness"] == pytest.approx(0.5)


def test_a_mesh_is_measured_to_its_triangles(tmp_path):
    corners = np.array([[0, 0, 0], [8, 0, 0], [8, 6, 0], [0, 6, 0]])
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(tmp_path / "mesh.ply")
    points = np.random.default_rng(0).uniform([1, 1, 0.04], [7, 5, 0.04], (500, 3))
    result = tmp_path / "scores.json"
    cloud = write_ply(tmp_path / "cloud.ply", points)
    reference = tmp_path / "mesh.ply"
    assert evaluate(cloud, "--reference", reference, "--register", "False", "--json", result) == 0
    (scores,) = json.loads(result.read_text())["clouds"]
    assert scores["cloud_to_reference"]["mean_m"] == pytest.approx(0.04, abs=1e-6)


def test_exact_depth_judges_clouds(folder, capsys):
    options = ["--depth-scale", 0.0005, "--model", folder / "sparse", "--gsd", 0.1, "--tau", 0.25, 1]
    result = folder / "scores.json"
    assert evaluate(folder / "deep.ply", "--reference", folder / "depth", *options, "--json", result) == 0
    assert "exact depth of 3 images" in capsys.readouterr().out
    (scores,) = json.loads(result.read_text())["clouds"]
    assert scores["registration"] is None
    # 0.03 m off the plane, and at most half the diagonal of a sample's voxel (tau / 4) off along it.
    assert 0.03 <= scores["cloud_to_reference"]["mean_m"] < 0.04
    strict, loose = scores["thresholds"]
    assert strict["accuracy"] == 0 and loose["accuracy"] == 1
    assert loose["completeness"] == 1, "the middle camera sees all that three cameras see"


@pytest.mark.parametrize("error", [0.0, 1.5])
def test_depth_maps_are_compared_at_colmaps_pixel_origin(folder, capsys, error):
    workspace = write_workspace(folder / "dense", error)
    result = folder / "scores.json"
    options = ["--workspace", workspace.root, "--depth-scale", 0.0005, "--json", result]
    assert evaluate("--reference", folder / "depth", *options) == 0
    assert "geometric depth maps" in capsys.readouterr().out
    scores = json.loads(result.read_text())
    assert scores["clouds"] == [] and sorted(scores["depth_maps"]["images"]) == NAMES
    mean = scores["depth_maps"]["mean"]
    assert mean["coverage"] == pytest.approx((WIDTH / 2) / (WIDTH - 1))
    assert mean["median_error_gsd"] == pytest.approx(error, abs=0.003)
    assert mean["within"] == ([1, 1, 1] if error == 0 else [0, 1, 1])
    assert mean["median_normal_angle_deg"] < 0.2


def test_depth_of_pixel_centres_is_off_by_the_slope(folder):
    workspace = write_workspace(folder / "dense")
    result = folder / "scores.json"
    for name, camera in EXACT.items():
        depth = plane_depth(camera, 0.5).astype(np.float32)
        write_depth_map(workspace.depth_map_path(name, "geometric"), depth)
        exact = (folder / "depth" / name).with_suffix(".npy")
        np.save(exact, depth)
        exact.with_suffix(".png").unlink()
    options = ["--workspace", workspace.root, "--gsd", 0.1, "--json", result]
    assert evaluate("--reference", folder / "depth", *options) == 0
    for name, camera in EXACT.items():
        off = np.abs(plane_depth(camera, 0.5) - plane_depth(camera, 0.0))[1:, 1:]
        scores = json.loads(result.read_text())["depth_maps"]["images"][name]
        assert scores["median_error_gsd"] == pytest.approx(np.median(off) / 0.1, abs=1e-3)


def test_an_empty_exact_depth_map_is_left_out(folder, capsys):
    cv2.imwrite(str(folder / "depth" / "a.png"), np.zeros((HEIGHT, WIDTH), np.uint16))
    options = ["--workspace", write_workspace(folder / "dense").root, "--depth-scale", 0.0005]
    assert evaluate("--reference", folder / "depth", *options) == 0
    out, err = capsys.readouterr()
    assert "north/b.jpg" in out and "a.jpg" not in out and "a.jpg: its exact depth map is empty" in err


def test_the_command_line_itself(folder):
    command = [sys.executable, "-P", "-m", "colmap_sph", "evaluate", folder / "deep.ply"]
    command += ["--reference", folder / "depth", "--model", folder / "sparse"]
    run = subprocess.run([*map(str, command), "--depth-scale", "0.0005"], capture_output=True, text=True)
    assert run.returncode == 0 and "deep.ply" in run.stdout and run.stderr == ""
    run = subprocess.run([*map(str, command), "--tau", "0"], capture_output=True, text=True)
    assert run.returncode == 2 and run.stdout == "" and "Traceback" not in run.stderr
    assert "tau must be a positive number" in run.stderr


# ---- bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tau", [0, -0.1, "nan", "inf"])
def test_refuses_tau(folder, capsys, tau):
    assert evaluate(folder / "deep.ply", "--reference", folder / "deep.ply", "--tau", 0.1, tau) == 2
    assert "tau must be a positive number" in sentence(capsys)


@pytest.mark.parametrize("role", ["cloud", "reference"])
def test_refuses_clouds_that_cannot_be_measured(folder, capsys, role):
    points = ground(CAMERAS[1])
    good = folder / "deep.ply"

    def refused(bad: Path) -> str:
        cloud, reference = (bad, good) if role == "cloud" else (good, bad)
        assert evaluate(cloud, "--reference", reference) == 2
        message = sentence(capsys)
        assert bad.name in message
        return message

    message = refused(folder / "missing.ply")
    assert "does not exist" in message
    assert ("or as --reference a folder of exact depth maps" in message) == (role == "reference")
    (folder / "cloud.xyz").write_text("0 0 0\n")
    assert "unknown format" in refused(folder / "cloud.xyz")
    (folder / "text.laz").write_text("not a cloud")
    assert "cannot be read" in refused(folder / "text.laz")
    properties = "\n".join(f"property float {axis}" for axis in "xyz")
    header = f"ply\nformat ascii 1.0\nelement vertex 0\n{properties}\nend_header\n"
    (folder / "empty.ply").write_text(header)
    assert "empty" in refused(folder / "empty.ply")
    damaged = points.copy()
    damaged[7, 2] = np.nan
    assert "1 of 10800 points have coordinates that are NaN" in refused(write_ply(folder / "nan.ply", damaged))
    assert "do not overlap" in refused(write_ply(folder / "away.ply", points + EAST * 500))
    wkt = 'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84"]]'
    projected = write_las(folder / "utm.las", points + UTM, wkt)
    message = refused(projected)
    assert "map coordinates (projected (WGS 84 / UTM zone 33N))" in message and "subtract the offset" in message


def test_refuses_a_cloud_that_is_its_own_reference(folder, capsys):
    (folder / "link.ply").symlink_to("deep.ply")
    assert evaluate(folder / "link.ply", "--reference", folder / "deep.ply") == 2
    assert "link.ply is the reference itself" in sentence(capsys)


@pytest.mark.parametrize("fused", [["reference"], ["cloud"], ["reference", "cloud"], []])
def test_a_cloud_and_its_reference_that_may_be_exchanged(folder, capsys, fused):
    """What fusion made is measured, and seldom is it what is true."""
    for name in ("reference", "cloud"):
        write_ply(folder / f"{name}.ply", ground(CAMERAS[1]))
    for name in fused:
        (folder / f"{name}.ply.vis").write_bytes(b"")
    assert evaluate(folder / "cloud.ply", "--reference", folder / "reference.ply", "--register", "False") == 0
    assert ("are the two exchanged?" in capsys.readouterr().err) == (fused == ["reference"])


def test_a_projected_reference_is_shifted_to_the_local_model(folder, capsys):
    reference = write_las(folder / "utm.laz", ground(CAMERAS[1]) + UTM)
    shift = ["--reference-shift", 455_000, 5_400_000, 100]
    assert evaluate(folder / "deep.ply", "--reference", reference, "--register", "False", *shift) == 0
    assert "0.03" in capsys.readouterr().out


def test_refuses_projected_clouds_against_exact_depth(folder, capsys):
    cloud = write_las(folder / "utm.las", ground(CAMERAS[1]) + UTM)
    options = ["--model", folder / "sparse", "--depth-scale", 0.0005]
    assert evaluate(cloud, "--reference", folder / "depth", *options) == 2
    assert "map coordinates" in sentence(capsys)


def test_refuses_options_that_contradict_each_other(folder, capsys):
    cloud = folder / "deep.ply"
    depth = folder / "depth"
    model = ("--model", folder / "sparse")
    scale = ("--depth-scale", 0.0005)
    for arguments, words in [
        (("--reference", cloud), "at least one cloud"),
        ((cloud, "--reference", depth, *scale), "need --model"),
        ((cloud, "--reference", cloud, *model), "leave them out"),
        ((cloud, "--reference", depth, *model, "--depth-scale", 0), "--depth-scale must be a positive number"),
        ((cloud, "--reference", depth, *model, "--depth-scale", "nan"), "--depth-scale must be"),
        ((cloud, "--reference", depth, *model), "give --depth-scale"),
        ((cloud, "--reference", depth, *model, *scale, "--min-view-count", 4), ""),
    ]:
        assert evaluate(*arguments) == (4 if "--min-view-count" in arguments else 2)
        assert words in sentence(capsys)
    assert evaluate(cloud, "--reference", cloud, "--json", folder / "no" / "scores.json") == 3
    assert "its folder does not exist" in sentence(capsys)


def test_only_results_are_replaced_by_results(folder, capsys):
    cloud = folder / "deep.ply"
    before = cloud.read_bytes()
    assert evaluate(cloud, "--reference", cloud, "--json", cloud) == 3
    assert "deep.ply is there already, and no evaluation wrote it; name another for --json" in sentence(capsys)
    assert cloud.read_bytes() == before
    reference = write_ply(folder / "reference.ply", ground(CAMERAS[1]))
    (folder / "scores.json").touch()
    for _ in range(2):
        assert evaluate(cloud, "--reference", reference, "--json", folder / "scores.json") == 0
        assert json.loads((folder / "scores.json").read_text())["reference"] == str(reference)


def test_refuses_what_is_not_exact_depth(folder, capsys):
    options = ("--model", folder / "sparse", "--depth-scale", 0.0005)
    first = folder / "depth" / "a.png"
    good = first.read_bytes()

    def refused() -> str:
        assert evaluate(folder / "deep.ply", "--reference", folder / "depth", *options) == 2
        return sentence(capsys)

    first.write_bytes(good[: len(good) // 3])
    assert "a.png" in refused()
    first.write_bytes(b"not an image")
    assert "cannot be read as an image" in refused()
    cv2.imwrite(str(first), np.full((HEIGHT, WIDTH), 200, np.uint8))
    assert "is not a depth map: it has 1 channel(s) of uint8" in refused()
    cv2.imwrite(str(first), np.full((HEIGHT, WIDTH, 3), 200, np.uint16))
    assert "3 channel(s) of uint16" in refused()
    cv2.imwrite(str(first), np.full((HEIGHT, 2 * WIDTH), 20_000, np.uint16))
    assert "240 x 90 pixels and its camera 120 x 90" in refused()
    first.unlink()
    first.with_suffix(".npy").write_bytes(b"\x93NUMPY")
    assert "cannot be read as a NumPy array" in refused()
    first.with_suffix(".npy").unlink()
    assert evaluate(folder / "deep.ply", "--reference", folder / "depth", *options, "--min-view-count", 2) == 0
    assert "1 of 3 images have no exact depth, such as a.jpg" in capsys.readouterr().err
    (folder / "other").mkdir()
    assert evaluate(folder / "deep.ply", "--reference", folder / "other", *options) == 2
    assert "has no depth map for any of the 3 images" in sentence(capsys)


@pytest.mark.parametrize(("scale", "remedy"), [(0.5, "0.0005"), (5e-7, "0.0005"), (0.0005, ""), (0.0006, "")])
def test_refuses_depth_in_another_unit_than_the_model(folder, capsys, scale, remedy):
    """Millimetres taken for metres, or the other way round: all shares would be 0, or all 1."""
    points = ground(CAMERAS[1])[::50]
    nothing = (np.empty((0, 2)),) * 3
    sparse = syn.SparsePoints(points, nothing, (np.empty(0, np.int64),) * 3)
    model = syn.build_reconstruction(NAMES, CAMERAS, sparse)
    for camera in model.cameras.values():
        camera.model, camera.params = "PINHOLE", [FOCAL, FOCAL, 60, 45]
    syn.write_reconstruction(model, folder / "sparse")
    arguments = ("--reference", folder / "depth", "--model", folder / "sparse", "--depth-scale", scale)
    code = evaluate(folder / "deep.ply", *arguments, "--tau", 1)
    if remedy:
        assert code == 2
        assert f"times as deep; give --depth-scale {remedy}, or another --model." in sentence(capsys)
    else:
        assert code == 0


def test_refuses_models_and_workspaces_that_do_not_fit(folder, capsys):
    cloud = folder / "deep.ply"
    reference = ("--reference", folder / "depth", "--depth-scale", 0.0005)
    assert evaluate(cloud, *reference, "--model", folder / "nowhere") == 2
    assert "does not exist" in sentence(capsys)
    distorted = write_model(folder / "distorted", "OPENCV")
    assert evaluate(cloud, *reference, "--model", distorted) == 2
    assert "distorted OPENCV camera" in sentence(capsys)
    workspace = write_workspace(folder / "dense")
    other = write_model(folder / "other", focal=FOCAL + 1)
    assert evaluate(*reference, "--workspace", workspace.root, "--model", other) == 2
    assert "is not that of its exact depth map" in sentence(capsys)
    first = workspace.depth_map_path("a.jpg", "geometric")
    first.write_bytes(first.read_bytes()[:-9])
    assert evaluate(*reference, "--workspace", workspace.root) == 2
    assert "truncated" in sentence(capsys)
    write_depth_map(first, np.ones((HEIGHT, WIDTH + 1), np.float32))
    assert evaluate(*reference, "--workspace", workspace.root) == 2
    assert "another size" in sentence(capsys)
    assert evaluate(*reference, "--workspace", workspace.root, "--map-kind", "photometric") == 2
    assert "has no photometric depth map" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["depth_map_path", "normal_map_path"])
def test_a_pipe_in_the_place_of_a_map_is_told(what: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It counted as none: an image was left out, or its normals were not measured."""
    workspace = write_workspace(folder / "dense")
    path = getattr(workspace, what)(NAMES[-1], "geometric")
    path.unlink()
    os.mkfifo(path)
    assert evaluate("--reference", folder / "depth", "--depth-scale", 0.0005, "--workspace", workspace.root) == 2
    assert f"{path} cannot be read (it is not a regular file)" in sentence(capsys)
