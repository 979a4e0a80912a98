"""Exact maps of a slanted plane through COLMAP's own fusion: pixel origin, layout and signs of what we write.

And the gates that take points away, named rightly; and Debian's COLMAP against pycolmap.
"""

import os
import shutil
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pytest
from clouds import read_fused, read_visibility
from exact_maps import GSD, HEIGHT, NORMAL, WIDTH, make_workspace, stored_maps, write_maps
from refusals import assert_refused

from colmap_sph.errors import InputError, OptionError, OutputError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.colmap_fusion import fuse_by_colmap
from colmap_sph.project.map_files import read_depth_map, read_normal_map, write_depth_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.fusion_losses import explain_losses

COLMAP_DEFAULTS = FusionOptions(method="colmap", min_num_pixels=5, max_reproj_error=2.0, max_normal_error=10.0)
# Our defaults of the options that COLMAP has, too.
OURS = FusionOptions(method="colmap")


@pytest.fixture
def workspace(tmp_path):
    return make_workspace(tmp_path / "dense")


# ---- what is fused -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [OURS, COLMAP_DEFAULTS], ids=["ours", "COLMAP's"])
def test_exact_maps_fuse_to_the_true_plane(workspace, options):
    count = fuse_by_colmap(workspace, options.for_colmap(), threads=1)
    cloud = read_fused(workspace.fused_path)
    assert count == len(cloud) > WIDTH * HEIGHT / 5
    distance = cloud["xyz"].astype(float) @ NORMAL
    # Not zero, as COLMAP takes the median of each coordinate of the pixels it merges.
    assert abs(distance.mean()) < 0.01 * GSD
    assert np.median(np.abs(distance)) < 0.05 * GSD
    assert np.abs(distance).max() < 0.5 * GSD
    # Towards the cameras, which are all above.
    np.testing.assert_allclose(cloud["normal"] @ NORMAL, 1, atol=1e-5)
    assert not any((workspace.state_dir).iterdir())


def test_half_a_pixel_would_show(tmp_path):
    """The measure above can tell depths of pixel centres from depths at COLMAP's pixel origin."""
    workspace = make_workspace(tmp_path / "dense", origin=0.5)
    fuse_by_colmap(workspace, OURS.for_colmap(), threads=1)
    distance = read_fused(workspace.fused_path)["xyz"] @ NORMAL
    assert abs(distance.mean()) > 0.2 * GSD


def test_visibility_lists_the_images_of_each_point(workspace):
    count = fuse_by_colmap(workspace, COLMAP_DEFAULTS.for_colmap(), threads=1)
    cloud = read_fused(workspace.fused_path)
    visible = read_visibility(workspace.fused_path.with_name("fused.ply.vis"))
    views = read_scene(workspace.sparse_dir).views
    assert len(visible) == count
    assert min(len(set(images)) for images in visible) >= 2
    for index, view in enumerate(views):
        seen = cloud["xyz"][[index in images for images in visible]].astype(float)
        pixel = (seen @ view.R.T + view.t) @ view.K.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        assert len(seen) > 1000
        assert (pixel > -3).all()
        assert (pixel < [WIDTH + 2, HEIGHT + 2]).all()


def test_options_reach_colmap(workspace, tmp_path):
    every = fuse_by_colmap(workspace, OURS.for_colmap(), threads=1)
    assert fuse_by_colmap(workspace, replace(OURS, min_num_pixels=4).for_colmap(), threads=1) < 0.8 * every
    masks = tmp_path / "masks"
    masks.mkdir()
    for name in "abcdef":
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, : WIDTH // 2] = 0
        cv2.imwrite(str(masks / f"{name}.png.png"), mask)
    masked = fuse_by_colmap(workspace, replace(OURS, mask_path=masks).for_colmap(), threads=1)
    assert 0.3 * every < masked < 0.7 * every
    for name in "abcdef":
        (masks / f"{name}.png.png").rename(masks / f"{name}.png")
    assert fuse_by_colmap(workspace, replace(OURS, mask_path=masks).for_colmap(), threads=1) == masked
    (masks / "c.png").write_bytes((masks / "c.png").read_bytes()[:-20])
    with pytest.raises(InputError, match=r"c\.png is damaged"):
        fuse_by_colmap(workspace, replace(OURS, mask_path=masks).for_colmap(), threads=1)


