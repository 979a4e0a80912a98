"""Textures of exact meshes, read back by another program, against the colours of the solids."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from surveyed import BLUE, BOX, GREEN, RED, ROOF, surveyed_workspace

from colmap_sph.errors import OutputError
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.mesh import obj
from colmap_sph.products.mesh.glb import write_glb
from colmap_sph.products.mesh.make import MeshRequest, make_mesh
from colmap_sph.products.mesh.obj import write_obj
from colmap_sph.products.mesh.options import MeshOptions
from colmap_sph.products.mesh.texture.atlas import lay_out
from colmap_sph.products.mesh.texture.choice import choose_views
from colmap_sph.products.mesh.texture.neighbours import neighbours_of
from colmap_sph.products.mesh.texture.textured import Sheet, textured
from colmap_sph.products.mesh.triangles import Triangles
from colmap_sph.products.surface.seen import seen_views

TOLERANCE = 0.5
MARGIN = 0.5
GREY = (128, 128, 128)


def rectangle(corner: Any, right: Any, up: Any, steps: tuple[int, int]) -> Triangles:
    """Seen from where `right` × `up` points to, in triangles."""
    across, along = steps
    i, j = (each.ravel() for each in np.mgrid[: across + 1, : along + 1])
    points = np.array(corner) + np.outer(i / across, right) + np.outer(j / along, up)
    first = (np.arange(across)[:, None] * (along + 1) + np.arange(along)).ravel()
    quads = np.stack([first, first + along + 1, first + along + 2, first + 1], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Triangles(points.astype(np.float32), np.full((len(points), 3), GREY, np.uint8), faces.astype(np.int32))


def together(parts: list[Triangles]) -> Triangles:
    first = np.cumsum([0, *(len(part.points) for part in parts)])
    return Triangles(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.colours for part in parts]),
        np.concatenate([part.faces + shift for part, shift in zip(parts, first, strict=False)]),
    )


@pytest.fixture(scope="module")
def solids() -> Triangles:
    """The ground, the roof, and two of the walls."""
    (left, near), (right, far) = BOX
    width, length = right - left, far - near
    return together(
        [
            rectangle((-8, -6, 0), (16, 0, 0), (0, 12, 0), (64, 48)),
            rectangle((left, near, ROOF), (width, 0, 0), (0, length, 0), (32, 24)),
            rectangle((left, near, 0), (width, 0, 0), (0, 0, ROOF), (32, 16)),
            rectangle((right, near, 0), (0, length, 0), (0, 0, ROOF), (24, 16)),
        ]
    )


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return surveyed_workspace(tmp_path_factory.mktemp("surveyed") / "dense")


@pytest.fixture(scope="module")
def sheets(workspace, solids, tmp_path_factory) -> list[Sheet]:
    scene, seen = seen_views(workspace)
    folder = tmp_path_factory.mktemp("pages")
    return textured(solids, workspace, scene, seen, TOLERANCE, folder, lambda: None)


def exact_colours(points: np.ndarray) -> np.ndarray:
    return np.where(points[:, 2:] > ROOF - 0.01, RED, np.where(points[:, 2:] < 0.01, GREEN, BLUE))


def is_hidden(points: np.ndarray) -> np.ndarray:
    """Ground under the box, which no image sees."""
    inside = ((points[:, :2] > BOX[0] + MARGIN) & (points[:, :2] < BOX[1] - MARGIN)).all(axis=1)
    return inside & (points[:, 2] < 0.01)


def is_visible(points: np.ndarray) -> np.ndarray:
    """What is some pixels away from all edges, and not hidden."""
    from_side = np.abs(np.abs(points[:, :2]) - BOX[1]) > MARGIN
    beyond = (np.abs(points[:, :2]) > BOX[1] + MARGIN).any(axis=1)
    within = (np.abs(points[:, :2]) < BOX[1] - MARGIN).all(axis=1)
    on_wall = (points[:, 2] > MARGIN) & (points[:, 2] < ROOF - MARGIN) & from_side.any(axis=1)
    return np.where(points[:, 2] < 0.01, beyond, np.where(points[:, 2] > ROOF - 0.01, within, on_wall))


def test_neighbours_share_an_edge_also_across_parts():
    one = rectangle((0, 0, 0), (2, 0, 0), (0, 1, 0), (2, 1))
    other = rectangle((2, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1))
    mesh = together([one, other])
    beside = neighbours_of(mesh)
    places = [{tuple(point) for point in mesh.points[face].tolist()} for face in mesh.faces]
    for face, around in enumerate(beside.tolist()):
        wanted = {other for other in range(len(places)) if len(places[face] & places[other]) == 2}
        assert {each for each in around if each != face} == wanted


def test_faces_take_views_that_see_them(workspace, solids):
    _, seen = seen_views(workspace)
    chosen = choose_views(solids, workspace, seen, TOLERANCE, lambda: None)
    middles = solids.points[solids.faces].mean(axis=1)
    assert (chosen[is_hidden(middles)] == -1).all()
    assert (chosen[is_visible(middles)] >= 0).all()
    # Walls are seen from the side that they look to.
    normals = np.cross(*(solids.points[solids.faces[:, k]] - solids.points[solids.faces[:, 0]] for k in (1, 2)))
    for face in np.flatnonzero((np.abs(normals[:, 2]) < 1e-9) & (chosen >= 0)).tolist():
        assert normals[face] @ (seen[chosen[face]].view.center - middles[face]) > 0


def test_pages_have_what_the_images_show(solids, sheets):
    *pages, unseen = sheets
    assert unseen.picture is None
    assert sum(len(sheet.faces) for sheet in sheets) == len(solids.faces)
    for sheet in pages:
        assert sheet.picture is not None
        assert sheet.uv is not None
        picture: Any = cv2.imread(str(sheet.picture))
        height, width = picture.shape[:2]
        middles = sheet.points[sheet.faces].mean(axis=1)
        places = sheet.uv[sheet.faces].mean(axis=1) * [width, height]
        assert ((sheet.uv >= 0) & (sheet.uv <= 1)).all()
        column, row = np.floor(places).astype(int).T
        off = np.abs(picture[row, column, ::-1].astype(int) - exact_colours(middles)).max(axis=1)
        assert off[is_visible(middles)].max() < 50


def test_parts_of_images_do_not_overlap_on_pages(workspace, solids):
    _, seen = seen_views(workspace)
    chosen = choose_views(solids, workspace, seen, TOLERANCE, lambda: None)
    charts, on_pages = lay_out(solids, chosen, seen)
    taken = [np.zeros(size[::-1], int) for size in charts.sizes]
    for box, page, corner in zip(charts.box, charts.page, charts.corner, strict=True):
        width, height = box[2:] - box[:2]
        taken[page][corner[1] : corner[1] + height, corner[0] : corner[0] + width] += 1
    assert all(page.max() == 1 for page in taken)
    assert sorted(on_pages.faces.tolist()) == np.flatnonzero(chosen >= 0).tolist()


def test_an_interruption_leaves_no_obj_with_the_pictures_of_another_mesh(solids, sheets, tmp_path, monkeypatch):
    places = [sheet.points for sheet in sheets]
    write_obj(tmp_path / "mesh.obj", sheets, places)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(obj, "_write_sheet", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_obj(tmp_path / "mesh.obj", sheets, places)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.mtl", "mesh_0.jpg"]


def test_other_programs_read_glb_and_obj_with_their_pictures(solids, sheets, tmp_path):
    write_glb(tmp_path / "mesh.glb", sheets, np.eye(3))
    made = write_obj(tmp_path / "mesh.obj", sheets, [sheet.points for sheet in sheets])
    assert [path.name for path in made] == ["mesh.obj", "mesh.mtl", "mesh_0.jpg"]
    turned = solids.points - (solids.points.min(axis=0) + solids.points.max(axis=0)) / 2
    for name, points in (("glb", turned[:, [0, 2, 1]] * [1, 1, -1]), ("obj", solids.points)):
        found: Any = trimesh.load(tmp_path / f"mesh.{name}", process=False, force="scene")
        parts = list(found.geometry.values())
        assert sum(len(part.faces) for part in parts) == len(solids.faces)
        whole = found.to_geometry()
        assert whole.area == pytest.approx(16 * 12 + 48 + 8 * ROOF + 6 * ROOF, rel=1e-4)
        np.testing.assert_allclose(whole.bounds, [points.min(axis=0), points.max(axis=0)], atol=1e-4)
        (pictured,) = (part for part in parts if part.visual.kind == "texture" and part.visual.uv is not None)
        material = pictured.visual.material
        picture = np.asarray(material.baseColorTexture if name == "glb" else material.image)
        height, width = picture.shape[:2]
        # trimesh counts rows from below.
        places = pictured.visual.uv[pictured.faces].mean(axis=1) * [width, height]
        colours = picture[np.floor(height - places[:, 1]).astype(int), np.floor(places[:, 0]).astype(int), :3]
        up = pictured.triangles_center[:, 2]  # not turned: that is the scene's part
        on_roof = up > up.max() - 1e-3
        assert (np.abs(colours[on_roof].astype(int) - RED).max(axis=1) < 60).mean() > 0.97


def test_pictures_and_materials_of_others_are_not_replaced(workspace, tmp_path):
    for number, name in enumerate(("mesh.mtl", "mesh_3.jpg")):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / name).write_bytes(b"mine")
        options = MeshOptions("poisson", formats=("obj",), texture=True)
        with pytest.raises(OutputError, match=f"{name} is there already"):
            make_mesh(MeshRequest(workspace, Georeference(), options, folder, 8 << 30, 1), print, print)


def test_the_command_makes_textures_of_a_mesh_on_the_map(workspace, tmp_path):
    pytest.importorskip("open3d")
    place = Georeference("EPSG:25832", "", 1.0, np.eye(3), np.array([5e5, 5.4e6, 300]))
    options = MeshOptions(formats=("glb", "obj"), texture=True, simplify=0.2)
    request = MeshRequest(workspace, place, options, tmp_path, 8 << 30, 1)
    paths, faces = make_mesh(request, lambda *_: None, lambda: None)
    assert {path.name for path in paths} >= {"mesh.glb", "mesh.obj", "mesh.mtl", "mesh_0.jpg"}
    lines = Path(tmp_path / "mesh.obj").read_text().splitlines()
    assert sum(line.startswith("f ") for line in lines) == faces
    first = next(line for line in lines if line.startswith("v "))
    assert np.abs(np.array(first.split()[1:4], float) - place.translation).max() < 100
