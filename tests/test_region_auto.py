"""The core of a scene, as a surveyor would draw it, in scenes of which it is known."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import keep_images
from scipy.spatial.transform import Rotation

from colmap_sph.app import cli
from colmap_sph.errors import InputError, OptionError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.plan import make_plan
from colmap_sph.project.project import Project
from colmap_sph.project.region_file import as_given, read_region
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Region, Scene, View
from colmap_sph.stereo.partners.frusta import sees
from colmap_sph.stereo.region.core import core_of, precision
from colmap_sph.stereo.region.focus import focused
from colmap_sph.stereo.region.inside import is_inside
from colmap_sph.stereo.region.window import outline_on

Vector = tuple[float, float, float]


def camera(center: Vector, target: Vector, name: str = "", focal_length: float = 800) -> View:
    """1000 x 750 pixels; z of the world is up, and lies in the image's columns where it can."""
    forward = np.subtract(target, center)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1] if abs(forward[2]) < 0.99 else [0, 1, 0])
    right = right / np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    K = np.array([[focal_length, 0, 500], [0, focal_length, 375], [0, 0, 1]])
    return View(0, name, 1000, 750, K, R, -R @ np.array(center), np.empty(0, np.int64))


def scene_of(views: Sequence[View], points: np.ndarray) -> Scene:
    """Each view observes all that it has in the image."""
    named = [
        replace(view, image_id=k, name=f"{k:04d}", point_indices=np.flatnonzero(sees(view, points)))
        for k, view in enumerate(views)
    ]
    return Scene(tuple(named), points)


def moved(scene: Scene, turn: np.ndarray, shift: np.ndarray, scale: float) -> Scene:
    """The same scene in another frame: X' = scale · turn X + shift."""
    views = [replace(view, R=view.R @ turn.T, t=scale * view.t - view.R @ turn.T @ shift) for view in scene.views]
    return replace(scene, views=tuple(views), points=scale * scene.points @ turn.T + shift)


def block_with_horizon(rng: np.random.Generator) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Vertical images 100 above ground, which some oblique ones see as far as three kilometres away.

    With which points must lie inside: what lies below the cameras; and which outside: what is farther from all of
    them than four times their height.
    """
    places = [(x, y) for x in range(0, 241, 40) for y in range(0, 161, 40)]
    views = [camera((x, y, 100), (x, y, 0)) for x, y in places]
    for x, y in places[::3]:
        views += [camera((x, y, 100), (x + 100 * dx, y + 100 * dy, 45)) for dx, dy in ((1, 0), (-1, 0), (0, 1))]
    near = rng.uniform((-100, -100, -3), (340, 260, 12), (6000, 3))
    distance = 10 ** rng.uniform(2, 3.5, 4000)
    angle = rng.uniform(0, 2 * np.pi, 4000)
    far = np.column_stack(
        [120 + distance * np.cos(angle), 80 + distance * np.sin(angle), rng.uniform(-3, 12, 4000)]
    )
    points = np.concatenate([near, far])
    beside = np.maximum(np.maximum([0, 0] - points[:, :2], points[:, :2] - [240, 160]), 0)
    beyond = np.linalg.norm(beside, axis=1)
    return scene_of(views, points), beyond == 0, beyond > 400


def object_before_background(rng: np.random.Generator) -> tuple[Scene, np.ndarray, np.ndarray]:
    """A ball, 0.4 in diameter, and a wall behind it, which carries four fifths of the points.

    The ball inside, the wall outside.
    """
    angles = np.radians(np.linspace(-60, 60, 15))
    views = [camera((np.sin(a), -np.cos(a), 0.3), (0, 0, 0)) for a in angles]
    ball = rng.normal(size=(1000, 3))
    ball = 0.2 * ball / np.linalg.norm(ball, axis=1)[:, None]
    wall = np.column_stack([rng.uniform(-6, 6, 4000), rng.uniform(4.9, 5, 4000), rng.uniform(-3, 3, 4000)])
    is_ball = np.arange(5000) < 1000
    return scene_of(views, np.concatenate([ball, wall])), is_ball, ~is_ball


def street(rng: np.random.Generator) -> tuple[Scene, np.ndarray, np.ndarray]:
    """A drive between two rows of façades that looks ahead: what is passed inside, what is far ahead outside."""
    views = [camera((0, y, 1.6), (0, y + 10, 1.6)) for y in np.arange(0, 60, 1.5)]
    side = rng.choice([-8, 8], 3000)
    facades = np.column_stack([side, rng.uniform(0, 60, 3000), rng.uniform(0, 8, 3000)])
    ground = np.column_stack([rng.uniform(-8, 8, 2000), rng.uniform(0, 60, 2000), np.zeros(2000)])
    far = np.column_stack([rng.uniform(-60, 60, 1500), rng.uniform(400, 900, 1500), rng.uniform(0, 60, 1500)])
    points = np.concatenate([facades, ground, far])
    is_driven = (np.arange(6500) < 5000) & (points[:, 1] > 5) & (points[:, 1] < 60)
    return scene_of(views, points), is_driven, np.arange(6500) >= 5000


def facade(rng: np.random.Generator) -> tuple[Scene, np.ndarray, np.ndarray]:
    """A façade, with hills far behind and above it: the façade inside, the hills outside."""
    views = [camera((x, -25, 1.7), (x, 0, 10)) for x in range(-20, 21, 5)]
    wall = np.column_stack([rng.uniform(-25, 25, 3000), rng.uniform(-1, 1, 3000), rng.uniform(0, 18, 3000)])
    hills = np.column_stack([rng.uniform(-900, 900, 900), rng.uniform(800, 1500, 900), rng.uniform(400, 800, 900)])
    is_wall = np.arange(3900) < 3000
    return scene_of(views, np.concatenate([wall, hills])), is_wall, ~is_wall


def block_with_details(number: int, rng: np.random.Generator) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Vertical images of a block without any horizon, and some from the ground, a twelfth as far from a monument.

    All of it inside.
    """
    views = [camera((x, y, 100), (x, y, 0)) for x in range(0, 241, 40) for y in range(0, 161, 40)]
    angles = np.linspace(0, 2 * np.pi, number, endpoint=False)
    views += [camera((120 + 8 * np.cos(a), 80 + 8 * np.sin(a), 2), (120, 80, 2)) for a in angles]
    ground = rng.uniform((-60, -60, -1), (300, 220, 8), (4000, 3))
    points = np.concatenate([ground, rng.uniform((117, 77, 0), (123, 83, 5), (2000, 3))])
    return scene_of(views, points), np.ones(6000, bool), np.zeros(6000, bool)