def test_photometric_maps(workspace):
    for folder in ("depth_maps", "normal_maps"):
        for path in (workspace.stereo_dir / folder).iterdir():
            path.rename(path.with_name(path.name.replace("geometric", "photometric")))
    assert fuse_by_colmap(workspace, OURS.for_colmap(), threads=1, kind="photometric") > WIDTH * HEIGHT


def test_a_model_without_tracks_fuses_by_partners(tmp_path):
    """COLMAP finds no overlapping image without tracks; ours gives the same cloud as with them."""
    expected = fuse_by_colmap(make_workspace(tmp_path / "tracks"), OURS.for_colmap(), threads=1)
    workspace = make_workspace(tmp_path / "none", tracks=False)
    names = workspace.fusion_cfg_path.read_text().split()
    model = {path.name: path.read_bytes() for path in workspace.sparse_dir.iterdir()}
    assert fuse_by_colmap(workspace, OURS.for_colmap(), threads=1) == 0
    partners = {name: [other for other in names if other != name] for name in names}
    # Not to the point: COLMAP visits the images in the order of what they share.
    count = fuse_by_colmap(workspace, OURS.for_colmap(), threads=1, partners=partners)
    assert count == pytest.approx(expected, rel=0.02)
    assert {path.name: path.read_bytes() for path in workspace.sparse_dir.iterdir()} == model
    assert workspace.images_dir.is_dir()
    assert workspace.depth_map_path("a.png", "geometric").is_file()
    assert not any(workspace.state_dir.iterdir())


def test_debian_colmap_agrees(finished, tmp_path):
    """COLMAP 3.8 and pycolmap 4 read the same workspace of ours and fuse as many points, within 5 %."""
    program = shutil.which("colmap")
    if program is None:
        pytest.skip("the colmap program is not installed (Debian: apt-get install colmap)")
    output = tmp_path / "fused.ply"
    done = subprocess.run(
        [program, "stereo_fusion", "--workspace_path", finished.dense, "--output_path", output],
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    dense = tmp_path / "dense"
    shutil.copytree(finished.dense, dense, ignore=shutil.ignore_patterns("colmap_sph"))
    ours = fuse_by_colmap(Workspace(dense), COLMAP_DEFAULTS.for_colmap())
    theirs = len(read_fused(output))
    assert ours > 10_000
    assert theirs == pytest.approx(ours, rel=0.05)


# ---- which gate took the points ----------------------------------------------------------------------------


def spoil_normals(workspace, names):
    rng = np.random.default_rng(0)
    for name in names:
        normals = rng.standard_normal((HEIGHT, WIDTH, 3))
        write_maps(workspace, name, normals=normals / np.linalg.norm(normals, axis=2, keepdims=True))


def interleave_normals(workspace, names):
    """The planar file filled with interleaved memory, as pycolmap 4.2.1 would write it."""
    for name in names:
        normals = read_normal_map(workspace.normal_map_path(name, "geometric"))
        write_maps(workspace, name, normals=np.moveaxis(normals.reshape(3, HEIGHT, WIDTH), 0, 2))


def scale_depths(workspace, names):
    for factor, name in enumerate(names):
        depth = read_depth_map(workspace.depth_map_path(name, "geometric"))
        write_maps(workspace, name, depth=depth * (1 + 0.05 * factor))


def remove_depths(workspace, names):
    for name in names[1:]:
        write_maps(workspace, name, depth=np.zeros((HEIGHT, WIDTH)))


@pytest.mark.parametrize(
    ("spoil", "options", "gate"),
    [
        (spoil_normals, replace(OURS, min_num_pixels=4), "normal"),
        (interleave_normals, COLMAP_DEFAULTS, "normal"),
        (scale_depths, OURS, "depth"),
        (remove_depths, OURS, "unseen"),
        (None, replace(OURS, max_reproj_error=0.02), "reprojection"),
        (None, OURS, "kept"),
    ],
    ids=["normals", "interleaved normals", "depths", "no depths", "narrow gate", "nothing"],
)
def test_the_gate_that_takes_the_points_is_named(workspace, spoil, options, gate):
    if spoil:
        spoil(workspace, workspace.fusion_cfg_path.read_text().split())
    losses = explain_losses(stored_maps(workspace), read_scene(workspace.sparse_dir), options)
    shares = {name: getattr(losses, name) for name in ("unseen", "depth", "reprojection", "normal", "kept")}
    assert sum(shares.values()) == pytest.approx(1)
    assert max(shares, key=shares.__getitem__) == gate
    assert shares[gate] > 0.5
    option = {"normal": "max-normal-error", "depth": "max-depth-error", "reprojection": "max-reproj-error"}
    assert gate not in option or f"loosen --fusion.{option[gate]} or" in losses.sentence()
    # COLMAP's own fusion loses (or keeps) the points indeed.
    count = fuse_by_colmap(workspace, options.for_colmap(), threads=1)
    assert (count > WIDTH * HEIGHT / 5) == (gate == "kept")


def test_only_overlapping_views_are_compared(workspace):
    """In a large block a view's losses are counted against its neighbours, wherever they are in the list."""
    scene = read_scene(workspace.sparse_dir)
    far = [
        replace(
            view,
            name=f"{name}{k}.png",
            t=view.t + np.array([1000.0, 0, 0]),
            point_indices=view.point_indices[:0],
        )
        for k in range(4)
        for name, view in zip("abcdef", scene.views, strict=True)
    ]
    for view in far:
        write_maps(workspace, view.name, np.zeros((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH, 3)))
    block = replace(scene, views=tuple(sorted((*scene.views, *far), key=lambda view: view.name)))
    assert explain_losses(stored_maps(workspace), block, OURS, max_views=5).kept > 0.9


# ---- bad input ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_num_pixels": 0},
        {"max_num_pixels": 0},
        {"max_num_pixels": 4, "min_num_pixels": 5},
        {"max_traversal_depth": 0},
        {"check_num_images": -1},
        {"max_reproj_error": 0.0},
        {"max_depth_error": float("nan")},
        {"max_normal_error": -1.0},
        {"cache_size": 0.0},
    ],
    ids=str,
)
def test_options_out_of_bounds(wrong):
    assert_refused(FusionOptions(**wrong), *wrong)
    with pytest.raises(OptionError):
        RunOptions(fusion=FusionOptions(**wrong)).check()


