"""The cloud of a workspace with exact maps: its files, what a run may be given, and what may go wrong."""

import shutil
import subprocess
import threading
import tracemalloc
from contextlib import contextmanager

import cv2
import numpy as np
import pycolmap
import pytest
from clouds import read_fused, read_points, read_visibility
from exact_maps import GSD, HEIGHT, NAMES, NORMAL, WIDTH, make_workspace, write_maps

from colmap_sph.errors import InputError, NoResultError, OptionError, OutputError
from colmap_sph.evaluation import Mesh, read_geometry
from colmap_sph.pipeline import memory
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.memory import parse_memory
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages import cloud as cloud_module
from colmap_sph.pipeline.stages import fuse as fuse_module
from colmap_sph.pipeline.stages import fusion_parts as parts_module
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.fuse import fuse_stage
from colmap_sph.pipeline.stages.stage import Result
from colmap_sph.project.cloud_files import join_parts, write_part
from colmap_sph.project.colmap_fusion import fuse_by_colmap
from colmap_sph.project.files import whole_digest
from colmap_sph.project.map_files import read_depth_map, write_depth_map
from colmap_sph.project.pair_lists import write_fusion_cfg
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import POINT
from colmap_sph.stereo import fusion
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.fusion import FusionOptions, PackedMaps

UTM = np.array([5e5 + 1 / 3, 5e6 + 1 / 7, 300.0])


@pytest.fixture
def workspace(tmp_path):
    return make_workspace(tmp_path / "dense")


def context_of(workspace, scene=None, **options):
    """A run that has come to its last stage."""
    run_options = RunOptions(**{"threads": 1, **options})
    scene = scene or read_scene(workspace.sparse_dir)
    context = Context(workspace, scene, run_options, Keys(workspace, run_options))
    context.report.coverage = {view.name: 1.0 for view in context.scene.views}
    return context


def fuse(workspace, pairs=(), scene=None, **options):
    """Run the stage; its report."""
    context = context_of(workspace, scene, **options)
    execute(stage_of(context, pairs))
    return context.report


def stage_of(context, pairs=()):
    """The stage, after one that gave every image the coverage in the report."""
    coverage = context.report.coverage
    maps = {view.name: Result("key", False, Facts(coverage[view.name])) for view in context.scene.views}
    return fuse_stage(context, dict.fromkeys(pairs, "key"), maps)


def cloud_bytes(workspace):
    return [workspace.root.joinpath(name).read_bytes() for name in ("fused.ply", "fused.ply.vis")]


def seen_as_listed(workspace, image_ids, cloud, visible):
    """Share of the listings (point, image) whose image has the point in view, where `image_ids` are numbered."""
    views = {view.image_id: view for view in read_scene(workspace.sparse_dir).views}
    right = total = 0
    for number, image_id in enumerate(image_ids):
        view = views[image_id]
        seen = cloud["xyz"][[number in listed for listed in visible]].astype(float)
        pixel = (seen @ view.R.T + view.t) @ view.K.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        inside = (pixel > -2.6) & (pixel < [view.width + 1.6, view.height + 1.6])
        right += int(inside.all(axis=1).sum())
        total += len(seen)
    return right / total


# ---- the files ---------------------------------------------------------------------------------------------


def test_the_cloud_is_the_plane(workspace):
    report = fuse(workspace)
    cloud = read_fused(workspace.fused_path)
    # Nothing hides and the images are alike: as dense as one of them, over somewhat more than one.
    assert WIDTH * HEIGHT < report.points == len(cloud) < 3 * WIDTH * HEIGHT
    assert np.abs(cloud["xyz"].astype(float) @ NORMAL).max() < 1e-5
    np.testing.assert_allclose(cloud["normal"] @ NORMAL, 1, atol=1e-6)
    assert cloud["rgb"].std() > 20
    assert report.made["fuse"] == 1
    assert report.seconds["fuse"] > 0
    assert not (workspace.fusion_scratch_dir).exists()
    assert fuse(workspace).made["fuse"] == 0


