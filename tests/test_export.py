"""What `colmap_sph export` writes is what is in the workspace, in the formats' own conventions."""

import json
import os
import shlex
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import cv2
import laspy
import lazrs
import msgspec
import numpy as np
import OpenImageIO
import pycolmap
import pytest
from clouds import read_points
from conftest import no_room_beyond
from small_workspaces import ALTITUDE, FOCAL, HEIGHT, WIDTH, ground_workspace

from colmap_sph.app import cli
from colmap_sph.errors import ColmapSphError, InputError, NoResultError, OptionError, OutputError
from colmap_sph.products.clouds import copc, octree, spread
from colmap_sph.products.crs import read_crs, utm_zone_of, wkt_of
from colmap_sph.products.export import Exporter, ExportFormat, ExportOptions, export
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.places import check_places
from colmap_sph.project.cloud_tiles import INDEX, Tile, TileIndex
from colmap_sph.project.map_files import write_depth_map, write_normal_map
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View
from colmap_sph.stereo.map_sizes import at_pixel_centres

NAMES = ["a/0.png", "a/1.png", "b.png", "c.png"]
UTM = np.array([691_000.0, 5_334_000.0, 500.0])
POINT = np.dtype([("xyz", "<f8", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])


def make_cloud(count: int, seed: int = 0) -> tuple[np.ndarray, list[list[int]]]:
    """A rough surface far from the world's origin, and the images that see each point."""
    rng = np.random.default_rng(seed)
    points = np.zeros(count, POINT)
    places = rng.uniform(-60, 60, (count, 2))
    points["xyz"] = UTM + np.column_stack([places, 5 * np.sin(places[:, 0] / 7) + rng.normal(0, 0.01, count)])
    normals = rng.normal(size=(count, 3))
    points["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    points["rgb"] = rng.integers(0, 256, (count, 3))
    return points, [sorted(rng.choice(4, rng.integers(1, 5), replace=False).tolist()) for _ in range(count)]


def write_far_cloud(path: Path, points: np.ndarray, images: list[list[int]]) -> None:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property double {name}" for name in "xyz"] + [f"property float n{name}" for name in "xyz"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + points.tobytes())
    words = [number for seen in images for number in (len(seen), *seen)]
    data = struct.pack("<Q", len(points)) + np.array(words, "<u4").tobytes()
    path.with_name(f"{path.name}.vis").write_bytes(data)


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """Cameras above the ground near UTM, with a cloud there, though not of what their maps show."""
    monkeypatch.setattr(spread, "_LEAST_SHOWN", 0.0)
    made = ground_workspace(tmp_path / "dense", NAMES)
    model = pycolmap.Reconstruction(made.sparse_dir)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), UTM))
    rng = np.random.default_rng(5)
    for _ in range(60):
        place = UTM + np.array([rng.uniform(0, 60), rng.uniform(-20, 20), 0])
        model.add_point3D(place, pycolmap.Track(), np.zeros(3, np.uint8))
    model.write_binary(made.sparse_dir)
    write_far_cloud(made.fused_path, *make_cloud(5000))
    return made


def exported(
    workspace: Workspace,
    folder: Path,
    *formats: ExportFormat,
    georeference: Georeference | None = None,
    splat_points: int = 500_000,
    las_scale: float | None = None,
) -> list[Path]:
    options = ExportOptions(formats=formats, splat_points=splat_points, las_scale=las_scale)
    made = Exporter(workspace, options, georeference or Georeference(), folder)
    return list(export(made, lambda _: nullcontext()))


def by_place(xyz: np.ndarray) -> np.ndarray:
    return np.lexsort(np.round(xyz, 3).T)


