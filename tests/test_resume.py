"""A second run redoes what is missing or would differ, nothing else; damage and failures cost what they hit."""

import errno
import json
import os
import pkgutil
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import keep_images
from projects import FOUR_NAMES, FOUR_SIZE, copy_four_images, read_picture

import colmap_sph
from colmap_sph.errors import InputError, NoResultError, OutputError
from colmap_sph.pipeline import memory
from colmap_sph.pipeline.forecast.within import START_SECONDS
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import Plan, make_plan
from colmap_sph.pipeline.report import RunReport, Silent
from colmap_sph.project import files
from colmap_sph.project.claim import claimed
from colmap_sph.project.files import remove as remove_path
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.confirm import ConfirmOptions
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.normals import NormalOptions
from colmap_sph.stereo.partners.pairs import PairOptions, select_pairs
from colmap_sph.stereo.rectification import RectificationOptions
from colmap_sph.stereo.refinement import RefinementOptions
from colmap_sph.stereo.vote import VoteOptions

NAMES = FOUR_NAMES
WIDTH, HEIGHT = FOUR_SIZE
OPTIONS = RunOptions(threads=2)
NOTHING = {"undistort": 0, "match pairs": 0, "vote on depth": 0, "confirm depth": 0, "fuse": 0}


@dataclass(frozen=True)
class Finished:
    """A finished run on four images, and its report."""

    project: Path
    report: RunReport

    @property
    def dense(self) -> Path:
        return self.project / "dense"

    @property
    def ids(self) -> dict[str, int]:
        return {view.name: view.image_id for view in read_scene(self.dense / "sparse").views}

    def rerun(self, *, overwrite: bool = False, verify: bool = False, **changes: Any) -> RunReport:
        """As a dense workspace with `overwrite`, so that its images stay."""
        options = replace(OPTIONS, **changes)
        if overwrite:
            return colmap_sph.run(workspace=self.dense, options=options, overwrite=True, verify=verify)
        return colmap_sph.run(self.project / "sparse/0", options=options, verify=verify)


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Not to be changed. Small pictures: most tests run twice."""
    project = tmp_path_factory.mktemp("resume")
    copy_four_images(project)
    return Finished(project, colmap_sph.run(project / "sparse/0", options=OPTIONS))


@pytest.fixture
def finished(pristine: Finished, tmp_path: Path) -> Iterator[Finished]:
    """A copy to do with as a test likes."""
    shutil.copytree(pristine.project, tmp_path / "project", symlinks=True)
    yield Finished(tmp_path / "project", pristine.report)


@pytest.fixture
def project(pristine: Finished, tmp_path: Path) -> Path:
    """Its images and model alone."""
    shutil.copytree(pristine.project, tmp_path / "project", ignore=shutil.ignore_patterns("dense"))
    return tmp_path / "project"


def results(dense: Path) -> dict[str, tuple[int, bytes]]:
    """Time stamp and content of everything that a stage wrote, but for the cloud's and the maps' records."""
    files = [*dense.glob("stereo/*_maps/*.bin"), *Workspace(dense).cloud_paths]
    files += [*dense.glob("colmap_sph/pairs/*/*"), *dense.glob("colmap_sph/photometric/*")]
    assert len(files) == 2 * 4 + 2 + 6 + 4
    return {str(path.relative_to(dense)): (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def rewritten(before: dict[str, tuple[int, bytes]], dense: Path) -> set[str]:
    after = results(dense)
    return {name for name in before if after[name][0] != before[name][0]}


def expected_files(*, pairs: int, votes: int, geometric: int, cloud: bool) -> dict[str, int]:
    return {
        "pairs": pairs,
        "votes": votes,
        "geometric maps": 2 * geometric,
        "cloud": 2 * cloud,
    }


def counted(files: set[str]) -> dict[str, int]:
    return {
        "pairs": sum(name.startswith("colmap_sph/pairs/") for name in files),
        "votes": sum(name.startswith("colmap_sph/photometric/") for name in files),
        "geometric maps": sum(name.endswith(".geometric.bin") for name in files),
        "cloud": sum(name.startswith("fused") for name in files),
    }


# ---- nothing changed ---------------------------------------------------------------------------------------


def test_a_second_run_redoes_nothing(finished: Finished) -> None:
    first = finished.report
    before = results(finished.dense)
    assert first.made == {"undistort": 4, "match pairs": 6, "vote on depth": 4, "confirm depth": 4, "fuse": 1}
    assert first.reused == NOTHING
    second = finished.rerun()
    assert second.made == NOTHING
    assert second.reused == first.made
    assert rewritten(before, finished.dense) == set()
    for fact in ("images", "coverage", "points", "advice", "pairs", "skipped_images", "skipped_pairs"):
        assert getattr(second, fact) == getattr(first, fact), fact


def test_time_stamps_threads_and_place_do_not_matter(finished: Finished) -> None:
    """A workspace that was copied elsewhere, without its time stamps, is as good."""
    moved = finished.project.with_name("moved")
    shutil.copytree(finished.dense, moved, copy_function=shutil.copyfile)
    report = colmap_sph.run(workspace=moved, options=replace(OPTIONS, threads=1))
    assert not any(report.made.values())


# ---- options and inputs that changed -----------------------------------------------------------------------

EVERYTHING = expected_files(pairs=6, votes=4, geometric=4, cloud=True)
CHANGES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "matching": ({"matching": MatchingOptions(p1=12)}, EVERYTHING),
    "rectification": ({"rectification": RectificationOptions(near_margin=2.2)}, EVERYTHING),
    "depth": (
        {"vote": VoteOptions(tolerance=2.5)},
        expected_files(pairs=0, votes=4, geometric=4, cloud=True),
    ),
    "consistency": (
        {"confirm": ConfirmOptions(max_contradiction=0.7)},
        expected_files(pairs=0, votes=0, geometric=4, cloud=True),
    ),
    "normals": (
        {"normals": NormalOptions(radius=3)},
        expected_files(pairs=0, votes=0, geometric=4, cloud=True),
    ),
    "refinement": (
        {"refinement": RefinementOptions(rounds=1)},
        expected_files(pairs=0, votes=0, geometric=4, cloud=True),
    ),
    "fusion": (
        {"fusion": FusionOptions(max_reproj_error=0.7)},
        expected_files(pairs=0, votes=0, geometric=0, cloud=True),
    ),
}


@pytest.mark.parametrize("what", CHANGES)
def test_changed_options_redo_what_depends_on_them(what: str, finished: Finished) -> None:
    changes, expected = CHANGES[what]
    plan = make_plan(Project(finished.project / "sparse/0"), replace(OPTIONS, **changes))
    before = results(finished.dense)
    report = finished.rerun(**changes)
    assert counted(rewritten(before, finished.dense)) == expected
    assert (plan.pairs - plan.pairs_done, plan.fuse) == (report.made["match pairs"], bool(report.made["fuse"]))
    assert plan.images - plan.images_done == report.made["confirm depth"]
    # And back: the same files again, made anew.
    finished.rerun()
    after = results(finished.dense)
    assert {name for name in before if after[name][1] != before[name][1]} == set()


def test_photometric_maps_are_made_only_where_they_are_fused(finished: Finished) -> None:
    """From the votes that are there; and they do not outlive these."""

    def maps() -> list[Path]:
        return sorted(finished.dense.glob("stereo/*/*.photometric.bin"))

    fused: dict[str, Any] = {"fusion": FusionOptions(input="photometric")}
    assert maps() == []
    report = finished.rerun(**fused)
    assert report.made == NOTHING | {"vote on depth": 4, "fuse": 1}
    assert len(maps()) == 2 * 4
    before = [path.read_bytes() for path in maps()]
    assert finished.rerun(**fused).made == NOTHING
    assert finished.rerun().made == NOTHING | {"fuse": 1}
    assert [path.read_bytes() for path in maps()] == before
    assert finished.rerun(vote=VoteOptions(tolerance=2.5)).made["vote on depth"] == 4
    assert maps() == []


def test_photometric_maps_do_not_outlive_other_normals(finished: Finished) -> None:
    """The votes stay; maps that do not fit the options any more are removed where none are asked for."""
    finished.rerun(fusion=FusionOptions(input="photometric"))
    before = results_of_votes(finished.dense)
    assert len(list(finished.dense.glob("stereo/*/*.photometric.bin"))) == 2 * 4
    others: dict[str, Any] = {"normals": NormalOptions(radius=2)}
    assert finished.rerun(**others).made["vote on depth"] == 4
    assert list(finished.dense.glob("stereo/*/*.photometric.bin")) == []
    assert results_of_votes(finished.dense) == before
    assert finished.rerun(**others).made == NOTHING


def test_a_photometric_map_of_another_program_stays_and_is_told_once(
    finished: Finished, caplog: pytest.LogCaptureFixture
) -> None:
    finished.rerun(fusion=FusionOptions(input="photometric"))
    foreign, *_ = sorted(finished.dense.glob("stereo/depth_maps/*.photometric.bin"))
    foreign.write_bytes(b"its own")
    others: dict[str, Any] = {"normals": NormalOptions(radius=2)}
    for made, told in ((4, 1), (0, 1)):
        assert finished.rerun(**others).made["vote on depth"] == made
        assert [path.read_bytes() for path in finished.dense.glob("stereo/*/*.photometric.bin")] == [b"its own"]
        assert caplog.text.count(f"{foreign} is not what this program wrote there") == told


def results_of_votes(dense: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in dense.glob("colmap_sph/photometric/*")}


def test_fewer_pairs_keep_their_disparity_maps(finished: Finished) -> None:
    fewer = PairOptions(num_pairs=1)
    left = select_pairs(read_scene(finished.dense / "sparse"), fewer).unique_pairs()
    report = finished.rerun(pairs=fewer)
    assert (report.made["match pairs"], report.reused["match pairs"]) == (0, len(left))
    assert len(left) < 6
    # An image that keeps its three partners keeps its votes.
    lost = [name for name in NAMES if sum(name in pair for pair in left) < 3]
    assert report.made["vote on depth"] == len(lost) > 0
    assert finished.rerun().made["match pairs"] == 0


def test_a_changed_image_redoes_its_pairs(finished: Finished) -> None:
    before = results(finished.dense)
    path = finished.dense / "images" / NAMES[0]
    assert cv2.imwrite(str(path), cv2.convertScaleAbs(read_picture(path), beta=3))
    finished.rerun()
    files = rewritten(before, finished.dense)
    number = f"{finished.ids[NAMES[0]]:06d}"
    assert {name for name in files if "pairs/" in name} == {
        name for name in before if "pairs/" in name and number in name
    }
    assert counted(files) == expected_files(pairs=3, votes=4, geometric=4, cloud=True)


@pytest.mark.parametrize(
    ("place", "stage", "verify"),
    [
        ("images", "undistort", False),
        ("images", "undistort", True),
        ("dense/images", "match pairs", False),
        ("dense/images", "match pairs", True),
        ("dense/images", "confirm depth", False),
        ("dense/images", "fuse", False),
    ],
)
def test_an_image_that_changes_during_a_run(
    place: str, stage: str, verify: bool, pristine: Finished, tmp_path: Path
) -> None:
    """It is told; and with the former image the next run makes what an undisturbed one makes, and that once."""
    shutil.copytree(pristine.project, tmp_path / "project", ignore=shutil.ignore_patterns("dense"))
    image = tmp_path / "project" / place / NAMES[0]
    kept = tmp_path / "kept"

    class Exchange(Silent):
        def start(self, stage_begun: str, total: int) -> None:
            if stage_begun == stage:
                shutil.copyfile(image, kept)
                shutil.copyfile(image.with_name(NAMES[1]), image)

    report = colmap_sph.run(tmp_path / "project/sparse/0", options=OPTIONS, progress=Exchange())
    assert report.incomplete[NAMES[0]] == f"{image} was changed while the run was at work; run again"
    shutil.copyfile(kept, image)
    again = Finished(tmp_path / "project", report)
    assert again.rerun(verify=verify).incomplete == {}
    assert {name: content for name, (_, content) in results(again.dense).items() if "colmap_sph" not in name} == {
        name: content for name, (_, content) in results(pristine.dense).items() if "colmap_sph" not in name
    }
    assert again.rerun().made == NOTHING


def test_an_image_that_changes_before_a_run_fails(pristine: Finished, tmp_path: Path) -> None:
    shutil.copytree(pristine.project, tmp_path / "project", ignore=shutil.ignore_patterns("dense"))
    image = tmp_path / "project/dense/images" / NAMES[0]
    former: list[bytes] = []

    class Exchange(Silent):
        def start(self, stage: str, total: int) -> None:
            if stage == "match pairs":
                former.append(image.read_bytes())
                shutil.copyfile(image.with_name(NAMES[1]), image)
            if stage == "confirm depth":
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        colmap_sph.run(tmp_path / "project/sparse/0", options=OPTIONS, progress=Exchange())
    image.write_bytes(former[0])
    again = Finished(tmp_path / "project", RunReport())
    assert again.rerun().made["match pairs"] == 3
    assert Workspace(again.dense).fused_path.read_bytes() == Workspace(pristine.dense).fused_path.read_bytes()


@pytest.mark.parametrize(("what", "stage"), [("masks", "match pairs"), ("fusion.mask_path", "fuse")])
def test_a_mask_that_changes_during_a_run(what: str, stage: str, pristine: Finished, tmp_path: Path) -> None:
    """It is told; and with the former mask the next run makes what an undisturbed one makes."""
    clouds = []
    for disturbed in (False, True):
        dense = tmp_path / str(disturbed) / "dense"
        shutil.copytree(pristine.dense, dense)
        mask = dense.parent / "masks" / f"{NAMES[0]}.png"
        mask.parent.mkdir()
        half = np.full((HEIGHT, WIDTH), 255, np.uint8)
        half[:, : WIDTH // 2] = 0
        cv2.imwrite(str(mask), half)

        class Exchange(Silent):
            def start(self, begun: str, total: int, mask: Path = mask, half: np.ndarray = half) -> None:
                if begun == stage:
                    cv2.imwrite(str(mask), half[:, ::-1])

        def rerun(progress: Silent | None, dense: Path = dense, folder: Path = mask.parent) -> RunReport:
            options = OPTIONS
            masks: Path | None = folder
            if what == "fusion.mask_path":
                options, masks = replace(OPTIONS, fusion=replace(OPTIONS.fusion, mask_path=folder)), None
            return colmap_sph.run(workspace=dense, masks=masks, options=options, progress=progress)

        if disturbed:
            told = rerun(Exchange()).incomplete
            assert told == {NAMES[0]: f"{mask} was changed while the run was at work; run again"}
            cv2.imwrite(str(mask), half)
        assert rerun(None).incomplete == {}
        clouds.append(Workspace(dense).fused_path.read_bytes())
    assert clouds[0] == clouds[1] != Workspace(pristine.dense).fused_path.read_bytes()


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_model_that_changes_during_a_run(is_whole: bool, pristine: Finished, tmp_path: Path) -> None:
    """As structure from motion that is still at work does: it is told, and with it the next run begins anew."""
    shutil.copytree(pristine.project, tmp_path / "project", ignore=shutil.ignore_patterns("dense"))
    model = tmp_path / "project/sparse/0"

    class Exchange(Silent):
        def start(self, stage: str, total: int) -> None:
            if stage == "undistort":
                moved = pycolmap.Reconstruction(model)
                moved.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.zeros(3)))
                moved.write(model)
                if not is_whole:
                    os.truncate(model / "images.bin", 100)

    with pytest.raises(InputError, match=r"sparse/0 was changed while the run was at work; run again"):
        colmap_sph.run(model, options=OPTIONS, progress=Exchange())
    shutil.copytree(pristine.project / "sparse/0", model, dirs_exist_ok=True)
    again = Finished(tmp_path / "project", colmap_sph.run(model, options=OPTIONS))
    assert Workspace(again.dense).fused_path.read_bytes() == Workspace(pristine.dense).fused_path.read_bytes()


def test_an_image_that_is_only_touched_during_a_run(finished: Finished) -> None:
    class Touch(Silent):
        def start(self, stage: str, total: int) -> None:
            os.utime(finished.dense / "images" / NAMES[0], (5, 5))

    report = colmap_sph.run(finished.project / "sparse/0", options=OPTIONS, progress=Touch())
    assert (report.incomplete, report.made) == ({}, NOTHING)


def test_a_changed_mask_redoes_the_pairs_of_its_image(finished: Finished) -> None:
    """As a changed image does; and without it everything is as before."""
    masks = finished.project / "masks"
    number = f"{finished.ids[NAMES[0]]:06d}"
    masks.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    before = results(finished.dense)

    def rerun(*, given: bool = True) -> RunReport:
        cv2.imwrite(str(masks / f"{NAMES[0]}.png"), mask)
        plan = make_plan(Project(workspace=finished.dense, masks=masks if given else None), OPTIONS)
        report = colmap_sph.run(workspace=finished.dense, masks=masks if given else None, options=OPTIONS)
        assert plan.pairs - plan.pairs_done == report.made["match pairs"]
        return report

    for columns in (50, 100):
        state = results(finished.dense)
        mask[:, :columns] = 0
        assert rerun().made == {"match pairs": 3, "vote on depth": 4, "confirm depth": 4, "fuse": 1}
        assert all(number in name for name in rewritten(state, finished.dense) if "pairs/" in name)
        assert not any(rerun().made.values())
    assert rerun(given=False).made["match pairs"] == 3
    after = results(finished.dense)
    assert {name for name in before if after[name][1] != before[name][1]} == set()


def test_the_cloud_depends_on_where_the_scene_lies_and_how_images_are_numbered(finished: Finished) -> None:
    keys = Keys(Workspace(finished.dense), OPTIONS)
    scene = read_scene(finished.dense / "sparse")
    near = keys.cloud({}, {}, scene)
    assert near == keys.cloud({}, {}, replace(scene))
    elsewhere = replace(scene, origin=np.full(3, 1e6))
    anchored_elsewhere = replace(scene, anchor=np.full(3, 1.0))
    numbered_otherwise = replace(scene, image_ids=scene.image_ids[::-1])
    assert all(keys.cloud({}, {}, one) != near for one in (elsewhere, anchored_elsewhere, numbered_otherwise))


def test_a_changed_mask_redoes_the_cloud(finished: Finished) -> None:
    masks = finished.project / "masks"
    masks.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    options: dict[str, Any] = {"fusion": FusionOptions(mask_path=masks)}
    cv2.imwrite(str(masks / f"{NAMES[0]}.png"), mask)
    first = finished.rerun(**options)
    mask[:, : WIDTH // 2] = 0
    cv2.imwrite(str(masks / f"{NAMES[0]}.png"), mask)
    second = finished.rerun(**options)
    assert second.made == NOTHING | {"fuse": 1}
    assert second.points < first.points
    moved = masks.rename(finished.project / "elsewhere")
    assert finished.rerun(fusion=FusionOptions(mask_path=moved)).made == NOTHING


def test_a_changed_program_redoes_everything(finished: Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("colmap_sph.pipeline.keys.program_digest", lambda _: "of another version")
    assert finished.rerun().made == finished.report.made


# ---- files that were damaged -------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def remove(path: Path) -> None:
    path.unlink()


def garble(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(path.stat().st_size))


def alter(path: Path) -> None:
    """One byte in the middle: in a state file, one that changes what it says."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


