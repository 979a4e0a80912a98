"""Images, masks and maps with fewer pixels than they have on the disk."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_sph.project.images.reading import read_colours, read_grey
from colmap_sph.project.masks import read_view_mask
from colmap_sph.scene import View
from colmap_sph.stereo.map_sizes import reduced_maps

K = np.array([[500.0, 0, 310], [0, 520, 250], [0, 0, 1]])
VIEW = View(1, "a.png", 640, 480, K, np.eye(3), np.zeros(3), np.empty(0, np.int64), 0.4)


def plane_maps(view: View, normal: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact maps of the plane normal · X = -distance; pixel (col, row) has the ray K⁻¹ (col, row, 1)."""
    columns, rows = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(view.K).T
    depth = -distance / (rays @ normal)
    normals = np.broadcast_to(normal[:, None, None], (3, *depth.shape))
    return depth.astype(np.float32), normals.astype(np.float32)


@pytest.mark.parametrize(
    ("size", "expected"), [(320, (320, 240)), (213, (213, 160)), (-1, (640, 480)), (900, (640, 480))]
)
def test_a_view_is_reduced_as_colmap_reduces_it(size, expected):
    small = VIEW.no_larger_than(size)
    assert (small.width, small.height) == expected
    assert small.file_size == (640, 480)
    points = np.array([[0.3, -0.2, 4.0], [-1.0, 1.0, 3.0]])
    scale = np.array(expected) / [640, 480]
    np.testing.assert_allclose(small.project(points)[0], VIEW.project(points)[0] * scale)
    assert VIEW.resized(320, 240).resized(640, 480).full_size is None


@pytest.mark.parametrize("size", [320, 213, 100])
def test_a_plane_stays_the_same_plane(size):
    normal = np.array([0.5, -0.3, -0.9])
    normal /= np.linalg.norm(normal)
    small = VIEW.no_larger_than(size)
    depth, normals = reduced_maps(*plane_maps(VIEW, normal, 7.0), VIEW, small)
    expected_depth, expected_normals = plane_maps(small, normal, 7.0)
    np.testing.assert_allclose(depth, expected_depth, rtol=1e-5)
    np.testing.assert_array_equal(normals, expected_normals)


def test_no_depth_stays_none_and_surfaces_are_not_mixed():
    depth = np.where(np.arange(640) < 320, np.float32(2), np.float32(9)) * np.ones((480, 1), np.float32)
    depth[:, 100:200] = 0
    normals = np.zeros((3, 480, 640), np.float32)
    normals[2, depth > 0] = -1
    small = VIEW.resized(213, 160)
    reduced, reduced_normals = reduced_maps(depth, normals, VIEW, small)
    assert set(np.unique(reduced)) == {0, 2, 9}
    np.testing.assert_array_equal(reduced > 0, reduced_normals[2] < 0)


def test_images_and_masks_are_reduced_when_read(tmp_path: Path):
    picture = np.zeros((480, 640, 3), np.uint8)
    picture[:, 320:] = (10, 20, 200)
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    colours = read_colours(tmp_path / "a.png", (320, 240))
    assert colours.shape == (240, 320, 3)
    np.testing.assert_array_equal(colours[:, 160:], np.broadcast_to([10, 20, 200], (240, 160, 3)))
    grey = read_grey(tmp_path / "a.png", (320, 240))
    np.testing.assert_allclose(grey[0, [0, -1]], [0, 0.114 * 10 + 0.587 * 20 + 0.299 * 200], rtol=1e-4)
    mask = np.full((480, 640), 255, np.uint8)
    mask[101, 201] = 0
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    reduced = read_view_mask(tmp_path / "m.png", VIEW.resized(320, 240))
    assert reduced is not None
    assert np.argwhere(reduced == 0).tolist() == [[50, 100]]
    whole = read_view_mask(tmp_path / "m.png", replace(VIEW))
    np.testing.assert_array_equal(whole, mask)