SCENES = [block_with_horizon, object_before_background, street, facade]


@pytest.mark.parametrize("make", SCENES)
@pytest.mark.parametrize("has_tracks", [True, False])
@pytest.mark.parametrize("is_turned", [False, True])
def test_the_core_is_inside_and_the_background_outside(make, has_tracks, is_turned):
    rng = np.random.default_rng(5)
    scene, inside, outside = make(rng)
    if is_turned:
        turn = Rotation.from_rotvec([0.9, -0.5, 1.4]).as_matrix()
        scene = moved(scene, turn, np.array([3.0, -70, 12]), 0.07)
    if not has_tracks:
        scene = replace(scene, views=tuple(view.without_points() for view in scene.views))
    region = read_region(as_given(core_of(scene)))
    found = is_inside(region, scene.points)
    seen = np.sum([sees(view, scene.points) for view in scene.views], axis=0) > 1
    assert (seen & outside).sum() > 300
    assert found[inside & seen].mean() > 0.99
    assert found[outside].mean() < 0.01
    part, *_ = focused(scene, region, 15, "--region")
    assert len(part.views) > 0.9 * len(scene.views)


@pytest.mark.parametrize("number", [10, 50])
def test_some_details_do_not_cost_the_block(number):
    scene, inside, _ = block_with_details(number, np.random.default_rng(5))
    assert is_inside(core_of(scene), scene.points)[inside].mean() > 0.99


def test_a_turned_box_stands_upright():
    scene, *_ = block_with_horizon(np.random.default_rng(5))
    turn = Rotation.from_rotvec([0.9, -0.5, 1.4]).as_matrix()
    plain = core_of(scene)
    turned = core_of(moved(scene, turn, np.array([3.0, -70, 12]), 10))
    assert plain.axes is None and turned.axes is not None
    assert turned.axes[2] @ turn[:, 2] > 0.999
    sizes = [np.sort(np.ptp(region.box, axis=0)) for region in (plain, turned)]
    assert np.allclose(sizes[1], 10 * sizes[0], rtol=0.05)


