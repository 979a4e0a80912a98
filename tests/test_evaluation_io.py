"""Reading clouds and meshes."""

from pathlib import Path

import numpy as np
import pytest

from colmap_sph.errors import InputError
from colmap_sph.evaluation import EvaluationOptions, Mesh, PointCloud, evaluate_files, read_geometry

laspy = pytest.importorskip("laspy")
pytest.importorskip("trimesh")

POINTS = np.random.default_rng(0).random((50, 3)) * 10 + [512_345, 5_403_210, 250]
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def ply(style: str, points: np.ndarray, *, kind: str = "double", faces: np.ndarray | None = None) -> bytes:
    header = f"ply\nformat {style} 1.0\ncomment written by hand\nelement vertex {len(points)}\n"
    header += "".join(f"property {kind} {axis}\n" for axis in "xyz") + "property uchar red\n"
    if faces is not None:
        header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    header += "end_header\n"
    if style == "ascii":
        body = "".join(f"{x!r} {y!r} {z!r} 9\n" for x, y, z in points.tolist())
        body += "" if faces is None else "".join(f"3 {a} {b} {c}\n" for a, b, c in faces.tolist())
        return header.encode() + body.encode()
    order = ORDERS[style]
    record = np.zeros(len(points), [("xyz", order + ("f8" if kind == "double" else "f4"), 3), ("red", "u1")])
    record["xyz"] = points
    data = header.encode() + record.tobytes()
    if faces is not None:
        triangles = np.zeros(len(faces), [("n", "u1"), ("rows", order + "i4", 3)])
        triangles["n"], triangles["rows"] = 3, faces
        data += triangles.tobytes()
    return data


def write_las(path: Path, points: np.ndarray, crs_records: list | None = None) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, 1e-4)
    header.vlrs.extend(crs_records or [])
    las = laspy.LasData(header)
    las.xyz = points
    las.write(path)
    return path


@pytest.mark.parametrize("style", ["ascii", *ORDERS])
def test_ply_clouds_keep_every_digit(tmp_path: Path, style: str):
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply(style, POINTS))
    cloud = read_geometry(path)
    assert isinstance(cloud, PointCloud) and cloud.points.dtype == np.float64
    np.testing.assert_array_equal(cloud.points, POINTS)


@pytest.mark.parametrize("style", ["ascii", *ORDERS])
def test_ply_with_faces_is_a_mesh(tmp_path: Path, style: str):
    path = tmp_path / "mesh.ply"
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    path.write_bytes(ply(style, POINTS[:4], faces=faces))
    mesh = read_geometry(path)
    assert isinstance(mesh, Mesh)
    np.testing.assert_array_equal(mesh.vertices, POINTS[:4])
    np.testing.assert_array_equal(mesh.faces, faces)


def test_obj(tmp_path: Path):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    mesh = read_geometry(path)
    assert isinstance(mesh, Mesh) and len(mesh.faces) == 2
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\n")
    assert isinstance(read_geometry(path), PointCloud)


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las(tmp_path: Path, ending: str):
    cloud = read_geometry(write_las(tmp_path / f"cloud.{ending}", POINTS))
    assert isinstance(cloud, PointCloud) and cloud.z_is_up and cloud.crs is None
    np.testing.assert_allclose(cloud.points, POINTS, rtol=0, atol=5.1e-5)


def stated_system(path: Path) -> str | None:
    cloud = read_geometry(path)
    assert isinstance(cloud, PointCloud)
    return cloud.crs


@pytest.mark.parametrize("point_format", [1, 6])
def test_points_of_las_that_do_not_count_are_left_out(
    tmp_path: Path, point_format: int, caplog: pytest.LogCaptureFixture
):
    """Withheld ones and noise, which would make a cloud incomplete (ASPRS, LAS 1.4 R15, tables 7, 9 and 17)."""
    las = laspy.create(point_format=point_format, file_version="1.4")
    las.x, las.y, las.z = np.arange(30.0).reshape(3, 10)
    las.classification = [2, 2, 7, 18, 2, 5, 6, 1, 0, 2]
    las.withheld = np.arange(10) == 5
    las.write(tmp_path / "lidar.las")
    cloud = read_geometry(tmp_path / "lidar.las")
    assert isinstance(cloud, PointCloud)
    assert cloud.points[:, 0].tolist() == [0, 1, 4, 6, 7, 8, 9]
    assert "lidar.las: 3 points of 10 are marked as withheld or as noise; left out" in caplog.text


