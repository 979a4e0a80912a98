"""A run's check of itself: depth maps against the sparse points, on sound input and on garbage."""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from exact_maps import HEIGHT, NAMES, WIDTH, make_workspace
from projects import FOUR_NAMES, copy_four_images, read_picture

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.run_command import print_summary
from colmap_sph.app.terminal import Terminal
from colmap_sph.errors import NoResultError
from colmap_sph.pipeline.checks.self_check import (
    judge_agreement,
    judge_copies,
    judge_reprojection,
    misplaced_views,
    refuse_cameras,
    refuse_disagreement,
    share_in_sight,
)
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.input.good_images import without_misplaced
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.report import RunReport
from colmap_sph.pipeline.stages.facts import Agreement
from colmap_sph.products.maps.reading import check_maps
from colmap_sph.project.map_files import read_depth_map, write_depth_map
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import read_scene, scene_of_model
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.agreement import SparseTracks, compare_with_sparse

OPTIONS = RunOptions(threads=2)


# ---- one depth map -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """A scene of six views of a plane, and their exact depth maps."""
    workspace = make_workspace(tmp_path_factory.mktemp("exact") / "dense")
    maps = {name: read_depth_map(workspace.depth_map_path(name, "geometric")) for name in NAMES}
    return read_scene(workspace.sparse_dir), maps


@pytest.fixture
def aligned(tmp_path):
    """A workspace whose model was scaled, moved and turned after its maps were made, by so much."""

    def workspace(scale):
        made = make_workspace(tmp_path / "dense")
        model = pycolmap.Reconstruction(made.sparse_dir)
        turned = pycolmap.Rotation3d(np.array([0.5, 0.5, 0.5, 0.5]))
        model.transform(pycolmap.Sim3d(scale, turned, np.array([5e5, 5e6, 0.0])))
        model.write(made.sparse_dir)
        return made

    return workspace


@pytest.mark.parametrize("scale", [0.01, 1.2, 37.0])
@pytest.mark.parametrize("what", ["surface", "mesh", "export", "stereo_fusion"])
def test_maps_of_a_model_of_another_scale_are_refused(what, scale, aligned, capsys):
    """As where a model is aligned after dense reconstruction: depth counts in its old unit."""
    workspace = aligned(scale)
    before = sorted(workspace.root.iterdir())
    paths = ["--workspace_path", str(workspace.root), "--output_path", str(workspace.root / "cloud.ply")]
    assert cli.main([what, *(paths if what == "stereo_fusion" else [str(workspace.root)])]) == 2
    assert re.fullmatch(
        r"error: The depth maps in \S+stereo are not of the model in \S+sparse: only \d\.\d % of its sparse "
        r"points that have a depth there agree with it\. Was the model scaled, .*\n",
        capsys.readouterr().err,
    )
    made = {*workspace.root.iterdir()} - {*before}
    assert made <= {workspace.state_dir}  # the log


def test_maps_of_a_model_that_was_moved_and_turned_are_its_own(aligned):
    """Depth is along the cameras' axes. So are maps with half as many pixels."""
    workspace = aligned(1.0)
    check_maps(workspace)
    for name in NAMES:
        path = workspace.depth_map_path(name, "geometric")
        write_depth_map(path, np.ascontiguousarray(read_depth_map(path)[::2, ::2]))
    check_maps(workspace)


@pytest.mark.parametrize("what", [["export"], ["mesh", "--method", "poisson"]], ids=["export", "mesh"])
def test_a_cloud_of_a_model_that_was_moved_since_is_refused(what, tmp_path, capsys):
    """As where a model is aligned after dense reconstruction: its maps are still right, its cloud is not."""
    workspace = make_workspace(tmp_path / "dense")
    root = str(workspace.root)
    paths = ["--workspace_path", root, "--output_path", str(workspace.fused_path)]
    assert cli.main(["stereo_fusion", *paths]) == 0
    assert cli.main(["export", root, "--output", str(tmp_path / "before")]) == 0
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([3.0, 0.0, 0.0])))
    model.write(workspace.sparse_dir)
    capsys.readouterr()
    assert cli.main([*what, root]) == 2
    refusal = r"error: The cloud in \S+ is not of the model in \S+sparse: only \d\.\d % of .* Fuse again\.\n$"
    assert re.search(refusal, capsys.readouterr().err)


