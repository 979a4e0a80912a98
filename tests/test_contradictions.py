"""Options that the number of images cannot satisfy, and what is told where nothing comes of a run."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from projects import FOUR_NAMES, FOUR_SIZE, copy_four_images, write_picture

import colmap_sph
from colmap_sph.app import run_command as command_module
from colmap_sph.app.run_command import PARTIAL_EXIT_CODE, RunCommand, run_command
from colmap_sph.app.terminal import Terminal
from colmap_sph.errors import InputError, NoResultError, OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages import photo
from colmap_sph.project.project import Project
from colmap_sph.scene import View
from colmap_sph.stereo.confirm import ConfirmOptions
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.vote import VoteOptions

OPTIONS = RunOptions(threads=1)


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """Four images, undistorted, with all results."""
    root = tmp_path_factory.mktemp("four")
    copy_four_images(root)
    colmap_sph.run(root / "sparse/0", options=OPTIONS)
    return root


@pytest.fixture
def project(four, tmp_path):
    shutil.copytree(four, tmp_path / "project")
    return tmp_path / "project"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"fusion": FusionOptions(min_num_pixels=5)}, "fusion.min_num_pixels is 5, but there are 4 images"),
        (
            {"fusion": FusionOptions(min_num_pixels=4, check_num_images=2)},
            "fusion.min_num_pixels is 4, but a point is looked for in 3 images",
        ),
        ({"vote": VoteOptions(min_support=4)}, "no image has partners at more than 3 places"),
    ],
)
def test_impossible_numbers_are_told_before_any_work(options, sentence, project):
    cloud = (project / "dense/fused.ply").stat()
    for ask in (
        lambda chosen: colmap_sph.run(workspace=project / "dense", options=chosen),
        lambda chosen: make_plan(Project(workspace=project / "dense"), chosen),
    ):
        with pytest.raises(OptionError, match=sentence):
            ask(replace(OPTIONS, **options))
    assert (project / "dense/fused.ply").stat() == cloud


def test_what_is_just_possible_is_done(project, caplog):
    options = replace(OPTIONS, fusion=FusionOptions(min_num_pixels=4), confirm=ConfirmOptions(min_consistent=20))
    report = colmap_sph.run(workspace=project / "dense", options=options)
    assert report.points > 0
    warned = [text for text in caplog.messages if "--confirm.min-consistent is 20" in text]
    assert len(warned) == 1 and "partners at more than 3 places" in warned[0]


def test_the_option_that_leaves_nothing_is_named(project):
    options = replace(OPTIONS, confirm=ConfirmOptions(tolerance=1e-9))
    with pytest.raises(
        NoResultError, match=r"confirmed by a second image; is it the same without --confirm\.tolerance"
    ):
        colmap_sph.run(workspace=project / "dense", options=options)


def mask_all(project, names):
    for name in names:
        write_picture(project / "dense/masks" / f"{name}.png", np.zeros((*FOUR_SIZE[::-1], 3), np.uint8))


def test_a_mask_of_everything_is_named(project):
    mask_all(project, FOUR_NAMES[:1])
    report = colmap_sph.run(workspace=project / "dense", options=OPTIONS)
    assert "mask" in report.skipped_images[FOUR_NAMES[0]]


def test_masks_of_everything_are_not_blamed_on_confirmation(project):
    mask_all(project, FOUR_NAMES)
    with pytest.raises(NoResultError) as caught:
        colmap_sph.run(workspace=project / "dense", options=OPTIONS)
    assert "confirmed" not in str(caught.value)
    assert "found any depth" in str(caught.value) and "black in the masks" in str(caught.value)


# ---- what could not be read --------------------------------------------------------------------------------


def test_a_pair_lost_for_a_moment_makes_the_run_incomplete(project, monkeypatch):
    """The disk fails once while a pair is read: said of both images, and done by the next run."""
    original = photo.read_view_mask
    calls = []

    def fails_once(path: Path, view: View):
        calls.append(path)
        if len(calls) == 1:
            raise InputError(f"{path} cannot be read (Input/output error).")
        return original(path, view)

    shutil.rmtree(project / "dense/colmap_sph/pairs")
    monkeypatch.setattr(photo, "read_view_mask", fails_once)
    report = colmap_sph.run(workspace=project / "dense", options=OPTIONS)
    assert report.skipped_images == {}
    assert len(report.skipped_pairs) == 1 and len(report.incomplete) == 2
    assert all("Input/output error" in reason for reason in report.incomplete.values())
    again = colmap_sph.run(workspace=project / "dense", options=OPTIONS)
    assert (again.pairs, again.skipped_pairs, again.incomplete) == (6, {}, {})
    assert again.made["match pairs"] == 1


@pytest.mark.parametrize(
    ("report", "code"),
    [(RunReport(), 0), (RunReport(incomplete={"a.jpg": "its maps cannot be read"}), PARTIAL_EXIT_CODE)],
)
def test_incomplete_results_have_their_exit_code(report, code, project, monkeypatch, capsys):
    monkeypatch.setattr(command_module, "run_project", lambda *_, **__: report)
    assert run_command(RunCommand(Project(workspace=project / "dense"), OPTIONS), Terminal()) == code
    assert ("incomplete: a.jpg: its maps cannot be read" in capsys.readouterr().err) == bool(code)
