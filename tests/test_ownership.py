"""What others made, or what was damaged, is never replaced or used without a word."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_resume import NAMES, NOTHING, OPTIONS, Finished, results, rewritten
from test_resume import finished as finished
from test_resume import pristine as pristine

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.errors import InputError, OutputError
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.stages.maps import MapFacts, MapFiles
from colmap_sph.project.files import whole_digest
from colmap_sph.project.map_files import read_depth_map, read_normal_map, write_depth_map, write_normal_map
from colmap_sph.project.project import Project
from colmap_sph.project.state.ownership import remove_recorded
from colmap_sph.project.state.records import vouch
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.normals import NormalOptions

REFUSED = r"depth_maps/N_0_0\.jpg\.geometric\.bin and 9 more files were not made by this program.*--overwrite"
OTHER_FUSION: dict[str, Any] = {"fusion": FusionOptions(max_reproj_error=0.7)}


@pytest.fixture
def foreign(finished: Finished) -> Path:
    """A workspace that COLMAP itself has finished: maps and a cloud, and nothing of ours."""
    shutil.rmtree(finished.dense / "colmap_sph")
    return finished.dense


def backups(dense: Path) -> dict[str, bytes]:
    paths = [path for path in dense.rglob("*") if ".backup" in path.name]
    return {str(path.relative_to(dense)): path.read_bytes() for path in paths}


def contents(dense: Path) -> dict[str, bytes]:
    return {name: content for name, (_, content) in results(dense).items()}


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---- files of others ---------------------------------------------------------------------------------------


def test_maps_and_clouds_of_others_are_refused_before_anything_is_done(foreign: Path) -> None:
    before = files_in(foreign)
    with pytest.raises(InputError, match=REFUSED):
        make_plan(Project(workspace=foreign), OPTIONS)
    with pytest.raises(InputError, match=REFUSED):
        colmap_sph.run(workspace=foreign, options=OPTIONS)
    after = files_in(foreign)
    assert {path: after[path] for path in before} == before
    assert not list(foreign.glob("colmap_sph/p*/*"))


def test_a_cloud_alone_is_refused_too(finished: Finished) -> None:
    finished.dense.joinpath("colmap_sph/cloud.json").unlink()
    with pytest.raises(InputError, match=r"fused\.ply and 1 more file were not made by this program"):
        finished.rerun()


def test_overwrite_keeps_what_others_made_under_other_names(
    foreign: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {str(path.relative_to(foreign)): path.read_bytes() for path in foreign.glob("stereo/*_maps/*.bin")}
    before |= {path.name: path.read_bytes() for path in Workspace(foreign).cloud_paths}
    (foreign / "meshed.ply").write_text("of the user")
    whole = files_in(foreign)
    make_plan(Project(workspace=foreign), OPTIONS, overwrite=True)
    assert "Would get another name" in caplog.text and "and 7 more files" in caplog.text
    assert files_in(foreign) == whole
    caplog.clear()
    assert cli.main(["run", "--workspace", str(foreign), "--threads", "2", "--overwrite"]) == 0
    assert "and 7 more files were not made by this program" in " ".join(capsys.readouterr().err.split())
    assert backups(foreign) == {f"{name}.backup": content for name, content in before.items()}
    assert (foreign / "meshed.ply").read_text() == "of the user"
    # From now on they are ours.
    assert not any(colmap_sph.run(workspace=foreign, options=OPTIONS).made.values())
    colmap_sph.run(workspace=foreign, options=OPTIONS, overwrite=True)
    assert len(backups(foreign)) == len(before)


def test_what_another_program_wrote_over_ours_is_kept(
    finished: Finished, caplog: pytest.LogCaptureFixture
) -> None:
    before = contents(finished.dense)
    theirs = {"fused.ply": b"ply of COLMAP", f"stereo/depth_maps/{NAMES[0]}.geometric.bin": b"a map of COLMAP"}
    for name, content in theirs.items():
        (finished.dense / name).write_bytes(content)
    assert finished.rerun().made == NOTHING | {"confirm depth": 1, "fuse": 1}
    assert contents(finished.dense) == before
    assert backups(finished.dense) == {f"{name}.backup": content for name, content in theirs.items()}
    assert all(f"{name} is not what this program wrote" in caplog.text for name in theirs)
    finished.dense.joinpath("fused.ply").write_bytes(b"another")
    finished.rerun()
    assert finished.dense.joinpath("fused.ply.backup2").read_bytes() == b"another"


@pytest.mark.parametrize("overwrite", [False, True])
def test_an_edit_that_the_samples_do_not_show_is_kept(finished: Finished, overwrite: bool) -> None:
    """Every byte is looked at before a file is replaced."""
    path = Workspace(finished.dense).fused_path
    edited = bytearray(path.read_bytes())
    edited[len(edited) // 2 + 20] ^= 1
    path.write_bytes(edited)
    assert not any(finished.rerun().made.values())
    options = {} if overwrite else OTHER_FUSION
    finished.rerun(overwrite=overwrite, **options)
    assert backups(finished.dense) == {"fused.ply.backup": bytes(edited)}


def test_a_run_killed_while_it_writes_leaves_files_of_its_own(
    finished: Finished, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the beginning of maps or a cloud and their record."""
    before = contents(finished.dense)

    def killed(*_: Any, **__: Any) -> None:
        raise OutputError("killed")

    for place in ("maps", "cloud"):
        with monkeypatch.context() as patch:
            patch.setattr(f"colmap_sph.pipeline.stages.{place}.vouch_when_on_disk", killed)
            with pytest.raises(OutputError, match="killed"):
                finished.rerun(normals=NormalOptions(radius=3))
    finished.rerun()
    assert contents(finished.dense) == before
    assert backups(finished.dense) == {}


