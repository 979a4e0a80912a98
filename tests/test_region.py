"""A run on a part of the scene: what lies outside is not worked on, what lies inside is as in the whole run."""

import json
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from clouds import read_fused
from conftest import FinishedRun
from scipy.spatial import cKDTree
from test_pages import Page

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.spelling import in_full
from colmap_sph.errors import InputError, OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.pipeline.report_files import command_of
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.pair_lists import read_patch_match_cfg
from colmap_sph.project.project import Project
from colmap_sph.project.region_file import read_region
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Region, Scene, View
from colmap_sph.stereo.anchor import anchored
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.rectification import RectificationOptions, rectify_pair
from colmap_sph.stereo.rectified_pair import Side, coordinates_of_rays
from colmap_sph.stereo.region.focus import focused
from colmap_sph.stereo.region.inside import drop_outside, is_inside, pixels_inside
from colmap_sph.stereo.region.window import Window, outline_on
from colmap_sph.synthetic import DemoBlock

GSD = 0.2
SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
HOLE = [[1, 1], [2, 1], [2, 2], [1, 2], [1, 1]]


def geojson(path: Path, *polygons: list) -> Path:
    path.write_text(json.dumps({"type": "MultiPolygon", "coordinates": polygons}))
    return path


# ---- what is given --------------------------------------------------------------------------------------------


def test_ways_to_write_one_region(tmp_path):
    box = "-1.5,0,2,3,4,1e2"
    numbers = np.array([[-1.5, 0, 2], [3, 4, 100]])
    (tmp_path / "box.txt").write_text(box.replace(",", " ").replace(" 3", "\n3"))
    assert (read_region(box).box == numbers).all()
    assert (read_region(str(tmp_path / "box.txt")).box == numbers).all()
    polygon = {"type": "Polygon", "coordinates": [SQUARE, HOLE]}
    wholes = [
        polygon,
        {"type": "Feature", "properties": None, "geometry": polygon},
        {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": polygon}]},
        {"type": "MultiPolygon", "coordinates": [polygon["coordinates"]]},
    ]
    for whole in wholes:
        (tmp_path / "area.geojson").write_text("\ufeff" + json.dumps(whole))
        region = read_region(str(tmp_path / "area.geojson"))
        assert region.box.tolist() == [[0, 0, -np.inf], [4, 4, np.inf]]
        assert [[ring.tolist() for ring in rings] for rings in region.polygons] == [[SQUARE[:-1], HOLE[:-1]]]


@pytest.mark.parametrize("box", ["1,2,3,4,5", "1,2,3,4,5,nan", "1,0,0,0,1,1", "0,0,0,0,1,1", "1,2,3,4,5,6,7"])
def test_numbers_that_are_no_box(box):
    with pytest.raises(OptionError, match="--region must be a box x0,y0,z0,x1,y1,z1"):
        RunOptions(region=box).check()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "neither polygons in GeoJSON nor"),
        ("1 2 3", "neither polygons in GeoJSON nor"),
        ("{", "no GeoJSON"),
        ("[" * 10_000, "neither"),
        ('{"a":' * 10_000, "no GeoJSON"),
        ("{}", "a Polygon or MultiPolygon belongs"),
        ('{"type": "Point", "coordinates": [1, 2]}', "Point"),
        ('{"type": "FeatureCollection", "features": []}', "no polygon"),
        ('{"type": "Feature", "geometry": null}', "a Polygon or MultiPolygon belongs"),
        ('{"type": "Polygon", "coordinates": []}', "no outline"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [0, 0]]]}', "fewer than three corners"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [2, 2], [0, 0]]]}', "no area"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, NaN], [2, 2], [0, 0]]]}', "NaN"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1e999], [2, 2], [0, 0]]]}', "not finite"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, "a"], [2, 2], [0, 0]]]}', "two numbers"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 1e308], [2, 2], [0, 0]]]}', "farther away"),
        ('{"type": "Polygon", "coordinates": 7}', "a list is missing"),
        ("\0" * (9 << 20), "cannot be read"),
    ],
)  # fmt: skip
def test_files_that_are_no_region(tmp_path, content, reason):
    (tmp_path / "area").write_text(content)
    with pytest.raises(InputError, match=reason) as caught:
        RunOptions(region=str(tmp_path / "area")).check()
    assert str(tmp_path / "area") in str(caught.value) and "\n" not in str(caught.value)


