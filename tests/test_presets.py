"""Qualities: what they set, what wins over them, and a workspace that goes from one to another."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import tyro
from conftest import keep_images

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.given_options import all_arguments
from colmap_sph.app.run_command import RunCommand
from colmap_sph.errors import OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.presets import PRESETS, FusionMethod, Quality, changed_options, preset

IMAGES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_0.jpg", "N_1_1.jpg", "N_1_2.jpg"]


def parsed(*typed: str) -> RunOptions:
    arguments = all_arguments(typed, RunCommand)
    return tyro.cli(RunCommand, args=arguments, config=(tyro.conf.AvoidSubcommands,)).options


@pytest.mark.parametrize("quality", get_args(Quality))
def test_a_quality_is_a_set_of_options(quality: Quality) -> None:
    preset(quality).check()
    assert parsed("--quality", quality) == parsed(f"--quality={quality}") == preset(quality)
    assert preset("normal") == RunOptions() == parsed()
    assert {preset(each).undistortion for each in get_args(Quality)} == {RunOptions().undistortion}


def test_what_is_given_beside_it_wins(tmp_path: Path) -> None:
    assert parsed("--num-pairs", "7", "--quality", "preview").pairs.num_pairs == 7
    (tmp_path / "run.toml").write_text('quality = "preview"\nnum-pairs = 6\n')
    config = ("--config", str(tmp_path / "run.toml"))
    by_file = parsed(*config)
    assert by_file.pairs.num_pairs == 6
    assert by_file.rectification == preset("preview").rectification
    better = parsed(*config, "--quality", "best")
    assert (better.pairs.num_pairs, better.rectification) == (6, preset("best").rectification)


@pytest.mark.parametrize(("method", "most"), [("best-pixel", 0.25), ("colmap", 0.5)])
def test_the_best_quality_is_of_both_methods_of_fusion(method: FusionMethod, most: float) -> None:
    """What makes our own clouds denser keeps COLMAP's fusion from merging, and its points are less exact then."""
    chosen = parsed("--quality", "best", "--fusion.method", method)
    assert chosen.fusion.reprojection_error == most
    assert chosen == preset("best", fusion_method=method)
    assert chosen.pairs == preset("best").pairs
    given = parsed("--fusion.max-reproj-error", "1", "--quality", "best", f"--fusion.method={method}")
    assert given.fusion.reprojection_error == 1


def test_what_there_is_not_is_refused() -> None:
    with pytest.raises(OptionError, match=r"quality must be one of preview, normal, best, not 'fine'"):
        preset("fine")  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"method must be 'best-pixel' or 'colmap', not 'colmpa'"):
        preset("best", fusion_method="colmpa")  # type: ignore[arg-type]


def test_a_report_leaves_nothing_to_a_quality(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "report.json").write_text('{"options": {}}')
    config = str(tmp_path / "report.json")
    assert cli.main(["run", "--model", "nowhere", "--config", config, "--quality", "best"]) == 2
    assert re.fullmatch(
        r"error: --quality has no effect, as .*report\.json sets all .*\n", capsys.readouterr().err
    )


@pytest.mark.parametrize("wrong", ["fine", ""])
def test_another_quality_is_refused(wrong: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["run", "--model", "nowhere", "--quality", wrong]) == 2
    words = f"error: --quality takes one of preview, normal, best, not {wrong!r}; see colmap_sph run --help-all.\n"
    assert capsys.readouterr().err == words


def test_a_workspace_goes_from_one_quality_to_another(project: Path) -> None:
    """It gets what it would have got at once, and only the undistorted images stay."""
    keep_images(project, IMAGES)
    model = project / "sparse/0"
    command = ["run", "--model", str(model), "--threads", "2", "--output"]
    dense, fresh = project / "dense", project / "fresh"
    assert cli.main([*command, str(dense), "--quality", "preview"]) == 0
    rough = (dense / "fused.ply").read_bytes()
    assert cli.main([*command, str(dense)]) == cli.main([*command, str(fresh)]) == 0
    report = json.loads((dense / "colmap_sph/report.json").read_text())
    assert report["made"].get("undistort", 0) == 0
    assert all(report["reused"][stage] == 0 for stage in ("match pairs", "vote on depth", "confirm depth", "fuse"))
    finer = (dense / "fused.ply").read_bytes()
    assert finer == (fresh / "fused.ply").read_bytes() != rough
    again = colmap_sph.run(model, output=fresh, options=preset("preview"))
    assert (fresh / "fused.ply").read_bytes() == rough
    assert again.made["match pairs"] == again.pairs


def test_preview_matches_less(project: Path) -> None:
    keep_images(project, IMAGES)
    model = project / "sparse/0"
    reports = {name: colmap_sph.run(model, output=project / name, options=preset(name)) for name in PRESETS}
    assert reports["normal"].sampling is not None
    assert reports["preview"].sampling == pytest.approx(0.5 * reports["normal"].sampling, abs=0.01)
    assert reports["preview"].pairs < reports["normal"].pairs <= reports["best"].pairs


def test_a_quality_is_told_by_its_name() -> None:
    """Not by options that nobody typed; what is given beside it is told, too."""
    preview = preset("preview")
    assert changed_options(preview, "rectification", "vote") == ["--quality preview"]
    given = replace(preview, vote=replace(preview.vote, min_support=3))
    assert changed_options(given, "rectification", "vote") == ["--quality preview", "--vote.min-support 3"]
    other = replace(preview, pairs=replace(preview.pairs, num_pairs=4))
    assert changed_options(other, "rectification", "vote") == ["--rectification.sampling 0.5"]
    assert changed_options(RunOptions(), "rectification", "vote") == []