DAMAGED = {
    "disparity map": ("colmap_sph/pairs/*/*.sph", {"match pairs": 1}),
    "estimate": ("colmap_sph/photometric/*.sph", {"vote on depth": 1}),
    "geometric map": ("stereo/normal_maps/*.geometric.bin", {"confirm depth": 1}),
    "cloud": ("fused.ply", {"fuse": 1}),
    "visibility": ("fused.ply.vis", {"fuse": 1}),
    "record of maps": ("colmap_sph/state/*.geometric.json", {"confirm depth": 1}),
    "record of the cloud": ("colmap_sph/cloud.json", {"fuse": 1}),
}


def test_a_marker_that_the_system_refuses_is_not_damaged(
    finished: Finished, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To start afresh, as after damage, would cost all that is there."""
    marker = Workspace(finished.dense).marker_path
    real = files.open_descriptor

    def refuse(path: Path, flags: int, *, follow: bool = True) -> int:
        if path == marker:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, flags, follow=follow)

    with monkeypatch.context() as patch:
        patch.setattr(files, "open_descriptor", refuse)
        for overwrite in (False, True):
            with pytest.raises(InputError, match=r"undistortion\.json cannot be read \(Permission denied\)"):
                colmap_sph.run(finished.project / "sparse/0", options=OPTIONS, overwrite=overwrite)
    assert finished.rerun().made == NOTHING


@pytest.mark.parametrize("damage", [cut, empty, remove, garble])
@pytest.mark.parametrize("what", DAMAGED)
def test_what_is_damaged_is_made_again(what: str, damage: Callable[[Path], None], finished: Finished) -> None:
    """Maps and clouds that are not as they were written may be the user's, and so may those of a lost record."""
    pattern, made = DAMAGED[what]
    before = results(finished.dense)
    path = min(finished.dense.glob(pattern))
    damage(path)
    found = path.read_bytes() if path.exists() else None
    overwrite = what.startswith("record") and found is None
    if overwrite:
        with pytest.raises(InputError, match=r"not made by this program, .* --overwrite"):
            finished.rerun()
        assert finished.rerun(overwrite=True).skipped_images == {}
    else:
        report = finished.rerun()
        assert report.made == NOTHING | made
        assert report.skipped_images == {}
    after = results(finished.dense)
    assert {name for name in before if after[name][1] != before[name][1]} == set()
    backups = {str(file.relative_to(finished.dense)): file for file in finished.dense.rglob("*.backup")}
    if what.startswith("record"):
        assert len(backups) == 2
        assert all(file.read_bytes() == before[name.removesuffix(".backup")][1] for name, file in backups.items())
    elif found is None or what in ("disparity map", "estimate"):
        assert backups == {}
    else:
        assert [file.read_bytes() for file in backups.values()] == [found]
        assert list(backups.values()) == [path.with_name(f"{path.name}.backup")]


def test_a_record_with_one_altered_byte_does_not_vouch(finished: Finished) -> None:
    alter(finished.dense / "colmap_sph/cloud.json")
    assert finished.rerun().made == NOTHING | {"fuse": 1}


@pytest.mark.parametrize(
    "content", ["", "[]", "7", "null", "{}", '{"check": 1}', '{"check": "", "key": 1, "facts": 2}', "[" * 100_000]
)
def test_json_of_other_content_does_not_vouch(content: str, finished: Finished) -> None:
    (finished.dense / "colmap_sph/cloud.json").write_text(content)
    assert finished.rerun().made == NOTHING | {"fuse": 1}


def spoil_disparities(path: Path) -> None:
    """Damage the content, but leave the head as it is."""
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 100] = bytes(100 * [0xA5])
    path.write_bytes(data)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_spoilt_disparity_map_costs_its_images_and_is_made_again(finished: Finished, threads: int) -> None:
    ids = finished.ids
    path = finished.dense / f"colmap_sph/pairs/000/{ids[NAMES[0]]:06d}-{ids[NAMES[1]]:06d}.sph"
    spoil_disparities(path)
    changed: dict[str, Any] = {"vote": VoteOptions(tolerance=2.5), "threads": threads}
    report = finished.rerun(**changed)
    # Whichever of the two read it first removed it; the other finds it missing.
    assert sorted(report.skipped_images) == NAMES[:2]
    assert all(path.name in reason for reason in report.skipped_images.values())
    assert report.images == 2
    assert (finished.dense / "stereo/fusion.cfg").read_text().split() == NAMES[2:]
    again = finished.rerun(**changed)
    assert again.skipped_images == {}
    assert again.made["match pairs"] == 1
    assert again.images == 4


