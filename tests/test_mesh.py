"""Meshes of exact maps and clouds against the solids, read back by other programs, and what is refused."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import trimesh
from refusals import assert_refused
from scipy.spatial import cKDTree
from surveyed import BLUE, BOX, GREEN, GSD, RED, ROOF, surveyed_workspace

from colmap_sph.app import cli
from colmap_sph.errors import InputError, NoResultError, OptionError, OutputError
from colmap_sph.evaluation import read_geometry
from colmap_sph.evaluation.geometry_io import Mesh
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.mesh import make, preview, tsdf
from colmap_sph.products.mesh.glb import write_glb
from colmap_sph.products.mesh.make import MeshRequest, make_mesh
from colmap_sph.products.mesh.options import MeshOptions
from colmap_sph.products.mesh.preview import write_preview
from colmap_sph.products.mesh.texture.textured import plain
from colmap_sph.products.mesh.triangles import Triangles, read_ply, write_ply
from colmap_sph.project.cloud_tiles import INDEX, TileIndex
from colmap_sph.project.workspace import PREVIEW_SIDE, Workspace
from colmap_sph.scene import POINT

PLENTY = 8 << 30


def is_open3d_here() -> bool:
    try:
        tsdf.open3d()
    except InputError:
        return False
    return True


needs_open3d = pytest.mark.skipif(not is_open3d_here(), reason="Open3D, or what it needs, is not installed")


def made(
    workspace: Workspace,
    folder: Path,
    memory: int = PLENTY,
    place: Georeference | None = None,
    start: Callable[[str, int], None] = lambda *_: None,
    **options,
) -> Any:
    """The mesh that was made, read from mesh.ply by trimesh."""
    request = MeshRequest(workspace, place or Georeference(), MeshOptions(**options), folder, memory, 1)
    make_mesh(request, start, lambda: None)
    return trimesh.load(folder / "mesh.ply", process=False)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return surveyed_workspace(tmp_path_factory.mktemp("surveyed") / "dense")


@pytest.fixture(scope="module")
def cloudy(tmp_path_factory):
    """A workspace whose cloud is a sphere of radius 5 around (0, 0, 8): red above, green below."""
    made_of = surveyed_workspace(tmp_path_factory.mktemp("cloudy") / "dense")
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = np.zeros(len(directions), POINT)
    points["xyz"] = 5 * directions + [0, 0, 8]
    points["normal"] = directions
    points["rgb"] = np.where(directions[:, 2:] > 0, RED, GREEN)
    names = [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    names += [f"property uchar {name}" for name in ("red", "green", "blue")]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *names, "end_header\n"]
    made_of.fused_path.write_bytes("\n".join(head).encode() + points.tobytes())
    return made_of


def distance_to_solids(points):
    """From the ground and the box on it."""
    low, high = np.array([*BOX[0], 0.0]), np.array([*BOX[1], ROOF])
    outside = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=1)
    inside = np.minimum(points - low, high - points).min(axis=1)
    return np.minimum(np.abs(points[:, 2]), np.where(outside > 0, outside, inside))


# ---- files -------------------------------------------------------------------------------------------------


def pyramid() -> Triangles:
    points = np.array([[1, 2, 3], [5, 2, 3], [1, 4, 3], [2, 3, 9]], np.float32)
    colours = np.array([RED, GREEN, BLUE, (9, 8, 7)], np.uint8)
    return Triangles(points, colours, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32))


def test_a_glb_file_is_read_upright_by_others(tmp_path):
    mesh = pyramid()
    write_glb(tmp_path / "mesh.glb", [plain(mesh)], np.eye(3))
    found: Any = trimesh.load(tmp_path / "mesh.glb", process=False, force="mesh")
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    x, y, z = (mesh.points - middle).T
    np.testing.assert_allclose(found.vertices, np.stack([x, z, -y], axis=1), atol=1e-6)
    assert np.array_equal(found.faces, mesh.faces)
    # Where there is a material, trimesh lets go of colours.
    data = (tmp_path / "mesh.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = document["bufferViews"][accessor["bufferView"]]
    colours = np.frombuffer(data, np.uint8, view["byteLength"], 28 + length + view["byteOffset"]).reshape(-1, 4)
    assert np.array_equal(colours[:, :3], mesh.colours)


@pytest.mark.parametrize("most_faces", [0, 10**6], ids=["corners", "triangles"])
def test_a_small_picture_shows_a_mesh_from_the_south_and_above(tmp_path, monkeypatch, most_faces):
    """A level square, red in the north, green in the south, and a blue mast whose foot is in the middle.

    Corners alone would leave holes where these are farther apart than pixels.
    """
    monkeypatch.setattr(preview, "_MOST_FACES", most_faces)
    x, y = (each.ravel() for each in np.mgrid[-1:1:200j, -1:1:200j])
    mast = np.column_stack([np.zeros(300), np.zeros(300), np.linspace(0, 0.5, 300)])
    points = np.concatenate([np.column_stack([x, y, np.zeros(len(x))]), mast]).astype(np.float32)
    colours = np.where((points[:, 1] > 0)[:, None], (255, 0, 0), (0, 255, 0)).astype(np.uint8)
    colours[len(x) :] = (0, 0, 255)
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    axes *= np.linalg.det(axes)
    corner = np.arange(200 * 199)[np.arange(200 * 199) % 200 < 199, None]
    foot = len(x) + np.arange(298)[:, None]
    steps = ((corner, (0, 200, 1)), (corner, (1, 200, 201)), (foot, (0, 1, 2)))
    faces = np.concatenate([first + np.array(step) for first, step in steps]).astype(np.int32)
    mesh = Triangles((points @ axes).astype(np.float32), colours, faces)
    write_preview(tmp_path / "small.png", mesh, axes)
    found = cv2.imread(str(tmp_path / "small.png"))
    assert found is not None
    picture = found[..., ::-1]
    height, width = picture.shape[:2]
    assert height < width <= 101 if most_faces == 0 else width == PREVIEW_SIDE
    left = slice(width // 20, 2 * width // 5)
    assert (picture[height // 50 + 1 : height // 4, left] == (255, 0, 0)).all()
    assert (picture[-height // 4 : -height // 50 - 1, left] == (0, 255, 0)).all()
    blue = np.flatnonzero((picture == (0, 0, 255)).all(axis=2).any(axis=1))
    assert blue.max() <= height // 2 + 1
    assert blue.min() < 0.3 * height


def test_a_mesh_that_was_not_written_to_its_end_is_refused(tmp_path):
    """COLMAP tells nobody that the disk is full, and leaves a part: of it no smaller mesh is made."""
    path = tmp_path / "mesh.ply"
    mesh = pyramid()
    write_ply(path, mesh, mesh.points)
    whole = path.read_bytes()
    assert len(read_ply(path).faces) == len(mesh.faces)
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with pytest.raises(OutputError, match="cannot be written whole; free some space"):
            read_ply(path)


def test_a_ply_file_keeps_map_coordinates(tmp_path):
    mesh = pyramid()
    far = mesh.points + np.array([5e5, 5.4e6, 0.123456789])
    write_ply(tmp_path / "far.ply", mesh, far)
    found: Any = trimesh.load(tmp_path / "far.ply", process=False)
    assert np.array_equal(found.vertices, far)
    assert np.array_equal(found.faces, mesh.faces)
    write_ply(tmp_path / "near.ply", mesh, mesh.points)
    again = read_ply(tmp_path / "near.ply")
    assert all(
        np.array_equal(getattr(again, each), getattr(mesh, each)) for each in ("points", "colours", "faces")
    )
    geometry = read_geometry(tmp_path / "near.ply")
    assert isinstance(geometry, Mesh)
    assert np.array_equal(geometry.vertices, mesh.points)


# ---- of depth maps -----------------------------------------------------------------------------------------


@needs_open3d
def test_the_mesh_of_depth_maps_is_the_solids(workspace, tmp_path):
    mesh = made(workspace, tmp_path, min_images=2)
    points = np.asarray(mesh.vertices)
    inner = (np.abs(points[:, :2]) < 9).all(axis=1)
    off = distance_to_solids(points[inner])
    assert np.median(off) < 0.02 * GSD
    assert np.percentile(off, 95) < GSD
    # All of the roof is there, and most of the walls, which four images see.
    middles, areas = mesh.triangles_center, mesh.area_faces
    on_roof = (np.abs(middles[:, 2] - ROOF) < GSD) & (np.abs(middles[:, :2]) < [4, 3]).all(axis=1)
    assert areas[on_roof].sum() == pytest.approx(48, rel=0.1)
    assert (mesh.face_normals[on_roof][:, 2] > 0.5).mean() > 0.95
    on_walls = (middles[:, 2] > GSD) & (middles[:, 2] < ROOF - GSD) & (np.abs(middles[:, :2]) < 5).all(axis=1)
    assert areas[on_walls].sum() > 0.7 * (ROOF - 2 * GSD) * 28
    colours = np.asarray(mesh.visual.vertex_colors)[:, :3].astype(int)
    well_on_roof = (np.abs(points[:, 2] - ROOF) < 0.3 * GSD) & (np.abs(points[:, :2]) < [3.5, 2.5]).all(axis=1)
    assert np.abs(colours[well_on_roof] - RED).max() <= 3


@needs_open3d
def test_blocks_do_not_show(workspace, tmp_path):
    whole = made(workspace, tmp_path / "whole", voxel=2 * GSD)
    with pytest.raises(OptionError, match=r"would do") as refused:
        made(workspace, tmp_path / "none", memory=1 << 20, voxel=2 * GSD)
    least = int(str(refused.value).split("MiB would do")[0].split()[-1]) << 20
    blocks = made(workspace, tmp_path / "blocks", memory=least + (1 << 20), voxel=2 * GSD)
    assert len(blocks.vertices) > len(whole.vertices)  # at the seams twice
    assert blocks.area == pytest.approx(whole.area, rel=1e-3)
    distance, _ = cKDTree(whole.vertices).query(blocks.vertices)
    assert np.percentile(distance, 99) < 1e-3 * GSD


@needs_open3d
def test_a_mesh_on_the_map_has_its_coordinates(workspace, tmp_path):
    place = Georeference("EPSG:25832", "", 2.0, np.eye(3), np.array([5e5, 5.4e6, 300]))
    local = made(workspace, tmp_path / "local", voxel=3 * GSD)
    far = made(workspace, tmp_path / "far", voxel=3 * GSD, place=place)
    # Their order is Open3D's.
    distance, _ = cKDTree(place.to_map(local.vertices)).query(far.vertices)
    assert distance.max() < 1e-5


# ---- of a cloud --------------------------------------------------------------------------------------------


def test_poissons_mesh_of_a_sphere_is_a_sphere(cloudy, tmp_path):
    mesh = made(cloudy, tmp_path, method="poisson", voxel=0.7, trim=0.0)
    points = np.asarray(mesh.vertices) - [0, 0, 8]
    assert np.abs(np.linalg.norm(points, axis=1) - 5).max() < 0.05
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 125, rel=0.01)  # and its faces look outwards
    above = np.asarray(mesh.visual.vertex_colors)[points[:, 2] > 1][:, :3].astype(int)
    assert np.abs(above - RED).max() <= 3
    assert (tmp_path / "mesh.glb").exists()


def test_glb_keeps_the_axes_of_a_level_model(cloudy, tmp_path):
    """Also where the scene's longer side lies askew to them, as those of the surface model and the orthophoto."""
    yaw = np.radians(30)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    turned = surveyed_workspace(tmp_path / "dense", turn=turn)
    turned.fused_path.write_bytes(cloudy.fused_path.read_bytes())
    mesh = made(turned, tmp_path / "mesh", method="poisson", voxel=0.7, trim=0.0)
    found: Any = trimesh.load(tmp_path / "mesh" / "mesh.glb", process=False, force="mesh")
    x, y, z = (mesh.vertices - mesh.bounds.mean(axis=0)).T
    np.testing.assert_allclose(found.vertices, np.stack([x, z, -y], axis=1), atol=1e-5)


