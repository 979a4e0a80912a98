"""Surface models and orthophotos of exact maps against the solids that were rendered, and what is refused."""

import json
import resource
import shlex
import sys
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import oracle
import pytest
import surveyed
from projects import read_picture
from refusals import assert_refused
from surveyed import BLUE, BOX, GREEN, GSD, RED, ROOF, surveyed_workspace

from colmap_sph import _native
from colmap_sph import synthetic as syn
from colmap_sph.app import cli
from colmap_sph.errors import InputError, NoResultError, OptionError, OutputError
from colmap_sph.products.georeference import Georeference
from colmap_sph.products.publishing import alone_in
from colmap_sph.products.surface import make
from colmap_sph.products.surface.drawing import margin_of
from colmap_sph.products.surface.filling import filled
from colmap_sph.products.surface.geotiff import Layer, LayerFiles
from colmap_sph.products.surface.make import SurfaceRequest, make_surface
from colmap_sph.products.surface.options import SurfaceOptions
from colmap_sph.products.surface.tiles import Tile
from colmap_sph.project.claim import claimed
from colmap_sph.project.map_files import read_depth_map, write_depth_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.surface.coarser import coarser_colours, coarser_surface
from colmap_sph.stereo.surface.heights import Surface, highest_surface, hillshade
from colmap_sph.stereo.surface.raster import Raster

rasterio = pytest.importorskip("rasterio")

PLENTY = 4 << 30
# What the libraries themselves take.
PROGRAM = 350_000_000


def made(
    workspace: Workspace,
    folder: Path,
    memory: int = PLENTY,
    place: Georeference | None = None,
    *,
    overwrite: bool = True,
    **options,
):
    """Arrays of all files by their stems, the DSM's transform, and the summary."""
    chosen = SurfaceOptions(**{"cell": GSD, **options})
    request = SurfaceRequest(workspace, place or Georeference(), chosen, folder, memory, overwrite)
    paths, summary = make_surface(request, lambda *_: None, lambda: None)
    arrays = {}
    for path in paths:
        if path.suffix == ".tif":
            with rasterio.open(path) as file:
                arrays[path.stem] = file.read()
                transform = file.transform
    return arrays, transform, summary


def places(arrays, transform):
    """x and y (h, w) of the cells' centres."""
    rows, columns = np.mgrid[: arrays["dsm"].shape[1], : arrays["dsm"].shape[2]] + 0.5
    return transform.c + transform.a * columns, transform.f + transform.e * rows


def signed_distance(x, y):
    """To the outline of the box, negative inside of it."""
    return np.maximum(np.maximum(BOX[0, 0] - x, x - BOX[1, 0]), np.maximum(BOX[0, 1] - y, y - BOX[1, 1]))


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return surveyed_workspace(tmp_path_factory.mktemp("surveyed") / "dense")


@pytest.fixture(scope="module")
def products(workspace, tmp_path_factory):
    return made(workspace, tmp_path_factory.mktemp("products"))


# ---- the surface -------------------------------------------------------------------------------------------