# ---- failures of single items ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "what",
    ["match.match_pair", "vote.vote_depth", "confirm.confirm_depth", "confirm.fit_normals", "confirm.refine_maps"],
)
def test_memory_refused_once(what: str, finished: Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    """One item fails, the rest goes on, and the next run completes the work."""
    place = f"colmap_sph.pipeline.stages.{what}"
    original = pkgutil.resolve_name(place)
    calls = []

    def refused_first(*arguments: object, **keywords: object) -> object:
        calls.append(what)
        if len(calls) == 1:
            np.empty(1 << 60, np.uint8)
        return original(*arguments, **keywords)

    monkeypatch.setattr(place, refused_first)
    options = replace(OPTIONS, threads=1, matching=MatchingOptions(p1=12))
    report = colmap_sph.run(finished.project / "sparse/0", options=options)
    failed = report.skipped_pairs if what == "match.match_pair" else report.skipped_images
    assert len(failed) == 1
    assert "not enough memory" in next(iter(failed.values()))
    assert len(report.skipped_pairs) + len(report.skipped_images) == 1
    monkeypatch.undo()
    again = finished.rerun(matching=options.matching)
    assert again.images == 4
    assert again.skipped_pairs == again.skipped_images == {}
    assert again.made["match pairs"] == (1 if what == "match.match_pair" else 0)


def test_memory_refused_for_all(finished: Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("colmap_sph.pipeline.stages.vote.vote_depth", refused)
    with pytest.raises(NoResultError, match="not enough memory"):
        finished.rerun(vote=VoteOptions(tolerance=2.5))


# ---- starting afresh ---------------------------------------------------------------------------------------


def overwrite(finished: Finished) -> RunReport:
    return colmap_sph.run(finished.project / "sparse/0", options=OPTIONS, overwrite=True)


def test_overwrite_does_everything_again(finished: Finished) -> None:
    before = results(finished.dense)
    mesh = finished.dense / "meshed.ply"
    mesh.write_text("of the user")
    assert overwrite(finished).made == finished.report.made
    assert len(rewritten(before, finished.dense)) == len(before)
    assert mesh.read_text() == "of the user"


def test_overwrite_takes_other_undistortion_options(finished: Finished) -> None:
    smaller = replace(OPTIONS, undistortion=UndistortionOptions(max_image_size=100))
    with pytest.raises(InputError, match=r"made with --max-image-size -1, not 100; .*--overwrite"):
        colmap_sph.run(finished.project / "sparse/0", options=smaller)
    colmap_sph.run(finished.project / "sparse/0", options=smaller, overwrite=True)
    assert {view.width for view in read_scene(finished.dense / "sparse").views} == {100}


def test_overwrite_with_masks(finished: Finished) -> None:
    """Undistorted masks go with the images; a new one costs the pairs of its image alone."""
    masks, model = finished.project / "masks", finished.project / "sparse/0"
    masks.mkdir()
    with pytest.raises(InputError, match="holds no mask for any image"):
        colmap_sph.run(model, masks=masks, options=OPTIONS, overwrite=True)
    assert colmap_sph.run(model, options=OPTIONS).made == NOTHING
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :50] = 0
    cv2.imwrite(str(masks / f"{NAMES[0]}.png"), mask)
    assert make_plan(Project(model, masks=masks), OPTIONS).undistort
    assert colmap_sph.run(model, masks=masks, options=OPTIONS).made["match pairs"] == 3
    assert [path.name for path in (finished.dense / "masks").iterdir()] == [f"{NAMES[0]}.png"]
    overwrite(finished)
    assert not (finished.dense / "masks").exists()


@pytest.mark.parametrize(
    "place", ["images/mine.jpg", "stereo/depth_maps/notes.txt", "sparse/new/a.txt", "masks/mine.png"]
)
def test_overwrite_leaves_files_of_others(place: str, finished: Finished) -> None:
    path = finished.dense / place
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    assert overwrite(finished).made == finished.report.made
    assert path.read_text() == "mine"


def test_overwrite_leaves_linked_images(finished: Finished) -> None:
    """Someone has moved the images to another disk."""
    elsewhere = finished.project / "elsewhere"
    (finished.dense / "images").rename(elsewhere)
    (finished.dense / "images").symlink_to(elsewhere)
    with pytest.raises(OutputError, match=r"images is a link to .* give the folder as --workspace"):
        overwrite(finished)
    assert len(list(elsewhere.iterdir())) == 4


def test_overwrite_leaves_workspaces_of_others(finished: Finished) -> None:
    (finished.dense / "colmap_sph/undistortion.json").unlink()
    before = results(finished.dense)
    with pytest.raises(InputError, match="which this program did not make"):
        overwrite(finished)
    assert rewritten(before, finished.dense) == set()


def test_overwrite_of_a_given_workspace_keeps_its_images(finished: Finished) -> None:
    def given() -> dict[Path, tuple[int, int]]:
        files = [*finished.dense.glob("images/*"), *finished.dense.glob("sparse/*")]
        return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}

    images_and_model = given()
    before = results(finished.dense)
    report = colmap_sph.run(workspace=finished.dense, options=OPTIONS, overwrite=True)
    assert {"undistort": 4} | report.made == finished.report.made
    assert len(rewritten(before, finished.dense)) == len(before)
    assert given() == images_and_model