@pytest.mark.parametrize("kind", ["las", "laz", "copc"])
def test_clouds_hold_what_the_ply_holds(
    workspace: Workspace, tmp_path: Path, kind: ExportFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    pyproj = pytest.importorskip("pyproj")
    monkeypatch.setattr(copc, "_POINTS_IN_MEMORY", 400)
    monkeypatch.setattr(octree, "_FEW", 30)
    monkeypatch.setattr("colmap_sph.products.clouds.source.POINTS_AT_A_TIME", 700)
    place = Georeference(crs="EPSG:25832", wkt=wkt_of(read_crs("EPSG:25832")))
    (path,) = exported(workspace, tmp_path / "out", kind, georeference=place)
    las = laspy.read(path)
    points, images = make_cloud(5000)
    wanted, found = by_place(points["xyz"]), by_place(las.xyz)
    assert np.abs(las.xyz[found] - points["xyz"][wanted]).max() < 1e-4
    colours = np.column_stack([las.red, las.green, las.blue])
    np.testing.assert_array_equal(colours[found], points["rgb"][wanted].astype(int) * 257)
    normals = np.column_stack([las.NormalX, las.NormalY, las.NormalZ])
    np.testing.assert_array_equal(normals[found], points["normal"][wanted])
    np.testing.assert_array_equal(las.Images[found], np.array([len(seen) for seen in images])[wanted])
    crs = las.header.parse_crs()
    assert crs is not None and pyproj.CRS(crs).to_epsg() == 25832
    assert las.header.version == "1.4" and las.header.global_encoding.wkt
    assert np.array_equal(las.header.mins, las.xyz.min(axis=0))
    assert {int(value) for value in (*las.return_number, *las.number_of_returns)} == {1}
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_far_cloud_loses_nothing_and_a_similarity_is_applied(workspace: Workspace, tmp_path: Path) -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    place = Georeference(scale=3.0, rotation=turn, translation=np.array([10.0, 20.0, 30.0]))
    (path,) = exported(workspace, tmp_path / "out", "las", georeference=place)
    points, _ = make_cloud(5000)
    expected = 3 * points["xyz"] @ turn.T + [10, 20, 30]
    las = laspy.read(path)
    assert np.abs(las.xyz - expected).max() < 1e-4
    normals = np.column_stack([las.NormalX, las.NormalY, las.NormalZ])
    np.testing.assert_allclose(normals, points["normal"] @ turn.T, atol=1e-6)
    assert las.header.parse_crs() is None


def coarsen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes of 16 cells along each side, of which small clouds have many."""
    monkeypatch.setattr(copc, "_POINTS_IN_MEMORY", 400)
    monkeypatch.setattr(copc, "CELLS_LOG2", 4)
    monkeypatch.setattr(octree, "CELLS_LOG2", 4)
    monkeypatch.setattr(octree, "_FEW", 0)


def test_levels_are_evenly_spaced_and_those_of_parts_are_those_of_the_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    coarsen(monkeypatch)
    rng = np.random.default_rng(7)
    places = np.column_stack([rng.uniform(0, 1, (4000, 2)) ** 2, rng.uniform(0.4, 0.41, 4000)])
    levels = octree.levels_of(places)
    assert set(levels) == set(range(max(levels) + 1)) and max(levels) >= 3
    for level in range(max(levels)):
        cells = [tuple(cell) for cell in np.floor(places * 16 * 2**level).astype(int).tolist()]
        here = {cell for cell, own in zip(cells, levels, strict=True) if own == level}
        assert len(here) == (levels == level).sum()
        assert here >= {cell for cell, own in zip(cells, levels, strict=True) if own > level}
    for top in (1, 2, 4):
        cubes = octree.cells_of(places, top) @ [1 << 20, 1 << 10, 1]
        for cube in np.unique(cubes):
            np.testing.assert_array_equal(octree.levels_of(places[cubes == cube], top), levels[cubes == cube])


def test_nodes_of_copc_are_cubes_of_an_octree(
    workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarsen(monkeypatch)
    (path,) = exported(workspace, tmp_path / "out", "copc")
    all_points = laspy.read(path).xyz
    with laspy.CopcReader.open(path) as reader:
        info = reader.copc_info
        low, high = info.center - info.halfsize, info.center + info.halfsize
        assert (all_points >= low).all() and (all_points <= high).all()
        entries = reader.root_page.entries
        counts = {(key.level, key.x, key.y, key.z): entry.point_count for key, entry in entries.items()}
        assert sum(counts.values()) == len(all_points) and max(key[0] for key in counts) >= 2
        for level, x, y, z in counts:
            assert level == 0 or (level - 1, x // 2, y // 2, z // 2) in counts
        for key, entry in entries.items():
            side = 2 * info.halfsize / 2**key.level
            corner = low + np.array([key.x, key.y, key.z]) * side
            points = points_of(path, entry)
            assert (points >= corner - 1e-6).all() and (points <= corner + side + 1e-6).all()
        box = laspy.copc.Bounds(mins=UTM - np.array([20, 30, 99]), maxs=UTM + np.array([10, 5, 99]))
        inside = ((all_points >= box.mins) & (all_points <= box.maxs)).all(axis=1)
        assert len(reader.query(bounds=box)) == inside.sum() > 100
        coarse = [len(reader.query(level=level)) for level in range(3)]
    assert coarse[0] < coarse[1] < coarse[2]


def points_of(path: Path, entry: laspy.copc.Entry) -> np.ndarray:
    """Points of one chunk of a COPC file."""
    with laspy.open(path) as reader:
        header = reader.header
        data = path.read_bytes()[entry.offset : entry.offset + entry.byte_size]
        vlr = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
        raw = np.zeros(entry.point_count * header.point_format.size, np.uint8)
        lazrs.decompress_points_with_chunk_table(
            data, vlr.record_data(), raw, [(entry.point_count, entry.byte_size)]
        )
        points = raw.view(header.point_format.dtype())
        return np.column_stack([points[name] for name in "XYZ"]) * header.scales + header.offsets


def test_clouds_in_tiles_are_exported_whole(workspace: Workspace, tmp_path: Path) -> None:
    workspace.fused_path.unlink()
    workspace.tiles_dir.mkdir()
    tiles = []
    for number in range(2):
        points, images = make_cloud(300, number)
        path = workspace.tiles_dir / f"{number:04d}.ply"
        write_far_cloud(path, points, images)
        tiles.append(Tile(path.name, 300, ((0, 0, 0), (1, 1, 1)), {path.name: "0"}))
    index = TileIndex("colmap_sph tiles 1", 600, tuple(tiles))
    (workspace.tiles_dir / INDEX).write_bytes(msgspec.json.encode(index))
    (path,) = exported(workspace, tmp_path / "out", "laz")
    expected = np.concatenate([make_cloud(300, number)[0]["xyz"] for number in range(2)])
    assert np.abs(laspy.read(path).xyz - expected).max() < 1e-4


def test_points_that_cannot_be_are_left_out(
    workspace: Workspace, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    points, images = make_cloud(100)
    points["xyz"][7] = np.nan
    points["xyz"][9, 1] = 1e300
    write_far_cloud(workspace.fused_path, points, images)
    (path,) = exported(workspace, tmp_path / "out", "las")
    las = laspy.read(path)
    kept = np.delete(np.arange(100), [7, 9])
    assert np.abs(las.xyz - points["xyz"][kept]).max() < 1e-4
    np.testing.assert_array_equal(las.Images, [len(images[index]) for index in kept])
    assert caplog.messages == ["2 points of the cloud's 100 have no possible coordinates; left out"]


@pytest.mark.parametrize("kind", ["float", "none"])
def test_colours_that_are_not_read_are_told(
    kind: str, workspace: Workspace, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Other programs write numbers from 0 to 1, or none: LAS files were black without a word."""
    names = ["x", "y", "z", *(("red", "green", "blue") if kind == "float" else ())]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 50"]
    lines += [f"property float {name}" for name in names]
    values = np.random.default_rng(0).uniform(0, 1, (50, len(names))).astype("<f4")
    workspace.fused_path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + values.tobytes())
    workspace.visibility_path.unlink()
    (path,) = exported(workspace, tmp_path / "out", "las")
    assert not laspy.read(path).red.any()
    assert f"{workspace.fused_path} has no colours as this program reads them" in caplog.text


