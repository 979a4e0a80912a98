"""The adjustment of a model without points: ties and given centres are all that tell its poses."""

import numpy as np
import pycolmap
import pytest

from colmap_sph.project.polishing.adjustment import Observations, adjusted_model
from colmap_sph.stereo.rectified_pair import Float

SIZE, FOCAL = (640, 480), 600.0
NUM_IMAGES = 10
DEPTH = 3.0
PIXEL = DEPTH / FOCAL
"""What a pixel covers, in the model's units."""
NAMES = [f"{k}.jpg" for k in range(NUM_IMAGES)]
CAMERA = pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2]
)


def true_poses() -> list[pycolmap.Rigid3d]:
    """Cameras held into a room, a few hand's breadths from each other."""
    rng = np.random.default_rng(1)
    return [
        pycolmap.Rigid3d(turn := pycolmap.Rotation3d(rng.normal(0, 0.1, 3)), turn * rng.uniform(-0.25, 0.25, 3))
        for _ in NAMES
    ]


def observed(poses: list[pycolmap.Rigid3d]) -> Observations:
    """Ties between three images each, found to a sixth of a pixel, of what is nearly flat."""
    rng = np.random.default_rng(2)
    points: list[Float] = []
    rows: list[tuple[float, ...]] = []
    for point in rng.uniform([-1.5, -1, 0.97 * DEPTH], [1.5, 1, 1.03 * DEPTH], (200, 3)):
        pixels = [CAMERA.img_from_cam(pose * point) for pose in poses]
        seen = [
            k for k, pixel in enumerate(pixels) if pixel is not None and (np.abs(pixel / SIZE - 0.5) < 0.5).all()
        ]
        if len(seen) >= 3:
            rows += [(len(points), k, *pixels[k]) for k in rng.choice(seen, 3, replace=False)]
            points.append(point)
    track, image, x, y = np.array(rows).T
    places = np.stack([x, y], axis=1) + rng.normal(0, 0.16, (len(rows), 2))
    return Observations(NAMES, track.astype(np.int64), image.astype(np.int64), places, np.array(points), 0.8)


def model_of(poses: list[pycolmap.Rigid3d]) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(CAMERA)
    for image_id, (name, pose) in enumerate(zip(NAMES, poses, strict=True), 1):
        model.add_image_with_trivial_frame(pycolmap.Image(name, np.empty((0, 2)), 1, image_id), pose)
    return model


def centers(model: pycolmap.Reconstruction) -> Float:
    return np.array([model.image(k).projection_center() for k in sorted(model.images)])


def turns(model: pycolmap.Reconstruction, poses: list[pycolmap.Rigid3d]) -> Float:
    """(n, 3) turns that bring each camera to where it should be, pixels."""
    should_be = zip(sorted(model.images), poses, strict=True)
    wrong = [model.image(k).cam_from_world().rotation.inverse() * pose.rotation for k, pose in should_be]
    return FOCAL * np.array([2 * turn.quat[:3] * np.sign(turn.quat[3]) for turn in wrong])


@pytest.fixture(scope="module")
def adjusted() -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
    """A model whose cameras were turned by some pixels where they are, and the adjusted one."""
    rng = np.random.default_rng(3)
    given = []
    for pose in true_poses():
        turn = pycolmap.Rotation3d(rng.normal(0, 2.0 / FOCAL, 3)) * pose.rotation
        given.append(pycolmap.Rigid3d(turn, turn * (pose.rotation.inverse() * pose.translation)))
    model = model_of(given)
    result = adjusted_model(model, observed(true_poses()))
    assert result is not None
    return model, result


def test_centers_stay(adjusted: tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]) -> None:
    """They were right, and of so flat a scene ties hardly tell a step from a turn."""
    given, result = adjusted
    moved = np.linalg.norm(centers(result) - centers(given), axis=1) / PIXEL
    assert np.median(moved) < 0.3


def test_cameras_are_turned_back(adjusted: tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]) -> None:
    """But for what they have in common, of which ties know nothing: as a whole they stay as they were."""
    before, after = (turns(model, true_poses()) for model in adjusted)
    np.testing.assert_allclose(after.mean(axis=0), before.mean(axis=0), atol=0.1)
    left = [np.sqrt((wrong - wrong.mean(axis=0)) ** 2).mean() for wrong in (before, after)]
    assert left[1] < 0.1 * left[0]


def test_exact_poses_stay() -> None:
    """Ties of what is nearly flat fit cameras that are turned towards each other, too, and scale all depths."""
    model = model_of(true_poses())
    result = adjusted_model(model, observed(true_poses()))
    assert result is not None
    assert np.sqrt((turns(result, true_poses()) ** 2).mean()) < 0.08
    assert np.median(np.linalg.norm(centers(result) - centers(model), axis=1)) / PIXEL < 0.1