def test_overwrite_where_nothing_is(project: Path) -> None:
    keep_images(project, NAMES[:2])
    assert colmap_sph.run(project / "sparse/0", options=OPTIONS, overwrite=True).images == 2


# ---- what a killed run leaves, and a running one -----------------------------------------------------------


def test_leftovers_of_killed_runs_are_removed(finished: Finished) -> None:
    leftovers = [
        finished.dense / "stereo/depth_maps/.123-4567.tmp",
        finished.dense / "colmap_sph/.99-1.tmp",
        finished.dense / "colmap_sph/pairs/000/.99-140001.tmp",
        finished.dense / "colmap_sph/.fusion.tmp/fused.ply",
    ]
    mine = [finished.dense / "stereo/.mine.tmp", finished.dense / "stereo/depth_maps/1-2.tmp"]
    (finished.dense / "colmap_sph/.fusion.tmp").mkdir()
    for path in [*leftovers, *mine]:
        path.write_bytes(b"half")
    assert finished.rerun().made == NOTHING
    assert not any(path.exists() for path in leftovers)
    assert all(path.exists() for path in mine)
    assert not (finished.dense / "colmap_sph/.fusion.tmp").exists()


def test_two_runs_in_one_workspace(finished: Finished) -> None:
    with claimed(Workspace(finished.dense)), pytest.raises(OutputError, match="Another run is at work"):
        finished.rerun()
    assert finished.rerun().made == NOTHING


