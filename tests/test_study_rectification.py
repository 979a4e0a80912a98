"""The rectification study: its sums and tables on made-up numbers, and all of it on three rendered pictures."""

import importlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import keep_images

from colmap_sph import synthetic as syn
from colmap_sph.errors import InputError
from colmap_sph.evaluation import DepthView
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.scene import View

pytestmark = pytest.mark.usefixtures("scripts_on_path")


def made_up_pair(angle, frame, spherical):
    def scores(numbers):
        if numbers is None:
            return {"skipped": "a reason"}
        matched, correct, warped = numbers
        return {
            "matched": matched,
            "correct": correct,
            "warped": warped,
            "median_error_gsd": 0.5,
            "median_error_common_gsd": 0.25,
        }

    return {
        "left": "a.jpg",
        "right": f"b{angle}.jpg",
        "view_angle_deg": angle,
        "frame": scores(frame),
        "spherical": scores(spherical),
    }


def test_pairs_are_summed_by_angle():
    pairs = importlib.import_module("rectification_study.pairs")
    scored = [
        made_up_pair(5.0, (100, 80, 1000), (110, 90, 900)),
        made_up_pair(7.0, (50, 40, 500), (40, 40, 400)),
        made_up_pair(90.0, None, (30, 20, 300)),
    ]
    near, wide, every = pairs.by_angle(scored)
    assert (near["pairs"], near["frame"]["matched"], near["spherical"]["correct"]) == (2, 150, 130)
    assert (wide["frame"]["skipped"], wide["frame"]["warped"], wide["spherical"]["matched"]) == (1, 0, 30)
    assert (every["pairs"], every["frame"]["warped"], every["spherical"]["warped"]) == (3, 1500, 1600)
    assert wide["frame"]["median_error_gsd"] is None
    assert [pair["right"] for pair in pairs.telling_pairs(scored, 3)] == ["b5.0.jpg", "b7.0.jpg"]


def test_errors_are_in_pixels_on_the_ground_and_slopes_against_a_plane():
    pairs = importlib.import_module("rectification_study.pairs")
    K = np.array([[100.0, 0, 30], [0, 100.0, 20], [0, 0, 1]])
    flat = np.full((40, 60), 50.0, np.float32)
    exact = DepthView("a", K, np.eye(3), np.zeros(3), lambda: flat)
    view = View(1, "a", 60, 40, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    maps = pairs.ExactMaps([exact])
    # A pixel is 50 / 100 = 0.5 m large.
    errors = maps.errors(view, np.where(flat > 0, flat + 0.75, 0))
    np.testing.assert_allclose(errors[1:, 1:], 1.5, rtol=1e-5)
    assert np.isnan(errors[0]).all(), "no exact depth at the corners of the first row's pixels"
    tilted = np.array([0, np.sin(np.radians(30)), np.cos(np.radians(30))])
    np.testing.assert_allclose(maps.slopes(view, tilted)[1:, 1:], 30, atol=0.01)


def test_table_of_points():
    tables = importlib.import_module("rectification_study.tables")
    assert tables.change(200, 210) == "+5.00 %" and tables.change(0, 5) == "-"
    assert tables.table(["a", "b"], [["x", "1"]]) == "| a | b |\n| --- | ---: |\n| x | 1 |"


def test_the_whole_study(block: syn.DemoBlock, project: Path):
    pytest.importorskip("matplotlib")
    kept = [name for name in block.names if name.startswith("N")][:3]
    keep_images(project, kept)
    (project / "depth").mkdir()
    for name, camera in zip(block.names, block.cameras, strict=True):
        if name in kept:
            depth, _, _ = syn.exact_geometry(block.village.surfaces, camera, origin=0.5)
            np.save(project / "depth" / f"{name}.npy", depth.astype(np.float32))
    study = importlib.import_module("study_rectification")
    asked = study.Study(
        output=project / "study",
        model=project / "sparse" / "0",
        exact_depth=project / "depth",
        shown_pairs=1,
        same_pixels="spherical",
        run=RunOptions(threads=2),
    )
    study.main(asked)
    content = json.loads((project / "study" / "study.json").read_text())
    assert content["images"] == 3 and len(content["pairs"]) == 3
    total = content["by_angle"][-1]
    for model in ("frame", "spherical"):
        assert total[model]["correct"] > 0.8 * total[model]["matched"] > 0
        assert total[model]["median_error_gsd"] < 1
        assert content["cost"][model]["match pairs"]["cpu_seconds"] > 0
    same = content["same_pixels"]
    frame, spherical = same["by_angle"][-1]["warped_common"]
    assert spherical == pytest.approx(frame, rel=0.02)
    assert spherical != pytest.approx(total["warped_common"][1], rel=0.02), "they had different numbers before"
    assert total["frame"]["warped"] == same["by_angle"][-1]["frame"]["warped"]
    for model in ("frame", "spherical"):
        counts = total["found"][model]
        assert counts["seen"] == total["found_common"][model]["seen"] > counts["found"] > 0.6 * counts["seen"]
        assert counts["within_1_pixel"] > 0.9 * counts["found"]
    report = (project / "study" / "study.md").read_text()
    assert "frame cannot rectify 0 of 3 pairs; spherical cannot rectify 0 of 3 pairs." in report
    assert f"# With as many rectified pixels: spherical with sampling {same['sampling']:.3f}" in report
    for heading in (
        "Points",
        "Exact depth",
        "Found of what both images see",
        "By angle",
        "By slope",
        "Pairs that could not be rectified",
        "Cost",
    ):
        assert f"## {heading}" in report
    pictures = sorted(path.name for path in (project / "study").glob("*.png"))
    assert len(pictures) == 3 and all(name in report for name in pictures)
    with pytest.raises(InputError, match="another model or with other options"):
        study.main(replace(asked, run=RunOptions(threads=1)))


def test_a_street_leaves_nothing_to_the_frame(tmp_path: Path):
    pytest.importorskip("matplotlib")
    scenes = importlib.import_module("rectification_study.scenes")
    options = syn.CanyonOptions(width=160, height=120, images=3, points=600, supersample=1)
    street = syn.make_canyon_block(tmp_path, options, threads=2)
    scenes.write_exact_depth(street.names, street.cameras, street.surfaces, tmp_path / "depth")
    study = importlib.import_module("study_rectification")
    study.main(
        study.Study(
            output=tmp_path / "study",
            model=street.sparse_dir,
            exact_depth=tmp_path / "depth",
            same_pixels="spherical",
            run=RunOptions(threads=2),
        )
    )
    content = json.loads((tmp_path / "study" / "study.json").read_text())
    total = content["by_angle"][-1]
    assert "viewing ray runs along it" in content["failures"]["frame"]
    assert (total["pairs"], total["frame"]["skipped"], total["spherical"]["skipped"]) == (3, 3, 0)
    assert total["found"]["frame"]["found"] == 0 < total["found"]["spherical"]["found"]
    assert total["found"]["frame"]["seen"] == total["found"]["spherical"]["seen"]
    assert "same_pixels" not in content, "there are no pairs on both"
    report = (tmp_path / "study" / "study.md").read_text()
    assert "**frame cannot rectify 3 of 3 pairs; spherical cannot rectify 0 of 3 pairs.**" in report
    assert "**frame: no result.**" in report
