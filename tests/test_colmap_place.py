"""`patch_match_stereo` and `stereo_fusion` in COLMAP's place, on a small rendered block."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import FinishedRun

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.colmap.options import COMMANDS
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import POINT
from colmap_sph.synthetic import DemoBlock

pytestmark = pytest.mark.filterwarnings("error")
REDUCED = 160


def command(name: str, *arguments: object) -> int:
    return cli.main([name, *map(str, arguments)])


def undistorted(finished: FinishedRun, dense: Path) -> Path:
    """A dense workspace as COLMAP's image_undistorter leaves it."""
    for folder in ("images", "sparse"):
        shutil.copytree(finished.dense / folder, dense / folder)
    names = sorted(path.name for path in (dense / "images").iterdir())
    (dense / "stereo").mkdir()
    (dense / "stereo/fusion.cfg").write_text("".join(f"{name}\n" for name in names))
    (dense / "stereo/patch-match.cfg").write_text("".join(f"{name}\n__auto__, 20\n" for name in names))
    return dense


def with_maps_of_others(finished: FinishedRun, dense: Path) -> Path:
    """A workspace with maps that no record of this program knows."""
    undistorted(finished, dense)
    for folder in ("depth_maps", "normal_maps"):
        shutil.copytree(finished.dense / "stereo" / folder, dense / "stereo" / folder)
    return dense


def points_of(path: Path) -> np.ndarray:
    content = path.read_bytes()
    return np.frombuffer(content, POINT, offset=content.index(b"end_header\n") + 11)


def test_both_commands_make_the_cloud_of_a_run(finished, tmp_path, capsys):
    dense = undistorted(finished, tmp_path / "dense")
    cfg = (dense / "stereo/fusion.cfg").read_bytes()
    assert command("patch_match_stereo", "--workspace_path", dense, "--PatchMatchStereo.gpu_index", "0") == 0
    assert not (dense / "fused.ply").exists() and (dense / "stereo/fusion.cfg").read_bytes() == cfg
    told = capsys.readouterr().err
    assert told.count("without effect") == 1 and "--PatchMatchStereo.gpu_index" in told
    first = (dense / "colmap_sph/log.txt").read_text().splitlines()[0]
    assert first.endswith(
        f"&& colmap_sph patch_match_stereo --workspace_path {dense} --PatchMatchStereo.gpu_index 0"
    )
    cloud = tmp_path / "elsewhere/cloud.ply"
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", cloud) == 0
    for kind in ("depth_maps", "normal_maps"):
        for path in sorted((finished.dense / "stereo" / kind).iterdir()):
            assert (dense / "stereo" / kind / path.name).read_bytes() == path.read_bytes()
    assert cloud.read_bytes() == (finished.dense / "fused.ply").read_bytes()
    assert cloud.with_name("cloud.ply.vis").read_bytes() == (finished.dense / "fused.ply.vis").read_bytes()
    # Where a run puts its own cloud, the next run puts it again, and has nothing else to do.
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", dense / "fused.ply") == 0
    report = colmap_sph.run(workspace=dense)
    assert report.made == {"match pairs": 0, "vote on depth": 0, "confirm depth": 0, "fuse": 1}
    assert not list(dense.glob("*.backup"))