# ---- dry run -----------------------------------------------------------------------------------------------


def test_plan_of_a_new_workspace(project: Path) -> None:
    """Before undistortion: from the model's cameras, and nothing is written."""
    before = sorted(project.rglob("*"))
    plan = make_plan(Project(project / "sparse/0"), OPTIONS)
    assert sorted(project.rglob("*")) == before
    assert plan.undistort and plan.fuse
    assert (plan.pairs_done, plan.images_done) == (0, 0)
    report = colmap_sph.run(project / "sparse/0", options=OPTIONS)
    assert (plan.pairs, plan.images, plan.pair_source) == (report.pairs, report.images, report.pair_source)
    used = sum(path.stat().st_size for path in (project / "dense").rglob("*") if path.is_file())
    assert 0.6 < plan.disk / used < 1.5
    # The clock of a busy machine says little: only the order of magnitude.
    assert 0.05 < plan.seconds / sum(report.seconds.values()) < 10


def test_plan_of_few_small_images(project: Path) -> None:
    """Most of the time goes to the program's start, and to the page."""
    plan = make_plan(Project(project / "sparse/0"), replace(OPTIONS, threads=1))
    before = os.times()
    command = [sys.executable, "-P", "-m", "colmap_sph", "run", "--model", "sparse/0", "--threads", "1"]
    subprocess.run(command, cwd=project, check=True, capture_output=True)
    after = os.times()
    taken = after.children_user + after.children_system - before.children_user - before.children_system
    assert 0.4 < plan.seconds / taken < 4