def test_patches_are_drawn_as_the_oracle_draws_them():
    rng = np.random.default_rng(0)
    depth = rng.uniform(5, 6, (6, 7)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = 0
    normals = rng.normal(0, 0.4, (3, 6, 7)) - [[[0]], [[0]], [[1]]]
    normals = (normals / np.linalg.norm(normals, axis=0)).astype(np.float32)
    ray_from_pixel = np.linalg.inv(np.array([[9.0, 0, 3], [0, 9, 3], [0, 0, 1]]))
    cells_from_camera = syn.look_at((1.0, -1, 2), (0, 0.2, 0))[0] * 4
    given = (ray_from_pixel, np.ascontiguousarray(cells_from_camera), np.array([8.0, 28, 0]), 0.6, 1.5)
    drawn = np.full((20, 24), -np.inf, np.float32)
    _native.draw_heights(depth, normals, *given, drawn)
    expected = oracle.draw_heights(depth, normals, *given, drawn.shape)
    assert np.isfinite(expected).sum() > 50
    np.testing.assert_allclose(drawn, expected, rtol=1e-5)


def test_the_highest_surface_is_that_of_a_search_cell_by_cell():
    rng = np.random.default_rng(1)
    heights = rng.choice([0.0, 0.1, 0.2, 1.0, 1.1, 5.0], (7, 9, 11)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.4] = -np.inf
    found = highest_surface(heights.copy(), 0.15, 3)
    for row, column in np.ndindex(9, 11):
        seen = sorted((h for h in heights[:, row, column].tolist() if h > -np.inf), reverse=True)
        clusters = ([h for h in seen[k:] if h >= top - 0.15] for k, top in enumerate(seen))
        first = next((each for each in clusters if len(each) >= min(3, len(seen))), [])
        assert found.count[row, column] == len(first)
        if first:
            assert found.height[row, column] == pytest.approx(np.mean(first), abs=1e-6)
        if len(first) > 1:
            assert found.deviation[row, column] == pytest.approx(np.std(first, ddof=1), abs=1e-5)


def test_no_view_sees_no_surface():
    surface = highest_surface(np.empty((0, 4, 5), np.float32), 0.15, 3)
    assert np.isnan(surface.height).all()
    assert not surface.count.any()


def test_the_surface_is_that_of_the_solids(products):
    arrays, transform, summary = products
    height, deviation, count = arrays["dsm"]
    x, y = places(arrays, transform)
    distance = signed_distance(x, y)
    known = height > -9999
    roof, ground = known & (distance < -GSD), known & (distance > GSD)
    # All of the roof, and the ground around it, is in view of several cameras.
    assert known[distance < -GSD].all()
    assert known[(distance > GSD) & (distance < 5)].all()
    assert np.abs(height[roof] - ROOF).max() < 1e-3
    assert np.abs(height[ground]).max() < 1e-3
    assert deviation[roof & (count > 1)].max() < 1e-3
    assert count[roof].min() >= 3
    assert summary.covered == pytest.approx(known.mean())


def test_noise_becomes_the_standard_deviation(tmp_path):
    noisy = surveyed_workspace(tmp_path / "dense", noise=0.2)
    arrays, transform, _ = made(noisy, tmp_path / "out")
    height, deviation, count = arrays["dsm"]
    level = (height > -9999) & (signed_distance(*places(arrays, transform)) > 2 * GSD) & (count >= 9)
    # The highest of two or three patches that overlap at a cell is a little above the mean.
    assert np.abs(np.median(height[level])) < 0.2 * GSD
    assert 0.1 * GSD < np.median(deviation[level]) < 0.25 * GSD
    assert height[level].std() < np.median(deviation[level])


def test_the_shade_is_that_of_a_sun_in_the_north_west():
    y, x = np.mgrid[:20, :30].astype(np.float32)
    level = hillshade(np.zeros((20, 30), np.float32), 1.0)
    towards = hillshade(x + y, 1.0)  # rises to the south-east: faces the sun
    away = hillshade(-x - y, 1.0)
    assert level[10, 10] == pytest.approx(1 + 254 * np.sin(np.pi / 4), abs=1)
    # The slope's normal is (-1, 1, 1) / √3 in x, y (north) and z, the sun's direction (-1, 1, √2) / 2.
    assert towards[10, 10] == pytest.approx(1 + 254 * (2 + np.sqrt(2)) / (2 * np.sqrt(3)), abs=1)
    assert away[10, 10] == 1


def test_coarse_cells_take_the_middle_height_and_the_mean_colour(tmp_path):
    """Of noisy maps and of speckled pictures, as large as nine fine cells."""
    noisy = surveyed_workspace(tmp_path / "dense", noise=0.2)
    rng = np.random.default_rng(1)
    for path in sorted(noisy.images_dir.iterdir()):
        picture = read_picture(path)
        speckles = rng.integers(-30, 31, picture.shape[:2])[..., None]
        cv2.imwrite(str(path), np.clip(picture + speckles, 0, 255).astype(np.uint8))
    spread = {}
    for factor in (1, 3):
        arrays, transform, summary = made(noisy, tmp_path / "out", cell=factor * GSD, balance=False)
        height, deviation, count = arrays["dsm"]
        assert summary.cell == factor * GSD
        level = (signed_distance(*places(arrays, transform)) > 2 * GSD) & (count >= 9)
        assert np.abs(np.median(height[level])) < 0.2 * GSD
        assert 0.1 * GSD < np.median(deviation[level]) < 0.25 * GSD
        assert (arrays["orthophoto_images"][0][level] > 0).all()
        spread[factor] = (height[level].std(), arrays["orthophoto"][1][level].std())
    assert spread[3][0] < 0.7 * spread[1][0]
    assert spread[3][1] < 0.5 * spread[1][1]


def test_a_coarse_cell_at_an_edge_is_of_one_surface():
    rng = np.random.default_rng(2)
    height = rng.choice([0.0, 9.0, np.nan], (12, 20)).astype(np.float32)
    deviation, count = (
        rng.random(height.shape).astype(np.float32),
        rng.integers(1, 9, height.shape).astype(np.uint16),
    )
    colours = rng.integers(0, 256, (*height.shape, 3)).astype(np.uint8)
    source = rng.integers(0, 4, height.shape).astype(np.uint16)
    coarse, chosen = coarser_surface(Surface(height, deviation, count), 4)
    mean, numbers = coarser_colours(colours, source, 4, chosen)
    for row, column in np.ndindex(3, 5):
        part = np.s_[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        known = np.sort(height[part][np.isfinite(height[part])])
        if len(known) < 8:
            assert np.isnan(coarse.height[row, column])
            assert coarse.count[row, column] == 0
        else:
            assert coarse.height[row, column] == known[(len(known) - 1) // 2]
            taken = (deviation[part] == coarse.deviation[row, column]) & (
                height[part] == coarse.height[row, column]
            )
            assert count[part][taken].tolist() == [coarse.count[row, column]]
        shown = source[part] > 0
        if shown.sum() < 8:
            assert numbers[row, column] == 0
        else:
            np.testing.assert_allclose(mean[row, column], colours[part][shown].mean(axis=0), atol=0.501)
            assert numbers[row, column] in source[part][shown]


# ---- the orthophoto ----------------------------------------------------------------------------------------


def colour_of(arrays, colour):
    rgb = np.moveaxis(arrays["orthophoto"][:3], 0, 2).astype(int)
    return (np.abs(rgb - colour).max(axis=2) <= 3) & (arrays["orthophoto"][3] == 255)


def test_each_cell_has_the_colour_of_its_own_surface(products):
    arrays, transform, summary = products
    distance = signed_distance(*places(arrays, transform))
    known = arrays["dsm"][0] > -9999
    # Beyond a pixel of the edges, where pixels of images have two colours.
    assert colour_of(arrays, RED)[distance < -1.5 * GSD].all()
    assert colour_of(arrays, GREEN)[known & (distance > 1.5 * GSD) & (distance < 5)].all()
    assert not colour_of(arrays, BLUE).any()
    assert not arrays["orthophoto_images"][0][arrays["orthophoto"][3] == 0].any()
    assert len(summary.images) == 13


def test_gdal_keeps_the_blocks_it_works_with(tmp_path):
    """Two rows of them at least, of all bands: with a cache of bytes each pixel decompressed its block again."""
    with LayerFiles(tmp_path, {}, Raster(np.eye(3), np.zeros(3), 0, 0, 1.0, 8, 8), "", {}):
        kept = rasterio.env.get_gdal_config("GDAL_CACHEMAX")
    assert 2 * 512 * 4 * 3 * 4096 <= kept <= 128 << 20


def test_gdal_takes_the_orthophotos_alpha_for_alpha(workspace, tmp_path):
    """So QGIS shows no black where there is nothing, and overviews mix no black into the rims of holes."""
    made(workspace, tmp_path, cell=GSD / 2)
    path = tmp_path / "orthophoto.tif"
    with rasterio.open(path) as file:
        assert [each.name for each in file.colorinterp] == ["red", "green", "blue", "alpha"]
        alpha = file.read(4)
        np.testing.assert_array_equal(file.dataset_mask(), alpha)
    with rasterio.open(path, overview_level=0) as file:
        *colours, small = file.read()
    assert alpha.min() == 0
    assert np.count_nonzero(small) > 1000
    # Of all three colours and their mixtures; with a quarter of black it would be 195.
    assert np.sum(colours, axis=0, dtype=int)[small > 0].min() > sum(GREEN) - 5


def test_the_index_names_an_image_that_sees_the_cell(workspace, products):
    arrays, transform, _ = products
    x, y = places(arrays, transform)
    scene, cameras = surveyed.surfaces(), surveyed.cameras()
    source = arrays["orthophoto_images"][0]
    assert len(np.unique(source)) > 4
    truth = np.where(signed_distance(x, y) < 0, ROOF, 0.0)
    clear = np.abs(signed_distance(x, y)) > 1.5 * GSD
    for number, camera in enumerate(cameras, 1):
        cells = (source == number) & clear
        if cells.any():
            points = np.stack([x[cells], y[cells], truth[cells]], axis=1)
            pixels, depth = camera.project(points)
            nearest = syn.trace_points(scene, camera, pixels).distance
            assert (np.abs(nearest - depth) < 1e-3 * depth).mean() > 0.999


def test_images_of_unequal_brightness_are_balanced(tmp_path):
    uneven = surveyed_workspace(tmp_path / "dense", brightness={4: 0.75, 7: 1.2, 1: 0.85})
    spread = {}
    for balance in (True, False):
        arrays, transform, _ = made(uneven, tmp_path / str(balance), balance=balance)
        ground = (signed_distance(*places(arrays, transform)) > 1) & (arrays["orthophoto"][3] == 255)
        spread[balance] = arrays["orthophoto"][1][ground].std()
    assert spread[True] < 0.25 * spread[False]


# ---- frames, tiles, holes ----------------------------------------------------------------------------------


def test_tiles_do_not_show(workspace, products, tmp_path):
    whole, _, _ = products
    assert max(whole["dsm"].shape) > 300  # more than a tile
    with pytest.raises(OptionError, match=r"would do") as refused:
        made(workspace, tmp_path / "none", memory=1 << 20)
    least = int(str(refused.value).split("MiB would do")[0].split()[-1]) << 20
    tiles, _, _ = made(workspace, tmp_path / "tiles", memory=least)
    assert (np.abs(whole["dsm"] - tiles["dsm"]) < 1e-4).mean() > 0.9999
    assert (np.abs(whole["hillshade"] - tiles["hillshade"].astype(int)) <= 1).mean() > 0.9999
    assert (whole["orthophoto_images"] == tiles["orthophoto_images"]).mean() > 0.999
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("factor", [1, 3])
def test_tiles_are_planned_by_what_they_take(workspace, tmp_path, factor):
    """Arrays in use at any time, and the program itself, are within the memory that is given."""
    with pytest.raises(OptionError, match=r"would do") as refused:
        made(workspace, tmp_path, memory=1 << 20, cell=factor * GSD)
    least = int(str(refused.value).split("MiB would do")[0].split()[-1]) << 20
    tracemalloc.start()
    try:
        made(workspace, tmp_path, memory=least, cell=factor * GSD)
        assert tracemalloc.get_traced_memory()[1] < least - PROGRAM
    finally:
        tracemalloc.stop()


def test_a_model_on_its_side_is_seen_from_above(tmp_path, products):
    """As structure from motion leaves it: up is wherever."""
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    shift = np.array([1.0, -2.0, 0.5])
    turned = surveyed_workspace(tmp_path / "dense", turn=turn, shift=shift)
    for up in ("auto", ",".join(map(str, turn[:, 2]))):
        arrays, _, summary = made(turned, tmp_path / "out", up=up)
        known = arrays["dsm"][0] > -9999
        to_raster = np.array(summary.model_to_raster)
        level = to_raster[:, :3] @ shift + to_raster[:, 3]
        heights = arrays["dsm"][0][known] - level[2]
        assert min((np.abs(heights) < 0.02).sum(), (np.abs(heights - ROOF) < 0.02).sum()) > 0.8 * 48 / GSD**2
        assert np.minimum(np.abs(heights), np.abs(heights - ROOF)).max() < ROOF / 2
        assert np.linalg.det(to_raster[:, :3]) == pytest.approx(1)


def test_a_model_on_the_map_has_its_coordinates(workspace, tmp_path):
    yaw = np.radians(30)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    place = Georeference(
        "EPSG:25832", rasterio.crs.CRS.from_epsg(25832).to_wkt(), 2.0, turn, np.array([5e5, 5.4e6, 300])
    )
    arrays, transform, _ = made(workspace, tmp_path, place=place, cell=2 * GSD)
    x, y = places(arrays, transform)
    model = (np.stack([x, y, np.full_like(x, 300)], axis=-1) - place.translation) @ turn / 2.0
    distance = signed_distance(model[..., 0], model[..., 1])
    assert np.abs(arrays["dsm"][0][distance < -GSD] - (300 + 2 * ROOF)).max() < 1e-3
    with rasterio.open(tmp_path / "dsm.tif") as file:
        assert file.crs.to_epsg() == 25832
        assert file.nodata == -9999
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
    with pytest.raises(OptionError, match=r"^up "):
        made(workspace, tmp_path, place=place, up="z")


@pytest.mark.parametrize("aligned", [False, True], ids=["own coordinates", "aligned"])
def test_a_geocentric_model_is_seen_from_above(aligned, workspace, tmp_path):
    """Its z is the Earth's axis. East, north and up by latitude and longitude, as textbooks have them."""
    latitude, longitude, height = np.radians(-34.0), np.radians(18.5), 120.0
    sin, cos = np.sin(latitude), np.cos(latitude)
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    up = np.array([cos * np.cos(longitude), cos * np.sin(longitude), sin])
    turn = np.column_stack([east, np.cross(up, east), up])
    radius = 6378137.0 / np.sqrt(1 - 0.00669437999 * sin**2)
    place = np.array([*((radius + height) * up[:2]), (radius * (1 - 0.00669437999) + height) * sin])
    if aligned:
        scale = 2.0
        wkt = rasterio.crs.CRS.from_epsg(4978).to_wkt()
        georeference = Georeference("EPSG:4978", wkt, scale, turn, place)
        found, _, summary = made(workspace, tmp_path / "out", place=georeference, cell=2 * GSD)
        to_raster, level = np.array(summary.model_to_raster), 0.0
        np.testing.assert_allclose(to_raster[:, :3], 2 * np.eye(3), atol=1e-3)
    else:
        scale = 1.0
        moved = surveyed_workspace(tmp_path / "dense", turn=turn, shift=place)
        found, _, summary = made(moved, tmp_path / "out")
        to_raster = np.array(summary.model_to_raster)
        np.testing.assert_allclose(to_raster[:, :3] @ turn, np.eye(3), atol=1e-3)
        level = (to_raster[:, :3] @ place + to_raster[:, 3])[2]
    heights = found["dsm"][0][found["dsm"][0] > -9999] - level
    assert min((np.abs(heights) < 0.05).sum(), (np.abs(heights - scale * ROOF) < 0.05).sum()) > 0.8 * 48 / GSD**2
    with rasterio.open(tmp_path / "out" / "dsm.tif") as file:
        assert file.crs is None  # those of the map are not those of the raster


def test_a_facade_is_seen_from_outside(workspace, tmp_path):
    """The southern wall: 8 m wide, 4 m high, in the plane y = -3."""
    corners = ("-4,-3,0", "4,-3,0", "-4,-3,4")
    arrays, _, _ = made(workspace, tmp_path, plane=corners, cell=0.25, plane_depth=0.5, min_images=1)
    height = arrays["dsm"][0]
    assert height.shape == (16, 32)
    known = height > -9999
    assert known.mean() > 0.9
    assert np.abs(height[known]).max() < 0.5
    assert np.abs(height[2:-2][known[2:-2]]).max() < 1e-3
    inner = np.zeros_like(known)
    inner[3:-3, 3:-3] = True
    assert colour_of(arrays, BLUE)[inner & known].mean() > 0.99
    with pytest.raises(NoResultError, match=r"--plane"):
        made(workspace, tmp_path, plane=("-4,-3,90", "4,-3,90", "-4,-3,94"))


def with_hole(root: Path, x: float, *, below: float) -> Workspace:
    """No image has a depth within 1.5 of (x, 0), as far as it is below a height."""
    holed = surveyed_workspace(root)
    for path in sorted((holed.stereo_dir / "depth_maps").iterdir()):
        camera = surveyed.cameras()[int(path.name[:2])]
        depth = read_depth_map(path)
        rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]]
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.K).T
        points = (rays * depth[..., None] - camera.t) @ camera.R
        depth[(np.hypot(points[..., 0] - x, points[..., 1]) < 1.5) & (points[..., 2] < below)] = 0
        write_depth_map(path, depth)
    return holed