def test_a_first_run_killed_before_any_map_leaves_places_of_its_own(
    foreign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where no record was ever complete."""
    for path in [*foreign.glob("stereo/*_maps/*.bin"), *foreign.glob("fused*")]:
        path.unlink()

    def killed(*_: Any, **__: Any) -> None:
        raise OutputError("killed")

    with monkeypatch.context() as patch:
        patch.setattr("colmap_sph.pipeline.stages.maps.vouch_when_on_disk", killed)
        with pytest.raises(OutputError, match="killed"):
            colmap_sph.run(workspace=foreign, options=OPTIONS)
    assert list(foreign.glob("stereo/*_maps/*.bin"))
    assert colmap_sph.run(workspace=foreign, options=OPTIONS).images == 4
    assert backups(foreign) == {}


@pytest.mark.parametrize("place", ["match.make_disparity_map", "cloud.begin_cloud"])
def test_what_others_make_after_a_run_was_ended_is_kept(
    place: str, foreign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The user gives up, lets COLMAP make maps and cloud, and starts again: only what was ours is ours."""
    theirs = dict.fromkeys([*foreign.glob("stereo/*_maps/*.bin"), *foreign.glob("fused*")], b"of COLMAP")
    for path in theirs:
        path.unlink()

    def killed(*_: Any, **__: Any) -> None:
        raise OutputError("killed")

    with monkeypatch.context() as patch:
        module, _, name = place.partition(".")
        if name == "begin_cloud":
            patch.setattr(f"colmap_sph.pipeline.stages.fuse.{name}", killed)
        else:
            patch.setattr(f"colmap_sph.pipeline.stages.{module}.MatchStage.make", killed)
        with pytest.raises(OutputError, match="killed"):
            colmap_sph.run(workspace=foreign, options=OPTIONS)
    for path, content in theirs.items():
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"not made by this program"):
        colmap_sph.run(workspace=foreign, options=OPTIONS)
    colmap_sph.run(workspace=foreign, options=OPTIONS, overwrite=True)
    assert backups(foreign) == {f"{path.relative_to(foreign)}.backup": content for path, content in theirs.items()}