@pytest.mark.parametrize("kind", ["png", "npz", "nerfstudio"])
def test_normal_maps_that_cannot_be_used_are_refused(
    workspace: Workspace, tmp_path: Path, kind: ExportFormat
) -> None:
    """They were taken for none: no normals in NPZ files, and depths moved to pixels' centres without them."""
    path = workspace.normal_map_path(NAMES[0], "geometric")
    write_normal_map(path, np.zeros((HEIGHT, WIDTH - 1, 3), np.float32))
    with pytest.raises(InputError, match=f"{path} is not of its depth map's size"):
        exported(workspace, tmp_path / "size", kind)
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=f"{path} cannot be read"):
        exported(workspace, tmp_path / "folder", kind)
    path.rmdir()
    exported(workspace, tmp_path / "none", kind)  # programs that make depth maps alone


def test_visibility_of_another_cloud_is_not_used(workspace: Workspace, tmp_path: Path) -> None:
    workspace.visibility_path.write_bytes(struct.pack("<Q", 17))
    (path,) = exported(workspace, tmp_path / "out", "las")
    assert "Images" not in laspy.read(path).point_format.dimension_names


@pytest.mark.parametrize("size", [0.0, 3e-7, 1.0, 900.0, 1e5, 5e9])
def test_coordinates_are_as_fine_as_32_bit_floats_where_these_fit(
    workspace: Workspace, tmp_path: Path, size: float
) -> None:
    points, images = make_cloud(50)
    points["xyz"] = np.linspace(-size / 2, size / 2, 50)[:, None] * [1, -0.5, 0.25]
    write_far_cloud(workspace.fused_path, points, images)
    (path,) = exported(workspace, tmp_path / "out", "las")
    error = np.abs(laspy.read(path).xyz - points["xyz"]).max()
    assert error <= max(np.spacing(np.float32(max(size / 2, 1e-5))), 1e-4 if size > 1000 else 0) * 3