def test_map_coordinates_have_their_z_up():
    scene, *_ = facade(np.random.default_rng(5))
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    scene = replace(moved(scene, turn, np.zeros(3), 1), origin=np.array([5e5, 5e6, 100.0]))
    region = core_of(scene)
    assert region.axes is not None and region.axes[2].tolist() == [0, 0, 1]
    whole = region.moved(scene.origin)
    again = read_region(as_given(whole))
    assert (is_inside(again, scene.points + scene.origin) == is_inside(whole, scene.points + scene.origin)).all()


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_any_unit_will_do(scale):
    scene, inside, outside = object_before_background(np.random.default_rng(5))
    region = read_region(as_given(core_of(moved(scene, np.eye(3), np.zeros(3), scale))))
    found = is_inside(region, scale * scene.points)
    assert found[inside].mean() > 0.99 and not found[outside].any()


def test_points_in_a_cameras_centre_and_at_no_place_do_not_matter():
    scene, inside, outside = object_before_background(np.random.default_rng(5))
    far = np.flatnonzero(outside)[:40]
    points = scene.points.copy()
    points[far[:20]] = scene.views[0].center + 1e-200
    points[far[20:]] = np.nan
    region = core_of(replace(scene, points=points))
    assert is_inside(region, scene.points)[inside].mean() > 0.99
    assert not is_inside(region, scene.points)[outside].any()


# ---- how well points are placed -------------------------------------------------------------------------------


def test_precision_of_the_normal_case():
    """Two vertical images, and a point between them: B sigma_z = z² / f sqrt(2) where z is large."""
    views = [camera((x, 0, 0), (x, 0, -1)) for x in (-1.0, 1.0)]
    for distance in (50.0, 100.0, 400.0):
        expected = distance**2 / 800 / 2 * np.sqrt(2)
        (found,) = precision(views, np.array([[0, 0, -distance]]), np.ones((2, 1), bool))
        assert found == pytest.approx(expected, rel=2e-3)


def test_precision_of_a_point_that_two_cameras_cannot_place():
    views = [camera((x, 0, 0), (x, 0, -1)) for x in (1.0, 1.0)]
    assert precision(views, np.array([[0.0, 0, -9]]), np.ones((2, 1), bool)).tolist() == [np.inf]
    assert precision(views, np.array([[0.0, 0, -9]]), np.zeros((2, 1), bool)).tolist() == [np.inf]


# ---- nothing to draw ------------------------------------------------------------------------------------------


def in_one_place() -> Scene:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(500, 3)) * 10
    return scene_of([camera((0, 0, 0), (np.sin(a), np.cos(a), 0)) for a in np.linspace(0, 6, 12)], points)


def at_one_point() -> Scene:
    views = [camera((x, 0, 5), (0, 0, 0)) for x in (-1, 0, 1)]
    return scene_of(views, np.zeros((100, 3)))


def all_around() -> Scene:
    """Cameras side by side look out at what lies at all distances, from one to ten thousand."""
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(5000, 3)) * [1, 1, 0.2]
    points = rays / np.linalg.norm(rays, axis=1)[:, None] * 10 ** rng.uniform(0, 4, (5000, 1))
    places = rng.uniform(-0.1, 0.1, (24, 3))
    angles = np.linspace(0, 2 * np.pi, 24)
    axes = np.column_stack([np.sin(angles), np.cos(angles), np.zeros(24)])
    views = [camera(tuple(place), tuple(place + axis)) for place, axis in zip(places, axes, strict=True)]
    return scene_of(views, points)


@pytest.mark.parametrize(
    ("scene", "reason"),
    [
        (in_one_place(), "cameras stand in one place"),
        (all_around(), "nothing that stands out"),
        (block_with_details(140, np.random.default_rng(5))[0], "20 % of the images look elsewhere"),
        (at_one_point(), "all sparse points in one place"),
        (replace(in_one_place(), points=np.zeros((0, 3)), views=()), "the model has 0"),
    ],
)
def test_what_has_no_core(scene, reason):
    with pytest.raises(InputError, match=reason) as caught:
        core_of(scene)
    assert "--region" in str(caught.value) and "\n" not in str(caught.value)