def test_a_hole_beside_a_building_is_ground(tmp_path):
    holed = with_hole(tmp_path / "dense", BOX[1, 0] + 1, below=ROOF - 0.1)
    arrays, transform, _ = made(holed, tmp_path / "filled", fill=15)
    height, _, count = arrays["dsm"]
    is_filled = (
        (count == 0)
        & (height > -9999)
        & (np.hypot(*(places(arrays, transform)[k] - (5, 0)[k] for k in (0, 1))) < 2)
    )
    assert is_filled.sum() > 100
    assert (height[is_filled] < 0.05 * ROOF).mean() > 0.97


def test_a_hole_in_a_roof_is_roof():
    height = np.zeros((30, 30), np.float32)
    height[5:25, 5:25] = 9
    height[12:16, 12:16] = np.nan
    holed = Surface(height, np.zeros_like(height), np.full(height.shape, 3, np.uint16))
    assert (filled(holed, 10, 1.0, 0.1).height[12:16, 12:16] == 9).all()


def test_a_tiles_margin_is_enough_to_fill_its_holes():
    rng = np.random.default_rng(4)
    height = np.zeros((150, 160), np.float32)
    for value in [*rng.choice([0.5, 4.0, 9.0], 60), *[np.nan] * 60]:
        row, column, size = rng.integers(0, 150), rng.integers(0, 160), rng.integers(3, 14)
        height[row : row + size, column : column + size] = value
    whole = Surface(height, np.zeros_like(height), np.where(np.isfinite(height), 3, 0).astype(np.uint16))
    margin = margin_of(SurfaceOptions(fill=5, orthophoto=False), 1)
    part = np.s_[40 - margin : 100 + margin, 50 - margin : 110 + margin]
    tile = Surface(whole.height[part], whole.deviation[part], whole.count[part])
    expected = filled(whole, 5, 0.2, 0.1).height[40:100, 50:110]
    assert (np.isnan(height[40:100, 50:110]) & np.isfinite(expected)).sum() > 200
    inner = filled(tile, 5, 0.2, 0.1).height[margin:-margin, margin:-margin]
    np.testing.assert_array_equal(inner, expected)


