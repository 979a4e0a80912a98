"""A cloud in tiles is the cloud in one file, cut between images; nothing of others is lost; damage is found."""

import json
from itertools import chain
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from clouds import read_fused, read_points, read_visibility
from exact_maps import NAMES, make_workspace
from test_fuse_stage import UTM, context_of, fuse, stage_of

from colmap_sph.errors import InputError, OptionError
from colmap_sph.evaluation import read_geometry
from colmap_sph.pages import write_page
from colmap_sph.pages.whole_cloud import CloudServer
from colmap_sph.pipeline.execute import execute
from colmap_sph.project.cloud_reader import read_some_of_tiles
from colmap_sph.project.cloud_tiles import read_index
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.ownership import damaged_files, remove_recorded, tiles_place
from colmap_sph.stereo.fusion import FusionOptions

MOST = 9000
TILED = {"fusion": FusionOptions(max_points_per_file=MOST)}


@pytest.fixture
def workspace(tmp_path):
    return make_workspace(tmp_path / "dense")


def tiles_of(workspace):
    """Paths of the tiles, as the index has them, read without the program's own reader."""
    content = json.loads((workspace.root / "fused_tiles/index.json").read_text())
    return content, [workspace.root / "fused_tiles" / tile["file"] for tile in content["tiles"]]


def as_set(points, visible):
    return sorted((point.tobytes(), seen) for point, seen in zip(points, visible, strict=True))


def test_tiles_hold_the_points_of_the_one_file(workspace):
    """All of them with who sees them, each once; in every tile no more than asked for, in the box that is told."""
    fuse(workspace)
    whole = read_fused(workspace.fused_path)
    seen = read_visibility(workspace.visibility_path)
    assert len(whole) > 2 * MOST
    report = fuse(workspace, **TILED)
    content, paths = tiles_of(workspace)
    assert report.tiles == len(paths) > 2 and report.points == content["points"] == len(whole)
    assert not workspace.fused_path.exists() and not workspace.visibility_path.exists()
    tiles = [read_fused(path) for path in paths]
    listed = [read_visibility(path.with_name(f"{path.name}.vis")) for path in paths]
    assert as_set(np.concatenate(tiles), list(chain(*listed))) == as_set(whole, seen)
    for tile, told in zip(tiles, content["tiles"], strict=True):
        assert len(tile) == told["points"] <= MOST
        np.testing.assert_allclose(told["box"], [tile["xyz"].min(axis=0), tile["xyz"].max(axis=0)], rtol=1e-6)
    np.testing.assert_array_equal(read_points(workspace.tiles_dir / "index.json"), np.concatenate(tiles)["xyz"])


def test_the_cloud_changes_between_file_and_tiles(workspace):
    fuse(workspace, **TILED)
    first = {path: path.read_bytes() for path in tiles_of(workspace)[1]}
    made = {path: path.stat().st_mtime_ns for path in first}
    context = context_of(workspace, **TILED)
    execute(stage_of(context))
    assert context.report.reused == {"fuse": 1} and context.report.tiles == len(first)
    assert {path: path.stat().st_mtime_ns for path in first} == made
    fuse(workspace)
    assert workspace.fused_path.exists() and not workspace.tiles_dir.exists()
    fuse(workspace, **TILED)
    assert {path: path.read_bytes() for path in first} == first


@pytest.mark.parametrize("what", ["a file of mine", "a changed tile", "nobody's folder"])
def test_nothing_of_others_is_lost(workspace, what):
    mine = workspace.tiles_dir / "0000.ply"
    if what == "nobody's folder":
        mine.parent.mkdir()
    else:
        fuse(workspace, **TILED)
    if what == "a file of mine":
        mine = workspace.tiles_dir / "notes.txt"
    mine.write_bytes(b"mine")
    fuse(workspace, fusion=FusionOptions(max_points_per_file=MOST + 1))
    assert (workspace.root / "fused_tiles.backup" / mine.name).read_bytes() == b"mine"
    assert len(list((workspace.root / "fused_tiles.backup").iterdir())) == 1
    assert tiles_of(workspace)[0]["points"] > 2 * MOST


def test_a_cloud_of_another_program_is_kept_beside_tiles(workspace):
    workspace.fused_path.write_bytes(b"mine")
    fuse(workspace, **TILED)
    assert workspace.fused_path.with_name("fused.ply.backup").read_bytes() == b"mine"