# ---- turned boxes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_turned_box_is_a_box_in_a_turned_world(seed, tmp_path):
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    middle, sides = rng.uniform(-5, 5, 3), rng.uniform(0.5, 5, 3)
    numbers = [*middle, *sides, *quaternion]
    region = read_region(",".join(map(repr, map(float, numbers))))
    (tmp_path / "box").write_text("\n".join(map(repr, map(float, numbers))))
    w, x, y, z = quaternion
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    points = middle + rng.uniform(-5, 5, (2000, 3))
    expected = (np.abs((points - middle) @ R.T) <= sides / 2).all(axis=1)
    assert (is_inside(region, points) == expected).all() and expected.any()
    assert (is_inside(read_region(str(tmp_path / "box")), points) == expected).all()
    shift = rng.uniform(-3, 3, 3)
    assert (is_inside(region.moved(shift), points + shift) == expected).all()
    # What is written holds all of it, and little more.
    again = read_region(as_given(region))
    assert is_inside(again, points)[expected].all()
    assert (np.ptp(again.box, axis=0) < 1.05 * sides + 0.05 * sides.min()).all()


@pytest.mark.parametrize(
    "box",
    [
        "0,0,0,1,1,1,0,0,0,0",
        "0,0,0,1,1,1,2,0,0,0",
        "0,0,0,1,1,0,1,0,0,0",
        "0,0,inf,1,1,1,1,0,0,0",
        "0,0,0,1,1,1,nan,0,0,0",
    ],
)
def test_numbers_that_are_no_turned_box(box):
    with pytest.raises(OptionError, match="cx,cy,cz,sx,sy,sz,qw,qx,qy,qz"):
        RunOptions(region=box).check()


def test_images_of_a_turned_box():
    """The same scene and box in another frame: the same images, with the same outlines."""
    scene, *_ = block_with_horizon(np.random.default_rng(2))
    box = Region(np.array([[20.0, 20, -5], [70, 90, 15]]))
    turn = Rotation.from_rotvec([0.9, -0.5, 1.4]).as_matrix()
    part, focus, _ = focused(scene, box, 15, "--region")
    other, its, _ = focused(moved(scene, turn, np.zeros(3), 1), Region(box.box, axes=turn.T), 15, "--region")
    assert [view.name for view in part.views] == [view.name for view in other.views] != []
    assert len(part.views) < len(scene.views)
    for view, same in zip(part.views, other.views, strict=True):
        expected = outline_on(view, focus.box)
        assert expected is not None and np.allclose(
            np.ptp(its.outline(same), axis=0), np.ptp(expected, axis=0), atol=0.1
        )


# ---- a run ----------------------------------------------------------------------------------------------------


def test_a_run_says_what_it_drew_and_repeats_it(project: Path, capsys, monkeypatch):
    """Dry run, run and report say the same box; with it as --region all is up to date."""
    drawn_of: list[Scene] = []

    def counted(scene: Scene) -> Region:
        drawn_of.append(scene)
        return core_of(scene)

    keep_images(project, ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg"])
    model = project / "sparse/0"
    plan = make_plan(Project(model=model), RunOptions(region="auto"))
    monkeypatch.setattr("colmap_sph.pipeline.context.core_of", counted)
    assert cli.main(["run", "--model", str(model), "--region", "auto"]) == 0
    assert len(drawn_of) == 1  # of the given model; what the region leaves of it might have another core
    said = "".join(capsys.readouterr()).split()
    report = json.loads((project / "dense/colmap_sph/report.json").read_text())
    assert report["drawn_region"] == plan.region
    assert " ".join(report["drawn_region"].split()) in " ".join(said)
    drawn = report["options"]["region"]
    assert drawn in (project / "dense/colmap_sph/report.html").read_text()
    numbers = re.match(rf"{drawn} was drawn, with ([\d,]+) of ([\d,]+) sparse points", report["drawn_region"])
    assert numbers is not None
    inside = is_inside(read_region(drawn), read_scene(model).points)
    assert [int(number.replace(",", "")) for number in numbers.groups()] == [inside.sum(), len(inside)]
    for region in (drawn, "auto"):
        again = make_plan(Project(model=model), RunOptions(region=region))
        assert (again.images_done, again.pairs_done, again.fuse) == (3, again.pairs, False)
    # An existing workspace may be asked, too.
    assert cli.main(["run", "--workspace", str(project / "dense"), "--region", "auto", "--dry-run"]) == 0
    assert "was drawn" in " ".join("".join(capsys.readouterr()).split())