def test_holes_stay_or_are_filled_from_their_rims(tmp_path):
    holed = with_hole(tmp_path / "dense", 7.0, below=1.0)
    open_arrays, transform, _ = made(holed, tmp_path / "open")
    x, y = places(open_arrays, transform)
    hole = np.hypot(x - 7, y) < 1.2
    assert (open_arrays["dsm"][0][hole] == -9999).all()
    arrays, _, summary = made(holed, tmp_path / "filled", fill=10)
    assert np.abs(arrays["dsm"][0][hole]).max() < 1e-3
    assert (arrays["dsm"][2][hole] == 0).all()
    assert colour_of(arrays, GREEN)[hole].mean() > 0.95
    assert 0 < summary.filled < 0.2
    near, _, _ = made(holed, tmp_path / "near", fill=2)
    assert (near["dsm"][0][np.hypot(x - 7, y) < 0.8] == -9999).all()


# ---- what is refused ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"cell": -1.0}, ["cell"]),
        ({"cell": float("nan")}, ["cell"]),
        ({"min_images": 0}, ["min_images"]),
        ({"fill": -1}, ["fill"]),
        ({"up": "w"}, ["up"]),
        ({"up": "0,0,0"}, ["up"]),
        ({"plane": ("0,0,0", "1,0,0", "2,0,0")}, ["plane"]),
        ({"plane": ("0,0,0", "1,0", "0,1,0")}, ["plane"]),
        ({"plane": ("0,0,0", "1e300,0,0", "0,1e300,0")}, ["plane"]),
        ({"plane": ("0,0,0", "1,0,0", "0,1,0"), "up": "z"}, ["up", "plane"]),
        ({"plane_depth": 1.0}, ["plane_depth", "plane"]),
    ],
)
def test_nonsense_is_refused(options, names):
    assert_refused(SurfaceOptions(**options), *names)