def test_reduced_images_give_reduced_maps_of_the_same_depth(block: DemoBlock, finished, tmp_path):
    """Against exact depth: maps of half the size are as right in their own pixels, and COLMAP fuses them, too."""
    dense = undistorted(finished, tmp_path / "dense")
    arguments = ("--workspace_path", dense, "--PatchMatchStereo.max_image_size", REDUCED)
    assert command("patch_match_stereo", *arguments) == 0
    right = []
    covered = []
    for view in read_scene(dense / "sparse").views:
        depth = colmap_sph.read_depth_map(Workspace(dense).depth_map_path(view.name, "geometric"))
        assert depth.shape == (REDUCED * view.height // view.width, REDUCED)
        truth = block.truth(view.name)[0][:: view.width // REDUCED, :: view.width // REDUCED]
        there = (depth > 0) & (truth > 0)
        gsd = truth / (view.K[0, 0] * REDUCED / view.width)
        right.append((np.abs(depth - truth)[there] < 2 * gsd[there]).mean())
        covered.append(there.sum() / (truth > 0).sum())
    assert np.mean(right) > 0.85 and np.mean(covered) > 0.6
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", tmp_path / "a.ply") == 0
    ours = points_of(tmp_path / "a.ply")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 2
    theirs = pycolmap.stereo_fusion(tmp_path / "b.ply", dense, options=options, output_type="PLY").num_points3D()
    assert len(ours) > 2000 and theirs > 1000
    # Every point is somewhere on the village.
    full = points_of(finished.dense / "fused.ply")["xyz"]
    low, high = full.min(axis=0) - 2, full.max(axis=0) + 2
    assert ((ours["xyz"] > low) & (ours["xyz"] < high)).all()


def test_photometric_maps_only_and_given_depths(finished, tmp_path):
    dense = undistorted(finished, tmp_path / "dense")
    (tmp_path / "pairs.cfg").write_text("N_0_0.jpg\nN_0_1.jpg, N_1_0.jpg\nN_0_1.jpg\nN_0_0.jpg, N_0_2.jpg\n")
    section = "--PatchMatchStereo."
    arguments = [
        "--workspace_path",
        dense,
        "--config_path",
        tmp_path / "pairs.cfg",
        f"{section}max_image_size=200",
    ]
    arguments += [f"{section}geom_consistency", 0, f"{section}depth_min", 80, f"{section}depth_max", 97]
    assert command("patch_match_stereo", *arguments) == 0
    made = sorted(path.name for path in (dense / "stereo/depth_maps").iterdir())
    assert made == [f"N_{name}.jpg.photometric.bin" for name in ("0_0", "0_1", "0_2", "1_0")]
    depths = [colmap_sph.read_depth_map(dense / "stereo/depth_maps" / name) for name in made]
    there = np.concatenate([depth[depth > 0] for depth in depths])
    assert len(there) > 5000 and there.min() >= 80 and there.max() <= 97
    report = (dense / "colmap_sph/report.json").read_text()
    assert '"pairs": 3' in report
    # Geometric ones are asked for, and are not there.
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", tmp_path / "c.ply") == 2
    arguments = ["--workspace_path", dense, "--output_path", tmp_path / "c.ply", "--input_type", "photometric"]
    assert command("stereo_fusion", *arguments) == 0


def test_depths_without_limit_are_those_of_sparse_points(finished, tmp_path):
    """COLMAP's users give a very wide range to say so."""
    dense = undistorted(finished, tmp_path / "dense")
    words = {"max_image_size": 200, "geom_consistency": 0, "depth_min": 1e-3, "depth_max": 1e9}
    arguments = [word for name, value in words.items() for word in (f"--PatchMatchStereo.{name}", value)]
    assert command("patch_match_stereo", "--workspace_path", dense, *arguments) == 0
    agreement = json.loads((dense / "colmap_sph/report.json").read_text())["agreement"]
    assert len(agreement) == 10 and min(agreement.values()) > 0.95


def test_maps_of_another_program_are_fused_as_our_own(finished, tmp_path, capsys):
    dense = with_maps_of_others(finished, tmp_path / "dense")
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", tmp_path / "a.ply") == 0
    assert (tmp_path / "a.ply").read_bytes() == (finished.dense / "fused.ply").read_bytes()
    # They are not replaced; and an image without maps is left out, as COLMAP does.
    assert command("patch_match_stereo", "--workspace_path", dense) == 2
    (dense / "stereo/normal_maps/N_0_0.jpg.geometric.bin").unlink()
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", tmp_path / "b.ply") == 0
    assert "N_0_0.jpg" in capsys.readouterr().err
    assert 0 < len(points_of(tmp_path / "b.ply")) < len(points_of(tmp_path / "a.ply"))


def test_only_points_in_the_box(finished, tmp_path):
    dense = with_maps_of_others(finished, tmp_path / "dense")
    full = points_of(finished.dense / "fused.ply")
    low, high = np.percentile(full["xyz"], [30, 70], axis=0)
    (tmp_path / "box.txt").write_text(" ".join(map(repr, map(float, [*low, *high]))))
    arguments = ["--workspace_path", dense, "--output_path", tmp_path / "box.ply"]
    assert command("stereo_fusion", *arguments, "--bbox_path", tmp_path / "box.txt") == 0
    inside = ((full["xyz"] > low) & (full["xyz"] < high)).all(axis=1)
    assert inside.sum() > 100
    assert points_of(tmp_path / "box.ply").tobytes() == full[inside].tobytes()
    for words in ("1 2 3", "1 1 1 0 0 0", "a b c d e f"):
        (tmp_path / "box.txt").write_text(words)
        assert command("stereo_fusion", *arguments, "--bbox_path", tmp_path / "box.txt") == 2


@pytest.mark.parametrize("kind", ["bin", "txt", "ply"])
def test_a_model_has_the_points_with_the_images_that_see_them(finished, tmp_path, kind):
    """From Python, with pycolmap's options, their bounding box among them."""
    dense = with_maps_of_others(finished, tmp_path / "dense")
    middle = np.median(points_of(finished.dense / "fused.ply")["xyz"], axis=0)
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 4
    options.bounding_box = (middle - 8, middle + 8)
    output = tmp_path / "model"
    model = colmap_sph.stereo_fusion(output, dense, options=options, output_type=kind)
    assert model.num_points3D() > 100 and model.num_reg_images() == 10
    if kind == "ply":
        assert len(points_of(output)) == model.num_points3D()
    else:
        assert (output / f"points3D.{kind}").is_file()
        assert pycolmap.Reconstruction(output).num_points3D() == model.num_points3D()
    points = list(model.points3D.values())
    assert min(point.track.length() for point in points) >= 4
    assert (np.abs(np.array([point.xyz for point in points]) - middle) <= 8.001).all()
    # COLMAP's own projection of each point is where the image says that it sees it.
    model.update_point_3d_errors()
    assert max(point.error for point in points) < 1e-3


def test_smaller_maps_for_fusion(finished, tmp_path):
    dense = with_maps_of_others(finished, tmp_path / "dense")
    arguments = ["--workspace_path", dense, "--output_path", tmp_path / "small.ply"]
    assert command("stereo_fusion", *arguments, "--StereoFusion.max_image_size", REDUCED) == 0
    small = points_of(tmp_path / "small.ply")
    assert 0.15 < len(small) / len(points_of(finished.dense / "fused.ply")) < 0.4


def test_images_that_are_missing(finished, tmp_path, capsys):
    dense = undistorted(finished, tmp_path / "dense")
    (dense / "images/N_0_0.jpg").unlink()
    arguments = ["--workspace_path", dense, "--PatchMatchStereo.max_image_size", 100]
    assert command("patch_match_stereo", *arguments) == 2
    assert "N_0_0.jpg is missing" in capsys.readouterr().err
    assert not list((dense / "stereo").rglob("*.bin"))
    assert command("patch_match_stereo", *arguments, "--PatchMatchStereo.allow_missing_files", 1) == 0
    assert len(list((dense / "stereo/depth_maps").glob("*.geometric.bin"))) == 9


def test_outputs_that_cannot_be(finished, tmp_path, capsys):
    dense = with_maps_of_others(finished, tmp_path / "dense")
    for output, kind, words in (
        (tmp_path, "PLY", "is a folder"),
        (dense / "sparse", "BIN", "own model"),
        (dense / "stereo/fusion.cfg", "TXT", "is a file"),
    ):
        arguments = ["--workspace_path", dense, "--output_path", output, "--output_type", kind]
        assert command("stereo_fusion", *arguments) > 0
        assert words in capsys.readouterr().err


def test_maps_that_are_not_there(finished, tmp_path, capsys):
    """What is there is said: the other kind of maps, or an empty list; none of it is for want of a match."""
    dense = with_maps_of_others(finished, tmp_path / "dense")
    arguments = ["--workspace_path", dense, "--output_path", tmp_path / "cloud.ply"]
    assert command("stereo_fusion", *arguments, "--input_type", "photometric") == 2
    assert "has geometric maps, not photometric ones; fuse those by --input_type" in capsys.readouterr().err
    (dense / "stereo/fusion.cfg").write_text("\n")
    assert command("stereo_fusion", *arguments) == 2
    assert "fusion.cfg lists no image; list them" in capsys.readouterr().err
    shutil.rmtree(dense / "stereo")
    assert command("stereo_fusion", *arguments) == 2
    assert "has no geometric maps; make them by" in capsys.readouterr().err


def test_a_pipe_in_the_place_of_a_map_is_told(finished, tmp_path, capsys):
    """It counted as none, and its image had no part in the cloud."""
    dense = with_maps_of_others(finished, tmp_path / "dense")
    path = dense / "stereo/normal_maps/N_0_0.jpg.geometric.bin"
    path.unlink()
    os.mkfifo(path)
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", tmp_path / "cloud.ply") == 2
    assert f"{path} cannot be read (it is not a regular file)" in " ".join(capsys.readouterr().err.split())


def test_a_list_of_pairs_that_is_missing(finished, tmp_path, capsys):
    dense = undistorted(finished, tmp_path / "dense")
    assert command("patch_match_stereo", "--workspace_path", dense, "--config_path", tmp_path / "no.cfg") == 1
    assert "--config_path: " in (said := capsys.readouterr().err) and "no.cfg is no file" in said


def test_no_file_but_a_cloud_is_replaced(finished, tmp_path, capsys):
    dense = with_maps_of_others(finished, tmp_path / "dense")
    name = next(path.name for path in (dense / "images").iterdir())
    (dense / "fused.ply.vis").write_bytes(bytes(8))
    pipe = tmp_path / "pipe.ply"
    os.mkfifo(pipe)
    model = tmp_path / "model"
    model.mkdir()
    (model / "points3D.bin").write_bytes(bytes(8))
    for output, kind, words in (
        (dense / "images" / name, "PLY", "is no cloud"),
        (dense / "sparse/images.bin", "PLY", "is no cloud"),
        (dense / f"stereo/depth_maps/{name}.geometric.bin", "PLY", "is no cloud"),
        (pipe, "PLY", "a device or a pipe"),
        (dense / "fused.ply.vis/x/cloud.ply", "PLY", f"Nothing can be written in {dense / 'fused.ply.vis'}"),
        (model, "TXT", "holds a binary model"),
    ):
        before = output.read_bytes() if output.is_file() else None
        arguments = ["--workspace_path", dense, "--output_path", output, "--output_type", kind]
        assert command("stereo_fusion", *arguments) == 3
        assert words in capsys.readouterr().err
        assert before is None or output.read_bytes() == before
    assert pipe.is_fifo() and len(list(model.iterdir())) == 1


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_no_model_but_a_clouds_is_replaced(finished, tmp_path, capsys, kind):
    """As with clouds: a user's model is not lost by a slip; what this program wrote, and nobody changed, is."""
    dense = with_maps_of_others(finished, tmp_path / "dense")
    model = tmp_path / "sparse/0"
    model.mkdir(parents=True)
    source = pycolmap.Reconstruction(dense / "sparse")
    (source.write_binary if kind == "bin" else source.write_text)(model)
    before = {path.name: path.read_bytes() for path in model.iterdir()}

    def fuse(folder: Path) -> int:
        return command("stereo_fusion", "--workspace_path", dense, "--output_path", folder, "--output_type", kind)

    assert fuse(model) == 3
    assert re.search(rf"sparse/0/\w+\.{kind} is there already", capsys.readouterr().err)
    assert {path.name: path.read_bytes() for path in model.iterdir()} == before
    folder = tmp_path / "new/cloud"
    assert fuse(folder) == 0
    first = (folder / f"points3D.{kind}").read_bytes()
    (folder / "notes").write_text("of others, and in nobody's way")
    assert fuse(folder) == 0
    assert (folder / f"points3D.{kind}").read_bytes() == first
    with (folder / f"points3D.{kind}").open("ab") as file:
        file.write(b"# mine\n")
    assert fuse(folder) == 3
    assert (folder / f"points3D.{kind}").read_bytes() != first


def test_no_scan_is_replaced(finished, tmp_path, capsys):
    """Fusion's clouds, ours and COLMAP's, have a file beside them with as many points."""
    dense = with_maps_of_others(finished, tmp_path / "dense")
    scan = tmp_path / "scan.ply"
    content = (finished.dense / "fused.ply").read_bytes()
    scan.write_bytes(content)
    arguments = ["--workspace_path", dense, "--output_path", scan]
    assert command("stereo_fusion", *arguments) == 3
    assert "is not from fusion" in capsys.readouterr().err
    (tmp_path / "scan.ply.vis").write_bytes((7).to_bytes(8, "little"))
    assert command("stereo_fusion", *arguments) == 3
    assert scan.read_bytes() == content
    shutil.copy(finished.dense / "fused.ply.vis", tmp_path / "scan.ply.vis")
    assert command("stereo_fusion", *arguments) == 0


def test_a_cloud_goes_where_a_link_leads(finished, tmp_path):
    dense = with_maps_of_others(finished, tmp_path / "dense")
    (tmp_path / "disk").mkdir()
    link = tmp_path / "link.ply"
    link.symlink_to(tmp_path / "disk/cloud.ply")
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", link) == 0
    assert link.is_symlink() and len(points_of(tmp_path / "disk/cloud.ply")) == finished.report.points


OF_SCRIPTS = {
    "in the workspace, as its own scripts": (
        "--workspace_path . --workspace_format COLMAP --PatchMatchStereo.geom_consistency true",
        "--workspace_path . --workspace_format COLMAP --input_type geometric --output_path ./fused.ply",
    ),
    "a benchmark": (
        "--workspace_path=. --PatchMatchStereo.depth_min=20 --PatchMatchStereo.depth_max=300 "
        "--PatchMatchStereo.window_radius=7 --PatchMatchStereo.num_iterations=7 "
        "--PatchMatchStereo.filter_min_ncc=0.07 "
        "--PatchMatchStereo.filter_min_num_consistent=1 --PatchMatchStereo.gpu_index=0,1 "
        "--PatchMatchStereo.cache_size=64",
        "--workspace_path=. --output_path=cloud.ply --StereoFusion.min_num_pixels=3 "
        "--StereoFusion.max_reproj_error=2 "
        "--StereoFusion.max_depth_error=0.05 --StereoFusion.max_normal_error=25 --StereoFusion.use_cache=1",
    ),
    "photometric, in a hurry": (
        "--workspace_path . --PatchMatchStereo.geom_consistency 0 --PatchMatchStereo.window_step 2 "
        "--PatchMatchStereo.num_samples 7 --PatchMatchStereo.filter 1 "
        "--PatchMatchStereo.write_consistency_graph 0",
        "--workspace_path . --input_type photometric --output_type PLY --output_path out/x.ply "
        "--StereoFusion.check_num_images 20 --StereoFusion.max_traversal_depth 50 --log_to_stderr 1",
    ),
}


@pytest.mark.parametrize("script", OF_SCRIPTS)
def test_option_lists_of_scripts(finished, tmp_path, monkeypatch, capsys, script):
    """Each option is taken, and each without effect named once."""
    monkeypatch.chdir(undistorted(finished, tmp_path / "dense"))
    for name, words in zip(("patch_match_stereo", "stereo_fusion"), OF_SCRIPTS[script], strict=True):
        arguments = words.split()
        if name == "patch_match_stereo":
            arguments += ["--PatchMatchStereo.max_image_size", "120"]
        assert command(name, *arguments) == 0
        notice = "".join(line for line in capsys.readouterr().err.split("\n") if "without effect" in line)
        flags = [word[2:].partition("=")[0] for word in arguments if word.startswith("--")]
        idle = {flag for flag in flags if not COMMANDS[name].flags()[flag].acts}
        assert {word.strip(" ,") for word in notice.partition(": ")[2].split("--") if word.strip()} == idle
    assert len(points_of(next(Path.cwd().rglob("*.ply")))) > 1000


SCRIPT = """
set -e
colmap() { "$PYTHON" -m colmap_sph "$@"; }
mkdir dense
colmap image_undistorter --image_path images --input_path sparse/0 --output_path dense --output_type COLMAP
colmap patch_match_stereo --workspace_path dense --workspace_format COLMAP \\
    --PatchMatchStereo.max_image_size 200 --PatchMatchStereo.geom_consistency true
colmap stereo_fusion --workspace_path dense --workspace_format COLMAP --input_type geometric \\
    --output_path dense/fused.ply
colmap poisson_mesher --input_path dense/fused.ply --output_path dense/meshed-poisson.ply \\
    --PoissonMeshing.depth 7 --PoissonMeshing.trim 2
"""


@pytest.mark.skipif(shutil.which("colmap") is None, reason="no program colmap is installed")
def test_a_script_in_the_manner_of_colmaps_tutorial(project):
    environment = {"PYTHON": sys.executable, "PATH": "/usr/local/bin:/usr/bin:/bin"}
    subprocess.run(["bash", "-c", SCRIPT], cwd=project, env=environment, check=True, capture_output=True)
    assert len(points_of(project / "dense/fused.ply")) > 5000
    assert (project / "dense/meshed-poisson.ply").stat().st_size > 100_000