def test_an_anchored_scene_gives_the_cloud_in_the_models_coordinates(workspace):
    """Its origin is a camera; the plane lies where it did, to a thousandth of what a pixel covers, 0.07 units."""
    scene = anchored(read_scene(workspace.sparse_dir))
    assert np.linalg.norm(scene.anchor) > 9
    fuse(workspace, scene=scene)
    cloud = read_fused(workspace.fused_path)
    assert len(cloud) > WIDTH * HEIGHT
    assert np.abs(cloud["xyz"].astype(float) @ NORMAL).max() < 1e-4


def test_visibility_names_images_as_colmap_does(tmp_path):
    """By their place among the model's registered images, which is not the order of their names."""
    workspace = make_workspace(tmp_path / "dense", names=[f"{letter}.png" for letter in "dbface"])
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    model.deregister_frame(model.image(3).frame_id)
    model.write_binary(workspace.sparse_dir)
    views = read_scene(workspace.sparse_dir).views
    write_fusion_cfg(workspace.fusion_cfg_path, [view.name for view in views])
    image_ids = [1, 2, 4, 5, 6]
    by_name = [view.image_id for view in views]
    assert sorted(by_name) == image_ids != by_name

    def shares():
        cloud, visible = read_fused(workspace.fused_path), read_visibility(workspace.root / "fused.ply.vis")
        assert len(cloud) == len(visible) > 5000
        assert min(map(len, visible)) >= 2
        assert {index for listed in visible for index in listed} == set(range(5))
        return [seen_as_listed(workspace, ids, cloud, visible) for ids in (image_ids, by_name)]

    fuse_by_colmap(workspace, FusionOptions(max_reproj_error=2.0).for_colmap(), threads=1)
    theirs = shares()
    fuse(workspace)
    for right, wrong in (theirs, shares()):
        assert right == 1
        assert wrong < 0.99


def test_files_are_colmaps_to_the_byte_but_for_their_points(workspace):
    """The same header; positions, normals and colours as 27 bytes; a count and as many lists."""
    fuse_by_colmap(workspace, FusionOptions().for_colmap(), threads=1)
    theirs = workspace.fused_path.read_bytes().partition(b"end_header\n")
    fuse(workspace)
    ours = workspace.fused_path.read_bytes().partition(b"end_header\n")

    def without_count(header):
        return [line for line in header.splitlines() if not line.startswith(b"element vertex")]

    assert without_count(ours[0]) == without_count(theirs[0])
    assert len(ours[2]) == 27 * len(read_visibility(workspace.root / "fused.ply.vis"))


def read_vertices(path):
    mesh = read_geometry(path)
    assert isinstance(mesh, Mesh)
    return mesh.vertices


def test_colmap_meshes_the_cloud(workspace, tmp_path):
    """Its own reader takes points and normals; the mesh lies on the plane."""
    fuse(workspace)
    options = pycolmap.PoissonMeshingOptions()
    options.depth, options.trim, options.num_threads = 6, 0, 1
    pycolmap.poisson_meshing(workspace.fused_path, tmp_path / "mesh.ply", options)
    vertices = read_vertices(tmp_path / "mesh.ply")
    middle = np.linalg.norm(vertices, axis=1) < 2
    assert middle.sum() > 100
    assert np.abs(vertices[middle] @ NORMAL).max() < GSD