def test_deviation_is_that_of_the_maps_along_the_normal(workspace: Workspace, tmp_path: Path) -> None:
    """Maps of a level ground, each some centimetres too deep, and a point of it that all images see."""
    offsets = {"a/0.png": 0.00, "a/1.png": 0.03, "b.png": 0.05, "c.png": 5.0}
    for name, offset in offsets.items():
        write_depth_map(
            workspace.depth_map_path(name, "geometric"), np.full((HEIGHT, WIDTH), ALTITUDE + offset, np.float32)
        )
    points = np.zeros(3, POINT)
    points["xyz"] = UTM + np.array([[30, 0, 0.0], [31, 2, 0.0], [1000, 0, 0]])
    points["normal"] = [[0, 0, 1], [0, 0.6, 0.8], [0, 0, 1]]
    write_far_cloud(workspace.fused_path, points, [[0, 1, 2, 3], [0, 1, 2], [0, 1]])
    (path,) = exported(workspace, tmp_path / "out", "laz", georeference=Georeference(scale=2.0))
    found = laspy.read(path).StdDev
    # The fourth image shows another surface, and nothing shows the third point.
    assert found[0] == pytest.approx(2 * np.std([0.0, 0.03, 0.05], ddof=1), rel=1e-3)
    assert found[1] == pytest.approx(deviation_on_a_slope(points["xyz"][1] - UTM), rel=1e-3)
    assert found[2] == -1


def deviation_on_a_slope(point: np.ndarray) -> float:
    """The same for a point with a tilted normal, from the map's pixels nearest to where it is seen."""
    distances = []
    for number, offset in enumerate((0.0, 0.03, 0.05)):
        center = np.array([20.0 * number, 0, ALTITUDE])
        seen = (point - center) * [1, -1, -1]
        pixel = np.rint(FOCAL * seen[:2] / seen[2] + [WIDTH / 2, HEIGHT / 2])
        ray = np.append((pixel - [WIDTH / 2, HEIGHT / 2]) / FOCAL, 1.0) * [1, -1, -1]
        distances.append((center + ray * (ALTITUDE + offset) - point) @ [0, 0.6, 0.8])
    return float(2 * np.std(distances, ddof=1))


# ---- maps ---------------------------------------------------------------------------------------------------


def tilted() -> tuple[View, np.ndarray, np.ndarray, np.ndarray]:
    """A view, and of a tilted plane depth at COLMAP's pixels, at the centres, and the normals as planes."""
    K = np.array([[300.0, 0, 31.0], [0, 280.0, 22.5], [0, 0, 1]])
    view = View(1, "a.png", 60, 44, K, np.eye(3), np.zeros(3), np.empty(0, np.int64))
    normal = np.array([0.6, -0.3, -1.0]) / np.linalg.norm([0.6, -0.3, -1.0])
    rows, columns = np.mgrid[0:44, 0:60].astype(float)

    def depth(offset: float) -> np.ndarray:
        rays = np.stack([(columns + offset - 31.0) / 300, (rows + offset - 22.5) / 280, np.ones_like(rows)])
        return -20.0 / np.tensordot(normal, rays, 1)

    normals = np.broadcast_to(normal[:, None, None], (3, 44, 60)).astype(np.float32)
    return view, depth(0.0), depth(0.5), normals


def test_depth_at_the_centres_of_pixels_is_exact_on_a_plane() -> None:
    view, given, centred, normals = tilted()
    found = at_pixel_centres(given.astype(np.float32), normals, view)
    np.testing.assert_allclose(found, centred, rtol=1e-6)
    assert np.abs(given - centred).max() > 4e-4 * given.max()
    np.testing.assert_array_equal(
        at_pixel_centres(given.astype(np.float32), 0 * normals, view), given.astype(np.float32)
    )


