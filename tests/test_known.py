"""What is remembered of results counts for the same input and untouched files alone, and spares asking anew."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from projects import FOUR_NAMES, copy_four_images

import colmap_sph
from colmap_sph.pipeline.known import remembering
from colmap_sph.pipeline.known.selection import read_selection, write_selection
from colmap_sph.pipeline.known.table import KnownResult, ResultTable, stamp_of_files
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.stages import selection as selection_module
from colmap_sph.pipeline.stages.confirm import ConfirmStage
from colmap_sph.pipeline.stages.facts import Agreement, Facts
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.pipeline.stages.vote import VoteStage
from colmap_sph.project.project import Project
from colmap_sph.stereo.partners.pairs import PairSelection, Partner, select_pairs
from colmap_sph.stereo.refinement import RefinementOptions

OPTIONS = RunOptions(threads=1)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.bin"
    path.write_bytes(b"content")
    return path


def table(tmp_path: Path, key: str = "input") -> ResultTable:
    return ResultTable(tmp_path / "known/table.json", key)


def test_a_table_keeps_what_it_is_given(tmp_path: Path, file: Path) -> None:
    facts = Facts(0.5, 0.25, Agreement(3, 2, 1), row_residual=0.001)
    known = KnownResult("key", stamp_of_files([str(file)]), facts)
    table(tmp_path).add({"a": known})
    table(tmp_path).add({"b": known})
    assert table(tmp_path).find("a", [str(file)]) == table(tmp_path).find("b", [str(file)]) == known
    assert table(tmp_path).find("c", [str(file)]) is None
    assert table(tmp_path, "other input").find("a", [str(file)]) is None


@pytest.mark.parametrize("change", ["content", "same size and time", "copy", "gone", "folder"])
def test_a_touched_file_is_unknown(tmp_path: Path, file: Path, change: str) -> None:
    table(tmp_path).add({"a": KnownResult("key", stamp_of_files([str(file)]), Facts())})
    status = file.stat()
    if change == "content":
        file.write_bytes(b"contents")
    elif change == "same size and time":
        file.write_bytes(b"CONTENT")
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    elif change == "copy":
        file.with_suffix(".copy").write_bytes(b"content")
        file.with_suffix(".copy").replace(file)
    else:
        file.unlink()
        if change == "folder":
            file.mkdir()
    assert table(tmp_path).find("a", [str(file)]) is None


@pytest.mark.parametrize("damage", [b"", b"{}", b'{"key": "input", "check": "", "content": {}}', b"\xff\xfe"])
def test_a_damaged_table_knows_nothing(tmp_path: Path, file: Path, damage: bytes) -> None:
    table(tmp_path).add({"a": KnownResult("key", stamp_of_files([str(file)]), Facts())})
    (tmp_path / "known/table.json").write_bytes(damage)
    assert table(tmp_path).find("a", [str(file)]) is None


def test_a_selection_is_read_as_it_was(tmp_path: Path) -> None:
    partners = {"a": (Partner("b", 3, 1 / 3), Partner("c", 1, float("nan"))), "b": ()}
    path = tmp_path / "selection.json"
    write_selection(path, "key", PairSelection(partners, "frusta"))
    found = read_selection(path, "key")
    assert found is not None and found.source == "frusta"
    assert repr(found.partners) == repr(partners)
    assert read_selection(path, "other") is None
    path.write_bytes(path.read_bytes().replace(b"0.333", b"0.334"))
    assert read_selection(path, "key") is None


# ---- in runs ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished workspace; tests leave it finished."""
    project = tmp_path_factory.mktemp("known")
    copy_four_images(project)
    colmap_sph.run(project / "sparse/0", options=OPTIONS)
    return project / "dense"


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Items that were asked the long way; and "selection" where pairs were chosen."""
    items: list[object] = []
    # It asks some items of stages whose input it does not know yet.
    monkeypatch.setattr("colmap_sph.pipeline.reconstruct.foreseen_stages", lambda *args, **kwargs: [])

    def noting(original: Callable[..., Any], what: Callable[..., object]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            items.append(what(*args))
            return original(*args, **kwargs)

        return call

    for stage in (MatchStage, VoteStage, ConfirmStage):
        monkeypatch.setattr(stage, "ask", noting(stage.ask, lambda _, item: item))
    monkeypatch.setattr(selection_module, "select_pairs", noting(select_pairs, lambda *_: "selection"))
    return items


def test_a_second_run_asks_nothing_anew(dense: Path, asked: list[object]) -> None:
    colmap_sph.run(workspace=dense, options=OPTIONS)  # told to in other words than the first
    page = (dense / "colmap_sph/report.html").read_bytes()
    report = colmap_sph.run(workspace=dense, options=OPTIONS)
    plan = make_plan(Project(workspace=dense), OPTIONS)
    assert asked == [] and not any(report.made.values())
    assert (plan.pairs_done, plan.images_done, plan.fuse) == (6, 4, False)
    assert (dense / "colmap_sph/report.html").read_bytes() == page


def test_what_is_remembered_is_what_would_be_found(dense: Path, asked: list[object]) -> None:
    """Without it all is asked, found up to date, and remembered again."""
    known = dense / "colmap_sph/known"
    before = {path.name: json.loads(path.read_text()) for path in known.iterdir() if path.stem != "page"}
    for path in known.iterdir():
        path.unlink()
    report = colmap_sph.run(workspace=dense, options=OPTIONS)
    assert not any(report.made.values()) and len(set(asked)) == 6 + 4 + 1
    assert {name: json.loads((known / name).read_text()) for name in before} == before


def test_one_file_that_was_touched_is_asked_for_alone(dense: Path, asked: list[object]) -> None:
    (dense / f"stereo/normal_maps/{FOUR_NAMES[1]}.geometric.bin").touch()
    report = colmap_sph.run(workspace=dense, options=OPTIONS)
    assert set(asked) == {FOUR_NAMES[1]} and not any(report.made.values())
    asked.clear()
    colmap_sph.run(workspace=dense, options=OPTIONS)
    assert asked == []


def test_other_options_ask_the_stages_that_they_concern(dense: Path, asked: list[object]) -> None:
    options = replace(OPTIONS, refinement=RefinementOptions(rounds=1))
    make_plan(Project(workspace=dense), options)
    assert set(asked) == set(FOUR_NAMES)


def test_nothing_is_remembered_of_what_somebody_exchanged(dense: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A map that was exchanged while the others were being made is made again, and kept under another name."""
    path = dense / f"stereo/depth_maps/{FOUR_NAMES[2]}.geometric.bin"
    original = remembering.RememberingStage.remember

    def exchange(self: ConfirmStage, results: object) -> None:
        if isinstance(self, ConfirmStage):
            path.write_bytes(path.read_bytes()[:-1] + bytes([path.read_bytes()[-1] ^ 255]))
        original(self, results)  # type: ignore[arg-type]

    good = path.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(remembering.RememberingStage, "remember", exchange)
        colmap_sph.run(workspace=dense, options=replace(OPTIONS, refinement=RefinementOptions(rounds=1)))
    exchanged = path.read_bytes()
    report = colmap_sph.run(workspace=dense, options=replace(OPTIONS, refinement=RefinementOptions(rounds=1)))
    assert report.made["confirm depth"] == 1 and path.read_bytes() != exchanged
    report = colmap_sph.run(workspace=dense, options=OPTIONS)
    assert report.made["confirm depth"] == 4 and path.read_bytes() == good


def test_many_that_are_missing_are_foreseen_from_some(
    dense: Path, asked: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = make_plan(Project(workspace=dense), OPTIONS, overwrite=True)
    asked.clear()
    monkeypatch.setattr("colmap_sph.pipeline.forecast.survey._ASKED", 2)
    some = make_plan(Project(workspace=dense), OPTIONS, overwrite=True)
    assert len([item for item in asked if item != "selection"]) == 2 + 2 + 2
    assert (some.pairs, some.images, some.pairs_done) == (whole.pairs, whole.images, 0)
    np.testing.assert_allclose(some.seconds, whole.seconds, rtol=0.2)
