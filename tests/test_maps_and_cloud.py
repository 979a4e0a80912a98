"""Which maps a cloud is of: what the page shows after maps alone, and which pairs fusion goes by."""

import json
import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import FinishedRun
from small_workspaces import ground_workspace
from test_colmap_place import command, points_of, undistorted
from test_pages import Page

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.errors import InputError
from colmap_sph.pages import write_page
from colmap_sph.products.surface.seen import seen_views
from colmap_sph.project.state.cloud_marks import is_cloud_of
from colmap_sph.project.workspace import Workspace

SMALL = ("--PatchMatchStereo.max_image_size", "120")


def page_of(dense: Path) -> Page:
    return Page(dense)


def shows_cloud(page: Page) -> bool:
    assert bool(page.all("canvas")) == (page.data["cloud"] is not None)
    return bool(page.all("canvas"))


@pytest.fixture
def dense(finished: FinishedRun, tmp_path: Path) -> Path:
    """A copy of a finished workspace."""
    return Path(shutil.copytree(finished.dense, tmp_path / "dense"))


def test_an_earlier_cloud_is_not_shown_beside_other_maps(dense: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert shows_cloud(page_of(dense))
    assert command("patch_match_stereo", "--workspace_path", dense, *SMALL) == 0
    page = page_of(dense)
    assert not shows_cloud(page)
    assert "fused.ply was made of other depth maps" in page.text("p")
    assert "10 of 10 images with depth maps, in" in page.text("p")
    # Fused, it is that of these maps.
    capsys.readouterr()
    assert command("stereo_fusion", "--workspace_path", dense, "--output_path", dense / "fused.ply") == 0
    page = page_of(dense)
    assert shows_cloud(page)
    assert f"{len(points_of(dense / 'fused.ply')):,} points" in page.text("p")
    assert "out of date" not in page.text("strong")


def test_photometric_maps_are_not_shown_as_confirmed(dense: Path) -> None:
    """Geometric maps and cloud are of the run before; fused, the photometric ones have a cloud of their own."""
    arguments = ("--workspace_path", dense, *SMALL, "--PatchMatchStereo.geom_consistency", "0")
    assert command("patch_match_stereo", *arguments) == 0
    page = page_of(dense)
    assert not shows_cloud(page)
    assert "photometric maps only:" in page.text("strong")
    bars = [each["aria-label"] or "" for each in page.all("svg") if each.get("class") == "bar"]
    assert len(bars) == 10 and not any("confirmed" in words.replace("unconfirmed", "") for words in bars)
    assert "10 of 10 images with depth maps, in" in page.text("p")
    where = ("--workspace_path", dense, "--output_path", dense / "fused.ply")
    assert command("stereo_fusion", *where, "--input_type", "photometric") == 0
    assert shows_cloud(page_of(dense))


def test_a_run_that_was_ended_before_fusion(dense: Path, finished: FinishedRun) -> None:
    """A map is another than that which was fused."""
    workspace = Workspace(dense)
    names = sorted(finished.report.coverage)
    assert is_cloud_of(workspace, [(name, "geometric") for name in names])
    path = workspace.depth_map_path(names[0], "geometric")
    path.write_bytes(workspace.depth_map_path(names[1], "geometric").read_bytes())
    assert is_cloud_of(workspace, [(name, "geometric") for name in names]) is False
    assert "the cloud is of other depth maps" in write_page(workspace)
    assert not shows_cloud(page_of(dense))


def test_a_cloud_of_another_program_that_is_older_than_the_maps(tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", ["a.png", "b.png"])
    made = workspace.fused_path.stat().st_mtime_ns
    path = workspace.depth_map_path("b.png", "geometric")
    for later, is_doubted in ((-(10**9), False), (10**9, True)):
        for name in ("a.png", "b.png"):
            for kind in ("photometric", "geometric"):
                os.utime(Workspace(workspace.root).depth_map_path(name, kind), ns=(made, made))
        os.utime(path, ns=(made + later, made + later))
        write_page(workspace)
        page = page_of(workspace.root)
        assert shows_cloud(page)
        assert ("fused.ply is older than depth maps" in page.text("p")) == is_doubted


def test_the_report_of_colmaps_command_repeats_it(finished: FinishedRun, tmp_path: Path) -> None:
    dense = undistorted(finished, tmp_path / "a dense\x1bworkspace")
    assert command("patch_match_stereo", "--workspace_path", dense, *SMALL) == 0
    said = json.loads((dense / "colmap_sph/report.json").read_text())["command"]
    assert "\x1b" not in said and "\\x1b" in said
    assert said.startswith(
        f"cd {shlex.quote(str(Path.cwd()))} && colmap_sph patch_match_stereo --workspace_path $'"
    )


def test_fusion_goes_by_the_pairs_of_the_maps(finished: FinishedRun, tmp_path: Path) -> None:
    """Not by those of earlier maps, of which there are files, too."""
    first = "N_0_0.jpg"
    (tmp_path / "pairs.cfg").write_text(f"{first}\nN_0_1.jpg, N_1_0.jpg\nN_0_1.jpg\n{first}, N_0_2.jpg\n")
    clouds = []
    for name, before in (("fresh", False), ("used", True)):
        dense = undistorted(finished, tmp_path / name)
        if before:
            assert command("patch_match_stereo", "--workspace_path", dense, *SMALL) == 0
        arguments = ("--workspace_path", dense, *SMALL, "--config_path", tmp_path / "pairs.cfg")
        assert command("patch_match_stereo", *arguments) == 0
        files = [path for path in (dense / "colmap_sph/pairs").rglob("*") if path.is_file()]
        assert (len(files) > 3) == before
        listed = [first, "N_0_1.jpg", "N_0_2.jpg", "N_1_0.jpg"]
        (dense / "stereo/fusion.cfg").write_text("".join(f"{each}\n" for each in listed))
        assert command("stereo_fusion", "--workspace_path", dense, "--output_path", tmp_path / "cloud.ply") == 0
        clouds.append((tmp_path / "cloud.ply").read_bytes())
        log = (dense / "colmap_sph/log.txt").read_text()
        assert "Pairs of the maps: 3" in log
    assert clouds[0] == clouds[1]


def test_records_say_which_images_each_was_matched_with(finished: FinishedRun) -> None:
    record = json.loads((finished.dense / "colmap_sph/state/N_0_0.jpg.geometric.json").read_text())
    pairs = [pair[:2] for pair in finished.report.matched_pairs]
    partners = {*(pair[1] for pair in pairs if pair[0] == "N_0_0.jpg"), *(a for a, b in pairs if b == "N_0_0.jpg")}
    assert set(record["facts"]["partners"]) == partners


def test_a_run_with_other_options_ends_with_its_own_cloud(dense: Path) -> None:
    options = colmap_sph.RunOptions()
    options = replace(options, confirm=replace(options.confirm, min_consistent=3))
    colmap_sph.run(workspace=dense, options=options)
    assert shows_cloud(page_of(dense))
    assert cli.main(["report", str(dense)]) == 0
    assert shows_cloud(page_of(dense))


def exported_maps(dense: Path, folder: Path) -> set[str]:
    """Names of the images whose depth maps are exported."""
    arguments = ["export", str(dense), "--formats", "npz", "--output", str(folder)]
    assert cli.main(arguments) == 0
    return {path.name.removesuffix(".npz") for path in (folder / "depth_npz").iterdir() if path.suffix == ".npz"}


def test_products_are_made_of_the_maps_of_the_last_run(
    dense: Path, finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Maps of images that it left out lie there, of the run before."""
    names = set(finished.report.coverage)
    assert exported_maps(dense, tmp_path / "all") == names
    assert "left out" not in capsys.readouterr().err
    gone = min(names)
    (dense / "images" / gone).unlink()
    report = colmap_sph.run(workspace=dense)
    assert set(report.coverage) == names - {gone}
    assert Workspace(dense).depth_map_path(gone, "geometric").is_file()
    assert exported_maps(dense, tmp_path / "fewer") == names - {gone}
    said = " ".join(capsys.readouterr().err.split())
    assert f"The cloud in {dense} was not made of 1 of the 10 depth maps there, such as that of {gone}" in said
    assert {each.view.name for each in seen_views(Workspace(dense))[1]} == names - {gone}


def test_products_are_not_made_without_a_damaged_map(
    dense: Path, finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was left out, as one that has no part in the cloud: a hole, and exit code 0."""
    path = Workspace(dense).depth_map_path(min(finished.report.coverage), "geometric")
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 1)
    assert cli.main(["export", str(dense), "--formats", "npz", "--output", str(tmp_path / "out")]) == 2
    assert f"{path} is truncated or damaged" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="truncated or damaged"):
        seen_views(Workspace(dense))


def test_products_of_maps_that_are_not_fused_say_so(
    dense: Path, finished: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("patch_match_stereo", "--workspace_path", dense, *SMALL) == 0
    capsys.readouterr()
    assert exported_maps(dense, tmp_path / "out") == set(finished.report.coverage)
    assert "was made of other depth maps than are there" in " ".join(capsys.readouterr().err.split())