def test_a_region_that_is_not_there_or_has_too_many_corners(tmp_path):
    with pytest.raises(InputError, match=r"nowhere.*--region"):
        read_region(str(tmp_path / "nowhere"))
    angles = np.linspace(0, 2 * np.pi, 30_000)
    circle = np.column_stack([np.cos(angles), np.sin(angles)]).tolist()
    with pytest.raises(InputError, match="simplify"):
        read_region(str(geojson(tmp_path / "circle", [circle])))


def test_a_box_may_begin_with_a_minus_and_a_run_can_be_repeated(tmp_path, monkeypatch):
    for box in ("-1,0,0,1,1,1", "-.5,0,0,1,1,1", "-inf,0,0,1,1,1"):
        assert in_full(["--region", box, "--threads", "2"]) == [f"--region={box}", "--threads", "2"]
    monkeypatch.chdir(tmp_path)
    geojson(tmp_path / "area", [SQUARE])
    words = command_of(Project(model=Path("/sparse/0")), RunOptions(region="area"))
    assert words == f"colmap_sph run --model /sparse/0 --region {tmp_path / 'area'}"


def test_polishing_wants_the_whole_block():
    polished = replace(RunOptions().polish, poses="on")
    with pytest.raises(OptionError, match="--polish-poses moves all poses"):
        RunOptions(region="0,0,0,1,1,1", polish=polished).check()


# ---- inside and outside -----------------------------------------------------------------------------------------


def test_inside_of_polygons_as_opencv_has_it():
    rng = np.random.default_rng(4)
    ring = rng.permutation(rng.uniform(0, 10, (12, 2)))  # it crosses itself
    hole = np.array([[3.0, 3], [5, 3], [4, 6]])
    other = np.array([[8.0, 8], [12, 8], [12, 12], [8, 12]])  # on the first
    corners = np.concatenate([ring, other])
    box = np.array([[*corners.min(axis=0), 0], [*corners.max(axis=0), 5]])
    points = rng.uniform(-1, 13, (3000, 3))
    inside = is_inside(Region(box, ((ring, hole), (other,))), points)

    def holds(outline: np.ndarray, point: np.ndarray) -> bool:
        """Where the outline crosses a ray to the right of the point an odd number of times."""
        crossings = 0
        for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            if (y0 > point[1]) != (y1 > point[1]):
                crossings += point[0] < x0 + (point[1] - y0) * (x1 - x0) / (y1 - y0)
        return crossings % 2 == 1

    expected = [
        0 <= point[2] <= 5 and ((holds(ring, point) != holds(hole, point)) or holds(other, point))
        for point in points
    ]
    assert inside.tolist() == expected
    assert 100 < inside.sum() < 2900
    in_square = [
        cv2.pointPolygonTest(other.astype(np.float32), (float(x), float(y)), measureDist=False) > 0
        for x, y, _ in points
    ]
    assert (is_inside(Region(np.array([[-99.0] * 3, [99.0] * 3]), ((other,),)), points) == in_square).all()


