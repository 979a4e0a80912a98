"""The same numbers as CloudCompare's command line, on the same files."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from colmap_sph.evaluation import EvaluationOptions, PointCloud, evaluate_cloud, make_reference, read_geometry

CLOUDCOMPARE = shutil.which("CloudCompare") or shutil.which("cloudcompare.CloudCompare") or ""
pytestmark = pytest.mark.skipif(not CLOUDCOMPARE, reason="CloudCompare is not installed")


def write_ply(path: Path, points: np.ndarray) -> Path:
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "property double x\nproperty double y\nproperty double z\nend_header\n"
    path.write_bytes(header.encode() + np.ascontiguousarray(points, "<f8").tobytes())
    return path


def cloudcompare(cloud: Path, reference: Path, *options: str) -> tuple[float, float]:
    """Mean and standard deviation that `CloudCompare -C2C_DIST` logs."""
    log = cloud.with_suffix(".log")
    command = [CLOUDCOMPARE, "-SILENT", "-LOG_FILE", str(log), "-AUTO_SAVE", "OFF"]
    command += ["-O", str(cloud), "-O", str(reference), "-C2C_DIST", *options]
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    text = log.read_text() if log.exists() else done.stdout
    found = re.search(r"Mean distance = (\S+) / std deviation = (\S+)", text)
    assert found, f"CloudCompare printed no distance:\n{done.stdout}\n{done.stderr}"
    return float(found[1]), float(found[2])


def ours(cloud: Path, reference: Path, cap: float | None = None) -> tuple[float, float]:
    options = EvaluationOptions(register=False, crop="none", distance_cap=cap)
    scores = evaluate_cloud(read_geometry(cloud), make_reference(read_geometry(reference), options), options)
    return scores.cloud_to_reference.mean, scores.cloud_to_reference.standard_deviation


@pytest.mark.parametrize("cap", [None, 0.3])
def test_synthetic_clouds(tmp_path: Path, cap: float | None):
    random = np.random.default_rng(0)
    reference = np.column_stack([random.random((20_000, 2)) * 20, np.zeros(20_000)])
    cloud = np.column_stack([random.random((30_000, 2)) * 20, random.normal(0, 0.3, 30_000)])
    a, b = write_ply(tmp_path / "a.ply", cloud), write_ply(tmp_path / "b.ply", reference)
    limit = () if cap is None else ("-MAX_DIST", str(cap))
    assert ours(a, b, cap) == pytest.approx(cloudcompare(a, b, *limit), rel=1e-3)


@pytest.mark.parametrize("cap", [None, 1.0])
def test_real_clouds(tmp_path: Path, data_dir: Path, cap: float | None):
    """An aerial image's depth map, as a cloud, against airborne LiDAR."""
    cv2 = pytest.importorskip("cv2")
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(data_dir / "penta" / "sparse" / "0"))
    image = next(image for image in model.images.values() if Path(image.name).stem == "B_02_05")
    pose = image.cam_from_world().matrix()
    depth = cv2.imread(str(data_dir / "penta" / "depth" / "B_02_05.png"), cv2.IMREAD_UNCHANGED)[::3, ::3] * 0.005
    row, column = np.nonzero(depth > 0)
    z = depth[row, column]
    x, y = (3 * column + 0.5 - 600) / 1200, (3 * row + 0.5 - 450) / 1200
    cloud = (np.stack([x * z, y * z, z], axis=1) - pose[:, 3]) @ pose[:, :3]
    lidar = read_geometry(data_dir / "penta" / "lidar.laz")
    assert isinstance(lidar, PointCloud)
    a, b = write_ply(tmp_path / "a.ply", cloud), write_ply(tmp_path / "b.ply", lidar.points)
    limit = () if cap is None else ("-MAX_DIST", str(cap))
    assert ours(a, b, cap) == pytest.approx(cloudcompare(a, b, *limit), rel=1e-3)