def test_colmap_program_reads_points_and_visibility(workspace, tmp_path):
    """Its Delaunay mesher reads both files before anything else, where it was built with CGAL."""
    program = shutil.which("colmap")
    if program is None:
        pytest.skip("the colmap program is not installed (Debian: apt-get install colmap)")
    fuse(workspace)
    command = [program, "delaunay_mesher", "--input_path", workspace.root, "--output_path", tmp_path / "mesh.ply"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    if "CGAL" in done.stderr + done.stdout:
        pytest.skip("this colmap was built without CGAL, which its Delaunay mesher needs")
    assert done.returncode == 0, done.stderr
    assert np.abs(read_vertices(tmp_path / "mesh.ply") @ NORMAL).max() < 5 * GSD


def test_parts_are_joined_in_the_order_given(tmp_path):
    rng = np.random.default_rng(0)
    stems = [tmp_path / name for name in ("7", "12", "3")]
    bodies = []
    words = []
    for number, stem in enumerate(stems):
        body = rng.integers(0, 256, (number, 27), dtype=np.uint8)
        listed = np.arange(3 * number, dtype=np.uint32)
        points = body.view(POINT)[:, 0]
        bands = [(points[:1], listed[:3]), (points[1:], listed[3:])]
        assert write_part(stem, bands) == number
        bodies.append(body.tobytes())
        words.append(listed.tobytes())
    digests = join_parts(stems[::-1], tmp_path, 3)
    assert digests == (whole_digest(tmp_path / "fused.ply"), whole_digest(tmp_path / "fused.ply.vis"))
    assert read_fused(tmp_path / "fused.ply").tobytes() == b"".join(bodies[::-1])
    visible = (tmp_path / "fused.ply.vis").read_bytes()
    assert visible == np.array(3, "<u8").tobytes() + b"".join(words[::-1])
    assert {path.name for path in tmp_path.iterdir()} == {"fused.ply", "fused.ply.vis"}


# ---- threads, memory, order --------------------------------------------------------------------------------


@pytest.mark.parametrize("threads", [2, 4])
def test_threads_do_not_matter(workspace, threads):
    fuse(workspace)
    expected = cloud_bytes(workspace)
    shutil.rmtree(workspace.state_dir)
    fuse(workspace, threads=threads)
    assert cloud_bytes(workspace) == expected


NEEDED = int(1.15 * 43 * WIDTH * HEIGHT)


@contextmanager
def counted(monkeypatch):
    """Largest number of images in work at a time."""
    original, lock, counts = parts_module.write_part, threading.Lock(), [0, 0]

    def write(stem, bands, **given):
        with lock:
            counts[0] += 1
            counts[1] = max(counts)
        try:
            return original(stem, bands, **given)
        finally:
            with lock:
                counts[0] -= 1

    with monkeypatch.context() as patch:
        patch.setattr(parts_module, "write_part", write)
        patch.setattr(memory, "resident", lambda: 100 << 20)
        yield counts


def test_little_memory_changes_nothing(workspace, monkeypatch):
    """One image at a time where the budget is that of one; with less, the message tells what would do."""
    fuse(workspace)
    expected = cloud_bytes(workspace)
    with counted(monkeypatch) as counts:
        with pytest.raises(OptionError, match=r"too little for \w\.png; (\w+) would do") as refused:
            fuse(workspace, threads=4, memory="100MiB", fusion=FusionOptions(cache_size=1.0))
        enough = str(refused.value).split("; ")[1].split()[0]
        assert parse_memory(enough) < (100 << 20) * 1.05 + 3 * NEEDED
        for amount in (f"{(100 << 20) + NEEDED + 1000}B", enough):
            shutil.rmtree(workspace.state_dir)
            counts[:] = [0, 0]
            fuse(workspace, threads=4, memory=amount)
            assert cloud_bytes(workspace) == expected
            if amount != enough:
                assert counts[1] == 1


def test_memory_is_what_is_reserved(workspace, monkeypatch):
    """Arrays of one image at a time, without a cache: measured, against 43 bytes per pixel."""
    monkeypatch.setattr(memory, "resident", lambda: 100 << 20)
    monkeypatch.setattr(fusion, "_BAND_PIXELS", 1 << 10)  # the image is smaller than a band otherwise
    options = {"memory": f"{(100 << 20) + NEEDED + 1000}B", "fusion": FusionOptions(min_num_pixels=1)}
    fuse(workspace, **options)
    shutil.rmtree(workspace.state_dir)
    stage = stage_of(context_of(workspace, **options))
    tracemalloc.start()
    try:
        execute(stage)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 30 * WIDTH * HEIGHT < peak < NEEDED + 300_000


# ---- what it may be given ----------------------------------------------------------------------------------


def test_photometric_maps(workspace, tmp_path):
    fuse(workspace)
    other = make_workspace(tmp_path / "photometric", kind="photometric")
    fuse(other, fusion=FusionOptions(input="photometric"))
    assert cloud_bytes(other) == cloud_bytes(workspace)


def test_a_model_without_tracks(workspace, tmp_path):
    """The frusta say what overlaps; only the order of partners may differ."""
    fuse(workspace)
    other = make_workspace(tmp_path / "none", tracks=False)
    fuse(other)
    clouds = [read_fused(one.fused_path) for one in (workspace, other)]
    assert clouds[0].tobytes() == clouds[1].tobytes()
    listed = [read_visibility(one.root / "fused.ply.vis") for one in (workspace, other)]
    assert [sorted(views) for views in listed[0]] == [sorted(views) for views in listed[1]]


def test_pairs_without_common_points_agree_too(workspace):
    """A pair that the user asked for need not share a point of the model."""
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    for index in list(model.image(1).get_observation_point2D_idxs()):
        model.delete_observation(1, index)
    model.write_binary(workspace.sparse_dir)
    assert fuse(workspace).points > 0
    alone = read_visibility(workspace.root / "fused.ply.vis")
    assert not any(0 in listed for listed in alone)
    fuse(workspace, pairs=[("a.png", "c.png")])
    paired = read_visibility(workspace.root / "fused.ply.vis")
    assert {frozenset(listed) & {0, 2} for listed in paired if 0 in listed} == {frozenset((0, 2))}


def test_fewer_images_to_look_in(workspace):
    fuse(workspace, fusion=FusionOptions(check_num_images=1, min_num_pixels=1))
    visible = read_visibility(workspace.root / "fused.ply.vis")
    assert {len(listed) for listed in visible} == {1, 2}


def test_masks_keep_pixels_out(workspace, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    for name in NAMES:
        cv2.imwrite(str(masks / f"{name}.png"), mask)
    fuse(workspace, fusion=FusionOptions(mask_path=masks, min_num_pixels=1))
    cloud = read_fused(workspace.fused_path)
    visible = read_visibility(workspace.root / "fused.ply.vis")
    assert len(cloud) > 1000
    for index, view in enumerate(read_scene(workspace.sparse_dir).views):
        seen = cloud["xyz"][[index in listed for listed in visible]].astype(float)
        pixel = (seen @ view.R.T + view.t) @ view.K.T
        assert (pixel[:, 0] / pixel[:, 2]).min() > WIDTH // 2 - 0.501


def test_map_coordinates(workspace, tmp_path):
    """The same cloud, moved, to a millionth of a unit, and beside it the one near the origin."""
    fuse(workspace)
    far = make_workspace(tmp_path / "far")
    model = pycolmap.Reconstruction(far.sparse_dir)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
    model.write_binary(far.sparse_dir)
    fuse(far)
    near_points, far_points = (read_points(one.fused_path) for one in (workspace, far))
    np.testing.assert_allclose(far_points - UTM, near_points, rtol=0, atol=3e-6)
    assert cloud_bytes(far)[1] == cloud_bytes(workspace)[1]
    local = Workspace(far.local_dir)
    origin = np.array([float(word) for word in (local.root / "origin.txt").read_text().split()])
    near = read_fused(local.fused_path)
    np.testing.assert_allclose(near["xyz"] + origin, far_points, rtol=0, atol=1e-9)
    assert near["rgb"].tobytes() == read_fused(workspace.fused_path)["rgb"].tobytes()
    assert (local.root / "fused.ply.vis").read_bytes() == cloud_bytes(far)[1]
    assert (
        fuse_by_colmap(Workspace(shutil.copytree(local.root, tmp_path / "copy")), FusionOptions().for_colmap())
        > 5000
    )


# ---- what goes wrong ---------------------------------------------------------------------------------------


def test_an_image_that_fails_is_left_out_and_done_again(workspace):
    """Its name and reason are reported, the others' cloud is as without it, and nothing vouches for that."""
    path = workspace.depth_map_path("c.png", "geometric")
    depth = read_depth_map(path)
    fuse(workspace)
    whole = cloud_bytes(workspace)
    path.write_bytes(path.read_bytes()[:-100])
    context = context_of(workspace, fusion=FusionOptions(max_depth_error=0.011))
    for made in (1, 1):  # again, and again in vain
        execute(stage_of(context))
        assert list(context.report.skipped_images) == ["c.png"]
        assert str(path) in context.report.skipped_images["c.png"]
        assert context.report.made["fuse"] == made
    visible = read_visibility(workspace.root / "fused.ply.vis")
    assert {index for listed in visible for index in listed} == {0, 1, 3, 4, 5}
    without = cloud_bytes(workspace)
    write_maps(workspace, "c.png", depth=np.zeros((HEIGHT, WIDTH)))
    fuse(workspace, fusion=FusionOptions(max_depth_error=0.011))
    assert cloud_bytes(workspace) == without
    write_depth_map(path, depth)
    shutil.rmtree(workspace.state_dir)
    fuse(workspace)
    assert cloud_bytes(workspace) == whole


def test_a_partner_that_cannot_be_read_for_a_moment_is_made_up_for(workspace, monkeypatch):
    """One read of the last image fails while the first is fused: nothing vouches for what lacks it."""
    last = context_of(workspace).order.sorted(NAMES)[-1]
    fuse(workspace)
    whole = cloud_bytes(workspace)
    original = parts_module.read_view_maps
    failed: list[str] = []

    def fails_once(sources):
        if sources.view.name == last and not failed:
            failed.append(sources.view.name)
            raise InputError(f"{last} cannot be read (Input/output error); run again.")
        return original(sources)

    shutil.rmtree(workspace.state_dir)
    monkeypatch.setattr(parts_module, "read_view_maps", fails_once)
    report = fuse(workspace)
    assert failed and cloud_bytes(workspace) != whole
    assert list(report.incomplete) == [last]
    assert "Input/output error" in report.incomplete[last]
    again = fuse(workspace)
    assert again.made["fuse"] == 1 and again.incomplete == {}
    assert cloud_bytes(workspace) == whole
    assert fuse(workspace).made["fuse"] == 0


def test_all_images_fail(workspace):
    for name in NAMES:
        workspace.normal_map_path(name, "geometric").unlink()
    with pytest.raises(NoResultError, match=r"No image could be fused \(.*a\.png.*cannot be read"):
        fuse(workspace)
    assert not workspace.fused_path.exists()
    assert not (workspace.fusion_scratch_dir).exists()


def test_no_point(workspace):
    """The files are whole and empty, and the report says which gate it was."""
    report = fuse(workspace, fusion=FusionOptions(min_num_pixels=7))
    assert report.points == len(read_fused(workspace.fused_path)) == 0
    assert read_visibility(workspace.root / "fused.ply.vis") == []
    assert "lower --fusion.min-num-pixels, which is 7" in report.advice


@pytest.mark.parametrize(
    ("cause", "options", "advice"),
    [
        ("depth", {}, "loosen --fusion.max-depth-error"),
        ("depth", {"max_depth_error": 1e-9}, "loosen --fusion.max-depth-error"),
        ("normal", {"max_normal_error": 1e-3}, "loosen --fusion.max-normal-error"),
        ("apart", {}, "check the poses, or try --fusion.input photometric"),
        ("apart, with poses that fit", {}, "; try --fusion.input photometric"),
        ("maps lost", {}, "; mend first what left 5 of 6 images without maps: b.png, as it is gone; run again."),
        ("mask", {}, "--fusion.mask-path leaves out 100 %"),
    ],
)
def test_the_advice_names_the_cause(workspace, tmp_path, cause, options, advice):
    for factor, name in enumerate(NAMES):
        if cause == "depth" and not options:
            depth = read_depth_map(workspace.depth_map_path(name, "geometric"))
            write_maps(workspace, name, depth=depth * (1 + 0.05 * factor))
        if cause == "normal":
            turned = np.roll(np.array([0.01 * factor, 0, -1]), 0) * np.ones((HEIGHT, WIDTH, 1))
            write_maps(workspace, name, normals=turned / np.linalg.norm(turned, axis=2, keepdims=True))
        if cause.startswith("apart") and name != NAMES[0]:
            write_maps(workspace, name, depth=np.zeros((HEIGHT, WIDTH)))
        if cause == "mask":
            cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
            options = {"mask_path": tmp_path}
    context = context_of(workspace, fusion=FusionOptions(**options))
    context.report.overall_agreement = 0.95 if "poses that fit" in cause else None
    if cause == "maps lost":
        context.report.skipped_images.update(dict.fromkeys(NAMES[1:], "it is gone; run again."))
        context.report.coverage.update(dict.fromkeys(NAMES[1:], 0.0))
    execute(stage_of(context))
    assert context.report.points < 20
    assert advice in context.report.advice
    assert ("poses" in context.report.advice) == (cause == "apart")


def test_thin_clouds_of_many_images_are_no_reason_for_advice(workspace, monkeypatch):
    """Where most pixels are confirmed, few points only mean that many images see the same."""
    monkeypatch.setattr("colmap_sph.pipeline.stages.cloud._FEW_POINTS", 2.0)
    assert fuse(workspace).advice == ""
    rng = np.random.default_rng(0)
    for name in NAMES[2:]:
        normals = rng.standard_normal((HEIGHT, WIDTH, 3))
        write_maps(workspace, name, normals=normals / np.linalg.norm(normals, axis=2, keepdims=True))
    report = fuse(workspace, fusion=FusionOptions(min_num_pixels=2, max_depth_error=0.011))
    assert report.points > 0
    assert "loosen --fusion.max-normal-error" in report.advice


@pytest.mark.parametrize("is_masked", [False, True])
def test_advice_takes_what_is_left_of_the_memory(workspace, tmp_path, is_masked):
    """And is the same: where there is no room for maps, those of two images are there at a time."""
    for name in NAMES if is_masked else ():
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
    options = FusionOptions(min_num_pixels=7, mask_path=tmp_path if is_masked else None)
    found, peaks = [], []
    for amount in ("1MiB", "64GiB"):
        context = context_of(workspace, fusion=options, memory=amount)
        cloud_module.facts_of_cloud(context, NAMES, 0)  # what is made once is made
        tracemalloc.start()
        found.append(cloud_module.facts_of_cloud(context, NAMES, 0))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert found[0] == found[1] and found[0].advice
    of_samples = 2000 * 150  # whatever the size of the maps
    assert peaks[0] < cloud_module._LOOKED_AT_BYTES * WIDTH * HEIGHT + of_samples
    assert peaks[1] > 16 * len(NAMES) * WIDTH * HEIGHT


@pytest.mark.parametrize("coverage", [0.0, 1.0], ids=["before", "in fusion"])
def test_a_skipped_image_has_no_say_in_the_advice(workspace, coverage):
    """It has no maps to look at."""
    workspace.depth_map_path("b.png", "geometric").unlink()
    context = context_of(workspace, fusion=FusionOptions(min_num_pixels=6))
    context.report.coverage["b.png"] = coverage
    execute(stage_of(context))
    assert context.report.points == 0
    assert context.report.advice


def without_records(workspace):
    """All files and folders but those that say that the cloud was begun."""
    records = {workspace.state_dir, workspace.cloud_record_path, workspace.fusion_cfg_record_path}
    return sorted(set(workspace.root.rglob("*")) - records)


@pytest.mark.parametrize("blocked", ["fused.ply", "fused.ply.vis", "colmap_sph/local"])
def test_unwritable_output(workspace, blocked, monkeypatch):
    path = workspace.root / blocked
    if blocked == "colmap_sph/local":

        def refuse(*_):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(fuse_module, "move_cloud_into_place", refuse)
    else:
        path.mkdir()
    before = without_records(workspace)
    with pytest.raises(OutputError, match=r"fused\.ply.* (is a folder|cannot be written \(Permission denied\))"):
        fuse(workspace)
    assert without_records(workspace) == before


def test_colmaps_fusion_still_warns_of_its_memory(workspace, caplog, monkeypatch):
    monkeypatch.setattr(fuse_module, "resident", lambda: 10**12)
    fuse(workspace, fusion=FusionOptions(method="colmap"))
    assert "COLMAP's fusion will take about" in caplog.text
    caplog.clear()
    fuse(workspace)
    assert caplog.text == ""


@pytest.mark.parametrize("threads", [1, 3])
def test_packed_maps_in_another_order_make_the_same_cloud(workspace, threads, monkeypatch):
    """As where there is room for few."""
    fuse(workspace)
    expected = cloud_bytes(workspace)
    orders = []

    def turned(given, *_):
        orders.extend(given)
        return given[0][::-1]

    unpacked = []
    usual = PackedMaps.unpacked

    def counting(self):
        unpacked.append(self)
        return usual(self)

    monkeypatch.setattr(parts_module, "best_order", turned)
    monkeypatch.setattr(PackedMaps, "unpacked", counting)
    monkeypatch.setattr(memory, "resident", lambda: 100 << 20)
    shutil.rmtree(workspace.state_dir)
    monkeypatch.setattr(parts_module, "_UNPACKING_BYTES", 0.0)
    fuse(workspace, threads=threads, memory=f"{(100 << 20) + int(2.6 * NEEDED)}B")
    assert unpacked and orders and all(sorted(order) == sorted(orders[0]) for order in orders)
    assert cloud_bytes(workspace) == expected