def test_exr_maps_are_the_same_to_the_byte_at_any_time(workspace: Workspace, tmp_path: Path) -> None:
    made = []
    for name in ("first", "second"):
        (folder,) = exported(workspace, tmp_path / name, "exr")
        made.append({path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.exr")})
        time.sleep(1.1)  # dates in OpenEXR have seconds
    assert made[0].keys() >= {Path(f"{name}.exr") for name in NAMES}
    assert made[0] == made[1]


def test_depth_maps_are_read_back(workspace: Workspace, tmp_path: Path) -> None:
    place = Georeference(scale=2.0)
    exr, png, npz = exported(workspace, tmp_path / "out", "exr", "png", "npz", georeference=place)
    cameras = json.loads((png / "cameras.json").read_text())
    assert cameras["map_units_per_model_unit"] == 2
    assert [each["name"] for each in cameras["images"]] == sorted(NAMES)
    truth = np.full((HEIGHT, WIDTH), ALTITUDE, np.float32)
    truth[:40] = 0
    scene = read_scene(workspace.sparse_dir)
    for each in cameras["images"]:
        steps = cv2.imread(str(png / each["depth"]), cv2.IMREAD_UNCHANGED)
        assert steps is not None and steps.dtype == np.uint16
        np.testing.assert_allclose(steps * cameras["model_units_per_step"], truth, atol=5e-4)
        file = OpenImageIO.ImageInput.open(str(exr / f"{each['name']}.exr"))
        assert file is not None and list(file.spec().channelnames) == ["Z"]
        np.testing.assert_array_equal(np.asarray(file.read_image())[..., 0], truth)
        arrays = np.load(npz / f"{each['name']}.npz")
        np.testing.assert_array_equal(arrays["depth"], truth)
        assert (arrays["normals"][truth > 0] == [0, 0, -1]).all()
        view = scene.view(each["name"])
        place_of_camera = -np.array(arrays["R"]).T @ arrays["t"]
        np.testing.assert_allclose(place_of_camera, view.center + scene.origin, atol=1e-6)
        np.testing.assert_allclose(np.array(each["cam_from_world"])[:, 3], arrays["t"], atol=1e-6)


def test_impossible_depth_is_none(workspace: Workspace, tmp_path: Path) -> None:
    """It made the steps of all PNG files so long that no depth was left, or ended the program."""
    truth = np.full((HEIGHT, WIDTH), ALTITUDE, np.float32)
    write_raw_map(workspace, "b.png", np.full_like(truth, np.inf))
    damaged = truth.copy()
    damaged[0, :4] = 1e30, np.nan, np.inf, -5
    write_raw_map(workspace, "c.png", damaged)
    truth[0, :4] = 0
    (png,) = exported(workspace, tmp_path / "out", "png")
    cameras = json.loads((png / "cameras.json").read_text())
    assert [each["name"] for each in cameras["images"]] == ["a/0.png", "a/1.png", "c.png"]
    steps = cv2.imread(str(png / "c.png.png"), cv2.IMREAD_UNCHANGED)
    assert steps is not None
    np.testing.assert_allclose(steps * cameras["model_units_per_step"], truth, atol=1e-3)
    for name in NAMES:
        write_raw_map(workspace, name, np.full_like(truth, np.inf))
    with pytest.raises(NoResultError, match="has no depth in any geometric depth map"):
        exported(workspace, tmp_path / "none", "png")


def write_raw_map(workspace: Workspace, name: str, depth: np.ndarray) -> None:
    """As another program may write it."""
    head = f"{depth.shape[1]}&{depth.shape[0]}&1&".encode()
    workspace.depth_map_path(name, "geometric").write_bytes(head + depth.astype("<f4").tobytes())


# ---- folders for other programs -----------------------------------------------------------------------------


def ground_points() -> np.ndarray:
    return np.random.default_rng(6).uniform([-20, -15, 0], [60, 15, 0], (40, 3))


def test_nerfstudio_sees_the_same_pixels(workspace: Workspace, tmp_path: Path) -> None:
    """By its data conventions: OpenGL's cameras, depth in files that it multiplies by 0.001."""
    (folder,) = exported(workspace, tmp_path / "out", "nerfstudio", splat_points=800)
    content = json.loads((folder / "transforms.json").read_text())
    scene = read_scene(workspace.sparse_dir)
    origin = np.array(content["model_coordinates_of_origin"])
    assert {frame["file_path"] for frame in content["frames"]} == {f"images/{name}" for name in NAMES}
    for frame in content["frames"]:
        assert (folder / frame["file_path"]).is_file()
        name = frame["file_path"].removeprefix("images/")
        points = ground_points() + UTM
        local = (points - origin) @ np.array(frame["transform_matrix"])[:3, :3] - (
            np.array(frame["transform_matrix"])[:3, 3] @ np.array(frame["transform_matrix"])[:3, :3]
        )
        x = frame["cx"] - frame["fl_x"] * local[:, 0] / local[:, 2]
        y = frame["cy"] + frame["fl_y"] * local[:, 1] / local[:, 2]
        pixels, depth = scene.view(name).project(points - scene.origin)
        np.testing.assert_allclose(np.column_stack([x, y]), pixels, atol=1e-6)
        np.testing.assert_allclose(-local[:, 2], depth, atol=1e-6)
        stored = np.load(folder / frame["depth_file_path"]) * 1e-3
        assert stored.shape == (frame["h"], frame["w"])
        np.testing.assert_allclose(stored[40:], ALTITUDE, rtol=1e-6)
        assert not stored[:40].any()
    start = read_points(folder / content["ply_file_path"])
    assert 400 <= len(start) <= 800
    expected = make_cloud(5000)[0]["xyz"] - origin
    nearest = np.abs(start[:, None] - expected[None]).max(axis=2).min(axis=1)
    assert nearest.max() < 1e-4


def read_points3d(path: Path) -> dict[int, tuple[np.ndarray, list[tuple[int, int]]]]:
    """COLMAP's ``points3D.bin`` by its documented format: place and track of each point."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    position = 8
    points = {}
    for _ in range(count):
        number, x, y, z = struct.unpack_from("<Q3d", data, position)
        (length,) = struct.unpack_from("<Q", data, position + 43)
        track = struct.unpack_from(f"<{2 * length}I", data, position + 51)
        points[number] = (np.array([x, y, z]), list(zip(track[::2], track[1::2], strict=True)))
        position += 51 + 8 * length
    assert position == len(data)
    return points


def test_splats_begin_with_thinned_points_and_their_tracks(workspace: Workspace, tmp_path: Path) -> None:
    (folder,) = exported(workspace, tmp_path / "out", "splats", splat_points=600)
    model_dir = folder / "sparse" / "0"
    origin = np.array([float(word) for word in (folder / "origin.txt").read_text().split()])
    found = read_points3d(model_dir / "points3D.bin")
    assert 300 <= len(found) <= 600
    points, images = make_cloud(5000)
    model = pycolmap.Reconstruction(model_dir)
    ids = model.reg_image_ids()
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    for number, (place, track) in found.items():
        row = int(np.abs(points["xyz"] - origin - place).max(axis=1).argmin())
        assert np.abs(points["xyz"][row] - origin - place).max() < 1e-6
        assert sorted(image for image, _ in track) == sorted(ids[index] for index in images[row])
        for image_id, index in track:
            image = model.image(image_id)
            key_point = image.points2D[index]
            assert key_point.point3D_id == number
            camera = image.cam_from_world() * place
            expected = FOCAL * camera[:2] / camera[2] + [WIDTH / 2, HEIGHT / 2]
            np.testing.assert_allclose(key_point.xy, expected, atol=1e-6)
    assert (folder / "images" / NAMES[0]).is_file()
    spread = np.array([place for place, _ in found.values()])
    assert (np.ptp(spread, axis=0)[:2] > 110).all()


def test_splats_keep_of_each_voxel_what_most_images_see(workspace: Workspace, tmp_path: Path) -> None:
    (folder,) = exported(workspace, tmp_path / "out", "splats", splat_points=200)
    tracks = [len(track) for _, track in read_points3d(folder / "sparse" / "0" / "points3D.bin").values()]
    assert np.mean(tracks) > 3.7  # of all points 2.5


def test_mvsnet_reads_cameras_and_pairs(workspace: Workspace, tmp_path: Path) -> None:
    """As its `load_cam` and `gen_pipeline_mvs_list` take words apart."""
    (folder,) = exported(workspace, tmp_path / "out", "mvsnet")
    scene = read_scene(workspace.sparse_dir)
    for number, view in enumerate(scene.views):
        words = (folder / "cams" / f"{number:08d}_cam.txt").read_text().split()
        assert len(words) == 31 and (words[0], words[17]) == ("extrinsic", "intrinsic")
        extrinsic = np.array(words[1:17], float).reshape(4, 4)
        intrinsic = np.array(words[18:27], float).reshape(3, 3)
        near, step, planes, far = map(float, words[27:])
        assert near < ALTITUDE < far and near + step * (planes - 1) == pytest.approx(far, rel=1e-6)
        points = ground_points() + UTM - scene.origin
        seen = (points @ extrinsic[:3, :3].T + extrinsic[:3, 3]) @ intrinsic.T
        # The first pixel's centre is (0, 0) there, and (0.5, 0.5) in COLMAP.
        np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], view.project(points)[0] - 0.5, atol=1e-6)
        picture = cv2.imread(str(folder / "images" / f"{number:08d}.jpg"))
        assert picture is not None and picture.shape == (HEIGHT, WIDTH, 3)
    words = (folder / "pair.txt").read_text().split()
    position = 1
    for number in range(int(words[0])):
        assert int(words[position]) == number
        count = int(words[position + 1])
        partners = [int(word) for word in words[position + 2 : position + 2 + 2 * count : 2]]
        assert partners and number not in partners and set(partners) <= set(range(4))
        position += 2 + 2 * count
    assert position == len(words)


@pytest.mark.parametrize("place", ["originals", "originals/a"])
def test_no_product_lies_among_the_original_images(workspace: Workspace, tmp_path: Path, place: str) -> None:
    """They are nowhere in the workspace; a new folder below theirs is the user's own wish."""
    for name in NAMES:
        path = tmp_path / "originals" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"original")
    with pytest.raises(OutputError, match=r"originals.* has images of the model, such as \w\.png; choose another"):
        exported(workspace, tmp_path / place, "las")
    exported(workspace, tmp_path / place / "new", "las")
    for folder in (workspace.images_dir, tmp_path / "a"):
        folder.mkdir(exist_ok=True)
        (folder / ".DS_Store").touch()
    exported(workspace, tmp_path / "a", "las")


# ---- bad input ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["las", "laz", "copc", "exr", "png", "npz", "nerfstudio", "splats"])
def test_a_full_disk_leaves_nothing_behind(workspace: Workspace, tmp_path: Path, kind: ExportFormat) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    with no_room_beyond(2000 if kind not in ("exr", "png", "npz") else 150), pytest.raises(OutputError) as told:
        exported(workspace, folder, kind)
    assert str(folder) in str(told.value) and "cannot be written" in str(told.value)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["las", "laz", "copc", "exr", "png", "npz", "nerfstudio", "splats", "mvsnet"])
