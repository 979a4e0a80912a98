"""A region of what is not plain: masked images, fisheye cameras, models whose points nobody observes."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from clouds import read_fused
from conftest import FinishedRun
from scipy.spatial import cKDTree

import colmap_sph
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.region_file import read_region
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.stereo.region.inside import is_inside
from colmap_sph.synthetic import DemoBlock

GSD = 0.2
HALF = colmap_sph.UndistortionOptions(max_image_size=160)


@pytest.fixture(scope="module")
def box(block: DemoBlock) -> str:
    """The south-west of the block."""
    low, high = np.percentile(read_scene(block.sparse_dir).points, [10, 55], axis=0)
    return f"{low[0]},{low[1]},-99,{high[0]},{high[1]},99"


def check_cloud(dense: Path, box: str, finished: FinishedRun, least: int) -> None:
    """It lies in the region, and on the surface of the whole run's at full size."""
    points = read_fused(dense / "fused.ply")["xyz"].astype(float)
    assert len(points) > least
    region = read_region(box)
    assert is_inside(replace(region, box=region.box + np.array([[-0.01], [0.01]])), points).all()
    whole = read_fused(finished.dense / "fused.ply")["xyz"].astype(float)
    distances, _ = cKDTree(whole).query(points)
    assert np.mean(distances < 4 * GSD) > 0.97


def test_masks(block: DemoBlock, box: str, finished: FinishedRun, tmp_path: Path) -> None:
    """The left half of all images: where the region lies under it, nothing is wrong."""
    for view in read_scene(block.sparse_dir).views:
        mask = np.full((view.height, view.width), 255, np.uint8)
        mask[:, : view.width // 2] = 0
        path = tmp_path / "masks" / f"{view.name}.png"
        path.parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(path), mask)
    options = RunOptions(region=box, undistortion=HALF)
    dense = tmp_path / "dense"
    report = colmap_sph.run(block.sparse_dir, masks=tmp_path / "masks", output=dense, options=options)
    check_cloud(dense, box, finished, 1000)
    for name in report.coverage:
        depth = read_depth_map(dense / f"stereo/depth_maps/{name}.geometric.bin")
        assert not depth[:, : depth.shape[1] // 2].any()
    empty = {name for name, share in report.coverage.items() if share == 0}
    assert empty and empty == report.out_of_region.keys()
    assert not report.skipped_images
    # What is masked is not covered, as without a region.
    assert 0.3 < report.coverage["N_0_0.jpg"] < 0.7


def test_points_that_no_image_observes(block: DemoBlock, box: str, finished: FinishedRun, tmp_path: Path) -> None:
    """As of imported models: images see the points that lie before them."""
    model = pycolmap.Reconstruction(block.sparse_dir)
    bare = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        bare.add_camera_with_trivial_rig(camera)
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        copy = pycolmap.Image(image.name, np.empty((0, 2)), image.camera_id, image.image_id)
        bare.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        bare.add_point3D(point.xyz, pycolmap.Track(), point.color)
    (tmp_path / "bare").mkdir()
    bare.write_binary(tmp_path / "bare")
    dense = tmp_path / "dense"
    options = RunOptions(region=box, undistortion=HALF)
    report = colmap_sph.run(tmp_path / "bare", images=block.images_dir, output=dense, options=options)
    check_cloud(dense, box, finished, 3000)
    assert report.images == 10 and not report.skipped_images
    assert min(report.coverage.values()) > 0.6 and max(report.in_region.values()) < 0.4


def with_fisheye(block: DemoBlock, folder: Path) -> None:
    """The block's pictures and model as a fisheye lens would have taken them."""
    model = pycolmap.Reconstruction(block.sparse_dir)
    fish = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        K = camera.calibration_matrix()
        params = [0.9 * K[0, 0], 0.9 * K[1, 1], K[0, 2], K[1, 2], 0.03, -0.01, 0.0, 0.0]
        size = {"width": camera.width, "height": camera.height}
        fish.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera.camera_id, model="OPENCV_FISHEYE", params=params, **size)
        )
    for image_id in model.reg_image_ids():
        image = model.image(image_id)
        lens = fish.camera(image.camera_id)
        K = model.camera(image.camera_id).calibration_matrix()
        x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
        rays = np.asarray(lens.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))[:, :2]
        places = (rays * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5).astype(np.float32).reshape(*x.shape, 2)
        picture = cv2.imread(str(block.images_dir / image.name))
        assert picture is not None
        taken = cv2.remap(picture, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
        assert cv2.imwrite(str(folder / "images" / image.name), taken, [cv2.IMWRITE_JPEG_QUALITY, 98])
        pose = image.cam_from_world()
        seen = [lens.img_from_cam(pose * model.points3D[each.point3D_id].xyz) for each in image.points2D]
        copy = pycolmap.Image(image.name, np.array(seen).reshape(-1, 2), image.camera_id, image_id)
        fish.add_image_with_trivial_frame(copy, pose)
    for point_id, point in model.points3D.items():
        fish.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=point.xyz, color=point.color, track=point.track))
    fish.write_binary(folder / "sparse/0")


def test_fisheye_cameras(block: DemoBlock, box: str, finished: FinishedRun, tmp_path: Path) -> None:
    for folder in ("images", "sparse/0"):
        (tmp_path / folder).mkdir(parents=True)
    with_fisheye(block, tmp_path)
    dense = tmp_path / "dense"
    report = colmap_sph.run(tmp_path / "sparse/0", output=dense, options=RunOptions(region=box, undistortion=HALF))
    check_cloud(dense, box, finished, 2000)
    assert report.images == 10 and min(report.coverage.values()) > 0.6
    assert (report.overall_agreement or 0) > 0.95