def test_a_raster_without_end_is_refused(workspace, tmp_path):
    with pytest.raises(OptionError, match=r"larger cell"):
        made(workspace, tmp_path, cell=1e-6)
    with pytest.raises(OptionError, match=r"smaller cell"):
        made(workspace, tmp_path, cell=1e6)


def test_a_workspace_without_maps_is_told_what_to_do(tmp_path):
    bare = surveyed_workspace(tmp_path / "w" / "mö ved")
    for path in (bare.stereo_dir / "depth_maps").iterdir():
        path.unlink()
    with pytest.raises(InputError) as error:
        made(bare, tmp_path / "out")
    command = str(error.value).split("`")[1]
    assert shlex.split(command) == ["colmap_sph", "run", "--workspace", str(bare.root)]


def test_a_missing_gdal_is_one_sentence(workspace, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(InputError, match=r"pip install '\.\[geo\]'"):
        made(workspace, tmp_path / "out")


def test_a_full_disk_leaves_what_was_there(workspace, tmp_path, monkeypatch):
    (tmp_path / "dsm.tif").write_text("earlier")
    monkeypatch.setattr("colmap_sph.products.surface.make.free_space", lambda _: 1000)
    with pytest.raises(OutputError, match=r"make room"):
        made(workspace, tmp_path)
    with pytest.raises(OutputError, match=r"dsm\.tif is there already; give --overwrite"):
        made(workspace, tmp_path, overwrite=False)
    assert [path.name for path in tmp_path.iterdir()] == ["dsm.tif"]
    assert (tmp_path / "dsm.tif").read_text() == "earlier"
    (tmp_path / "there").mkdir()
    with pytest.raises(OutputError, match=r"make room"):
        made(workspace, tmp_path / "there" / "a" / "b" / "c")
    assert list((tmp_path / "there").iterdir()) == []


@pytest.mark.parametrize("room", [0.1, 1.1], ids=["as it is drawn", "as it is compressed"])
def test_a_file_that_gdal_cannot_write_is_one_sentence(room, tmp_path):
    """A disk that fills up meanwhile; noise takes more space with its overviews than without."""
    side = 1024
    layer = Layer("dsm.tif", "uint16", ("height",), None, "NEAREST")
    noise = np.random.default_rng(0).integers(0, 1 << 16, (side, side), np.uint16)
    raster = Raster(np.eye(3), np.zeros(3), 5, 5, 0.5, side, side)
    scratch = tmp_path / ".surface.tmp"
    scratch.mkdir()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(room * noise.nbytes), hard))
    try:
        with (
            pytest.raises(OutputError) as error,
            LayerFiles(scratch, {"dsm": layer}, raster, "", {}) as files,
        ):
            files.write("dsm", Tile(0, 0, side, side), [noise])
            files.finish()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(error.value).startswith(f"{tmp_path / 'dsm.tif'} cannot be written (GDAL: ")
    assert "check space" in str(error.value)