def test_a_disk_without_room_for_the_last_byte_is_noticed(
    workspace: Workspace, tmp_path: Path, kind: ExportFormat
) -> None:
    """OpenImageIO and COLMAP do not notice: EXR, PNG and models were cut off, with exit code 0."""
    for name in NAMES:  # so that maps are no smaller than what is beside them
        depth = ALTITUDE + np.random.default_rng(0).random((HEIGHT, WIDTH), np.float32)
        write_depth_map(workspace.depth_map_path(name, "geometric"), depth)
    exported(workspace, tmp_path / "whole", kind)
    sizes = [path.stat().st_size for path in (tmp_path / "whole").rglob("*") if path.is_file()]
    with no_room_beyond(max(sizes) - 1), pytest.raises(OutputError):
        exported(workspace, tmp_path / "out", kind)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", ["images", "images/deeper", "sparse", "stereo/depth_maps", "colmap_sph", "link"])
def test_no_product_lies_among_what_is_read(workspace: Workspace, tmp_path: Path, place: str) -> None:
    (tmp_path / "link").symlink_to(workspace.images_dir, target_is_directory=True)
    folder = tmp_path / "link" if place == "link" else workspace.root / place
    with pytest.raises(OutputError, match="whose files are read; choose another --output"):
        exported(workspace, folder, "las")
    with pytest.raises(OutputError, match="whose files are read; choose another --output"):
        check_places(workspace, folder, ["dsm.tif"], overwrite=True)
    assert not list(workspace.root.rglob("*.las"))


