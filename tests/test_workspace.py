"""Map files against COLMAP's reader and the format's bytes; configuration files; nothing half-written."""

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from colmap_sph.errors import InputError, OutputError, reason_of
from colmap_sph.project.files import atomic_file
from colmap_sph.project.map_files import read_depth_map, read_normal_map, write_depth_map, write_normal_map
from colmap_sph.project.pair_lists import read_patch_match_cfg, write_fusion_cfg, write_patch_match_cfg
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import SourceImages


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (PermissionError(13, "Permission denied", "some/file"), "Permission denied"),
        (ValueError("two\n  lines"), "two lines"),
        (MemoryError(), "MemoryError"),
    ],
)
def test_why_a_file_failed_is_said_in_one_line(error: Exception, words: str) -> None:
    assert reason_of(error) == words


@pytest.fixture
def depth() -> np.ndarray:
    return np.random.default_rng(1).uniform(1, 9, (5, 7)).astype(np.float32)


def test_paths_follow_colmap() -> None:
    workspace = Workspace(Path("dense"))
    assert workspace.images_dir == Path("dense/images")
    assert workspace.sparse_dir == Path("dense/sparse")
    expected = Path("dense/stereo/depth_maps/left/a.jpg.geometric.bin")
    assert workspace.depth_map_path("left/a.jpg", "geometric") == expected
    expected = Path("dense/stereo/normal_maps/a.jpg.photometric.bin")
    assert workspace.normal_map_path("a.jpg", "photometric") == expected


def test_a_name_leaves_room_for_the_endings_of_our_files(tmp_path: Path) -> None:
    """255 bytes are what a file system takes; a letter may be several."""
    longest = "ü" * 117 + ".jpg"
    (tmp_path / f"{longest}.photometric.json").touch()
    workspace = Workspace(tmp_path)
    assert workspace.image_path(longest).name == longest
    assert workspace.image_path(f"{'x' * 250}/a.jpg").name == "a.jpg"
    with pytest.raises(InputError, match="is longer than the 238 bytes"):
        workspace.image_path(f"x{longest}")


@pytest.mark.parametrize("name", ["../a.jpg", "/etc/a.jpg", "a/../../b.jpg", ""])
def test_names_stay_inside_the_workspace(name: str) -> None:
    with pytest.raises(InputError, match="leads out"):
        Workspace(Path("dense")).depth_map_path(name, "geometric")


def test_depth_map_is_read_by_colmap(tmp_path: Path, depth: np.ndarray) -> None:
    write_depth_map(tmp_path / "d.bin", depth)
    theirs = pycolmap.DepthMap()
    theirs.read(tmp_path / "d.bin")
    np.testing.assert_array_equal(theirs.to_array(), depth)
    np.testing.assert_array_equal(read_depth_map(tmp_path / "d.bin"), depth)


def test_depth_map_of_colmap_is_read(tmp_path: Path, depth: np.ndarray) -> None:
    pycolmap.DepthMap.from_array(depth, 0.1, 100.0).write(tmp_path / "d.bin")
    read = read_depth_map(tmp_path / "d.bin")
    np.testing.assert_array_equal(read, depth)
    assert read.dtype == np.float32
    read[0, 0] = 0  # writable


def test_normal_map_is_planar(tmp_path: Path) -> None:
    normals = np.random.default_rng(2).normal(size=(5, 7, 3)).astype(np.float32)
    path = tmp_path / "n.bin"
    write_normal_map(path, normals)
    data = path.read_bytes()
    assert data.startswith(b"7&5&3&")
    for channel, row, col in [(0, 0, 0), (1, 4, 6), (2, 3, 1)]:
        offset = len(b"7&5&3&") + 4 * (channel * 35 + row * 7 + col)
        assert struct.unpack_from("<f", data, offset)[0] == normals[row, col, channel]
    np.testing.assert_array_equal(read_normal_map(path), normals)


def test_values_that_are_not_finite_become_none(tmp_path: Path, depth: np.ndarray) -> None:
    depth[0, 0], depth[1, 1] = np.nan, np.inf
    normals = np.ones((2, 2, 3), np.float32)
    normals[0, 1, 2] = np.nan
    write_depth_map(tmp_path / "d.bin", depth)
    write_normal_map(tmp_path / "n.bin", normals)
    assert read_depth_map(tmp_path / "d.bin")[0, 0] == read_depth_map(tmp_path / "d.bin")[1, 1] == 0
    np.testing.assert_array_equal(read_normal_map(tmp_path / "n.bin")[0, 1], 0)


