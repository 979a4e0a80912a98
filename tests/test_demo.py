"""The built-in example on a small block: what it gives, and what it says."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL_BLOCK

from colmap_sph.app import cli, demo
from colmap_sph.app.demo import DemoResult, run_demo
from colmap_sph.errors import OutputError
from colmap_sph.evaluation import mean_of_depth_maps
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.stereo.partners.pairs import PairOptions
from colmap_sph.synthetic import BlockOptions

TINY = replace(SMALL_BLOCK, strips=1, strip_images=3, oblique_images=0, supersample=1, width=240, height=180)
TWO_PAIRS = RunOptions(threads=2, pairs=PairOptions(num_pairs=2))


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    return run_demo(tmp_path_factory.mktemp("demo"), options=RunOptions(threads=2), block=SMALL_BLOCK)


def test_depth_maps_against_exact_depth(result: DemoResult) -> None:
    assert len(result.depth_maps) == result.report.images == 10
    mean = mean_of_depth_maps(result.depth_maps)
    assert mean.thresholds[:2] == (1.0, 2.0)
    assert mean.coverage > 0.75
    assert mean.within[0] > 0.87
    assert mean.within[1] > 0.93
    assert mean.median_error < 0.2
    assert mean.median_normal_angle is not None and mean.normal_coverage is not None
    assert mean.median_normal_angle < 5
    assert mean.normal_coverage > 0.99


def test_cloud_against_exact_surface(result: DemoResult) -> None:
    one, two = result.cloud.thresholds[:2]
    assert (one.tau, two.tau) == pytest.approx((SMALL_BLOCK.nadir_gsd, 2 * SMALL_BLOCK.nadir_gsd))
    assert one.accuracy > 0.85
    assert one.completeness > 0.55
    assert two.accuracy > 0.93
    assert two.completeness > 0.7
    assert result.workspace.fused_path.is_file()


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "run_demo", partial(run_demo, block=TINY))
    for _ in range(2):  # an earlier demo is replaced
        assert cli.main(["demo", "--output", str(tmp_path / "demo"), "--threads", "2"]) == 0
        captured = capsys.readouterr()
        output = captured.out + captured.err
        assert "Against exact depth" in output
        for word in ("N_0_0.jpg", "coverage", "<= 1 GSD", "fused.ply", "acc 1 GSD", "comp 1 GSD"):
            assert word in output
    log = (tmp_path / "demo/dense/colmap_sph/log.txt").read_text()
    assert log.count(f"colmap_sph demo --output {tmp_path}/demo --threads 2") == 2
    assert "Match pairs" in log


def test_the_result_can_be_repeated(tmp_path: Path) -> None:
    first, second = (run_demo(tmp_path / name, options=TWO_PAIRS, block=TINY) for name in ("a", "b"))
    assert first.depth_maps == second.depth_maps
    assert first.report.points == pytest.approx(second.report.points, rel=0.01)
    # The maps of the first are what it was scored by.
    coverage = np.mean([scores.coverage for scores in first.depth_maps.values()])
    assert coverage == pytest.approx(np.mean(list(first.report.coverage.values())), abs=0.01)


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    """A folder called `truth`, which demos make, too, is none of their records."""
    for name in ("dense/fused.ply", "truth/mine.txt"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("mine")
    with pytest.raises(OutputError, match="already holds other files"):
        run_demo(tmp_path, block=TINY)
    assert (tmp_path / "dense/fused.ply").read_text() == "mine"
    assert (tmp_path / "truth/mine.txt").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dense", "truth"]


def test_files_beside_a_demo_stay(tmp_path: Path) -> None:
    run_demo(tmp_path, options=TWO_PAIRS, block=TINY)
    cloud = (tmp_path / "dense/fused.ply").read_bytes()
    mine = [
        tmp_path / name for name in ("mine", "images/mine.jpg", "truth/mine.npz", "dense/mine", "sparse/1/mine")
    ]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    (tmp_path / "dense/fused.ply").write_bytes(b"")
    run_demo(tmp_path, options=TWO_PAIRS, block=TINY)
    assert (tmp_path / "dense/fused.ply").read_bytes() == cloud
    assert [path.read_text() for path in mine] == ["mine"] * 5


def test_a_file_that_no_record_of_a_demo_names_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "colmap_sph_demo.json").write_text('{"files": ["images/N_0_0.jpg"]}')
    (tmp_path / "images").mkdir()
    for name in ("N_0_0.jpg", "N_0_1.jpg"):
        (tmp_path / "images" / name).write_text("mine")
    with pytest.raises(OutputError, match=r"N_0_1\.jpg was not made by an earlier demo"):
        run_demo(tmp_path, block=TINY)
    assert (tmp_path / "images/N_0_0.jpg").read_text() == "mine"


@pytest.mark.parametrize("record", [b"", b"{}", b'{"files": 3}', b"[]", b"\xff", b"[" * 100_000])
def test_a_damaged_record_of_a_demo_allows_nothing(record: bytes, tmp_path: Path) -> None:
    (tmp_path / "colmap_sph_demo.json").write_bytes(record)
    with pytest.raises(OutputError, match="already holds other files"):
        run_demo(tmp_path, block=TINY)


@pytest.mark.parametrize("place", ["images", "sparse", "truth", "truth/sub", "dense/stereo"])
def test_a_demo_follows_no_link_out_of_its_folder(place: str, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    link = tmp_path / "demo" / place
    link.parent.mkdir(parents=True)
    (tmp_path / "demo/colmap_sph_demo.json").write_text('{"files": []}')
    link.symlink_to(elsewhere)
    with pytest.raises(OutputError, match=f"{place} is a link to {elsewhere}"):
        run_demo(tmp_path / "demo", block=TINY)
    assert not list(elsewhere.iterdir())


def test_its_truth_can_be_given_to_evaluate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command of the documentation says what the demo itself says, up to what interpolation of depth costs."""
    result = run_demo(tmp_path / "demo", options=TWO_PAIRS, block=TINY)
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).parents[1] / "docs/usage.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^colmap_sph (evaluate demo/.*)$", text, re.MULTILINE)
    gsd = str(TINY.nadir_gsd)
    assert command.endswith(f"--gsd {BlockOptions().nadir_gsd}")
    assert cli.main([*command.split()[:-1], gsd, "--register", "False", "--json", "scores.json"]) == 0
    scores = json.loads(Path("scores.json").read_text())
    assert list(scores["depth_maps"]["images"]) == list(result.depth_maps)
    for name, mine in result.depth_maps.items():
        found = scores["depth_maps"]["images"][name]
        assert found["coverage"] == pytest.approx(mine.coverage, abs=0.02)
        assert found["within"][1] == pytest.approx(mine.within[1], abs=0.02)
    (cloud,) = scores["clouds"]
    assert cloud["point_count"] == result.cloud.point_count
    f_scores = [threshold["f_score"] for threshold in cloud["thresholds"]]
    assert f_scores == pytest.approx([threshold.f_score for threshold in result.cloud.thresholds], abs=0.02)