def test_space_is_asked_for_without_what_a_killed_process_left(workspace, tmp_path, monkeypatch):
    left = tmp_path / ".surface.tmp" / "dsm.tif"
    left.parent.mkdir()
    left.write_text("half")
    monkeypatch.setattr(
        "colmap_sph.products.surface.make.free_space", lambda _: 1000 if left.exists() else 1 << 50
    )
    made(workspace, tmp_path)
    assert (tmp_path / "dsm.tif").exists() and not left.exists()


@pytest.mark.parametrize("what", ["surface", "mesh --method poisson", "export"])
def test_two_commands_in_one_folder(what, workspace, tmp_path, capsys):
    """The second would take temporary files of the first for leftovers, and its own be published unfinished."""
    typed = [*what.split(), str(workspace.root), "--output", str(tmp_path / "out")]
    with alone_in(tmp_path / "out"):
        assert cli.main(typed) == 3
        assert f"Another command is at work in {tmp_path / 'out'}; wait for its end" in capsys.readouterr().err
        assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("what", ["surface", "mesh --method poisson", "export --formats npz"])
def test_one_cause_has_one_exit_code(what, tmp_path, capsys):
    """Maps that are missing are the input's fault; maps without any depth are of what cannot be reconstructed."""
    bare = surveyed_workspace(tmp_path / "dense")
    command, *options = what.split()
    typed = [command, str(bare.root), *options, "--output", str(tmp_path / "out")]
    paths = list((bare.stereo_dir / "depth_maps").iterdir())
    for path in paths:
        write_depth_map(path, np.zeros_like(read_depth_map(path)))
    assert cli.main(typed) == 4
    assert f"{bare.root} has no depth in any geometric depth map; " in capsys.readouterr().err
    for path in paths:
        path.unlink()
    assert cli.main(typed) == 2
    assert f"{bare.root} has no geometric depth map; run " in capsys.readouterr().err


