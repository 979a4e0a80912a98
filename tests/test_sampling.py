"""Pairs are sampled as finely as their images are sharp."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import FinishedRun
from projects import read_picture

from colmap_sph.pipeline.context import Context
from colmap_sph.pipeline.execute import execute
from colmap_sph.pipeline.input.good_images import with_good_images
from colmap_sph.pipeline.keys import Keys
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages import check_images
from colmap_sph.pipeline.stages.match import _PAIR_SECONDS, MatchStage
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair, sampling_of
from colmap_sph.stereo.rectified_pair import RectifiedPair

SAMPLING = RunOptions(rectification=RectificationOptions(sampling=0.8))


def context_of(dense: Path, options: RunOptions = SAMPLING) -> Context:
    workspace = Workspace(dense)
    return Context(workspace, read_scene(workspace.sparse_dir), options, Keys(workspace, options))


def pair_of(scene: Scene) -> tuple[str, str]:
    first, second = scene.views[:2]
    return first.name, second.name


def geometry_of(context: Context) -> RectifiedPair:
    pair = pair_of(context.scene)
    return MatchStage(context, [pair]).job(pair).task.geometry


@pytest.fixture
def dense(finished: FinishedRun, tmp_path: Path) -> Path:
    """Images and model of a small block, without results."""
    for name in ("images", "sparse"):
        shutil.copytree(finished.dense / name, tmp_path / name)
    return tmp_path


def blur(dense: Path, name: str, sigma: float) -> None:
    path = dense / "images" / name
    picture = cv2.GaussianBlur(read_picture(path), (0, 0), sigma)
    path.write_bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())


def test_blurred_images_are_sampled_coarsely(dense: Path) -> None:
    sharp = with_good_images(context_of(dense), execute)
    names = pair_of(sharp.scene)
    for name in names:
        blur(dense, name, 1.5)
    soft = with_good_images(context_of(dense), execute)
    assert all(soft.details[name] < 0.6 * sharp.details[name] for name in names)
    assert {k: v for k, v in soft.details.items() if k not in names} == {
        k: v for k, v in sharp.details.items() if k not in names
    }
    ratio = geometry_of(soft).columns_per_radian / geometry_of(sharp).columns_per_radian
    finest = [sampling_of(max(context.details[name] for name in names)) for context in (sharp, soft)]
    assert ratio == pytest.approx(finest[1] / finest[0], rel=0.01)
    assert ratio < 0.6
    pair = pair_of(sharp.scene)
    assert MatchStage(soft, [pair]).job(pair).key != MatchStage(sharp, [pair]).job(pair).key


def test_a_pair_that_would_be_tried_first_is_another(dense: Path) -> None:
    """Whether it is depends on how well sparse points fit, which the geometry does not know."""
    context = with_good_images(context_of(dense), execute)
    pair = pair_of(context.scene)
    jobs = []
    for error in (0.1, 0.2, 1.0):
        views = tuple(replace(view, reprojection_error=error) for view in context.scene.views)
        jobs.append(MatchStage(replace(context, scene=replace(context.scene, views=views)), [pair]).job(pair))
    assert [job.task.trial < 1 for job in jobs] == [False, False, True]
    assert jobs[0].key == jobs[1].key != jobs[2].key
    share_of_pixels = jobs[2].task.trial ** 2
    of_pixels = [job.cost.seconds - _PAIR_SECONDS * (1 + (job.task.trial < 1)) for job in jobs]
    assert of_pixels[2] == pytest.approx((1 + share_of_pixels) * of_pixels[0])


def test_the_detail_of_an_image_is_measured_once(dense: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = with_good_images(context_of(dense), execute)
    monkeypatch.setattr(check_images, "image_detail", lambda _: pytest.fail("measured again"))
    second = with_good_images(context_of(dense), execute)
    assert second.details == first.details
    assert second.report.detail == pytest.approx(np.mean(list(first.details.values())), abs=0.001)
    expected = 0.8 * np.mean([sampling_of(detail) for detail in first.details.values()])
    assert second.report.sampling == pytest.approx(expected, abs=0.001)


def test_images_to_come_are_taken_for_sharp(dense: Path) -> None:
    """In a dry run; where some are there, for what these are."""
    context = context_of(dense)
    foreseen = with_good_images(context, execute, to_come=context.scene.index_of)
    assert foreseen.details == {}
    half_known = replace(foreseen, details={context.scene.views[2].name: 0.4})
    ratio = geometry_of(half_known).columns_per_radian / geometry_of(foreseen).columns_per_radian
    assert ratio == pytest.approx(sampling_of(0.4) / sampling_of(1.0), rel=0.01)


def test_many_pixels_are_right_where_many_are_asked_for(dense: Path) -> None:
    """`max_pixels_ratio` is about how images lie, not about how finely they are sampled."""
    scene = read_scene(Workspace(dense).sparse_dir)
    left, right = scene.views[:2]
    coarse = RectificationOptions(max_pixels_ratio=1.5)
    for sampling, details in ((1.0, None), (1.0, (1.0, 1.0)), (4.0, (1.0, 0.3)), (0.3, (0.3, 0.3))):
        pair = rectify_pair(scene, left, right, replace(coarse, sampling=sampling), details)
        usual = rectify_pair(scene, left, right, coarse)
        finest = 1.0 if details is None else max(map(sampling_of, details))
        assert pair.columns_per_radian == pytest.approx(sampling * finest * usual.columns_per_radian, rel=0.01)