def test_glb_of_a_geocentric_map_is_upright(cloudy, tmp_path):
    """At 45° south and 45° east: its z is the Earth's axis, which lies there as far below the horizon."""
    east, up = np.array([-1.0, 1.0, 0.0]) / np.sqrt(2), np.array([0.5, 0.5, -np.sqrt(0.5)])
    turn = np.column_stack([east, np.cross(up, east), up])
    place = Georeference("EPSG:4978", "GEOCCS[]", 1.0, turn, 6367489.0 * up)
    made(cloudy, tmp_path, place=place, method="poisson", voxel=0.7, trim=0.0)
    made(cloudy, tmp_path / "near", method="poisson", voxel=0.7, trim=0.0)
    found: Any = trimesh.load(tmp_path / "mesh.glb", process=False, force="mesh")
    near: Any = trimesh.load(tmp_path / "near" / "mesh.glb", process=False, force="mesh")
    # The normal of the ellipsoid is .19 degrees off the direction from its middle.
    np.testing.assert_allclose(found.vertices, near.vertices, atol=0.1)


def test_simplified_meshes_have_fewer_faces(cloudy, tmp_path, capfd):
    full = made(cloudy, tmp_path / "full", method="poisson", voxel=0.7, trim=0.0)
    steps: list[str] = []
    chosen: dict[str, Any] = {"voxel": 0.7, "trim": 0.0, "simplify": 0.2, "formats": ("ply",)}
    few = made(cloudy, tmp_path / "few", start=lambda name, _: steps.append(name), method="poisson", **chosen)
    assert steps == ["poisson", "simplify"]  # which takes long, too
    assert len(few.faces) == pytest.approx(0.2 * len(full.faces), rel=0.1)
    assert few.volume == pytest.approx(full.volume, rel=0.01)
    assert not (tmp_path / "few" / "mesh.glb").exists()
    assert not capfd.readouterr().err  # of COLMAP's
    above = np.asarray(few.visual.vertex_colors)[few.vertices[:, 2] > 9][:, :3].astype(int)
    assert np.abs(above - RED).max() <= 3