@pytest.mark.parametrize("what", ["surface", "mesh --method poisson", "export"])
def test_nothing_is_made_of_a_workspace_where_a_run_is_at_work(what, workspace, tmp_path, capsys):
    typed = [*what.split(), str(workspace.root), "--output", str(tmp_path / "out")]
    with claimed(workspace):
        assert cli.main(typed) == 3
    assert f"Another run is at work in {workspace.root}, or" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("what", ["surface", "mesh", "export"])
def test_no_run_begins_where_a_product_is_being_made(what, workspace, tmp_path, monkeypatch):
    """It would be made of some maps of before and some of after."""

    def a_run_begins(*_, **__):
        workspace.state_dir.mkdir(exist_ok=True)
        with claimed(workspace):
            raise AssertionError("a run began")

    maker = "app.products.export_command.export" if what == "export" else f"products.{what}.make.make_{what}"
    monkeypatch.setattr(f"colmap_sph.{maker}", a_run_begins)
    workspace.state_dir.mkdir(exist_ok=True)
    assert cli.main([what, str(workspace.root), "--output", str(tmp_path / "out")]) == 3


def test_small_pictures_show_the_surface(products, workspace, tmp_path):
    arrays, _, _ = products
    made(workspace, tmp_path)
    height, width = arrays["dsm"].shape[1:]
    surface, orthophoto = (read_picture(tmp_path / f"preview_{name}.png") for name in ("surface", "orthophoto"))
    assert surface.shape == orthophoto.shape == (height, width, 3)
    known = arrays["dsm"][0] > -9999
    assert (surface[~known] == 255).all()
    roof = surface[known & (arrays["dsm"][0] > ROOF / 2)].mean(axis=0)
    ground = surface[known & (arrays["dsm"][0] < ROOF / 2)].mean(axis=0)
    assert roof[2] > ground[2] + 50  # yellow above dark blue
    coloured = arrays["orthophoto"][3] > 0
    np.testing.assert_array_equal(orthophoto[coloured], np.moveaxis(arrays["orthophoto"][2::-1], 0, 2)[coloured])
    assert (orthophoto[~coloured] == 255).all()


