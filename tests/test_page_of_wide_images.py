"""The page of a workspace with fisheyes or panoramas: an entry for each of these, and none for their views."""

import base64
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from small_workspaces import HOSTILE_NAMES, ground_workspace
from test_pages import Page, made

from colmap_sph.app import cli
from colmap_sph.errors import printable
from colmap_sph.pages.block_map import Ground, frame_around
from colmap_sph.pages.originals import WideImage
from colmap_sph.pages.pictures import normal_picture
from colmap_sph.pages.reasons import Reason
from colmap_sph.pages.samples import MapSamples
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.layout import Face, faces_of
from colmap_sph.project.wide.projection import Lens, camera_rays
from colmap_sph.project.wide.range_maps import ViewMaps, range_and_normals, read_range_map
from colmap_sph.project.wide.table import TABLE_NAME, read_cuts, write_cuts
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import View
from colmap_sph.synthetic.wide.courtyard import CourtyardOptions, make_courtyard

FISHEYE = Lens("SIMPLE_FISHEYE", (40.0, 75.0, 70.0), 150, 140, 1.7)
PANORAMA = Lens("EQUIRECTANGULAR", (180.0, 90.0), 180, 90)


def pixels_with_a_view(lens: Lens, faces: list[Face]) -> np.ndarray:
    """(H, W) bool."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = camera_rays(lens, np.column_stack([x.ravel(), y.ravel()]))
    shown = [face.points(np.nan_to_num(rays))[1] for face in faces]
    return np.asarray((np.any(shown, axis=0) & ~np.isnan(rays[:, 0])).reshape(lens.height, lens.width))


# ---- joined samples ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [FISHEYE, PANORAMA], ids=["fisheye", "panorama"])
def test_samples_of_all_pixels_are_the_range_map(lens: Lens) -> None:
    """Views all of whose pixels are samples, with a depth here and there → the pixels that the range map has."""
    rng = np.random.default_rng(5)
    image = WideImage("a.jpg", lens, 192, with_pictures=True)
    maps = []
    turned, _ = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))
    for number, face in enumerate(faces_of(lens)):
        coarse = rng.uniform(-4, 9, (7, 7))
        depth = np.maximum(cv2.resize(coarse, (face.width, face.height)), 0).astype(np.float32)
        K = np.array([[face.focal, 0, face.x], [0, face.focal, face.y], [0, 0, 1]])
        view = View(
            number,
            f"{face.name}/a.png",
            face.width,
            face.height,
            K,
            face.R @ turned,
            np.zeros(3),
            np.empty(0, int),
        )
        normals = np.zeros((face.height, face.width, 3), np.float32)
        maps.append(ViewMaps(face.R, K, depth, normals))
        samples = MapSamples(np.arange(face.height), np.arange(face.width), depth, depth, True, True, depth < 0)
        reasons = np.where(depth > 0, Reason.CONFIRMED, Reason.BLANK + number % 2).astype(np.uint8)
        image.add(view, Cut("a.jpg", lens, face), samples, reasons, depth, None, None)
    exact, _ = range_and_normals(lens, maps)
    shown = pixels_with_a_view(lens, list(faces_of(lens)))
    facts = image.facts(1)
    share = (exact > 0).sum() / shown.sum()
    assert 0.5 < share < 0.95
    assert facts.shares[Reason.CONFIRMED] == pytest.approx(share, abs=2e-3)
    assert facts.found == pytest.approx(share, abs=2e-3)
    assert sum(facts.shares) == pytest.approx(1)
    assert facts.shares[Reason.BLANK] > 0.02
    assert facts.shares[Reason.NOT_FOUND] > 0.02
    assert facts.gsd == pytest.approx(
        np.median(exact[exact > 0]) / (40 if lens is FISHEYE else 90 / np.pi), rel=1e-2
    )
    assert (facts.width, facts.height) == (lens.width, lens.height)
    assert facts.cut_into == tuple(f"{face.name}/a.png" for face in faces_of(lens))


class Recorder(Ground):
    """What is put on a map."""

    def add_points(self, points: np.ndarray, reasons: np.ndarray, depth: np.ndarray, focal: np.float64) -> None:
        self.found = points, reasons, depth, focal


@pytest.mark.parametrize("lens", [FISHEYE, PANORAMA], ids=["fisheye", "panorama"])
def test_points_and_normals_are_those_of_the_surface(lens: Lens) -> None:
    """The ground z = 0 from a camera above it, turned somehow: points on it, and one normal."""
    image = WideImage("a.jpg", lens, 192, with_pictures=True)
    turned = np.asarray(cv2.Rodrigues(np.array([2.5, 0.4, -0.3]))[0])
    center = np.array([30.0, -20.0, 10.0])
    normal = turned[:, 2]
    for number, face in enumerate(faces_of(lens)):
        R = face.R @ turned
        K = np.array([[face.focal, 0, face.x], [0, face.focal, face.y], [0, 0, 1]])
        view = View(number, face.name, face.width, face.height, K, R, -R @ center, np.empty(0, int))
        columns, rows = np.meshgrid(np.arange(face.width), np.arange(face.height))
        falls = np.stack([columns, rows, np.ones_like(rows)], axis=2) @ np.linalg.inv(K).T @ R[:, 2]
        depth = np.where(falls < -0.3, -10 / np.minimum(falls, -0.3), 0).astype(np.float32)
        normals = np.where(depth > 0, (R[:, 2])[:, None, None], 0).astype(np.float32)
        samples = MapSamples(np.arange(face.height), np.arange(face.width), depth, depth, True, True, depth < 0)
        reasons = np.where(depth > 0, Reason.CONFIRMED, Reason.BLANK).astype(np.uint8)
        image.add(view, Cut("a.jpg", lens, face), samples, reasons, depth, normals, None)
    ground = Recorder(frame_around(np.zeros((1, 3)), center[None], np.eye(3)))
    image.put_on(ground)
    points, reasons, depth, focal = ground.found
    assert focal == pytest.approx(40 if lens is FISHEYE else 90 / np.pi)
    confirmed = reasons == Reason.CONFIRMED
    assert confirmed.mean() > 0.2
    assert np.linalg.norm(points - center, axis=1) == pytest.approx(depth, rel=1e-4, abs=1e-4)
    height = np.abs(points[confirmed, 2])
    assert np.median(height) < 0.1
    assert np.percentile(height, 95) < 0.6
    (drawn,) = (picture_of(each.uri) for each in image.facts(1).pictures if each.name == "normals")
    wanted = normal_picture(normal.reshape(3, 1, 1).astype(np.float32))[0, 0, ::-1].astype(int)
    is_near = np.abs(drawn.astype(int) - wanted).max(axis=2) < 12
    assert is_near.mean() == pytest.approx(image.facts(1).shares[Reason.CONFIRMED] * shown_share(lens), abs=0.05)


def shown_share(lens: Lens) -> float:
    return float(pixels_with_a_view(lens, list(faces_of(lens))).mean())


# ---- after a run ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["fisheye", "panorama"])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp(request.param)
    is_panorama = request.param == "panorama"
    options = CourtyardOptions(
        width=320 if is_panorama else 180, images=4, points=1500, supersample=2, panoramas=is_panorama
    )
    make_courtyard(root, options)
    command = ["run", "--model", str(root / "sparse" / "0"), "--output", str(root / "dense"), "--threads", "2"]
    assert cli.main([*command, "--num-pairs", "4"]) in (0, 5)  # a view of the sky has no partner
    return root


def picture_of(uri: str | None) -> np.ndarray:
    """(H, W, 3) blue, green and red."""
    data = np.frombuffer(base64.b64decode((uri or "").partition("base64,")[2]), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def test_originals_are_the_images_of_the_page(finished: Path) -> None:
    workspace = Workspace(finished / "dense")
    page = Page(workspace.root)
    report = json.loads(workspace.report_path.read_text())
    names = sorted(report["originals"])
    assert len(names) == 4
    assert [text for tag, text in page.texts if tag == "h3"][:4] == names
    assert page.data["names"] == names
    assert "4 of 4 images with depth maps" in page.text("p")
    assert "a diamond one that looks down or all around" in page.text("p")  # as panoramas do
    ids = {each["id"] for _, each in page.elements if "id" in each}
    assert {(each["href"] or "")[1:] for each in page.all("a") if "href" in each} <= ids
    originals = {name: cut.original for name, cut in read_cuts(workspace.sparse_dir).items()}
    pairs = [[originals[left], originals[right]] for left, right, _ in report["matched_pairs"]]
    assert [[names[left], names[right]] for left, right, _, _ in page.data["pairs"]] == pairs
    # Points of all views; the table's cells after coverage, matched, agreement, rows and GSD.
    rows = re.findall(r"<tr><th scope=\"row\">.*?</tr>", page.source)[:4]
    cells = [re.findall(r'data-value="([^"]*)"', row) for row in rows]
    assert sum(int(row[5]) for row in cells) == report["points"]
    assert [float(row[0]) for row in cells] == pytest.approx(
        [report["originals"][name] for name in names], abs=1e-4
    )
    assert all(0.8 < float(row[2]) <= 1 for row in cells)


def test_coverage_is_that_of_the_range_map(finished: Path) -> None:
    workspace = Workspace(finished / "dense")
    page = Page(workspace.root)
    cuts = read_cuts(workspace.sparse_dir)
    bars = [each["aria-label"] or "" for each in page.all("svg") if each.get("class") == "bar"]
    for name, words in zip(page.data["names"], bars, strict=True):
        own = [cut for cut in cuts.values() if cut.original == name]
        distance, _ = read_range_map(workspace.range_map_path(name))
        shown = pixels_with_a_view(own[0].lens, [cut.face for cut in own])
        shares = dict(re.findall(r"([a-z ]+?) ([\d.]+) %", words))
        assert float(shares["confirmed"]) == pytest.approx(100 * (distance > 0).sum() / shown.sum(), abs=0.3)
        assert sum(map(float, shares.values())) == pytest.approx(100, abs=0.5)


def test_pictures_are_those_of_the_originals(finished: Path) -> None:
    page = Page(finished / "dense")
    shown = [each for each in page.all("img") if each.get("alt") in ("picture", "depth")]
    for name, picture, depth in zip(page.data["names"], shown[::2], shown[1::2], strict=True):
        original = cv2.imread(str(finished / "images" / name))
        assert original is not None
        height, width = original.shape[:2]
        assert f"{width} × {height} pixels" in page.source
        assert int(picture["height"] or 0) == int(depth["height"] or 0) == 320 * height // width
        found = picture_of(picture["src"])
        small = cv2.resize(original, found.shape[1::-1], interpolation=cv2.INTER_AREA)
        seen = small.any(axis=2) & (found.min(axis=2) > 60)
        error = np.abs(found.astype(float) - small).mean(axis=2)[seen]
        assert seen.mean() > 0.5
        assert np.median(error) < 10
        distance, _ = read_range_map(Workspace(finished / "dense").range_map_path(name))
        drawn = picture_of(depth["src"])
        near = cv2.resize((distance > 0).astype(np.uint8), drawn.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
        coloured = np.ptp(drawn, axis=2) > 40
        assert (near == coloured).mean() > 0.95


def test_a_page_made_without_range_maps_and_report(finished: Path) -> None:
    """The page is made of the views: it needs no more."""
    workspace = Workspace(finished / "dense")
    kept = workspace.report_path.read_bytes()
    workspace.report_path.unlink()
    try:
        page = made(workspace)
    finally:
        workspace.report_path.write_bytes(kept)
    assert len(page.all("article")) == 4
    assert "4 of 4 images with depth maps" in page.text("p")
    assert "a diamond one that looks down or all around" in page.text("p")  # as panoramas do


def test_of_photometric_maps_alone_the_coverage_is_theirs(finished: Path) -> None:
    workspace = Workspace(finished / "dense")
    kept = workspace.report_path.read_bytes()
    workspace.report_path.write_text(json.dumps(json.loads(kept) | {"until": "photometric", "originals": {}}))
    try:
        page = made(workspace)
    finally:
        workspace.report_path.write_bytes(kept)
    rows = re.findall(r"<tr><th scope=\"row\">.*?</tr>", page.source)[:4]
    for row in rows:
        coverage, matched = re.findall(r'data-value="([^"]*)"', row)[:2]
        assert 0.3 < float(coverage) == float(matched) < 1


# ---- tables of strangers -------------------------------------------------------------------------------------

NAMES = ["left/a.png", "left/b.png", "right/a.png", "right/b.png", "z.png"]


def wide_workspace(root: Path, lens: Lens = FISHEYE, originals: dict[str, str] | None = None) -> Workspace:
    """Views whose table says that they were cut from two images, and a whole image."""
    workspace = ground_workspace(root, NAMES)
    face = Face("left", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), 160, 120, 100.0, 80.0, 60.0)
    told = originals or {name: name[-5:] for name in NAMES[:4]}
    write_cuts({name: Cut(original, lens, face) for name, original in told.items()}, workspace.sparse_dir)
    return workspace


def test_whole_and_cut_images_stand_side_by_side(tmp_path: Path) -> None:
    page = made(wide_workspace(tmp_path / "dense"))
    assert page.data["names"] == ["a.png", "b.png", "z.png"]
    words = page.text("p")
    assert "150 × 140 pixels" in words
    assert "160 × 120 pixels" in words
    assert "2 views: left/a.png, right/a.png." in words


def test_images_and_maps_of_views_may_be_missing(tmp_path: Path) -> None:
    workspace = wide_workspace(tmp_path / "dense")
    for path in (
        workspace.image_path(NAMES[0]),
        workspace.image_path(NAMES[2]),
        workspace.normal_map_path(NAMES[0], "geometric"),
        workspace.depth_map_path(NAMES[1], "geometric"),
    ):
        path.unlink(missing_ok=True)
    workspace.image_path(NAMES[3]).write_bytes(b"no image")
    page = made(workspace)
    assert len(page.all("article")) == 3
    assert "1 of 3 images have views without a geometric depth map" in page.source


@pytest.mark.parametrize(
    "lens",
    [
        Lens("EQUIRECTANGULAR", (0.0, 0.0), 1_000_000, 1_000_000),
        Lens("EQUIRECTANGULAR", (1e308, -1e-308), 1, 1_000_000),
        Lens("SIMPLE_FISHEYE", (0.0, 0.0, 0.0), 1_000_000, 1),
        Lens("SIMPLE_FISHEYE", (-1e308, 1e308, 1e308), 7, 7, 1e-300),
        Lens("OPENCV_FISHEYE", (1e-300, 1e300, 0.0, 0.0, 1e308, -1e308, 1e308, -1e308), 300, 200),
        Lens("THIN_PRISM_FISHEYE", (100.0, 100.0, 80.0, 60.0, *(1e200,) * 8), 160, 120),
        Lens("RAD_TAN_THIN_PRISM_FISHEYE", (100.0, 100.0, 80.0, 60.0, *(-1e9,) * 12), 160, 120),
        Lens("FOV", (100.0, 100.0, 80.0, 60.0, 1e30), 160, 120),
        Lens("EUCM", (100.0, 100.0, 80.0, 60.0, -1e100, -1e100), 160, 120),
        Lens("DIVISION", (100.0, 100.0, 80.0, 60.0, 1e300), 160, 120),
    ],
    ids=lambda lens: f"{lens.model}-{lens.width}",
)
def test_lenses_that_are_none_do_no_harm(tmp_path: Path, lens: Lens) -> None:
    page = made(wide_workspace(tmp_path / "dense", lens))
    assert page.data["names"] == ["a.png", "b.png", "z.png"]
    assert "nan" not in page.text("td")
    assert len(page.source) < 3e6


@pytest.mark.parametrize(
    "originals",
    [
        dict.fromkeys(NAMES, "one.png"),
        {NAMES[0]: "z.png"},
        {NAMES[0]: NAMES[1], NAMES[1]: NAMES[0]},
        {"nobody.png": "a.png"},
    ],
)
def test_any_view_may_be_said_to_be_of_any_image(tmp_path: Path, originals: dict[str, str]) -> None:
    workspace = wide_workspace(tmp_path / "dense", originals=originals)
    page = made(workspace)
    assert len(page.data["names"]) == len(page.all("article")) == len(read_scene(workspace.sparse_dir).photographs)
    assert len(page.source) < 3e6


def test_hostile_names_of_originals_stay_text(tmp_path: Path) -> None:
    page = made(wide_workspace(tmp_path / "dense", originals=dict(zip(NAMES, HOSTILE_NAMES, strict=True))))
    harmless = made(wide_workspace(tmp_path / "harmless", originals={name: name[:-1] for name in NAMES}))
    assert len(page.all("script")) == len(harmless.all("script")) == 2
    assert len(page.all("img")) == len(harmless.all("img"))
    assert not [name for _, each in page.elements for name in each if name.startswith("on")]
    assert page.data["names"] == [printable(name) for name in sorted(HOSTILE_NAMES)]
    assert not re.search("[\u202e\u2028\x1b\x07]", page.source)


@pytest.mark.parametrize("original", ["", "../../a.png", "/etc/passwd"])
def test_an_image_elsewhere_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], original: str) -> None:
    workspace = wide_workspace(tmp_path / "dense", originals={NAMES[0]: original})
    assert cli.main(["report", str(workspace.root)]) == 2
    assert TABLE_NAME in capsys.readouterr().err


def test_a_damaged_table_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    workspace = wide_workspace(tmp_path / "dense")
    text = json.loads((workspace.sparse_dir / TABLE_NAME).read_text())
    damage: dict[str, Any] = {"width": 0}
    text["lenses"][0] |= damage
    (workspace.sparse_dir / TABLE_NAME).write_text(json.dumps(text))
    assert cli.main(["report", str(workspace.root)]) == 2
    assert TABLE_NAME in capsys.readouterr().err