def agreement_of(scene, name, depth, mask=None):
    return Agreement(*compare_with_sparse(scene.view(name), depth, SparseTracks(scene).sights(name), mask))


@pytest.mark.parametrize("name", NAMES)
def test_exact_maps_agree_with_every_point(exact, name):
    scene, maps = exact
    found = agreement_of(scene, name, maps[name])
    assert found.tested > 0.95 * len(scene.view(name).point_indices) > 50
    assert found == Agreement(found.tested, found.tested, found.tested)


def test_what_has_no_depth_does_not_agree(exact):
    scene, maps = exact
    found = agreement_of(scene, "a.png", np.zeros_like(maps["a.png"]))
    assert found == Agreement(agreement_of(scene, "a.png", maps["a.png"]).tested, 0, 0)
    assert found.share == 0
    assert Agreement().share is None


def test_points_under_a_mask_are_not_asked(exact):
    scene, maps = exact
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    pixels, _ = scene.view("a.png").project(scene.points[scene.view("a.png").point_indices])
    right = int(np.count_nonzero(np.rint(pixels[:, 0]) >= WIDTH // 2))
    assert 0 < right < len(pixels)
    assert agreement_of(scene, "a.png", maps["a.png"], mask) == Agreement(right, right, right)


def parallax(scene, view, point, ratio, row):
    """How far a point moves in the view that tells most, where its distance from another changes."""
    moved = view.center + (point - view.center) * ratio
    others = [other for other in scene.views if other.name != view.name and row in other.point_indices]
    return max(np.linalg.norm(np.subtract(*other.project(np.array([point, moved]))[0])) for other in others)


def test_a_depth_agrees_up_to_four_pixels_in_the_view_that_tells_most(exact):
    """The points are moved along their rays, one by one, and projected as anybody would."""
    scene, maps = exact
    view = scene.view("b.png")
    # Without those that are seen under too little parallax.
    rows = np.array([k for k in view.point_indices if parallax(scene, view, scene.points[k], 1.25, k) > 4])
    pixels, depth = view.project(scene.points[rows])
    places = np.rint(pixels).astype(int)
    for factor in (1.01, 1.02, 1.05, 1.1, 0.95, 0.9):
        wrong = (maps["b.png"] * factor).astype(np.float32)
        expected = 0
        for k, point in enumerate(scene.points[rows]):
            shown = wrong[
                np.ix_(
                    np.clip(places[k, 1] + np.arange(-1, 2), 0, HEIGHT - 1),
                    np.clip(places[k, 0] + np.arange(-1, 2), 0, WIDTH - 1),
                )
            ]
            nearest = shown.flat[np.abs(shown - depth[k]).argmin()]
            expected += parallax(scene, view, point, nearest / depth[k], rows[k]) <= 4
        assert agreement_of(scene, "b.png", wrong) == Agreement(len(rows), len(rows), expected)


def test_points_without_parallax_tell_nothing(exact):
    scene, maps = exact
    first = scene.view("a.png")
    twin = replace(first, name="b.png", t=first.t - first.R @ np.array([0.001, 0, 0]))
    pair = Scene((first, twin), scene.points)
    assert agreement_of(pair, "a.png", maps["a.png"]) == Agreement()


# ---- what is told of it ------------------------------------------------------------------------------------


def reported(agreements, misplaced=0.0):
    """What the confirmation and the end of a run put into the report."""
    report = RunReport(
        agreement={name: found.share for name, found in agreements.items()},
        agreement_of_found={name: found.share_of_found for name, found in agreements.items()},
        sparse_points=sum(agreements.values(), Agreement()),
    )
    report.overall_agreement = report.sparse_points.share
    judge_agreement(report, misplaced=misplaced)
    return report


def test_an_image_that_hardly_agrees_is_named():
    sound = {f"{k}.jpg": Agreement(100, 95, 90) for k in range(5)}
    report = reported({**sound, "odd.jpg": Agreement(100, 40, 3), "few.jpg": Agreement(5, 0, 0)})
    assert "odd.jpg (3 %)" in report.doubts and "few.jpg" not in report.doubts and "0.jpg" not in report.doubts
    assert report.agreement["0.jpg"] == 0.9
    assert report.overall_agreement == pytest.approx(453 / 605)
    refuse_disagreement(report)
    assert reported(sound).doubts == ""


def test_an_image_that_agrees_less_than_the_others_is_named():
    """Two neighbours in a strip that were exchanged fit some of their points; a scene may be hard for all."""
    others = {f"{k}.jpg": Agreement(440, 320, 310) for k in range(5)}
    report = reported({**others, "a.jpg": Agreement(438, 250, 136), "few.jpg": Agreement(60, 29, 14)})
    assert "a.jpg (31 %)" in report.doubts and "few.jpg" not in report.doubts and "0.jpg" not in report.doubts
    hard = {f"{k}.jpg": Agreement(400, 300, 160) for k in range(5)}
    assert reported({**hard, "a.jpg": Agreement(438, 250, 136)}).doubts == ""


def test_hardly_any_agreement_is_no_result():
    report = reported({"a.jpg": Agreement(100, 30, 4), "b.jpg": Agreement(100, 30, 5)})
    with pytest.raises(NoResultError, match=r"Only 4\.5 % of the sparse points agree"):
        refuse_disagreement(report)
    # Where little is matched few points have a depth, but these agree.
    few = reported({"a.jpg": Agreement(100, 6, 5)})
    assert few.refusal == ""
    assert (
        "only 6.0 % of the sparse points that the images observe have a depth, of which 83 % agree" in few.doubts
    )
    # Too few to tell.
    refuse_disagreement(reported({"a.jpg": Agreement(10, 5, 0)}))


def test_depth_that_disagrees_with_a_model_that_disagrees_with_itself_is_no_result():
    """Neither alone: a rig among people agrees with a third; observations of another size leave depth right."""
    third = {f"{k}.jpg": Agreement(100, 80, 42) for k in range(5)}
    with pytest.raises(NoResultError, match=r"do not project .* only 42\.0 % of them agree"):
        refuse_disagreement(reported(third, misplaced=0.9))
    refuse_disagreement(reported(third, misplaced=0.4))
    refuse_disagreement(reported({f"{k}.jpg": Agreement(100, 95, 90) for k in range(5)}, misplaced=1.0))


def test_without_sparse_points_there_is_nothing_to_check(tmp_path, capsys):
    report = reported({"a.jpg": Agreement(), "b.jpg": Agreement()})
    assert (report.overall_agreement, report.doubts, report.refusal) == (None, "", "")
    assert report.agreement == {"a.jpg": None, "b.jpg": None}
    print_summary(report, Workspace(tmp_path), Terminal())
    assert "no sparse points to check against" in capsys.readouterr().err


def test_the_summary_tells_the_time_of_the_whole_command(tmp_path, capsys):
    report = reported({"a.jpg": Agreement()})
    report.seconds = {"match pairs": 2.0, "fuse": 1.0}
    report.total_seconds = 7.0
    print_summary(report, Workspace(tmp_path), Terminal())
    assert re.search(r"seconds +7\.0 \(match pairs 2\.0, fuse 1\.0\)", capsys.readouterr().err)


def test_of_many_images_left_out_the_first_are_listed(tmp_path, capsys):
    report = reported({"a.jpg": Agreement()})
    report.skipped_images = {f"{number}.jpg": "is missing" for number in range(70)}
    print_summary(report, Workspace(tmp_path), Terminal())
    told = re.findall(r"image skipped: (.*)", capsys.readouterr().err)
    assert told == [*(f"{number}.jpg: is missing" for number in range(60)), "10 more, see report.json"]


# ---- whole runs --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    root = tmp_path_factory.mktemp("four")
    copy_four_images(root)
    return root


@pytest.fixture
def project(four, tmp_path):
    shutil.copytree(four / "images", tmp_path / "images")
    shutil.copytree(four / "sparse", tmp_path / "sparse")
    return tmp_path


def test_sound_input_agrees_and_a_rerun_knows_it(project):
    report = colmap_sph.run(project / "sparse/0", options=OPTIONS)
    assert report.overall_agreement is not None and report.overall_agreement > 0.95
    assert sorted(report.agreement) == FOUR_NAMES
    assert all(share is not None and share > 0.9 for share in report.agreement.values())
    assert report.doubts == report.refusal == ""
    stored = json.loads((project / "dense/colmap_sph/report.json").read_text())
    assert (stored["agreement"], stored["overall_agreement"]) == (report.agreement, report.overall_agreement)
    again = colmap_sph.run(project / "sparse/0", options=OPTIONS)
    assert again.made["confirm depth"] == 0
    assert (again.agreement, again.overall_agreement) == (report.agreement, report.overall_agreement)


@pytest.mark.parametrize("garbage", ["turned", "mirrored"])
def test_small_garbage_is_refused(garbage, project):
    for name in FOUR_NAMES:
        picture = read_picture(project / "images" / name)
        cv2.imwrite(str(project / "images" / name), cv2.flip(picture, -1 if garbage == "turned" else 1))
    why = "No depth was confirmed by a second image|Only 0.0 % of the sparse points agree"
    with pytest.raises(NoResultError, match=why):
        colmap_sph.run(project / "sparse/0", options=OPTIONS)


def test_garbage_is_refused_and_stays_on_disk(project):
    """Every image is another's. Two neighbours in a strip still fit each other, as if they were one place on."""
    pictures = [read_picture(project / "images" / name) for name in FOUR_NAMES]
    for name, k in zip(FOUR_NAMES, [1, 2, 3, 0], strict=True):
        cv2.imwrite(str(project / "images" / name), pictures[k])
    with pytest.raises(NoResultError) as caught:
        colmap_sph.run(project / "sparse/0", options=OPTIONS)
    stored = json.loads((project / "dense/colmap_sph/report.json").read_text())
    assert stored["overall_agreement"] < 0.1
    assert "images do not belong to the poses" in str(caught.value)
    assert caught.value.exit_code == 4
    assert (project / "dense/fused.ply").exists()


def test_one_wrong_image_is_named(project):
    wrong = FOUR_NAMES[2]
    picture = read_picture(project / "images" / FOUR_NAMES[3])
    cv2.imwrite(str(project / "images" / wrong), cv2.flip(picture, -1))
    report = colmap_sph.run(project / "sparse/0", options=OPTIONS)
    assert wrong in report.doubts
    assert not any(name in report.doubts for name in FOUR_NAMES if name != wrong)


def misplace_third(model: pycolmap.Reconstruction) -> pycolmap.Image:
    """Give the third image the pose of the second one; returns it."""
    image_of = {image.name: image for image in model.images.values()}
    wrong = image_of[FOUR_NAMES[2]]
    assert wrong.frame is not None
    wrong.frame.rig_from_world = image_of[FOUR_NAMES[1]].cam_from_world()
    return wrong


def test_an_image_in_a_wrong_place_is_left_out(project, capsys):
    """It spoils no other: their maps are those of a model without it. The dry run knows it, too."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    wrong = misplace_third(model)
    assert wrong.frame is not None
    (project / "wrong").mkdir()
    model.write_binary(project / "wrong")
    plan = make_plan(Project(project / "wrong", project / "images", output=project / "dense"), OPTIONS)
    assert (plan.images, plan.pairs) == (3, 3)
    report = colmap_sph.run(
        project / "wrong", images=project / "images", output=project / "dense", options=OPTIONS
    )
    assert list(report.skipped_images) == [wrong.name]
    assert re.match(r"sparse points project \d\d pixels from where", report.skipped_images[wrong.name])
    assert report.doubts == "" and report.overall_agreement is not None and report.overall_agreement > 0.9
    model.deregister_frame(wrong.frame_id)
    (project / "without").mkdir()
    model.write_binary(project / "without")
    colmap_sph.run(project / "without", images=project / "images", output=project / "other", options=OPTIONS)
    for name in (*FOUR_NAMES[:2], FOUR_NAMES[3]):
        found, expected = (
            read_depth_map(Workspace(project / folder).depth_map_path(name, "geometric"))
            for folder in ("dense", "other")
        )
        assert np.count_nonzero(expected) and np.isclose(found, expected, rtol=1e-3).mean() > 0.95


@pytest.mark.parametrize(("observing", "left_out"), [(6, 2), (5, 2), (4, 0), (2, 0)])
def test_images_that_observe_nothing_are_no_witnesses(exact, tmp_path, observing, left_out):
    """Where half of the others are misplaced, as all are with coordinates of another size, none is left out."""
    views = [
        replace(
            view,
            point_indices=view.point_indices if place < observing else view.point_indices[:5],
            reprojection_error=50.0 if place < 2 else view.reprojection_error,
        )
        for place, view in enumerate(exact[0].views)
    ]
    workspace = Workspace(tmp_path)
    context = Context(workspace, replace(exact[0], views=tuple(views)), OPTIONS, Keys(workspace, OPTIONS))
    assert len(without_misplaced(context).scene.views) == len(views) - left_out
    assert len(context.report.skipped_images) == left_out


@pytest.mark.parametrize("wrong", [1, 2])
def test_all_views_of_a_photograph_are_in_one_place(exact, tmp_path, wrong):
    """Of three views one observes too little; the photograph is left out where half of the others tell so."""
    first, second, third, *others = exact[0].views
    cut = [replace(view, original="wide.jpg", reprojection_error=50.0) for view in (first, second, third)]
    cut[2] = replace(cut[2], point_indices=third.point_indices[:5], reprojection_error=0.1)
    if wrong == 1:
        cut[1] = replace(cut[1], reprojection_error=0.1)
    workspace = Workspace(tmp_path)
    context = Context(workspace, replace(exact[0], views=(*cut, *others)), OPTIONS, Keys(workspace, OPTIONS))
    assert without_misplaced(context).scene.views == tuple(others)
    assert set(context.report.skipped_images) == {view.name for view in cut}


def test_maps_of_an_image_that_comes_to_be_in_a_wrong_place_are_removed(project):
    """Surfaces, meshes and later fusions are made of all maps that are there."""
    workspace = Workspace(project / "dense")
    colmap_sph.run(project / "sparse/0", options=OPTIONS)
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    wrong = misplace_third(model)
    model.write_binary(workspace.sparse_dir)
    report = colmap_sph.run(project / "sparse/0", options=OPTIONS)
    assert list(report.skipped_images) == [wrong.name]
    maps = [workspace.depth_map_path(name, "geometric").exists() for name in FOUR_NAMES]
    assert maps == [name != wrong.name for name in FOUR_NAMES]


def test_points_that_are_not_where_they_are_observed_are_told(project):
    """Their image coordinates are those of images of twice the size."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    sound, report = RunReport(), RunReport()
    assert judge_reprojection(sound, scene_of_model(model, project)) == 0
    assert sound.doubts == ""
    for image in model.images.values():
        for point in image.points2D:
            point.xy = 2 * point.xy
    assert judge_reprojection(report, scene_of_model(model, project)) == 1
    assert all(name in report.doubts for name in FOUR_NAMES)


def with_focal_lengths(model, fx, fy, number):
    """So many images of a model get another camera, with so many times the focal lengths."""
    changed = pycolmap.Reconstruction()
    for index, image in enumerate(sorted(model.images.values(), key=lambda image: image.name)):
        camera = pycolmap.Camera(model.cameras[image.camera_id].todict())
        camera.camera_id = 100 + index
        if index < number:
            camera.params = list(np.multiply(camera.params, [fx, fy, 1, 1]))
        changed.add_camera_with_trivial_rig(camera)
        copy = pycolmap.Image(image.name, [point.xy for point in image.points2D], 100 + index, image.image_id)
        changed.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point_id, point in model.points3D.items():
        changed.add_point3D_with_id(point_id, point)
    return changed


@pytest.mark.parametrize(("fx", "fy"), [(1.1, 1.1), (0.9, 0.9), (0.7, 0.7), (0.8, 1), (1, 1.1), (0.1, 1)])
@pytest.mark.parametrize("number", [4, 2])
def test_other_focal_lengths_than_those_of_the_points_are_refused(fx, fy, number, project):
    """Depth is wrong by as much, in all images alike, and so agreed with that of others."""
    model = with_focal_lengths(pycolmap.Reconstruction(project / "sparse/0"), fx, fy, number)
    expected = rf"{number} of 4 images .* with {1 / fx:.3g} times the horizontal and {1 / fy:.3g} times the"
    with pytest.raises(NoResultError, match=expected):
        refuse_cameras(scene_of_model(model, project))


def test_the_one_image_with_another_focal_length_is_left_out(project):
    sound = pycolmap.Reconstruction(project / "sparse/0")
    assert misplaced_views(scene_of_model(with_focal_lengths(sound, 1.02, 1.02, 1), project)) == {}
    scene = scene_of_model(with_focal_lengths(sound, 1.04, 1.04, 1), project)
    refuse_cameras(scene)
    assert scene.view(FOUR_NAMES[0]).reprojection_error < 4  # no more than roughly adjusted poses leave
    assert misplaced_views(scene) == {FOUR_NAMES[0]: scene.view(FOUR_NAMES[0]).reprojection_error}


def test_a_copy_at_another_pose_is_told_with_its_cause(project):
    first, *_, last = FOUR_NAMES
    shutil.copy(project / "images" / first, project / "images" / last)
    report = colmap_sph.run(project / "sparse/0", options=OPTIONS)
    assert f"the same file under other names, but at other poses: {first}, {last}. Only" in report.doubts


def test_a_copy_at_the_pose_of_its_image_does_no_harm(project):
    """Structure from motion places it to a hundredth of a pixel or so, and not at the pose of the next image."""
    scene = read_scene(project / "sparse/0")
    view = scene.views[0]
    away = 1e-5 * np.linalg.norm(scene.views[-1].center - view.center)
    for other, is_told in ((view.center + away, False), (scene.views[1].center, True)):
        copy = replace(view, name="copy.jpg", t=-view.R @ other)
        report = RunReport()
        judge_copies(report, replace(scene, views=(*scene.views, copy)), {view.name: "1", "copy.jpg": "1"})
        assert ("copy.jpg" in report.doubts) == is_told


def test_a_camera_that_is_not_that_of_its_points_is_refused_before_anything_is_matched(project):
    wrong, folders = project / "wrong", {"images": project / "images", "output": project / "dense"}
    wrong.mkdir()
    with_focal_lengths(pycolmap.Reconstruction(project / "sparse/0"), 0.9, 0.9, 4).write_binary(wrong)
    for run in (
        lambda: colmap_sph.run(wrong, options=OPTIONS, **folders),
        lambda: make_plan(Project(wrong, folders["images"], output=folders["output"]), OPTIONS),
    ):
        with pytest.raises(NoResultError, match="Give the model as it was adjusted"):
            run()
    assert not list((project / "dense/stereo").rglob("*.bin"))


def test_poses_that_are_not_those_of_the_points_are_refused_before_anything_is_matched(project):
    """Every image is turned about the direction in which it looks: no other camera explains that."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d([0, 0, np.radians(20)]), np.zeros(3))
    for image in model.images.values():
        image.frame.rig_from_world = turn * image.cam_from_world()
    with pytest.raises(NoResultError, match="no other size or crop"):
        refuse_cameras(scene_of_model(model, project))


@pytest.mark.parametrize(
    ("factors", "shift"),
    [((1, 1), (0, 0)), ((3, 3), (0, 0)), ((0.25, 0.25), (0, 0)), ((1, 1), (-90, 40)), ((1.02, 1), (5, 5))],
)
def test_observations_of_another_size_or_crop_are_no_wrong_cameras(project, factors, shift):
    model = pycolmap.Reconstruction(project / "sparse/0")
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy * factors + shift
    refuse_cameras(scene_of_model(model, project))


@pytest.mark.parametrize("rows", [40, -20])
def test_of_points_on_one_side_a_crop_is_no_focal_length(project, rows):
    """As on the street in front of a vehicle: farther down they would be shifted more."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        for index, point in enumerate(image.points2D):
            if point.has_point3D() and not 0.75 < point.xy[1] / camera.height < 0.95:
                image.reset_point3D_for_point2D(index)
            else:
                point.xy += (0, rows)
    scene = scene_of_model(model, project)
    assert min(len(view.point_indices) for view in scene.views) > 10
    refuse_cameras(scene)


def test_few_points_tell_no_focal_length(project):
    """A single one always has another that explains it."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    image = model.images[min(model.images)]
    middle = model.cameras[image.camera_id].params[2:]
    points = list(image.points2D)
    seen = [index for index, point in enumerate(points) if point.has_point3D()]
    kept, *others = sorted(seen, key=lambda index: np.linalg.norm(points[index].xy - middle))
    for index in others:
        image.reset_point3D_for_point2D(index)
    points[kept].xy += 1
    assert misplaced_views(scene_of_model(model, project)) == {}


def test_wild_tracks_are_no_wrong_cameras(project):
    """Two in five observations are anywhere in the image."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    rng = np.random.default_rng(1)
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        for index, point in enumerate(image.points2D):
            if index % 5 < 2:
                point.xy = rng.uniform(0, (camera.width, camera.height))
    refuse_cameras(scene_of_model(model, project))


def test_cameras_are_refused_where_most_images_tell_so(project):
    scene = read_scene(project / "sparse/0")
    far = [
        replace(view, reprojection_error=0.1 * view.width, unexplained_error=0.04 * view.width)
        for view in scene.views
    ]
    refuse_cameras(replace(scene, views=(*far[:2], *scene.views[2:])))
    with pytest.raises(NoResultError):
        refuse_cameras(replace(scene, views=(*far[:3], scene.views[3])))
    # Too few points to tell.
    refuse_cameras(replace(scene, views=tuple(replace(view, point_indices=np.arange(9)) for view in far)))


def test_points_that_no_image_has_in_sight_are_told(project):
    """The principal point lies outside of the images: no depth map can be checked, and there was a cloud of it."""
    model = pycolmap.Reconstruction(project / "sparse/0")
    assert share_in_sight(scene_of_model(model, project)) > 0.99
    for camera in model.cameras.values():
        camera.params = [*camera.params[:2], 3 * camera.width, camera.params[3]]
    wrong = project / "wrong"
    wrong.mkdir()
    model.write_binary(wrong)
    assert share_in_sight(read_scene(wrong)) == 0
    with pytest.raises(NoResultError, match="only 0 % of them into these images at all"):
        colmap_sph.run(wrong, images=project / "images", output=project / "dense", options=OPTIONS)