def test_what_is_not_there_or_in_the_way_is_told(workspace: Workspace, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    (folder / "splats").mkdir(parents=True)
    (folder / "splats" / "thesis.txt").write_text("mine")
    (folder / "cloud.laz").write_text("mine")
    refused: list[tuple[ExportFormat, type[ColmapSphError], str]] = [
        ("splats", OutputError, "is there already"),
        ("laz", OutputError, "--overwrite"),
    ]
    for kind, error, words in refused:
        with pytest.raises(error, match=words):
            exported(workspace, folder, kind)
    made = Exporter(workspace, ExportOptions(formats=("splats",)), Georeference(), folder)
    with pytest.raises(OutputError, match="no export made it"):
        export(made, lambda _: nullcontext(), overwrite=True)
    assert (folder / "splats" / "thesis.txt").read_text() == "mine"
    assert (folder / "cloud.laz").read_text() == "mine"
    for scale, words in ((1e-9, "too fine"), (1000.0, "no less than the whole cloud")):
        with pytest.raises(OptionError, match=f"las_scale.*{words}"):
            exported(workspace, tmp_path / "other", "las", las_scale=scale)
    write_far_cloud(workspace.fused_path, make_cloud(1)[0], [])
    bad = [([1, 9], "more than"), ([0xFFFFFFFF, 0], "damaged"), ([2, 0], "cut off"), ([1, 0, 0], "damaged")]
    files = [(np.array(seen, "<u4").tobytes(), words) for seen, words in bad]
    for seen, words in [*files, (files[0][0][:-1], "cut off")]:
        data = struct.pack("<Q", 1) + seen
        workspace.visibility_path.write_bytes(data)
        with pytest.raises(InputError, match=words):
            exported(workspace, tmp_path / "other", "splats")
    workspace.visibility_path.unlink()
    with pytest.raises(InputError, match="which images see"):
        exported(workspace, tmp_path / "other", "splats")
    write_far_cloud(workspace.fused_path, *make_cloud(0))
    with pytest.raises(NoResultError, match="no points"):
        exported(workspace, tmp_path / "other", "las")
    workspace.fused_path.unlink()
    with pytest.raises(InputError, match="no fused cloud"):
        exported(workspace, tmp_path / "other", "las")
    named = Workspace(workspace.root.rename(tmp_path / "mö ved"))
    for path in named.stereo_dir.glob("depth_maps/**/*.bin"):
        path.unlink()
    kinds: tuple[ExportFormat, ...] = ("las", "exr")
    for kind in kinds:
        with pytest.raises(InputError) as told:
            exported(named, tmp_path / "other", kind)
        command = str(told.value).split("`")[1]
        assert shlex.split(command) == ["colmap_sph", "run", "--workspace", str(named.root)]
    workspace = named
    assert not (tmp_path / "other").exists()
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match="no fused cloud"):
        exported(workspace, tmp_path / "other", "las")
    assert (tmp_path / "other").is_dir()  # which was there before


def test_an_earlier_export_is_replaced_on_request(workspace: Workspace, tmp_path: Path) -> None:
    made = Exporter(workspace, ExportOptions(formats=("mvsnet", "las")), Georeference(), tmp_path / "out")
    paths = export(made, lambda _: nullcontext())
    (paths[0] / "pair.txt").write_text("old")
    assert export(made, lambda _: nullcontext(), overwrite=True) == paths
    assert (paths[0] / "pair.txt").read_text() != "old"