@pytest.mark.parametrize("step", ["sync_file", "move_into_place"])
def test_an_interruption_leaves_no_files_beside_the_summary_of_others(workspace, tmp_path, monkeypatch, step):
    """The disk may take seconds for each: that is waited for before the first is in its place."""
    made(workspace, tmp_path, cell=0.5)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    do = getattr(make, step)

    def interrupted(*paths: Path) -> None:
        do(*paths)
        if paths[0].name == "orthophoto.tif":
            raise KeyboardInterrupt

    monkeypatch.setattr(make, step, interrupted)
    with pytest.raises(KeyboardInterrupt):
        made(workspace, tmp_path, cell=0.4)
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    if step == "sync_file":
        assert after == before
    else:
        assert after.keys() == before.keys() - {"surface.json"}
        assert after["orthophoto.tif"] != before["orthophoto.tif"]


def test_the_command_says_what_it_made(workspace, tmp_path, capsys):
    arguments = ["surface", str(workspace.root), "--output", str(tmp_path), "--cell", "0.5", "--no-orthophoto"]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr()
    names = ["dsm.tif", "hillshade.tif", "preview_surface.png", "surface.json"]
    assert [Path(line).name for line in printed.out.splitlines()] == names
    assert "cells of 0.5" in printed.err
    assert json.loads((tmp_path / "surface.json").read_text())["cell"] == 0.5
    assert cli.main(["surface", str(tmp_path / "nowhere")]) == 2