# ---- what is refused ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"voxel": -1.0}, "voxel"),
        ({"voxel": float("inf")}, "voxel"),
        ({"simplify": 0.0}, "simplify"),
        ({"simplify": 2.0}, "simplify"),
        ({"min_images": 0}, "min_images"),
        ({"trim": -1.0}, "trim"),
        ({"formats": ()}, "formats"),
    ],
)
def test_nonsense_is_refused(options, name):
    assert_refused(MeshOptions(**options), name)


def test_a_texture_for_no_format_that_has_one_is_refused():
    assert_refused(MeshOptions(formats=("ply",), texture=True), "texture", "formats")


def test_a_missing_open3d_is_one_sentence(workspace, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(InputError, match=r"pip install '\.\[mesh\]', .*poisson"):
        made(workspace, tmp_path)


def test_a_library_that_open3d_needs_is_named(workspace, tmp_path, monkeypatch):
    def refuse(_):
        raise ImportError("libusb-1.0.so.0: cannot open shared object file: No such file or directory")

    monkeypatch.setattr(tsdf, "import_module", refuse)
    with pytest.raises(
        InputError, match=r"for lack of libusb-1\.0\.so\.0; .*apt install libusb-1\.0-0"
    ) as refused:
        made(workspace, tmp_path)
    assert "\n" not in str(refused.value)


def test_a_mesh_coarser_than_the_pixels_is_told(cloudy, tmp_path, monkeypatch, caplog):
    """Of a large block, or of two blocks far apart; here a sphere of 10 units, and cells of two pixels of 0.2."""
    made(cloudy, tmp_path / "fine", method="poisson", trim=0.0)
    assert caplog.text == ""
    monkeypatch.setattr(make, "_DEPTHS", (3, 4))
    made(cloudy, tmp_path / "coarse", method="poisson", trim=0.0)
    assert re.search(r"poisson has 16 cells along a side at most, not 2\d;", caplog.text)


def test_cells_of_poisson_are_as_asked_for_where_something_lies_far_off(cloudy, tmp_path, monkeypatch, caplog):
    """The octree is as large as all of the cloud, not as what most pixels see: cells were 8 times as large."""
    head, data = cloudy.fused_path.read_bytes().split(b"end_header\n")
    points = np.frombuffer(data, POINT).copy()
    points["xyz"][:8] += [600, 0, 0]
    other = surveyed_workspace(tmp_path / "other")
    other.fused_path.write_bytes(head + b"end_header\n" + points.tobytes())
    mesh = made(other, tmp_path / "made", method="poisson", voxel=0.5, trim=6.0)
    near = np.linalg.norm(np.asarray(mesh.vertices) - [0, 0, 8], axis=1)
    assert abs(np.median(near) - 5) < 0.05
    edges = mesh.edges_unique_length[(np.abs(mesh.vertices[mesh.edges_unique]) < 20).all(axis=(1, 2))]
    # Of a surface in cubes, whose side is the whole over a power of two: up to 1.5 times what is given.
    assert 0.25 < np.median(edges) < 1.0
    assert caplog.text == ""
    monkeypatch.setattr(make, "_DEPTHS", (3, 8))
    made(other, tmp_path / "coarse", method="poisson", voxel=0.5, trim=0.0)
    assert re.search(
        r"coarser than --voxel asks for, as poisson has 256 cells along a side at most, not 12\d\d;", caplog.text
    )


def test_poisson_without_a_cloud_says_what_is_missing(workspace, tmp_path):
    with pytest.raises(InputError, match=r"fused\.ply is missing, .* run colmap_sph run first"):
        made(workspace, tmp_path, method="poisson")
    other = surveyed_workspace(tmp_path / "other")
    other.tiles_dir.mkdir()
    (other.tiles_dir / INDEX).write_bytes(msgspec.json.encode(TileIndex("colmap_sph tiles 1", 0, ())))
    with pytest.raises(InputError, match=r"fused\.ply is missing, .* --fusion\.max-points-per-file 0 first"):
        made(other, tmp_path, method="poisson")


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("no normals", r"fused\.ply has 20,000 points without a normal"),
        ("one normal of 0", r"fused\.ply has 1 point without a normal"),
        ("one place unknown", r"without possible coordinates"),
        ("two points", r"has only 2 points"),
        ("one normal unknown", r"fused\.ply has 1 point without a normal"),
        ("normals of no length", r"fused\.ply has 20,000 points without a normal"),
        ("normals of any length", r"fused\.ply has 20,000 points without a normal of possible length"),
        ("one place for all", r"All points of .*fused\.ply lie within 0, less than one cell of 0\.\d+,"),
        ("nearly one place", r"All points of .*fused\.ply lie within 1e-30, less than one cell"),
    ],
)
def test_a_cloud_that_poisson_would_crash_on_is_refused(wrong, words, cloudy, tmp_path):
    """Others may have written it; COLMAP ends the whole program at some."""
    head, data = cloudy.fused_path.read_bytes().split(b"end_header\n")
    points = np.frombuffer(data, POINT).copy()
    if wrong == "no normals":
        head = re.sub(rb"property float n.\n", b"", head)
        points = points[["xyz", "rgb"]].astype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    elif wrong == "one normal of 0":
        points["normal"][7] = 0
    elif wrong == "one place unknown":
        points["xyz"][7, 1] = np.nan
    elif wrong == "one normal unknown":
        points["normal"][7, 1] = np.nan
    elif wrong in ("normals of no length", "normals of any length"):
        points["normal"] *= 1e-30 if wrong == "normals of no length" else 1e30
    elif wrong in ("one place for all", "nearly one place"):
        points["xyz"] = 0
        points["xyz"][::2, 0] = 1e-30 if wrong == "nearly one place" else 0
    else:
        head, points = head.replace(b"vertex 20000", b"vertex 2"), points[:2]
    other = surveyed_workspace(tmp_path / "other")
    other.fused_path.write_bytes(head + b"end_header\n" + points.tobytes())
    with pytest.raises((InputError, NoResultError), match=words):
        made(other, tmp_path / "made", method="poisson", trim=8.0)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("voxel", [1e-9, 1e9])
def test_a_voxel_that_cannot_be_had_is_refused(voxel, cloudy, tmp_path, capsys):
    """It was made another one without a word."""
    arguments = ["mesh", str(cloudy.root), "--output", str(tmp_path), "--method", "poisson", "--voxel", str(voxel)]
    assert cli.main(arguments) == 2
    assert f"error: --voxel is {voxel:g}, and " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_command_says_what_it_made(cloudy, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("colmap_sph.app.products.mesh_command.num_cores", lambda: 1)
    arguments = ["mesh", str(cloudy.root), "--output", str(tmp_path), "--method", "poisson", "--voxel", "0.8"]
    assert cli.main([*arguments, "--trim", "0", "--formats", "ply"]) == 0
    printed = capsys.readouterr()
    assert printed.out.splitlines() == [str(tmp_path / name) for name in ("mesh.ply", "preview_mesh.png")]
    assert "triangles" in printed.err
    assert cli.main([*arguments, "--simplify", "3"]) == 2