def camera(angle: float = 0.0, center: tuple[float, float, float] = (0, 0, -10)) -> View:
    """80 x 60 pixels of 0.01; looks along z, turned about y."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    return View(1, "a", 80, 60, K, R, -R @ np.array(center), np.empty(0, np.int64))


def test_pixels_of_a_slanted_view_inside_a_box():
    view = camera(0.5, (-5, 0.3, -8))
    depth = np.full((60, 80), 9, np.float32)
    depth[:10] = 0
    region = Region(np.array([[-1.0, -1, -2], [0.7, 2, 0.5]]))
    inside = pixels_inside(view, depth, region)
    for row, column in np.ndindex(60, 80):
        ray = np.linalg.inv(view.K) @ [column, row, 1]
        x, y, z = view.R.T @ (ray * depth[row, column] - view.t)
        assert inside[row, column] == (
            depth[row, column] > 0 and -1 <= x <= 0.7 and -1 <= y <= 2 and -2 <= z <= 0.5
        )
    assert 50 < inside.sum() < 3000
    cut = depth.copy()
    drop_outside(view, cut, region)
    assert ((cut > 0) == inside).all()
    cut = depth.copy()
    drop_outside(view, cut, region, margin=2)
    near = cv2.distanceTransform((~inside).view(np.uint8), cv2.DIST_C, 3) <= 2
    assert ((cut > 0) == (near & (depth > 0))).all()


# ---- what images show of it -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_an_outline_holds_all_of_a_box_that_is_in_view(seed):
    """Large and tiny boxes, before, around and behind the camera."""
    rng = np.random.default_rng(seed)
    view = camera(rng.uniform(-3, 3), tuple(rng.uniform(-3, 3, 3)))
    corner = rng.uniform(-6, 6, 3)
    box = np.array([corner, corner + rng.choice([0.1, 1, 5]) * rng.uniform(0.1, 1, 3)])
    points = rng.uniform(box[0], box[1], (4000, 3))
    points = points[sees(view, points)]
    outline = outline_on(view, box)
    if outline is None:
        # What is left out is less than what is not worth a look.
        assert not len(points) or (np.ptp(view.project(points)[0], axis=0) < 16).any()
        return
    pixels = view.project(points)[0]
    assert all(
        cv2.pointPolygonTest(outline.astype(np.float32), pixel, measureDist=True) > -1e-2 for pixel in pixels
    )
    window = Window.around(outline)
    assert 0 <= window.left < window.right <= 80 and 0 <= window.top < window.bottom <= 60


@pytest.mark.parametrize("surface", ["spherical", "frame"])
def test_rectified_images_are_cut_to_what_shows_the_region(block: DemoBlock, surface):
    scene = anchored(read_scene(block.sparse_dir))
    low, high = np.percentile(scene.points + scene.anchor, [30, 60], axis=0)
    region = Region(np.array([[low[0], low[1], -50], [high[0], high[1], 50]]))
    part, focus, _ = focused(scene, region, 10, "--region")
    options = RectificationOptions(surface=surface)
    tried = 0
    for first, second in zip(part.views[:-1], part.views[1:], strict=True):
        points = part.points[np.intersect1d(first.point_indices, second.point_indices)]
        points = points[is_inside(focus.region, points)]
        if len(points) < 20:
            continue
        tried += 1
        whole = rectify_pair(scene, scene.view(first.name), scene.view(second.name), options)
        outlines = ([focus.outline(first)], [focus.outline(second)])
        pair = rectify_pair(part, first, second, options, outlines=outlines)
        assert pair.height * pair.left_width < 0.8 * whole.height * whole.left_width
        sides: list[tuple[Side, View]] = [("left", first), ("right", second)]
        for side, view in sides:
            places = coordinates_of_rays(pair, side, (points - view.center) @ pair.rectified_from_world.T)
            assert (places > -1).all() and (places < [pair.width(side), pair.height]).all()
    assert tried > 2


def grid_scene(origin: tuple[float, float, float] = (0, 0, 0)) -> Scene:
    """A ground of points 1 apart, seen from above by nine cameras 10 apart, each of which sees 20 x 15."""
    points = np.array([(x, y, 0) for x in range(-20, 21) for y in range(-20, 21)], dtype=float)
    K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    views: list[View] = []
    for x in (-10, 0, 10):
        for y in (-10, 0, 10):
            view = View(len(views), f"{x} {y}", 320, 240, K, R, -R @ np.array([x, y, 25.0]), np.empty(0, np.int64))
            views.append(replace(view, point_indices=np.flatnonzero(sees(view, points))))
    return Scene(tuple(views), points, np.array(origin, dtype=float))


def test_a_scene_is_reduced_to_what_shows_a_region(tmp_path):
    origin = (5e5, 5e6, 100)
    scene = grid_scene(origin)
    corner = np.array([[15, 15], [18, 15], [18, 18], [15, 18]]) + origin[:2]
    region = read_region(str(geojson(tmp_path / "corner", [corner.tolist()])))
    part, focus, _ = focused(scene, region, 1, "--region")
    assert [view.name for view in part.views] == ["10 10"]
    assert focus.region.box[:, :2].tolist() == [[15, 15], [18, 18]]
    view = scene.view("10 10")
    observed = part.points[part.views[0].point_indices]
    assert {tuple(p) for p in observed} <= {tuple(p) for p in scene.points[view.point_indices]}
    # All those inside, and others only where there are so few.
    assert {(x, y, 0.0) for x in (15.0, 16, 17, 18) for y in (15.0, 16, 17)} <= {tuple(p) for p in observed}
    without_tracks = replace(
        scene, views=tuple(replace(view, point_indices=view.point_indices[:0]) for view in scene.views)
    )
    assert {view.name for view in focused(without_tracks, region, 1, "--region")[0].views} == {"10 10"}


@pytest.mark.parametrize("box", ["900,0,-1,901,1,1", "0,0,50,1,1,60", "-1e9,-1e9,-2e9,1e9,1e9,-1e9"])
def test_a_region_that_misses_the_scene(box):
    with pytest.raises(InputError, match=r"--region misses the scene.* reach from -2\d -2\d 0 to 2\d 2\d 0"):
        focused(grid_scene(), read_region(box), 1, "--region")


def test_a_region_needs_points():
    with pytest.raises(InputError, match="needs sparse points"):
        focused(Scene(grid_scene().views, np.zeros((0, 3))), read_region("0,0,0,1,1,1"), 1, "--region")


def test_lists_of_pairs_may_name_images_elsewhere(tmp_path):
    (tmp_path / "patch-match.cfg").write_text("a\nb, c\nb\n__auto__, 3\nc\na\n")
    assert read_patch_match_cfg(tmp_path / "patch-match.cfg", {"a", "b"}) == {"a": ["b"], "b": 3}


# ---- a run ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RegionRun:
    """A run on a part of the small block."""

    dense: Path
    region: Region
    given: str
    report: colmap_sph.RunReport


@pytest.fixture(scope="module")
def region_run(block: DemoBlock, tmp_path_factory: pytest.TempPathFactory) -> RegionRun:
    """A polygon in the west of the block; not to be changed."""
    root = tmp_path_factory.mktemp("region")
    points = read_scene(block.sparse_dir).points
    west, south = np.percentile(points[:, :2], 8, axis=0)
    east, north = np.percentile(points[:, :2], [45, 70], axis=0).diagonal()
    polygon = [
        [west, south],
        [east, south],
        [east, north],
        [(west + east) / 2, (north + south) / 2],
        [west, north],
    ]
    given = str(geojson(root / "west.geojson", [polygon]))
    report = colmap_sph.run(block.sparse_dir, output=root / "dense", options=RunOptions(region=given))
    return RegionRun(root / "dense", read_region(given), given, report)


def is_near(region: Region, points: np.ndarray) -> np.ndarray:
    """Which of (n, 3) points lie inside of a region, to a hundredth of a pixel: a run's cameras lie on a grid."""
    shifts = [(x, y, 0) for x in (-0.002, 0, 0.002) for y in (-0.002, 0, 0.002)]
    return np.any([is_inside(region, points + shift) for shift in shifts], axis=0)