def test_an_incomplete_cloud_is_ours_only_as_it_is(finished: Finished) -> None:
    """What the user makes of it is kept, as of a complete one."""
    spoil(finished.dense / f"stereo/{MAPS[0]}")
    assert finished.rerun(**OTHER_FUSION).skipped_images
    (finished.dense / "fused.ply").write_bytes(b"cleaned by the user")
    assert finished.rerun(**OTHER_FUSION).made["fuse"] == 1
    assert backups(finished.dense)["fused.ply.backup"] == b"cleaned by the user"


# ---- fusion.cfg --------------------------------------------------------------------------------------------


def cfg_of(dense: Path) -> Path:
    return dense / "stereo/fusion.cfg"


def test_a_list_of_images_that_says_the_same_is_left_alone(finished: Finished) -> None:
    before = cfg_of(finished.dense).stat()
    finished.rerun(**OTHER_FUSION)
    assert cfg_of(finished.dense).stat().st_mtime_ns == before.st_mtime_ns
    assert cfg_of(finished.dense).stat().st_ino == before.st_ino


def test_the_list_that_undistortion_wrote_is_replaced(finished: Finished) -> None:
    """Also where an image has come to the model since."""
    dense, image = finished.project / "other", finished.project / "images" / NAMES[3]
    whole = image.read_bytes()
    image.write_bytes(b"damaged")
    model = finished.project / "sparse/0"
    assert list(colmap_sph.run(model, output=dense, options=OPTIONS).skipped_images) == [NAMES[3]]
    image.write_bytes(whole)
    colmap_sph.run(model, output=dense, options=OPTIONS)
    assert cfg_of(dense).read_text().split() == NAMES
    assert backups(dense) == {}


def test_an_edited_list_of_images_is_kept(finished: Finished, caplog: pytest.LogCaptureFixture) -> None:
    path = cfg_of(finished.dense)
    path.write_text(f"{NAMES[2]}\n")
    finished.rerun()
    assert path.read_text().split() == NAMES
    assert backups(finished.dense) == {"stereo/fusion.cfg.backup": f"{NAMES[2]}\n".encode()}
    assert "fusion.cfg is not what this program wrote" in caplog.text


def test_colmaps_own_list_of_images_is_replaced(finished: Finished) -> None:
    """All images, in any order; and so is our own of another run."""
    cfg_of(finished.dense).write_text("\r\n".join(NAMES[::-1]).replace("\r", "") + "\n")
    finished.rerun()
    assert cfg_of(finished.dense).read_text().split() == NAMES
    (finished.dense / "stereo/patch-match.cfg").write_text(f"{NAMES[0]}\n{NAMES[1]}\n")
    finished.rerun()
    assert cfg_of(finished.dense).read_text().split() == NAMES[:2]
    (finished.dense / "stereo/patch-match.cfg").unlink()
    finished.rerun()
    assert cfg_of(finished.dense).read_text().split() == NAMES
    assert backups(finished.dense) == {}


# ---- earlier versions, and what --overwrite removes --------------------------------------------------------


def make_old(dense: Path) -> list[Path]:
    """Make a workspace one of the version before: records without digests, archives in place of our files."""
    for path in [*dense.glob("colmap_sph/state/*.json"), dense / "colmap_sph/cloud.json"]:
        content = json.loads(path.read_bytes())
        old = {name: content[name] for name in ("key", "stamps", "facts")}
        path.write_text(json.dumps(old | {"check": "0" * 32}, indent=1))
    (dense / "colmap_sph/fusion_cfg.json").unlink(missing_ok=True)
    archives = []
    for path in [*dense.glob("colmap_sph/photometric/*.sph"), *dense.glob("colmap_sph/pairs/*/*.sph")]:
        folder = dense / "colmap_sph" / ("pairs" if path.parents[1].name == "pairs" else "photometric")
        archives.append(folder / f"{path.stem}.npz")
        with archives[-1].open("wb") as file:
            np.savez(file, key="key", codes=np.zeros((3, 3), np.uint16))
        path.unlink()
    return archives