def test_the_command_says_what_is_wrong(
    workspace: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = str(workspace.root)
    assert cli.main(["export", root, "--formats", "laz", "--crs", "EPSG:25832"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{root}/export/cloud.laz"]
    assert cli.main(["export", root, "--output", str(tmp_path / "later")]) == 0
    assert laspy.read(tmp_path / "later" / "cloud.laz").header.parse_crs().to_epsg() == 25832
    assert cli.main(["export", root, "--crs", "EPSG:0"]) == 2
    assert "EPSG:0 is no coordinate system" in capsys.readouterr().err.replace("\n", " ")
    assert cli.main(["export", root, "--splat-points", "0"]) == 2
    assert "--splat-points" in capsys.readouterr().err
    assert cli.main(["export", str(tmp_path / "nowhere")]) == 2
    monkeypatch.setitem(sys.modules, "pyproj", None)
    capsys.readouterr()
    assert cli.main(["export", root, "--crs", "EPSG:25832", "--overwrite"]) == 2
    assert "pip install '.[geo]'" in capsys.readouterr().err.replace("\n", " ")
    assert cli.main(["export", root, "--formats", "las"]) == 0  # what is known needs no library


def test_a_link_out_of_the_workspace_is_not_followed(workspace: Workspace, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (workspace.root / "export").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="is a link"):
        exported(workspace, workspace.root / "export", "laz")


def test_zones() -> None:
    assert utm_zone_of(0.0, 179.99) == "EPSG:32660" and utm_zone_of(-1e-9, -180.0) == "EPSG:32701"


@pytest.mark.parametrize("kind", ["mvsnet", "nerfstudio", "splats"])
@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_images_that_are_not_whole_are_refused(
    tmp_path: Path, kind: ExportFormat, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of one was handed on; OpenCV shows the rest in grey, without a word."""
    monkeypatch.setattr(spread, "_LEAST_SHOWN", 0.0)
    names = [f"{number}{ending}" for number in range(4)]
    workspace = ground_workspace(tmp_path / "dense", names)
    write_far_cloud(workspace.fused_path, *make_cloud(50))
    path = workspace.image_path(names[2])
    assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8))
    exported(workspace, tmp_path / "whole", kind)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=rf"The image {path} is damaged or no image"):
        exported(workspace, tmp_path / "out", kind)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("what", ["pipe", "folder", "socket", "link to nowhere"])
@pytest.mark.parametrize("kind", ["png", "nerfstudio", "laz"])
def test_something_else_in_the_place_of_a_map_is_refused(
    workspace: Workspace, tmp_path: Path, kind: ExportFormat, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It counted as no map, and its image was left out."""
    path = workspace.depth_map_path(NAMES[2], "geometric")
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what == "socket":
        with socket.socket(socket.AF_UNIX) as end:
            monkeypatch.chdir(path.parent)  # names of sockets are short
            end.bind(path.name)
    else:
        path.symlink_to("nowhere")
    with pytest.raises(InputError, match=rf"{path} cannot be read \(it is not a regular file\)"):
        exported(workspace, tmp_path / "out", kind)
    assert not (tmp_path / "out").exists()


_KILLED = """
import os, sys
from contextlib import nullcontext
from pathlib import Path
import colmap_sph.products.publishing as publishing
from colmap_sph.products.export import Exporter, ExportOptions, export
from colmap_sph.products.georeference import Georeference
from colmap_sph.project.workspace import Workspace
root, folder, left = sys.argv[1], sys.argv[2], int(sys.argv[3])
def watched(event, arguments):
    global left
    if event == "os.rename" or event == "shutil.rmtree" or event == "os.rmdir":
        if any("mvsnet" in str(each) for each in arguments):
            left -= 1
            if left < 0:
                os.kill(os.getpid(), 9)
sys.addaudithook(watched)
made = Exporter(Workspace(Path(root)), ExportOptions(formats=("mvsnet",)), Georeference(), Path(folder))
export(made, lambda _: nullcontext(), overwrite=True)
"""


def test_a_kill_loses_no_earlier_export_and_leaves_nothing_for_ever(workspace: Workspace, tmp_path: Path) -> None:
    """Wherever it comes while folders are moved and removed; the next export, of any format, clears up."""
    folder = tmp_path / "out"
    (path,) = exported(workspace, folder, "mvsnet")
    killed = 0
    for moment in range(100):
        (path / "pair.txt").write_text("old")
        command = [sys.executable, "-P", "-c", _KILLED, str(workspace.root), str(folder), str(moment)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=100)
        if not done.returncode:
            break
        assert done.returncode == -signal.SIGKILL, done.stderr
        killed += 1
        (laz,) = exported(workspace, folder, "laz")
        laz.unlink()
        assert (path / "pair.txt").is_file() and sorted(each.name for each in folder.iterdir()) == ["mvsnet"]
    assert killed >= 3
    assert (path / "pair.txt").read_text() != "old"
