"""ICP against motions that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from colmap_sph.errors import InputError
from colmap_sph.evaluation import EvaluationOptions, PointCloud, evaluate_cloud, make_reference, register

pytest.importorskip("small_gicp")


def hills(count: int, seed: int, noise: float = 0.02) -> np.ndarray:
    random = np.random.default_rng(seed)
    x, y = random.random((2, count)) * 60
    z = 3 * np.sin(x / 5) * np.cos(y / 4) + 0.5 * np.sin(x) + random.normal(0, noise, count)
    return np.stack([x, y, z], axis=1)


def moved(points: np.ndarray, rotation: Rotation, shift: np.ndarray) -> np.ndarray:
    centre = points.mean(axis=0)
    return rotation.apply(points - centre) + centre + shift


@pytest.mark.parametrize("offset", [[0, 0, 0], [500_000, 5_400_000, 300]])
def test_a_known_motion_is_recovered(offset):
    reference = hills(40_000, 1)
    rotation, shift = Rotation.from_rotvec([0.004, -0.006, 0.01]), np.array([0.4, -0.3, 0.25])
    # Other samples of the same surface, and only two thirds of it.
    original = hills(40_000, 2)
    original = original[original[:, 0] < 40]
    cloud = moved(original, rotation, shift)
    result = register(cloud + offset, reference + offset, max_distance=2.0)
    assert result.applied
    error = np.linalg.norm(result.transform(cloud + offset) - offset - original, axis=1)
    assert error.max() < 0.01
    assert result.rotation_degrees == pytest.approx(np.degrees(rotation.magnitude()), abs=0.02)
    # What remains is the distance between samples, not between surfaces.
    assert result.rms_after < 0.6 * result.rms_before
    assert np.linalg.norm(np.array(result.shift) + shift) < 0.02


@pytest.mark.parametrize(("degrees", "is_told"), [(3, False), (9, True)])
def test_a_large_turn_is_told(degrees, is_told, caplog):
    reference = hills(40_000, 1)
    cloud = moved(hills(40_000, 2), Rotation.from_rotvec([0, 0, np.radians(degrees)]), np.zeros(3))
    result = register(cloud, reference, max_distance=4.0)
    assert result.rotation_degrees == pytest.approx(degrees, abs=0.1)
    assert (f"turned the cloud by {degrees}" in caplog.text or not is_told) and bool(caplog.text) == is_told


def test_what_is_in_place_stays_in_place():
    reference, cloud = hills(40_000, 1), hills(40_000, 2)
    result = register(cloud, reference, max_distance=1.0)
    assert np.linalg.norm(result.transform(cloud) - cloud, axis=1).max() < 0.01
    assert result.rotation_degrees < 0.01


def test_registration_is_reported_and_can_be_switched_off():
    reference = make_reference(PointCloud("reference", hills(30_000, 1)))
    cloud = PointCloud("cloud", hills(30_000, 2) + np.array([0.3, 0.2, 0.3]))
    on = evaluate_cloud(cloud, reference, EvaluationOptions())
    off = evaluate_cloud(cloud, reference, EvaluationOptions(register=False))
    assert on.registration is not None and on.registration.applied
    np.testing.assert_allclose(on.registration.shift, [-0.3, -0.2, -0.3], atol=0.02)
    assert off.registration is None
    assert off.cloud_to_reference.mean > 1.3 * on.cloud_to_reference.mean


def test_registration_needs_points_that_meet():
    with pytest.raises(InputError, match="registration needs 100 points"):
        register(hills(50, 1), hills(1000, 2), max_distance=1.0)
