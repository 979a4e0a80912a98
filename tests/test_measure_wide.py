"""What the script that measures wide images counts at the borders of views, on made-up views."""

import importlib

import numpy as np
import pytest

from colmap_sph.project.map_files import write_depth_map

pytestmark = pytest.mark.usefixtures("scripts_on_path")


def test_only_pixels_at_one_border_and_well_inside_another_count():
    script = importlib.import_module("measure_wide")
    # At the border of the first view three times; beside it; too deep; seen by it alone.
    inside = np.radians(np.array([[1, 1.9, 0.5, -1, 5, 1], [9, 20, 30, 20, 20, -500]]))
    has = np.array([[True, False, False, True, True, True], [True, True, False, True, True, False]])
    assert script.count_at_borders(inside, has).tolist() == [3, 1, 2]


def test_depth_is_looked_up_in_the_pixel_that_a_ray_meets(tmp_path):
    script = importlib.import_module("measure_wide")
    depth = np.zeros((3, 4), np.float32)
    depth[1, 2] = 5
    write_depth_map(tmp_path / "depth.bin", depth)
    # COLMAP's pixels have their centres at halves: that of column 2, row 1 lies at (2.5, 1.5).
    K = np.array([[2, 0, 2], [0, 2, 1.5], [0, 0, 1]])
    rays = [[0.25, 0, 1], [0.45, -0.2, 1], [-0.05, 0, 1], [0.25, 0.3, 1], [9, 0, 1], [-0.25, 0, -1]]
    assert script.has_depth(tmp_path / "depth.bin", K, np.array(rays)).tolist() == [True, True, *[False] * 4]
