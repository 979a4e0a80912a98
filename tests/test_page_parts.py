"""What a page is drawn from: why pixels are lost, which way is up, the map, the small cloud, small readings."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from small_workspaces import write_cloud

from colmap_sph.errors import InputError
from colmap_sph.evaluation.ply_files import read_ply
from colmap_sph.pages.block_map import Ground, footprint, frame_around, looks_towards, seen_from_above
from colmap_sph.pages.image_facts import find_blank
from colmap_sph.pages.pictures import COLOURS, depth_picture, normal_picture, picture_uri, reason_picture
from colmap_sph.pages.reasons import Partner, Reason, find_reasons
from colmap_sph.pages.samples import MapSamples, grid_of
from colmap_sph.pages.small_cloud import STEPS, thin_out
from colmap_sph.project.cloud_reader import read_some_points
from colmap_sph.project.images.reading import read_small_colours
from colmap_sph.project.map_files import read_some_pixels, write_depth_map, write_normal_map
from colmap_sph.project.state.ownership import undistorted_place
from colmap_sph.project.state.records import vouch
from colmap_sph.project.undistortion.rounding import rounding_of_original
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Region, View
from colmap_sph.stereo.region.map_axes import map_axes
from colmap_sph.stereo.region.shown import count_shown, filled

WIDTH, HEIGHT, FOCAL = 200, 150, 100.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
DOWN = np.diag([1.0, -1.0, -1.0])


def view_at(*center: float, R: np.ndarray = DOWN, name: str = "a.jpg") -> View:
    return View(1, name, WIDTH, HEIGHT, K, R, -R @ np.array(center), np.empty(0, np.int64))


def samples_of(
    view: View, photometric: float | np.ndarray, geometric: float | np.ndarray | None = None, *, step: int = 5
) -> MapSamples:
    """Depth at each fifth pixel; the same everywhere, or (h, w)."""
    rows, columns = grid_of(view, view.width // step)
    shape = (len(rows), len(columns))
    geometric = photometric if geometric is None else geometric
    first, second = (np.array(np.broadcast_to(depth, shape), np.float32) for depth in (photometric, geometric))
    return MapSamples(rows, columns, first, second, True, True, np.zeros(shape, bool))


# ---- reasons -----------------------------------------------------------------------------------------------

ALTITUDE = 50.0
SHAPE = (30, 40)


def reasons_of(samples: MapSamples, *partners: Partner, blank: np.ndarray | None = None) -> np.ndarray:
    blank = np.zeros(SHAPE, bool) if blank is None else blank
    return find_reasons(view_at(0, 0, ALTITUDE), samples, partners, blank=blank, min_angle=1.0)[0]


def partner_at(x: float, depth: float | np.ndarray = ALTITUDE) -> Partner:
    view = view_at(x, 0, ALTITUDE)
    return Partner(view, samples_of(view, depth))


def test_what_no_partner_has_in_view_is_seen_by_one_image_only() -> None:
    """20 units to the right at 50 units and 100 pixels of focal length: the left 40 pixels are not in common."""
    view = view_at(0, 0, ALTITUDE)
    samples = samples_of(view, ALTITUDE, 0)
    reasons = reasons_of(samples, partner_at(20.0))
    assert (reasons[:, samples.columns < 40] == Reason.ONE_IMAGE).all()
    assert not (reasons[:, samples.columns >= 40] == Reason.ONE_IMAGE).any()


@pytest.mark.parametrize(
    ("partner_depth", "reason"),
    [
        (0.0, Reason.ALONE),
        (ALTITUDE, Reason.CONTRADICTED),
        (1.5 * ALTITUDE, Reason.CONTRADICTED),  # the partner sees through it
        (0.5 * ALTITUDE, Reason.ALONE),  # something hides it from the partner
    ],
)
def test_a_depth_that_is_not_confirmed_was_contradicted_or_alone(partner_depth: float, reason: Reason) -> None:
    samples = samples_of(view_at(0, 0, ALTITUDE), ALTITUDE, 0)
    assert (reasons_of(samples, partner_at(5.0, partner_depth))[5:-5, 10:-5] == reason).all()


def test_partners_in_the_same_place_have_no_parallax() -> None:
    """At 50 units 0.5 units of baseline are 0.57 degrees, 2 units are 2.3: what is missing is one of the kinds."""
    found = np.full(SHAPE, ALTITUDE, np.float32)
    found[10:20, 10:30] = 0
    samples = samples_of(view_at(0, 0, ALTITUDE), found)
    for baseline, reason in ((0.5, Reason.NO_PARALLAX), (2.0, Reason.NOT_FOUND)):
        reasons = reasons_of(samples, partner_at(baseline))
        assert (reasons[10:20, 10:30] == reason).all()
        assert (reasons[found > 0] == Reason.CONFIRMED).all()


def test_masked_and_blank_pixels_are_told_apart_from_others() -> None:
    found = np.full(SHAPE, ALTITUDE, np.float32)
    found[:, 10:30] = 0
    blank = np.zeros(SHAPE, bool)
    blank[:15] = True
    samples = samples_of(view_at(0, 0, ALTITUDE), found)
    samples.ignored[:, 20:] = True
    reasons = reasons_of(samples, partner_at(5.0), blank=blank)
    assert (reasons[:15, 10:20] == Reason.BLANK).all()
    assert (reasons[15:, 10:20] == Reason.NOT_FOUND).all()
    assert (reasons[:, 20:30] == Reason.MASKED).all()
    assert (reasons[:, 30:] == Reason.CONFIRMED).all()


def test_what_jpeg_has_rounded_is_blank_in_undistorted_copies_too(tmp_path: Path) -> None:
    """A sky over texture, saved as JPEG; its copy is none, and only its record knows."""
    rng = np.random.default_rng(0)
    light = 200 - np.linspace(0, 30, 240)[:, None] + 2 * rng.standard_normal((240, 320))
    light[120:] += 160 * cv2.GaussianBlur(rng.standard_normal((120, 320)), (0, 0), 1.5)
    original = tmp_path / "original.jpg"
    cv2.imwrite(str(original), np.clip(light, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 50])
    picture = np.asarray(cv2.imread(str(original)), np.uint8)
    workspace = Workspace(tmp_path / "dense")
    copy = workspace.image_path("a.png")
    copy.parent.mkdir(parents=True)
    cv2.imwrite(str(copy), picture)
    shape = (60, 80)
    assert find_blank(workspace, "a.png", picture, shape)[:28].mean() < 0.7
    vouch(undistorted_place(workspace, "a.png").record, "key", {}, rounding_of_original(original))
    blank = find_blank(workspace, "a.png", picture, shape)
    assert blank[:28].all()
    assert not blank[32:].any()


def test_what_lies_outside_of_a_region_was_not_asked_for() -> None:
    """Ground 100 x 75 units wide; the region are 20 x 75 in its middle, of which half has a depth."""
    view = view_at(0, 0, ALTITUDE)
    found = np.zeros(SHAPE, np.float32)
    found[15:, 16:24] = ALTITUDE
    samples = samples_of(view, found)
    region = Region(np.array([[-10.0, -100, -1], [10, 100, 1]]))
    arguments = (view, samples, [partner_at(5.0)])
    reasons, _ = find_reasons(*arguments, blank=np.zeros(SHAPE, bool), min_angle=1.0, region=region)
    wanted = np.abs((samples.columns - WIDTH / 2) * ALTITUDE / FOCAL) <= 10
    assert wanted.sum() == 8
    assert (reasons[:, ~wanted] == Reason.OUTSIDE).all()
    assert (reasons[15:, wanted] == Reason.CONFIRMED).all()
    assert (reasons[:15, wanted] == Reason.NOT_FOUND).all()
    # Elsewhere, and behind the camera, nothing is asked for; without any depth, what is in the outline.
    for box in ([[500.0, 0, -1], [510, 1, 1]], [[-1.0, -1, 60], [1, 1, 70]]):
        reasons, _ = find_reasons(
            *arguments, blank=np.zeros(SHAPE, bool), min_angle=1.0, region=Region(np.array(box))
        )
        assert (reasons[:, ~wanted] == Reason.OUTSIDE).all()
    nothing = (view, samples_of(view, 0.0), [partner_at(5.0)])
    reasons, _ = find_reasons(*nothing, blank=np.zeros(SHAPE, bool), min_angle=1.0, region=region)
    assert (reasons[:, wanted] == Reason.NOT_FOUND).all()
    assert (reasons[:, :12] == Reason.OUTSIDE).all() and (reasons[:, 28:] == Reason.OUTSIDE).all()


def test_pixels_that_show_a_region_are_counted() -> None:
    """Ground, half a unit per pixel: columns within 10 units show a region 20 wide, with a depth or without."""
    view = view_at(0, 0, ALTITUDE)
    found = np.full((HEIGHT, WIDTH), ALTITUDE, np.float32)
    found[::2] = 0
    kept = found.copy()
    kept[:, :80] = 0
    kept[:, 121:] = 0
    region = Region(np.array([[-10.0, -100, -1], [10, 100, 1]]))
    assert count_shown(view, found, kept, region) == 41 * HEIGHT
    assert count_shown(view, np.zeros_like(found), np.zeros_like(found), region) == WIDTH * HEIGHT


def test_without_partners_one_image_sees_all_and_without_depth_nothing_is_known() -> None:
    nothing = samples_of(view_at(0, 0, ALTITUDE), 0.0)
    assert (reasons_of(nothing) == Reason.ONE_IMAGE).all()
    assert (reasons_of(nothing, partner_at(5.0)) == Reason.NOT_FOUND).all()


def test_holes_are_as_far_as_the_nearest_depth() -> None:
    rng = np.random.default_rng(2)
    depth = np.where(rng.random((20, 30)) < 0.05, rng.uniform(1, 9, (20, 30)), 0).astype(np.float32)
    there = np.argwhere(depth > 0)
    distances, _ = cKDTree(there).query(np.argwhere(np.ones_like(depth)))
    for place, value, nearest in zip(np.ndindex(*depth.shape), filled(depth).ravel(), distances, strict=True):
        away = np.linalg.norm(there[depth[tuple(there.T)] == value] - place, axis=1).min()
        # The distance transform is that of a 3 x 3 mask, which is right to some percent.
        assert away <= 1.15 * nearest + 1e-9


# ---- up, and the map ---------------------------------------------------------------------------------------


def looking(azimuth: float, elevation: float, roll: float = 0.0) -> np.ndarray:
    """World to camera: z of the world is up; azimuth and elevation of the direction of view in degrees."""
    a, e, r = np.radians([azimuth, elevation, roll])
    ahead = np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])
    right = np.array([np.cos(a), -np.sin(a), 0])
    down = np.cross(ahead, right)
    return np.array([np.cos(r) * right + np.sin(r) * down, np.cos(r) * down - np.sin(r) * right, ahead])


BLOCKS = {
    "strip of vertical images": [view_at(x, 0, 50.0) for x in range(0, 100, 10)],
    "vertical images, every other turned": [
        view_at(x, y, 50.0, R=DOWN if y % 20 else np.diag([-1.0, 1.0, -1.0]))
        for x in range(0, 90, 10)
        for y in (0, 10)
    ],
    "around a house": [
        view_at(20 * np.cos(a), 20 * np.sin(a), 2.0, R=looking(90 - np.degrees(a) + 180, -5, 1.0))
        for a in np.linspace(0, 6, 20)
    ],
    "oblique in four directions": [view_at(0, 0, 50.0, R=looking(a, -45)) for a in (0, 90, 180, 270)],
}


@pytest.mark.parametrize("name", BLOCKS)
def test_up_is_found(name: str) -> None:
    rng = np.random.default_rng(3)
    views = BLOCKS[name]
    ground = np.column_stack([rng.uniform(-60, 120, (2000, 2)), rng.uniform(0, 4, 2000)])
    world = Rotation.random(random_state=4).as_matrix()
    turned = [View(1, "", WIDTH, HEIGHT, K, view.R @ world.T, view.t, view.point_indices) for view in views]
    axes = map_axes(turned, ground @ world.T)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[2] @ world[:, 2] > np.cos(np.radians(3))


def test_maps_of_map_coordinates_have_north_on_top() -> None:
    ground = np.random.default_rng(3).uniform((-60, -60, 0), (120, 120, 4), (500, 3))
    for origin in ([5e5, 5.4e6, 300], [5e5, 6.365e6, 300]):  # the latter, 57.4° north, could be geocentric
        for views in BLOCKS.values():
            assert np.array_equal(map_axes(views, ground, origin=np.array(origin)), np.eye(3))


@pytest.mark.parametrize("azimuth", [0, 90, 180, 270])
def test_facades_on_maps_and_in_geocentric_coordinates_are_upright(azimuth: int) -> None:
    """Their images take what is in front of them for up: that must not turn them."""
    views = [view_at(x, 0, 5.0, R=looking(azimuth, 0)) for x in range(0, 30, 5)]
    wall = np.random.default_rng(5).uniform((-20, -15, 19.9), (20, 0, 20.1), (500, 3)) @ looking(azimuth, 0)
    for latitude, longitude in ((60, 11), (45, -90), (10, 100), (-1, 37), (-34, 18.5), (-75, 0)):
        a, b = np.radians([latitude, longitude])
        east = np.array([-np.sin(b), np.cos(b), 0])
        up = np.array([np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)])
        radius = 6378137.0 / np.sqrt(1 - 0.00669437999 * np.sin(a) ** 2)
        turn = np.column_stack([east, np.cross(up, east), up])
        turned = [View(1, "", WIDTH, HEIGHT, K, view.R @ turn.T, view.t, view.point_indices) for view in views]
        axes = map_axes(turned, wall @ turn.T, origin=radius * up * [1, 1, 1 - 0.00669437999])
        np.testing.assert_allclose(axes @ turn, np.eye(3), atol=1e-6)
    if azimuth != 180:  # to the south: that cannot be told from one on the equator
        assert np.array_equal(map_axes(views, wall, origin=np.array([5e5, 6.365e6, 30])), np.eye(3))


def test_a_map_is_seen_from_above() -> None:
    """A red square under a green one, seen from above; x to the right, y to the top.

    Both are thin: every other cell or so has no point. The red one has a hole.
    """
    low, high = np.mgrid[0:40, 0:40].reshape(2, -1).T + 0.5, np.mgrid[10:20, 25:40].reshape(2, -1).T + 0.5
    low = low[np.abs(low - [32, 8]).max(axis=1) > 4]
    points = np.vstack([np.c_[high, np.full(len(high), 5.0)], np.c_[low, np.zeros(len(low))]])
    colours = np.repeat(np.array([[0, 255, 0], [255, 0, 0]], np.uint8), [len(high), len(low)], axis=0)
    frame = frame_around(points, np.array([[20.0, 20, 30]]), np.eye(3))
    picture, _, ends = seen_from_above(frame, points, colours)
    assert ends == pytest.approx((0.0, 5.0))
    for x, y, colour in ((15, 30, (0, 255, 0)), (15, 10, (255, 0, 0)), (30, 30, (255, 0, 0))):
        across, down = frame.place(np.array([[x, y, 0.0]]))[0] * picture.shape[1::-1]
        near = picture[int(down) - 2 : int(down) + 3, int(across) - 2 : int(across) + 3].reshape(-1, 4)
        assert {tuple(each) for each in near} == {(*colour, 255)}
    across, down = (frame.place(np.array([[32.0, 8, 0]]))[0] * picture.shape[1::-1]).astype(int)
    assert not picture[down - 2 : down + 3, across - 2 : across + 3, 3].any()


def test_footprints_and_directions_are_those_of_the_camera() -> None:
    """From 50 units above the ground, 200 x 150 pixels of 0.5 units: what samples in the corners see."""
    view = view_at(30, 40, ALTITUDE)
    samples = samples_of(view, ALTITUDE)
    frame = frame_around(np.array([[0.0, 0, 0], [100, 100, 0]]), view.center[None], np.eye(3))
    corners = footprint(view, samples, samples.geometric, frame)
    edge = 2.0  # the first sample's column and row
    x = 30 + (np.array([edge, WIDTH - 3, WIDTH - 3, edge]) - WIDTH / 2) * 0.5
    y = 40 - (np.array([edge, edge, HEIGHT - 3, HEIGHT - 3]) - HEIGHT / 2) * 0.5
    assert corners == pytest.approx(frame.place(np.c_[x, y, np.zeros(4)]), abs=1e-6)
    assert looks_towards(view, frame) == pytest.approx([0, 0])
    assert looks_towards(view_at(0, 0, 0, R=looking(90, 0)), frame) == pytest.approx([1, 0])
    assert looks_towards(view_at(0, 0, 0, R=looking(0, 0)), frame) == pytest.approx([0, -1])


def test_the_ground_counts_images_and_knows_the_finest() -> None:
    """Two images at two heights, side by side: overlap, GSD and what was lost, by the geometry of the flight."""
    low, high = view_at(0, 0, ALTITUDE), view_at(40, 0, 2 * ALTITUDE)
    frame = frame_around(np.array([[-60.0, -60, 0], [160, 60, 1]]), np.zeros((1, 3)), np.eye(3))
    ground = Ground(frame)
    for view, depth in ((low, ALTITUDE), (high, 2 * ALTITUDE)):
        # The lower fifth of each image is lost.
        geometric = np.full((HEIGHT, WIDTH), depth, np.float32)
        geometric[120:] = 0
        samples = samples_of(view, depth, geometric, step=1)
        reasons = np.where(geometric > 0, Reason.CONFIRMED, Reason.CONTRADICTED).astype(np.uint8)
        ground.add(view, samples, reasons, samples.photometric)

    def at(layer: np.ndarray, x: float, y: float) -> float:
        place = frame.place(np.array([[x, y, 0.0]]))[0]
        return float(layer[int(place[1] * layer.shape[0]), int(place[0] * layer.shape[1])])

    # Along x the lower sees -50 to 50, the higher -60 to 140; along y -22.5 to 37.5 and -45 to 75.
    assert [at(ground.images, x, 10.0) for x in (-55, 0, 100, 150)] == [1, 2, 1, 0]
    assert [at(ground.images, 0.0, y) for y in (-30, -40, 30, 50)] == [1, 1, 2, 1]
    assert at(ground.gsd, 0.0, 10.0) == pytest.approx(0.5)
    assert at(ground.gsd, 100.0, 10.0) == pytest.approx(1.0)
    weak, shares = ground.weak_layer()
    assert list(shares) == [Reason.CONTRADICTED]
    assert [at(weak[..., 3], 100.0, y) for y in (-55, 0)] == [255, 0]


# ---- small cloud and pictures ------------------------------------------------------------------------------


def test_a_small_cloud_lies_on_the_cloud_and_is_even() -> None:
    """Two plates, one a hundred times as dense: each gets as many points as the other."""
    rng = np.random.default_rng(5)
    plates = [np.c_[rng.uniform(0, 10, (n, 2)), np.full(n, 2.0 * k)] for k, n in enumerate((300_000, 3_000))]
    points = np.vstack([*plates, [[1e6, 0, 0]]])
    colours = rng.integers(0, 256, points.shape, dtype=np.uint8)
    small = thin_out(points, colours, 2000)
    assert small is not None
    assert 1000 <= len(small.places) <= 2000
    back = small.corner + small.places * small.step
    distance, nearest = cKDTree(points).query(back)
    assert distance.max() <= np.sqrt(3) / 2 * small.step * (1 + 1e-6)
    assert small.step <= 1.02 * 10 / STEPS
    assert np.array_equal(small.colours, colours[nearest])
    upper = (back[:, 2] > 1).mean()
    assert 0.4 < upper < 0.6


@pytest.mark.parametrize("number", [0, 1, 2, 50])
def test_few_points_are_all_there(number: int) -> None:
    points = np.random.default_rng(6).normal(size=(number, 3)) * 1e-3
    small = thin_out(points, np.zeros((number, 3), np.uint8))
    if number == 0:
        assert small is None
    else:
        assert small is not None
        assert number - 2 <= len(small.places) <= number


def decoded(uri: str) -> np.ndarray:
    import base64

    data = np.frombuffer(base64.b64decode(uri.removeprefix("data:image/webp;base64,")), np.uint8)
    found = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert found is not None
    return cv2.cvtColor(found, cv2.COLOR_BGR2RGB)


def test_pictures_show_what_they_should() -> None:
    reasons = np.repeat(np.arange(len(Reason), dtype=np.uint8), 50).reshape(-1, 50)
    assert np.array_equal(
        decoded(picture_uri(reason_picture(reasons), 5000, exact=True))[:, 0], list(COLOURS.values())
    )
    depth = np.array([[0, 1, 10]], np.float32)
    shown, ends = depth_picture(depth)
    assert ends == pytest.approx((1, 10), rel=0.1)
    near, far = shown[0, 1].astype(int), shown[0, 2].astype(int)
    assert near[0] + near[1] > 400 > 200 > far[0] + far[1]  # yellow, and blue
    up = normal_picture(np.array([0, -1.0, 0], np.float32).reshape(3, 1, 1))[0, 0]
    assert up.tolist() == [127, 255, 127]


def test_a_picture_takes_no_more_than_it_may() -> None:
    noise = np.random.default_rng(7).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    for most in (100_000, 20_000, 2_000):
        uri = picture_uri(noise, most)
        assert len(uri) < 1.34 * most + 40
        height, width = decoded(uri).shape[:2]
        assert width / height == pytest.approx(4 / 3, rel=0.05)


# ---- small readings ----------------------------------------------------------------------------------------


def test_some_pixels_of_a_map_are_those_of_the_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    depth = rng.random((7, 11), dtype=np.float32)
    normals = rng.random((7, 11, 3), dtype=np.float32)
    write_depth_map(tmp_path / "depth", depth)
    write_normal_map(tmp_path / "normals", normals)
    rows, columns = np.array([0, 3, 6]), np.array([10, 2])
    assert np.array_equal(
        read_some_pixels(tmp_path / "depth", (7, 11), rows, columns), depth[np.ix_(rows, columns)]
    )
    found = read_some_pixels(tmp_path / "normals", (7, 11, 3), rows, columns)
    assert np.array_equal(found.transpose(1, 2, 0), normals[np.ix_(rows, columns)])
    with pytest.raises(InputError, match="size"):
        read_some_pixels(tmp_path / "depth", (11, 7), rows, columns)
    (tmp_path / "depth").write_bytes((tmp_path / "depth").read_bytes()[:-1])
    with pytest.raises(InputError, match="truncated"):
        read_some_pixels(tmp_path / "depth", (7, 11), rows, columns)


def test_some_points_are_of_the_cloud_and_evenly_spread(tmp_path: Path) -> None:
    points = np.random.default_rng(9).uniform(-5, 5, (50_000, 3))
    colours = (np.arange(150_000) % 251).astype(np.uint8).reshape(-1, 3)
    write_cloud(tmp_path / "cloud.ply", points, colours)
    whole = read_ply(tmp_path / "cloud.ply")[0]
    xyz, rgb, count = read_some_points(tmp_path / "cloud.ply", 100_000)
    assert count == 50_000
    assert np.array_equal(xyz, whole)
    assert np.array_equal(rgb, colours)
    some, rgb, _ = read_some_points(tmp_path / "cloud.ply", 1000)
    rows = cKDTree(whole).query(some)[1]
    assert 900 <= len(some) <= 1100
    assert np.array_equal(rgb, colours[rows])
    assert np.diff(np.sort(rows)).max() < 200


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "no binary little-endian PLY"),
        (b"", "no binary little-endian PLY"),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\nend_header\n", "begin with points"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n",
            "known format",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\n"
            b"property float y\nproperty float z\nend_header\n",
            "cut off",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
            "known format",
        ),
        (b"ply\nformat binary_little_endian 1.0\n\n\nproperty\nend_header\n", "begin with points"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
            b"property float z\nend_header\n" + 24 * b"\0",
            "goes on behind the 1 point that its header counts",
        ),
    ],
)
def test_what_is_no_cloud_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_some_points(tmp_path / "cloud.ply", 10)


def test_a_header_may_have_many_comments(tmp_path: Path) -> None:
    points = np.arange(12.0).reshape(-1, 3)
    write_cloud(tmp_path / "cloud.ply", points)
    first, _, rest = (tmp_path / "cloud.ply").read_bytes().partition(b"element")
    comments = b"comment station of the scanner\n" * 10_000
    (tmp_path / "cloud.ply").write_bytes(first + comments + b"element" + rest)
    assert read_some_points(tmp_path / "cloud.ply", 10)[0].tolist() == points.tolist()


def test_points_that_are_none_are_left_out(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, 0], [4, 5, 6]])
    write_cloud(tmp_path / "cloud.ply", points)
    assert read_some_points(tmp_path / "cloud.ply", 10)[0].tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("ending", [".jpg", ".png"])
@pytest.mark.parametrize("shape", [(600, 900), (900, 600), (50, 40)])
def test_a_small_picture_is_the_picture_shrunk(shape: tuple[int, int], ending: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(10)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (*shape, 3), dtype=np.uint8), (0, 0), 3)
    path = tmp_path / f"a{ending}"
    path.write_bytes(cv2.imencode(ending, picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes())
    small = read_small_colours(path, 128)
    assert max(small.shape[:2]) == min(128, max(shape))
    expected = cv2.resize(picture, small.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).mean() < 2


def test_a_damaged_picture_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"):
        (tmp_path / "a.jpg").write_bytes(content)
        with pytest.raises(InputError, match="cannot be read as an image"):
            read_small_colours(tmp_path / "a.jpg", 128)