def test_missing_and_damaged_tiles_are_made_again(workspace):
    fuse(workspace, **TILED)
    _, paths = tiles_of(workspace)
    content = paths[1].read_bytes()
    paths[1].unlink()
    assert fuse(workspace, **TILED).made == {"fuse": 1}
    assert paths[1].read_bytes() == content
    paths[1].write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert damaged_files(tiles_place(workspace)) == [paths[1]]
    assert fuse(workspace, **TILED).made == {"fuse": 1}
    assert paths[1].read_bytes() == content


def test_an_index_that_leads_elsewhere_is_none(workspace):
    fuse(workspace, **TILED)
    path = workspace.tiles_dir / "index.json"
    content = json.loads(path.read_text())
    for file in ("../0000.ply", "/etc/passwd", "0000.ply/../../x"):
        content["tiles"][0]["file"] = file
        path.write_text(json.dumps(content))
        assert read_index(workspace.tiles_dir) is None
        with pytest.raises(InputError, match="index of tiles"):
            read_geometry(path)


def test_tiles_go_with_the_other_results(workspace):
    fuse(workspace, **TILED)
    remove_recorded(workspace)
    assert not workspace.tiles_dir.exists()


@pytest.mark.parametrize("limit", [0, MOST])
def test_without_visibility(workspace, limit):
    """The same points, and no such file; one of an earlier run goes."""
    fuse(workspace, fusion=FusionOptions(max_points_per_file=limit))
    before = read_some(workspace)
    options = FusionOptions(visibility=False, max_points_per_file=limit)
    fuse(workspace, fusion=options)
    np.testing.assert_array_equal(read_some(workspace), before)
    assert not list(workspace.root.rglob("*.vis"))
    context = context_of(workspace, fusion=options)
    execute(stage_of(context))
    assert context.report.reused == {"fuse": 1}
    fuse(workspace, fusion=FusionOptions(max_points_per_file=limit))
    assert list(workspace.root.rglob("*.vis"))


def read_some(workspace):
    path = workspace.fused_path
    return read_points(path if path.exists() else workspace.tiles_dir / "index.json")


def test_map_coordinates(workspace, tmp_path):
    """Tiles are in them, as 64-bit floats, and boxes are; no cloud near the origin is left behind."""
    fuse(workspace, **TILED)
    far = make_workspace(tmp_path / "far")
    model = pycolmap.Reconstruction(far.sparse_dir)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
    model.write_binary(far.sparse_dir)
    fuse(far)
    fuse(far, **TILED)
    np.testing.assert_allclose(read_some(far) - UTM, read_some(workspace), rtol=0, atol=3e-6)
    boxes = [np.array([tile["box"] for tile in tiles_of(one)[0]["tiles"]]) for one in (workspace, far)]
    np.testing.assert_allclose(boxes[1] - UTM, boxes[0], rtol=0, atol=3e-6)
    assert not far.local_dir.exists() and not list(far.tiles_dir.glob("*.near"))


def test_the_page_shows_them_and_the_full_view_says_what_to_do(workspace):
    fuse(workspace, **TILED)
    index = read_index(workspace.tiles_dir)
    assert index is not None
    points, colours, total = read_some_of_tiles(workspace.tiles_dir, index, 1000)
    assert total == index.points and 500 < len(points) == len(colours) < 2000
    write_page(workspace)
    page = workspace.page_path.read_text()
    assert f"{total:,} points" in page and "fused_tiles" in page and "fused.ply" not in page
    with pytest.raises(InputError, match=r"tiles, and --full shows one file.*--fusion\.max-points-per-file 0"):
        CloudServer(workspace)


def test_bounds():
    with pytest.raises(OptionError, match="max_points_per_file must be at least 1, or 0"):
        FusionOptions(max_points_per_file=-1).check()


def test_images_are_whole(workspace):
    """One that has more points than a file may is in a tile of its own."""
    fuse(workspace, fusion=FusionOptions(max_points_per_file=1))
    with_points = {view.name for view in read_scene(workspace.sparse_dir).views}
    assert len(tiles_of(workspace)[1]) == len(NAMES) == len(with_points)


def test_interrupted_joining_leaves_no_tiles(workspace, monkeypatch):
    """What is not complete is not in its place."""
    fuse(workspace)
    before = workspace.fused_path.read_bytes()

    def fail(path: Path) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("colmap_sph.project.cloud_tiles.whole_digest", fail)
    with pytest.raises(KeyboardInterrupt):
        fuse(workspace, **TILED)
    assert workspace.fused_path.read_bytes() == before and not workspace.tiles_dir.exists()