def test_plan_of_reduced_images(project: Path) -> None:
    whole = make_plan(Project(project / "sparse/0"), OPTIONS)
    reduced = replace(OPTIONS, undistortion=UndistortionOptions(max_image_size=WIDTH // 2))
    half = make_plan(Project(project / "sparse/0"), reduced)
    assert half.disk == pytest.approx(whole.disk / 4, rel=0.15)
    assert half.pairs == whole.pairs


def test_plan_of_the_fusion(finished: Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    """The budget bounds ours, not COLMAP's, and more partners take more time."""
    monkeypatch.setattr(memory, "resident", lambda: 100 << 20)  # whatever other tests have left behind

    def plan(**changes: Any) -> Plan:
        tight = replace(OPTIONS, memory="203MB", fusion=FusionOptions(max_depth_error=0.011, **changes))
        return make_plan(Project(workspace=finished.dense), tight)

    ours, theirs = plan(), plan(method="colmap")
    assert ours.fuse and theirs.fuse
    assert ours.memory <= 203e6 < theirs.memory
    assert ours.seconds > plan(check_num_images=1).seconds > 0


def test_plan_of_a_finished_workspace(finished: Finished) -> None:
    before = results(finished.dense)
    state = sorted(finished.dense.rglob("*"))
    for project in (Project(finished.project / "sparse/0"), Project(workspace=finished.dense)):
        plan = make_plan(project, OPTIONS)
        assert not plan.undistort and not plan.fuse
        assert plan.pairs == plan.pairs_done == 6
        assert plan.images == plan.images_done == 4
        assert plan.disk == 0 and plan.seconds == START_SECONDS
        fresh = make_plan(project, OPTIONS, overwrite=True)
        assert fresh.undistort == (project.model is not None)
        assert fresh.fuse and fresh.pairs_done == fresh.images_done == 0
        assert fresh.disk > 2e6
    assert rewritten(before, finished.dense) == set()
    assert sorted(finished.dense.rglob("*")) == state


def test_plan_of_an_overwrite_is_that_of_an_empty_workspace(finished: Finished) -> None:
    fresh = make_plan(Project(workspace=finished.dense), OPTIONS, overwrite=True)
    for place in ("colmap_sph", "stereo", "fused.ply", "fused.ply.vis"):
        remove_path(finished.dense / place)
    empty = make_plan(Project(workspace=finished.dense), OPTIONS)
    # Memory is not compared: how large the disparity maps will be is better known where there are some.
    assert [replace(one, memory=0.0) for one in fresh.stages] == [replace(one, memory=0.0) for one in empty.stages]


@pytest.mark.parametrize("method", ["best-pixel", "colmap"])
def test_plan_where_no_depth_was_confirmed(method: Any, finished: Finished) -> None:
    """There are maps, all of them empty, and there is no cloud."""
    options = replace(
        OPTIONS,
        confirm=ConfirmOptions(tolerance=1e-9),
        fusion=FusionOptions(method=method),
    )
    with pytest.raises(NoResultError):
        colmap_sph.run(finished.project / "sparse/0", options=options)
    plan = make_plan(Project(finished.project / "sparse/0"), options)
    assert (plan.images_done, plan.fuse) == (4, True)


def test_plan_keeps_to_the_memory(finished: Finished, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "resident", lambda: 100 << 20)  # whatever other tests have left behind
    tight = replace(OPTIONS, memory="203MB", threads=16)
    assert 200e6 <= make_plan(Project(workspace=finished.dense), tight, overwrite=True).memory <= 203e6


def test_report_tells_what_was_done(finished: Finished) -> None:
    finished.rerun(normals=NormalOptions(radius=3))
    written = json.loads((finished.dense / "colmap_sph/report.json").read_text())
    assert written["made"]["match pairs"] == 0
    assert written["reused"]["match pairs"] == 6
    assert written["made"]["fuse"] == 1
