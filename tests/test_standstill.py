"""What stands still while the camera turns is not of the scene: it gets no depth, and this is told."""

import threading
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import colmap_sph
from colmap_sph import synthetic as syn
from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.input.standing import with_still_pixels
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages import photo
from colmap_sph.pipeline.stages.match import MatchStage
from colmap_sph.project.cloud_reader import read_some_points
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.matching import MatchingOptions
from colmap_sph.stereo.poses.standstill import still_pixels, turned_views
from colmap_sph.stereo.rectification import RectificationOptions

WIDTH, HEIGHT, FOCAL = 320, 240, 340.0
RADII = np.array([0.3, 0.4, 0.45])
IMAGES = 18


def texture(seed, contrast=0.25):
    return syn.Mottled(syn.Noise(0.006, seed=seed, tile=512), contrast=contrast)


def egg():
    return [syn.Ellipsoid(np.zeros(3), RADII, texture(1))]


def ring(count, radius, height, target=(0, 0, 0)):
    """Cameras on a circle around the z axis."""
    cameras = []
    for turn in 2 * np.pi * np.arange(count) / count:
        R, t = syn.look_at((radius * np.cos(turn), radius * np.sin(turn), height), target)
        cameras.append(syn.Camera(syn.pinhole(FOCAL, WIDTH, HEIGHT), R, t, WIDTH, HEIGHT))
    return cameras


def backdrop():
    """A cluttered room: (H, W, 3), with patches of several greys, some of them without texture."""
    rng = np.random.default_rng(5)
    columns, rows = np.meshgrid(np.arange(WIDTH) * 0.006, np.arange(HEIGHT) * 0.006)
    room = texture(7, 0.4).colour(np.stack([columns.ravel(), rows.ravel()])).reshape(HEIGHT, WIDTH, 3) * 200
    for _ in range(25):
        x, y = rng.uniform(0, (WIDTH, HEIGHT)).astype(int)
        room[y : y + 30, x : x + 40] *= rng.uniform(0.5, 1.4)
    return room


def photograph(surfaces, camera, seed, behind=None):
    """(H, W, 3) RGB picture with noise, and whether a surface is there; `behind` it stands the same in all."""
    view = syn.render(surfaces, camera.K, camera.R, camera.t, WIDTH, HEIGHT)
    picture = view.image.astype(np.float32)
    if behind is not None:
        picture[view.surface < 0] = behind[view.surface < 0]
    picture += np.random.default_rng(seed).normal(0, 1.5, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8), view.surface >= 0


def views_of(cameras):
    none = np.empty(0, np.int64)
    return [View(k + 1, f"{k:02d}.png", WIDTH, HEIGHT, c.K, c.R, c.t, none) for k, c in enumerate(cameras)]


def still_shares(surfaces, cameras, behind=None):
    """Shares of what is and of what is not of the scene that stand still, in the first image."""
    photographs = [photograph(surfaces, camera, k, behind) for k, camera in enumerate(cameras)]
    grey = {f"{k:02d}.png": cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for k, (image, _) in enumerate(photographs)}
    others = turned_views(views_of(cameras))["00.png"]
    still = still_pixels(grey["00.png"], [grey[name] for name in others])
    there = photographs[0][1]
    return still[there].mean(), still[~there].mean() if not there.all() else 0.0


def test_a_backdrop_stands_still_and_an_object_does_not():
    of_object, of_backdrop = still_shares(egg(), ring(IMAGES, 2, 0.7), backdrop())
    assert of_backdrop > 0.95  # what has no texture is blank
    assert of_object < 0.025  # at its rim, where it is as bright as the backdrop


def test_a_tower_of_four_equal_sides_does_not_stand_still():
    """Nor do its mast on the axis and the horizon, which all images show at the same place."""
    side = texture(2)
    tower = [
        syn.Plane((0, 0, -1), (0, 0, 1), texture(3), half_size=(60, 60)),
        syn.box((0, 0, -1), (0.7, 0.7, 1.6), [side] * 6),
        syn.box((0, 0, 0.6), (0.03, 0.03, 0.5), [side] * 6),
    ]
    of_scene, of_sky = still_shares(tower, ring(16, 2.4, 0.6, (0, 0, 0.3)))
    assert of_scene < 0.01
    assert of_sky < 0.02  # what is left is beside the mast, whose windows show its outlines