def test_a_workspace_of_the_version_before_is_brought_up_to_date(finished: Finished) -> None:
    before = contents(finished.dense)
    old = make_old(finished.dense)
    assert len(old) == 10
    mine = finished.dense / "colmap_sph/pairs/mine.npz"
    with mine.open("wb") as file:
        np.savez(file, depth=np.zeros(3))
    make_plan(Project(workspace=finished.dense), OPTIONS)
    assert all(path.exists() for path in old)
    assert finished.rerun().made == finished.report.made | {"undistort": 0}
    assert not any(path.exists() for path in old)
    assert mine.exists()
    mine.unlink()
    assert contents(finished.dense) == before
    assert backups(finished.dense) == {}


def test_disparity_maps_in_one_folder_are_made_anew_in_several(finished: Finished) -> None:
    """As the version before had them; what is there under such a name, but not ours, stays."""
    before = contents(finished.dense)
    flat = finished.dense / "colmap_sph/pairs"
    for path in flat.glob("*/*.sph"):
        path.rename(flat / path.name)
    (flat / "mine.sph").write_bytes(b"mine")
    assert make_plan(Project(workspace=finished.dense), OPTIONS).pairs_done == 0
    assert finished.rerun().made == NOTHING | {"match pairs": 6}
    assert [path.name for path in flat.glob("*.sph")] == ["mine.sph"]
    (flat / "mine.sph").unlink()
    assert contents(finished.dense) == before


MINE = [
    "known/a.json",
    "pairs/notes.txt",
    "pairs/1-2.npz",
    "photometric/a/b.sph",
    "state/notes.json",
    "state/a.txt",
    "mine.txt",
]


@pytest.mark.parametrize("how", ["overwrite", "remove"])
def test_files_of_the_user_in_our_folders_stay(how: str, finished: Finished) -> None:
    state = finished.dense / "colmap_sph"
    make_old(finished.dense)
    for name in MINE:
        (state / name).parent.mkdir(exist_ok=True)
        (state / name).write_text("mine")
    finished.rerun()
    if how == "overwrite":
        assert {"undistort": 4} | finished.rerun(overwrite=True).made == finished.report.made
    else:
        (finished.dense / "fused.ply").write_bytes(b"of COLMAP")
        assert remove_recorded(Workspace(finished.dense)) == [finished.dense / "fused.ply"]
        assert (finished.dense / "fused.ply").read_bytes() == b"of COLMAP"
        left = {str(path.relative_to(state)) for path in state.rglob("*") if path.is_file()}
        images = {"originals.json", "images.json", *(f"state/{name}.undistorted.json" for name in NAMES)}
        assert left - {"log.txt"} == {
            *MINE,
            *images,
            "cloud.json",
            "report.json",
            "report.html",
            "undistortion.json",
        }
        assert not list(finished.dense.glob("stereo/*_maps/*"))
    assert all((state / name).read_text() == "mine" for name in MINE)


# ---- damage that the samples do not show -------------------------------------------------------------------


