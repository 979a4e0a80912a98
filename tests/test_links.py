"""Links in a workspace: none leads a run out of it, and those that only show where something is do their work."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import copy_block
from projects import read_picture

from colmap_sph.app import cli
from colmap_sph.project.files import atomic_file

IMAGES = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg"]
FAST = ["--threads", "2", "--num-pairs", "2"]


@pytest.fixture(scope="module")
def made(block, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project of three images with its finished workspace; not to be changed."""
    root = tmp_path_factory.mktemp("made")
    copy_block(block, root, IMAGES)
    assert cli.main(["run", "--model", str(root / "sparse/0"), *FAST]) == 0
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True, symlinks=True)
    return tmp_path


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and not path.is_symlink()}


def moved_out(root: Path, place: str) -> Path:
    """Put what is at a place of the workspace elsewhere, and a link to it there; files of others are with it."""
    path = root / "dense" / place
    target = root / "elsewhere"
    if path.exists():
        path.rename(target)
    elif path.suffix:
        target.write_text("mine")
    else:
        target.mkdir()
    if target.is_dir():
        (target / "mine.txt").write_text("mine")
        (target / ".1-2.tmp").write_text("mine, too")
    path.symlink_to(target)
    return path


WRITTEN = [
    "colmap_sph",
    "colmap_sph/log.txt",
    "colmap_sph/report.json",
    "colmap_sph/cloud.json",
    "colmap_sph/pairs",
    "colmap_sph/photometric",
    "colmap_sph/state",
    "colmap_sph/.fusion.tmp",
    "colmap_sph/undistorting",
    "colmap_sph/local",
    "stereo",
    "stereo/depth_maps",
    "stereo/depth_maps/sub",
    "stereo/normal_maps",
    "stereo/consistency_graphs",
    "stereo/fusion.cfg",
    "fused.ply",
    "fused.ply.vis",
]


@pytest.mark.parametrize("place", WRITTEN)
def test_a_link_out_of_the_workspace_is_refused(
    place: str, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = moved_out(root, place)
    before = content(root)
    for more in ([], ["--overwrite"], ["--dry-run"]):
        for project in (["--workspace", str(root / "dense")], ["--model", str(root / "sparse/0")]):
            assert cli.main(["run", *project, *FAST, *more]) == 3
            said = capsys.readouterr().err
            assert said.count("\n") == 1
            assert said.startswith(f"error: {link} is a link to {root / 'elsewhere'}, ")
    assert content(root) == before


@pytest.mark.parametrize("place", ["images", "sparse", "masks"])
def test_what_is_only_read_may_be_elsewhere(place: str, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With --workspace; a run with --model writes there."""
    if place == "masks":
        (root / "dense/masks").mkdir()
        shape = read_picture(root / "dense/images" / IMAGES[0]).shape[:2]
        cv2.imwrite(str(root / "dense/masks" / f"{IMAGES[0]}.png"), np.full(shape, 255, np.uint8))
    link = moved_out(root, place)
    before = content(root / "elsewhere")
    assert cli.main(["run", "--model", str(root / "sparse/0"), *FAST]) == 3
    assert f"{link} is a link" in capsys.readouterr().err
    assert cli.main(["run", "--workspace", str(root / "dense"), *FAST, "--overwrite"]) == 0
    assert content(root / "elsewhere") == before


def test_links_inside_of_the_workspace(made: Path, root: Path) -> None:
    """And one by which the workspace itself is reached, and those that this program leaves itself."""
    dense = root / "dense"
    (dense / "stereo/depth_maps").rename(dense / "depth")
    (dense / "stereo/depth_maps").symlink_to("../depth")
    for folder in ("local", ".fusion.tmp"):
        (dense / "colmap_sph" / folder).mkdir(exist_ok=True)
        (dense / "colmap_sph" / folder / "images").symlink_to(root / "images")
    (root / "alias").symlink_to(dense)
    before = content(root / "images")
    assert cli.main(["run", "--workspace", str(root / "alias"), *FAST, "--overwrite"]) == 0
    assert content(root / "images") == before
    for name in IMAGES:
        path = f"stereo/depth_maps/{name}.geometric.bin"
        assert (dense / path).read_bytes() == (made / "dense" / path).read_bytes()
    assert (dense / "fused.ply").read_bytes() == (made / "dense/fused.ply").read_bytes()


def test_a_link_behind_a_link(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The first stays inside, the second, in a folder that no run looks at otherwise, leads out."""
    dense = root / "dense"
    (root / "elsewhere").mkdir()
    (dense / "stereo/depth_maps").rename(dense / "depth")
    (dense / "stereo/depth_maps").symlink_to("../depth")
    (dense / "depth/sub").symlink_to(root / "elsewhere")
    assert cli.main(["run", "--workspace", str(dense), *FAST, "--overwrite"]) == 3
    assert "depth_maps/sub is a link to" in capsys.readouterr().err
    assert not list((root / "elsewhere").iterdir())


@pytest.mark.parametrize("target", ["../nowhere", "loop", "/dev/null"])
def test_links_to_nothing(target: str, root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = root / "dense/colmap_sph/loop"
    link.symlink_to(target)
    shutil.rmtree(root / "dense/colmap_sph/pairs")
    (root / "dense/colmap_sph/pairs").symlink_to(link)
    code = cli.main(["run", "--workspace", str(root / "dense"), *FAST])
    said = capsys.readouterr().err
    assert code == 3
    assert "Traceback" not in said
    assert not (root / "dense/nowhere").exists()


def test_an_atomic_file_writes_through_no_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither where its temporary name is taken, nor where its own is."""
    monkeypatch.setattr("os.getpid", lambda: 1)
    monkeypatch.setattr("socket.gethostname", lambda: "host")
    monkeypatch.setattr("threading.get_ident", lambda: 2)
    (tmp_path / "victim").write_text("mine")
    for name in (".host-1-2-0.tmp", "report.json"):
        (tmp_path / name).symlink_to("victim")
    with atomic_file(tmp_path / "report.json") as file:
        file.write(b"new")
    assert (tmp_path / "victim").read_text() == "mine"
    assert (tmp_path / "report.json").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "victim"]