def world_points(view: View, depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) where each pixel of a depth map lies."""
    rows, columns = np.indices(depth.shape)
    rays = np.stack([columns, rows, np.ones(depth.shape)], axis=-1) @ np.linalg.inv(view.K).T
    return (rays * depth[..., None] - view.t) @ view.R


def test_maps_end_at_the_border_and_are_as_those_of_the_whole_run_inside(
    region_run: RegionRun, finished: FinishedRun, block: DemoBlock
):
    scene = read_scene(region_run.dense / "sparse")
    kept = 0
    of_whole = 0
    errors = []
    whole_errors = []
    for view in scene.views:
        depth = read_depth_map(region_run.dense / f"stereo/depth_maps/{view.name}.geometric.bin")
        found = depth > 0
        assert is_near(region_run.region, world_points(view, depth)[found]).all()
        whole = read_depth_map(finished.dense / f"stereo/depth_maps/{view.name}.geometric.bin")
        truth, _ = block.truth(view.name)
        wanted = is_inside(region_run.region, world_points(view, truth).reshape(-1, 3)).reshape(truth.shape)
        of_whole += int(np.count_nonzero(wanted & (whole > 0)))
        kept += int(np.count_nonzero(wanted & found))
        errors.append(np.abs(depth - truth)[wanted & found])
        whole_errors.append(np.abs(whole - truth)[wanted & (whole > 0)])
    assert of_whole > 20_000
    assert kept > 0.97 * of_whole
    assert np.median(np.concatenate(errors)) < 1.1 * np.median(np.concatenate(whole_errors))


def test_the_cloud_is_that_of_the_whole_run_inside(region_run: RegionRun, finished: FinishedRun):
    points = read_fused(region_run.dense / "fused.ply")["xyz"].astype(float)
    whole = read_fused(finished.dense / "fused.ply")["xyz"].astype(float)
    assert is_near(region_run.region, points).all()
    inside = whole[is_inside(region_run.region, whole)]
    assert len(inside) > 3000
    distances, _ = cKDTree(points).query(inside)
    assert np.mean(distances < 2 * GSD) > 0.99


def test_sparse_points_outside_are_not_asked(region_run: RegionRun, finished: FinishedRun):
    assert region_run.report.sparse_points.tested < 0.7 * finished.report.sparse_points.tested
    agreement = (region_run.report.overall_agreement or 0.0, finished.report.overall_agreement or 0.0)
    assert 0 < agreement[1] - 0.03 < agreement[0]


def test_a_region_is_a_part_of_what_results_depend_on(
    region_run: RegionRun, finished: FinishedRun, block: DemoBlock, tmp_path
):
    """The same again: nothing to do. Another, of few images: only these are undistorted. All: as without one."""
    again = colmap_sph.run(block.sparse_dir, output=region_run.dense, options=RunOptions(region=region_run.given))
    assert again.reused["match pairs"] == again.pairs and again.reused["fuse"] > 0
    points = read_scene(block.sparse_dir).points
    low = points[:, :2].min(axis=0)
    corner = f"{low[0]},{low[1]},-99,{low[0] + 8},{low[1] + 8},99"
    dense = tmp_path / "dense"
    first = colmap_sph.run(block.sparse_dir, output=dense, options=RunOptions(region=corner))
    images = {path.name for path in (dense / "images").iterdir()}
    assert images == {view.name for view in read_scene(dense / "sparse").views}
    assert 2 <= len(images) < len(block.names)
    assert first.points
    colmap_sph.run(block.sparse_dir, output=dense)
    assert (dense / "fused.ply").read_bytes() == (finished.dense / "fused.ply").read_bytes()
    assert (dense / "fused.ply.vis").read_bytes() == (finished.dense / "fused.ply.vis").read_bytes()


def test_a_miss_is_one_sentence_before_anything_is_written(block: DemoBlock, tmp_path, capsys):
    arguments = ["run", "--model", str(block.sparse_dir), "--output", str(tmp_path / "dense")]
    for extra in ([], ["--dry-run"]):
        assert cli.main([*arguments, "--region", "-9000,0,0,-8000,1,1", *extra]) == 2
        output = capsys.readouterr().err
        assert "--region -9000,0,0,-8000,1,1 misses the scene" in output.replace("\n", " ")
        assert "Traceback" not in output
    assert not (tmp_path / "dense/images").exists()


def test_a_dry_run_plans_the_region_alone(block: DemoBlock, region_run: RegionRun, tmp_path):
    project = Project(model=block.sparse_dir, output=tmp_path / "dense")
    whole = make_plan(project, RunOptions())
    part = make_plan(project, RunOptions(region=region_run.given))
    assert sum(stage.seconds for stage in part.stages) < 0.8 * sum(stage.seconds for stage in whole.stages)


# ---- what is told of it -----------------------------------------------------------------------------------------


def test_coverage_is_that_of_the_pixels_which_show_the_region(region_run: RegionRun, block: DemoBlock):
    """Against exact depth: a pixel shows the region where its piece of surface lies in it."""
    scene = read_scene(region_run.dense / "sparse")
    report = region_run.report
    assert report.in_region.keys() == report.coverage.keys()
    compared = 0
    for view in scene.views:
        truth, _ = block.truth(view.name)
        points = world_points(view, truth).reshape(-1, 3)
        shown = is_inside(region_run.region, points).reshape(truth.shape) & (truth > 0)
        depth = read_depth_map(region_run.dense / f"stereo/depth_maps/{view.name}.geometric.bin")
        if not (depth > 0).any():
            continue
        compared += 1
        assert report.in_region[view.name] == pytest.approx(shown.mean(), abs=0.04)
        assert report.coverage[view.name] == pytest.approx(
            np.count_nonzero(depth) / shown.sum(), rel=0.1, abs=0.02
        )
    assert compared > 5


def test_the_page_tells_what_lies_outside(region_run: RegionRun):
    page = Page(region_run.dense)
    assert "outside the region" in page.text("b")
    bars = [each["aria-label"] or "" for each in page.all("svg") if each.get("class") == "bar"]
    names = sorted(region_run.report.coverage)
    assert len(bars) == len(names)
    for name, words in zip(names, bars, strict=True):
        shares = dict(re.findall(r"([a-z ]+?) ([\d.]+) %", words.replace(", ", ",")))
        outside = float(shares.get("outside the region", 0)) / 100
        shown = region_run.report.in_region.get(name, 0)
        assert outside == pytest.approx(1 - shown, abs=0.06)
        confirmed = float(shares.get("confirmed", 0)) / 100
        assert confirmed == pytest.approx(region_run.report.coverage[name] * shown, abs=0.02)


def test_the_page_of_a_whole_run_knows_no_region(finished: FinishedRun):
    assert "outside the region" not in Page(finished.dense).source
    assert finished.report.region is None and finished.report.in_region == {}


def test_images_with_too_few_points_are_named(block: DemoBlock, tmp_path, capsys):
    """Fewer than asked for: left out with their reason, and no failure of the run."""
    scene = anchored(read_scene(block.sparse_dir))
    low = (scene.points + scene.anchor).min(axis=0)
    box = f"{low[0]},{low[1]},-99,{low[0] + 12},{low[1] + 12},99"
    part, _, _ = focused(scene, read_region(box), 1, "--region")
    least = sorted(len(view.point_indices) for view in part.views)[len(part.views) // 3] + 1
    part, _, too_few = focused(scene, read_region(box), least, "--region")
    assert too_few and all(0 < number < least for number in too_few.values())
    assert not too_few.keys() & {view.name for view in part.views}
    arguments = ["run", "--model", str(block.sparse_dir), "--output", str(tmp_path / "dense"), "--threads", "2"]
    code = cli.main([*arguments, f"--region={box}", "--pairs.min-shared-points", str(least)])
    said = capsys.readouterr().err
    report = json.loads((tmp_path / "dense/colmap_sph/report.json").read_text())
    assert code == (5 if report["skipped_images"] else 0)
    assert too_few.keys() <= report["out_of_region"].keys()
    assert f"{len(report['out_of_region'])} left out" in said
    page = Page(tmp_path / "dense")
    for name, number in too_few.items():
        assert f"sees {number} sparse points in the region and near it, fewer than {least}" in page.text("li")
        assert name in page.text("b")


def test_maps_of_images_outside_are_not_those_of_the_run(finished: FinishedRun, tmp_path):
    """In a workspace with maps of a whole run, a run on a corner shows the corner alone."""
    dense = tmp_path / "dense"
    shutil.copytree(finished.dense, dense)
    points = read_scene(dense / "sparse").points
    low = points[:, :2].min(axis=0)
    report = colmap_sph.run(
        workspace=dense, options=RunOptions(region=f"{low[0]},{low[1]},-99,{low[0] + 8},{low[1] + 8},99")
    )
    assert 2 <= report.images < 10
    page = Page(dense)
    assert f"{report.images} of 10 images with depth maps, {report.points:,} points" in page.text("p")
    assert page.all("canvas")
    bars = [each["aria-label"] or "" for each in page.all("svg") if each.get("class") == "bar"]
    assert sum(words == "outside the region 100.0 %" for words in bars) == 10 - len(report.coverage)