def context_of(root: Path, pictures, views, masks=()) -> Context:
    """Of a workspace with these images."""
    workspace = Workspace(root)
    for folder, images in ((workspace.image_path, pictures), (workspace.mask_path, masks)):
        for view, image in zip(views, images, strict=False):
            folder(view.name).parent.mkdir(exist_ok=True)
            cv2.imwrite(str(folder(view.name)), image[..., ::-1] if image.ndim == 3 else image)
    options = RunOptions()
    return Context(workspace, Scene(tuple(views), np.empty((0, 3))), options, Keys(workspace, options, {}))


def still_images(context: Context) -> int:
    return len(with_still_pixels(context, [view.name for view in context.scene.views]).still)


def test_an_object_with_eight_equal_sides_is_matched(tmp_path):
    """Of 16 images around it every other one shows the same."""
    cameras = ring(16, 2, 0.7)
    eggs = [[syn.Ellipsoid(np.zeros(3), RADII, texture(seed))] for seed in (1, 2)]
    pictures = [photograph(each, cameras[0], 0)[0] for each in eggs]
    assert not still_images(context_of(tmp_path, pictures * 8, views_of(cameras)))
    assert still_images(context_of(tmp_path, pictures[:1] * 16, views_of(cameras))) == 16
    # And all there are, where each of its sides has one.
    assert not still_images(context_of(tmp_path, pictures[:1] * 8, views_of(cameras[::2])))


def test_images_that_others_are_compared_with_are_read_once(tmp_path, monkeypatch):
    cameras = ring(IMAGES, 2, 0.7)
    picture = photograph(egg(), cameras[0], 0)[0]
    views = views_of(cameras)
    context = with_still_pixels(context_of(tmp_path, [picture] * IMAGES, views), [view.name for view in views])
    place = context.workspace.image_path
    read: list[str] = []
    small = photo.read_small_grey

    def count(path: Path, side: int) -> photo.Mask:
        read.append(path.name)
        return small(path, side)

    monkeypatch.setattr(photo, "read_small_grey", count)
    with photo.kept_masks.holding(1 << 24):
        for view in views:
            assert photo.still_mask(view, place(view.name), [*map(place, context.still[view.name])]).any()
    compared = {name for names in context.still.values() for name in names}
    assert sorted(read) == sorted([*compared, *(view.name for view in views)])


def test_memory_to_compare_small_images_is_counted(tmp_path):
    """Pairs that are matched coarsely need less."""
    cameras = ring(IMAGES, 2, 0.7)
    views = views_of(cameras)
    context = context_of(tmp_path, [photograph(egg(), cameras[0], 0)[0]] * IMAGES, views)
    coarse = replace(context.options, rectification=RectificationOptions(sampling=0.2))
    pair = (views[0].name, views[1].name)
    needed = [
        MatchStage(replace(context, options=coarse, still=still), [pair]).job(pair).cost.memory
        for still in ({}, dict.fromkeys(pair, ("03.png", "04.png", "05.png")))
    ]
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    tracemalloc.start()
    still_pixels(image, [image] * 3)
    measured = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert needed[0] < measured < needed[1]


def test_a_masked_backdrop_is_not_told_again(tmp_path):
    """Some pixels at the rim of masks may show it."""
    cameras, room = ring(IMAGES, 2, 0.7), backdrop()
    photographs = [photograph(egg(), camera, k, room) for k, camera in enumerate(cameras)]
    pictures = [picture for picture, _ in photographs]
    masks = [cv2.dilate(there.astype(np.uint8) * 255, np.ones((5, 5), np.uint8)) for _, there in photographs]
    assert not still_images(context_of(tmp_path, pictures, views_of(cameras), masks))