def spoil(path: Path) -> None:
    """Let depths or normals be off by 3 % in a place that no sampled block reaches, deep inside of the file."""
    data = bytearray(path.read_bytes())
    last = len(data) - 4096
    starts = [last * index // 15 for index in range(16)]
    first = -(-(starts[7] + 4096) // 4) * 4 + 8
    header = data.index(b"&", data.index(b"&", data.index(b"&") + 1) + 1) + 1
    first += (header - first) % 4
    assert first + 64 < starts[8]
    values = np.frombuffer(bytes(data[first : first + 64]), "<f4") * np.float32(1.03) + np.float32(1e-3)
    data[first : first + 64] = values.tobytes()
    path.write_bytes(data)


MAPS = ["depth_maps/N_0_1.jpg.geometric.bin", "normal_maps/N_0_1.jpg.geometric.bin"]


@pytest.mark.parametrize("method", ["best-pixel", "colmap"])
@pytest.mark.parametrize("name", MAPS)
def test_a_map_damaged_deep_inside_is_noticed_as_it_is_read(name: str, method: Any, finished: Finished) -> None:
    options: dict[str, Any] = {"fusion": FusionOptions(method=method, max_reproj_error=0.7)}
    path = finished.dense / "stereo" / name
    whole = path.read_bytes()
    spoil(path)
    spoilt = path.read_bytes()
    assert spoilt != whole
    assert finished.rerun().made == NOTHING  # samples do not show it
    report = finished.rerun(**options)
    assert list(report.skipped_images) == [NAMES[1]]
    assert name in report.skipped_images[NAMES[1]]
    assert "is not what this program wrote" in report.skipped_images[NAMES[1]]
    again = finished.rerun(**options)
    assert again.skipped_images == {}
    assert again.made == NOTHING | {"confirm depth": 1, "fuse": 1}
    assert path.read_bytes() == whole
    assert backups(finished.dense) == {f"stereo/{name}.backup": spoilt}
    assert finished.rerun(**options).made == NOTHING


DAMAGED = {
    f"stereo/{MAPS[0]}": {"confirm depth": 1},
    f"stereo/{MAPS[1]}": {"confirm depth": 1},
    "fused.ply": {"fuse": 1},
}


@pytest.mark.parametrize("name", DAMAGED)
def test_verify_finds_what_the_samples_do_not_show(
    name: str, finished: Finished, caplog: pytest.LogCaptureFixture
) -> None:
    before = contents(finished.dense)
    assert finished.rerun(verify=True).made == NOTHING
    path = finished.dense / name
    if name == "fused.ply":
        data = bytearray(path.read_bytes())
        data[5000] ^= 1  # the first block ends at 4096, the second begins later
        assert (len(data) - 4096) // 15 > 5001
        path.write_bytes(data)
    else:
        spoil(path)
    assert finished.rerun().made == NOTHING
    report = finished.rerun(verify=True)
    assert report.made == NOTHING | DAMAGED[name]
    assert f"Damaged, and made again: {path}" in caplog.text
    assert contents(finished.dense) == before


@pytest.mark.parametrize(("folder", "made"), [("pairs", "match pairs"), ("photometric", "vote on depth")])
def test_verify_finds_damaged_intermediate_results(folder: str, made: str, finished: Finished) -> None:
    before = contents(finished.dense)
    path = min(finished.dense.glob(f"colmap_sph/{folder}/**/*.sph"))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert finished.rerun().made == NOTHING
    assert finished.rerun(verify=True).made == NOTHING | {made: 1}
    assert contents(finished.dense) == before


def test_the_command_has_verify(finished: Finished, capsys: pytest.CaptureFixture[str]) -> None:
    spoil(finished.dense / f"stereo/{MAPS[0]}")
    assert cli.main(["run", "--workspace", str(finished.dense), "--threads", "2", "--verify"]) == 0
    assert "Damaged, and made again" in capsys.readouterr().err


@pytest.mark.parametrize("flaw", ["long", "short", "nan", "inf", "huge", "tiny", "depth inf", "depth nan"])
def test_maps_that_no_run_makes_are_not_fused(flaw: str, finished: Finished) -> None:
    """In a workspace from a stranger, whose records vouch for them."""
    name = NAMES[1]
    workspace = Workspace(finished.dense)
    maps = MapFiles(
        workspace.depth_map_path(name, "geometric"),
        workspace.normal_map_path(name, "geometric"),
        workspace.records_dir / f"{name}.geometric.json",
    )
    key = json.loads(maps.record.read_bytes())["key"]
    depth, normals = read_depth_map(maps.depth), read_normal_map(maps.normals)
    row, col = np.argwhere(depth > 0)[1000]
    original = normals.copy()
    if flaw.startswith("depth"):
        depth[row, col] = 12345.0
    else:
        normals[row, col] = {"long": 1.1, "short": 0.5, "nan": 7.0, "inf": 7.0, "huge": 1e30, "tiny": 1e-25}[
            flaw
        ] * normals[row, col]
    maps.write(normals, depth, key)
    value = np.float32({"nan": np.nan, "inf": np.inf, "depth inf": np.inf, "depth nan": np.nan}.get(flaw, 0))
    if value != 0:  # which the writer would not let through
        path = maps.depth if flaw.startswith("depth") else maps.normals
        place = 4 * (row * depth.shape[1] + col)
        data = bytearray(path.read_bytes())
        header = len(data) - 4 * depth.size * (1 if flaw.startswith("depth") else 3)
        data[header + place : header + place + 4] = value.tobytes()
        path.write_bytes(data)
        vouch_again(maps, key)
    report = finished.rerun(**OTHER_FUSION)
    assert list(report.skipped_images) == [name]
    assert ("not finite" if flaw.startswith("depth") else "not of unit length") in report.skipped_images[name]
    again = finished.rerun(**OTHER_FUSION)
    assert again.skipped_images == {}
    assert np.array_equal(read_normal_map(maps.normals), original)


def vouch_again(maps: MapFiles, key: str) -> None:
    vouch(
        maps.record, key, {path: whole_digest(path) for path in (maps.depth, maps.normals)}, MapFacts(0.5, 0, 0, 0)
    )


# ---- the disk ----------------------------------------------------------------------------------------------


@pytest.fixture
def operations(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, str]]]:
    """Syncs and renames, in their order, by the names of files and folders."""
    done: list[tuple[str, str]] = []
    fsync, replace = os.fsync, Path.replace

    def note_sync(descriptor: int) -> None:
        fsync(descriptor)
        done.append(("sync", str(Path(f"/proc/self/fd/{descriptor}").readlink())))

    def note_rename(path: Path, target: Path) -> Path:
        result = replace(path, target)
        done.append(("rename", f"{path} {target}"))
        return result

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "replace", note_rename)
    yield done