def test_las_states_its_coordinate_system(tmp_path: Path):
    from laspy.vlrs.known import GeoKeyDirectoryVlr, WktCoordinateSystemVlr

    projected = WktCoordinateSystemVlr('PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84"]]')
    assert stated_system(write_las(tmp_path / "a.las", POINTS, [projected])) == "projected (WGS 84 / UTM zone 33N)"
    geographic = WktCoordinateSystemVlr('GEOGCS["WGS 84",DATUM["WGS_1984"]]')
    assert stated_system(write_las(tmp_path / "b.las", POINTS, [geographic])) == "geographic (WGS 84)"
    keys = GeoKeyDirectoryVlr()
    keys.parse_record_data(np.array([1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, 32633], "<u2").tobytes())
    assert stated_system(write_las(tmp_path / "c.las", POINTS, [keys])) == "projected (EPSG:32633)"


def test_files_are_measured(tmp_path: Path):
    reference = write_las(tmp_path / "lidar.laz", POINTS)
    (tmp_path / "fused.ply").write_bytes(ply("binary_little_endian", POINTS + np.array([0, 0, 0.5])))
    scores = evaluate_files([tmp_path / "fused.ply"], reference, EvaluationOptions(tau=(0.6,), register=False))
    assert len(scores) == 1 and scores[0].thresholds[0].f_score == 1
    assert scores[0].cloud.endswith("fused.ply") and scores[0].reference.endswith("lidar.laz")


def test_bad_files_are_named(tmp_path: Path):
    def refuses(name: str, content: bytes | None, message: str) -> None:
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_geometry(path)

    whole = ply("binary_little_endian", POINTS)
    broken = POINTS.copy()
    broken[3, 1] = np.nan
    refuses("absent.ply", None, r"absent\.ply does not exist")
    refuses("cloud.xyz", b"1 2 3\n", "unknown format '.xyz': convert it to PLY")
    refuses("short.ply", whole[:-50], r"short\.ply cannot be read as PLY")
    refuses("long.ply", whole + whole[-25:], r"long\.ply .* it goes on behind what its header")
    refuses("long_ascii.ply", ply("ascii", POINTS) + b"1 2 3 9\n", "goes on behind what its header counts")
    (tmp_path / "line.ply").write_bytes(whole + b"\n")
    cloud = read_geometry(tmp_path / "line.ply")
    assert isinstance(cloud, PointCloud) and len(cloud.points) == len(POINTS)
    refuses("text.ply", b"not a cloud", r"text\.ply cannot be read as PLY")
    refuses("zero.ply", b"", r"zero\.ply cannot be read as PLY")
    refuses("none.ply", ply("binary_little_endian", POINTS[:0]), r"none\.ply is empty")
    refuses("none_ascii.ply", ply("ascii", POINTS[:0]), r"none_ascii\.ply is empty")
    refuses(
        "nan.ply",
        ply("binary_little_endian", broken),
        r"nan\.ply: 1 of 50 points have coordinates that are NaN",
    )
    refuses("flat.ply", whole.replace(b"property double z\n", b""), r"flat\.ply")
    refuses("text.las", b"not a cloud", r"text\.las cannot be read as LAS")
    las = write_las(tmp_path / "good.las", POINTS).read_bytes()
    refuses("short.las", las[:-200], r"short\.las")
    laz = write_las(tmp_path / "good.laz", POINTS).read_bytes()
    refuses("short.laz", laz[: len(laz) // 2], r"short\.laz")
    write_las(tmp_path / "none.las", POINTS[:1])
    header = laspy.LasHeader(point_format=6, version="1.4")
    laspy.LasData(header).write(tmp_path / "none.las")
    refuses("none.las", None, r"none\.las is empty")


def test_map_coordinates_in_short_floats_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = tmp_path / "cloud.ply"
    path.write_bytes(ply("binary_little_endian", POINTS, kind="float"))
    read_geometry(path)
    assert "32-bit floats, in steps of 0.5" in caplog.text