def test_only_images_of_one_camera_that_are_turned_are_compared():
    views = views_of(ring(16, 2, 0.7))
    turned = turned_views(views)
    assert turned.keys() == {view.name for view in views}
    R = {view.name: view.R for view in views}
    for name, others in turned.items():
        turns = [np.degrees(np.arccos((np.trace(R[name] @ R[other].T) - 1) / 2)) for other in others]
        assert len(others) >= 3
        assert min(turns) > 44.9
    assert not turned_views(views[::4][:3])  # two others
    assert not turned_views(views_of(ring(60, 2, 0.7))[:8])  # 42° in all


def write_project(root: Path) -> Path:
    cameras, room = ring(IMAGES, 2, 0.7), backdrop()
    names = [view.name for view in views_of(cameras)]
    (root / "images").mkdir()
    for k, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        cv2.imwrite(str(root / "images" / name), photograph(egg(), camera, k, room)[0][..., ::-1])
    sparse = syn.sample_sparse_points(egg(), cameras, 500, np.random.default_rng(0))
    syn.write_reconstruction(syn.build_reconstruction(names, cameras, sparse), root / "sparse" / "0")
    return root / "sparse" / "0"


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_project(tmp_path_factory.mktemp("hand"))


def share_off(workspace: Workspace) -> float:
    """Share of the cloud that is off the egg by a tenth of its size or more, along the ray from its centre."""
    points = read_some_points(workspace.fused_path, 50_000)[0]
    return float((np.abs(np.linalg.norm(points / RADII, axis=1) - 1) * RADII.min() > 0.03).mean())


def test_an_object_in_the_hand_is_free_of_the_room_behind_it(model, tmp_path):
    report = colmap_sph.run(model, output=tmp_path / "dense")
    assert report.still.startswith(("8", "9"))  # per cent
    assert "--masks" in report.still
    assert share_off(Workspace(tmp_path / "dense")) < 0.01
    assert report.points > 20_000


@pytest.mark.parametrize("keep_blank", [False, True])
def test_the_room_does_not_tell_of_poses(model, tmp_path, keep_blank):
    """Its features lie far from their epipolar planes, as those of a model whose images were exchanged."""
    without_points = pycolmap.Reconstruction(model)
    for point in list(without_points.points3D):
        without_points.delete_point3D(point)
    (tmp_path / "sparse").mkdir()
    without_points.write(tmp_path / "sparse")
    report = colmap_sph.run(
        tmp_path / "sparse",
        images=model.parents[1] / "images",
        output=tmp_path / "dense",
        options=RunOptions(matching=MatchingOptions(keep_blank=keep_blank)),
    )
    assert ("are matched all the same, as" in report.still) == keep_blank
    assert report.still
    assert not report.doubts
    assert report.points > 20_000


def test_keep_blank_matches_the_room_too(model, tmp_path):
    """Which shows what the rule is worth."""
    options = RunOptions(matching=MatchingOptions(keep_blank=True))
    report = colmap_sph.run(model, output=tmp_path / "dense", options=options)
    assert not report.still
    assert share_off(Workspace(tmp_path / "dense")) > 0.05


@pytest.mark.parametrize(("memory", "most"), [("", 3), ("1KiB", 1)])
def test_images_are_read_at_once_as_memory_allows(tmp_path, monkeypatch, memory, most):
    cameras = ring(IMAGES, 2, 0.7)
    views = views_of(cameras)
    context = context_of(tmp_path, [photograph(egg(), cameras[0], 0)[0]] * IMAGES, views)
    context = replace(context, options=replace(context.options, memory=memory, threads=3))
    small, lock = photo.read_small_grey, threading.Lock()
    reading: list[int] = [0]

    def read(path: Path, side: int) -> photo.Mask:
        with lock:
            reading.append(reading[-1] + 1)
        time.sleep(0.02)
        found = small(path, side)
        with lock:
            reading.append(reading[-1] - 1)
        return found

    monkeypatch.setattr("colmap_sph.pipeline.input.standing.read_small_grey", read)
    assert still_images(context) == IMAGES
    assert max(reading) == most