def test_files_are_on_the_disk_before_a_record_vouches_for_them(
    finished: Finished, operations: list[tuple[str, str]]
) -> None:
    """Names, then the files and their folders; the last writing of the record comes after all of them."""
    finished.rerun(overwrite=True, threads=1)
    workspace = Workspace(finished.dense)
    for name in NAMES:
        record = workspace.records_dir / f"{name}.geometric.json"
        depth = workspace.depth_map_path(name, "geometric")
        normals = workspace.normal_map_path(name, "geometric")
        check_order(operations, record, [depth, normals])
    cloud = workspace.cloud_record_path
    vouched = last_rename(operations, cloud)
    for path in workspace.cloud_paths:
        assert last(operations, ("sync", str(path))) < vouched
    assert last(operations[:vouched], ("sync", str(finished.dense))) > last_rename(
        operations, workspace.fused_path
    )


def check_order(operations: list[tuple[str, str]], record: Path, files: list[Path]) -> None:
    vouched = last_rename(operations, record)
    for path in files:
        renamed = last_rename(operations, path)
        for what in (path, path.parent):
            assert renamed < last(operations[:vouched], ("sync", str(what)))


def last(operations: list[tuple[str, str]], operation: tuple[str, str]) -> int:
    return max(place for place, each in enumerate(operations) if each == operation)


def last_rename(operations: list[tuple[str, str]], target: Path) -> int:
    return max(n for n, (kind, what) in enumerate(operations) if kind == "rename" and what.endswith(f" {target}"))


def test_maps_written_by_hand_are_read(tmp_path: Path) -> None:
    """Digests are those of the files."""
    depth = np.arange(12, dtype=np.float32).reshape(3, 4)
    digest = write_depth_map(tmp_path / "a.bin", depth)
    assert np.array_equal(read_depth_map(tmp_path / "a.bin", digest), depth)
    with pytest.raises(InputError, match="is not what this program wrote"):
        read_depth_map(tmp_path / "a.bin", "0" * 32)
    normals = np.zeros((3, 4, 3), np.float32)
    assert write_normal_map(tmp_path / "n.bin", normals) != digest


def test_results_that_stay_are_not_rewritten_by_verify(finished: Finished) -> None:
    before = results(finished.dense)
    finished.rerun(verify=True)
    assert rewritten(before, finished.dense) == set()