@pytest.mark.parametrize("blocked", ["fused.ply", "fused.ply.vis", "colmap_sph"])
def test_unwritable_output(workspace, blocked):
    path = workspace.root / blocked
    if blocked == "colmap_sph":
        path.rmdir()
        path.write_bytes(b"")
    else:
        path.mkdir()
    before = sorted(workspace.root.rglob("*"))
    with pytest.raises(OutputError, match=blocked):
        fuse_by_colmap(workspace, OURS.for_colmap(), threads=1)
    assert sorted(workspace.root.rglob("*")) == before


def test_a_missing_map_is_named(workspace):
    path = workspace.normal_map_path("c.png", "geometric")
    path.unlink()
    with pytest.raises(InputError, match=str(path)):
        fuse_by_colmap(workspace, OURS.for_colmap())


def test_fusion_cfg_that_does_not_fit(workspace):
    workspace.fusion_cfg_path.write_text("a.png\nz.png\n")
    with pytest.raises(InputError, match=r"z\.png"):
        fuse_by_colmap(workspace, OURS.for_colmap())
    workspace.fusion_cfg_path.unlink()
    with pytest.raises(InputError, match=r"fusion\.cfg"):
        fuse_by_colmap(workspace, OURS.for_colmap())


@pytest.mark.parametrize("kind", ["cut off", "other size", "no header"])
def test_a_damaged_map_is_named(workspace, kind):
    """COLMAP itself would fuse it without a word, or not say which it is."""
    path = workspace.depth_map_path("c.png", "geometric")
    if kind == "other size":
        write_depth_map(path, np.ones((HEIGHT, WIDTH - 1), np.float32))
    else:
        path.write_bytes(path.read_bytes()[:-100] if kind == "cut off" else b"\0" * 100)
    with pytest.raises(InputError, match=str(path)):
        fuse_by_colmap(workspace, OURS.for_colmap())
    assert not workspace.fused_path.exists()