@given(cut=st.integers(0, 145))
def test_every_truncation_is_told(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    path = tmp_path_factory.mktemp("map") / "d.bin"
    write_depth_map(path, np.ones((5, 7), np.float32))
    data = path.read_bytes()
    assert len(data) == 146
    path.write_bytes(data[:cut])
    with pytest.raises(InputError, match=r"d\.bin"):
        read_depth_map(path)


@pytest.mark.parametrize("data", [b"7&5&1&" + bytes(141), b"7&5&3&" + bytes(420), b"-1&5&1&", b"PNG\x00", b""])
def test_garbage_is_told(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "d.bin").write_bytes(data)
    with pytest.raises(InputError, match=r"d\.bin"):
        read_depth_map(tmp_path / "d.bin")


def test_missing_map_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_normal_map(tmp_path / "none.bin")


def test_interrupted_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), atomic_file(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_targets(tmp_path: Path, depth: np.ndarray) -> None:
    with pytest.raises(OutputError, match=r"d\.bin cannot .* \(No such file .*\); its folder is not there"):
        write_depth_map(tmp_path / "no folder" / "d.bin", depth)
    (tmp_path / "d.bin").mkdir()
    with pytest.raises(OutputError, match=r"d\.bin cannot be written \(.*\); remove the folder"):
        write_depth_map(tmp_path / "d.bin", depth)
    assert [path.name for path in tmp_path.iterdir()] == ["d.bin"]
    (tmp_path / "dense").write_text("a file in the way")
    with pytest.raises(OutputError, match="dense"):
        Workspace(tmp_path / "dense").create_stereo_dirs(["a.jpg"])


def test_stereo_dirs_hold_names_with_folders(tmp_path: Path, depth: np.ndarray) -> None:
    workspace = Workspace(tmp_path / "dense")
    workspace.create_stereo_dirs(["cam/left/a.jpg", "b.jpg"])
    write_depth_map(workspace.depth_map_path("cam/left/a.jpg", "photometric"), depth)
    write_normal_map(workspace.normal_map_path("b.jpg", "geometric"), np.zeros((2, 2, 3), np.float32))
    assert workspace.state_dir.is_dir()


def test_fusion_cfg_is_names_only(tmp_path: Path) -> None:
    write_fusion_cfg(tmp_path / "fusion.cfg", ["b.jpg", "sub/ä c.jpg"])
    assert (tmp_path / "fusion.cfg").read_bytes() == "b.jpg\nsub/ä c.jpg\n".encode()


def test_patch_match_cfg_round_trip(tmp_path: Path) -> None:
    sources: dict[str, SourceImages] = {
        "a.jpg": ["b.jpg", "c d.jpg"],
        "b.jpg": 20,
        "c d.jpg": "__all__",
        "e.jpg": [],
    }
    write_patch_match_cfg(tmp_path / "patch-match.cfg", sources)
    del sources["e.jpg"]
    assert read_patch_match_cfg(tmp_path / "patch-match.cfg") == sources


def test_patch_match_cfg_as_users_write_it(tmp_path: Path) -> None:
    path = tmp_path / "patch-match.cfg"
    path.write_bytes(b"# my pairs\r\n\r\na.jpg\r\n b.jpg,c.jpg ,b.jpg\r\nb.jpg\r\n__auto__,7")
    assert read_patch_match_cfg(path) == {"a.jpg": ["b.jpg", "c.jpg"], "b.jpg": 7}


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a.jpg\nb.jpg\nb.jpg\n", 3),
        ("a.jpg\n__auto__, many\n", 2),
        ("a.jpg\n__auto__\n", 2),
        ("a.jpg\n__auto__, 0\n", 2),
        ("# c\na.jpg\na.jpg, b.jpg\n", 3),
        ("a.jpg\nb.jpg\na.jpg\nc.jpg\n", 3),
        ("a.jpg\n,,\n", 2),
        ("__all__\na.jpg\n", 1),
        ("a.jpg\n__every__\n", 2),
    ],
)
def test_malformed_patch_match_cfg_names_the_line(tmp_path: Path, text: str, line: int) -> None:
    path = tmp_path / "patch-match.cfg"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"patch-match\.cfg, line {line}:"):
        read_patch_match_cfg(path)
