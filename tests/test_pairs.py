"""Pairs against counts and angles known by construction, and against COLMAP's own on a real block."""

import itertools
import logging
import sqlite3
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from projects import read_picture
from refusals import assert_refused

from colmap_sph.errors import InputError, NoResultError, OptionError
from colmap_sph.project.database import read_verified_matches
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.scene import Scene, SourceImages, View
from colmap_sph.stereo.partners.observers import observers_of_points
from colmap_sph.stereo.partners.pairing import partners_of
from colmap_sph.stereo.partners.pairs import PairOptions, PairSelection, overlapping_views, select_pairs
from colmap_sph.stereo.partners.partner_choice import choose, triangulation_angles, worth_of

K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
FEW = PairOptions(min_shared_points=1)


def view_at(center: Sequence[float], name: str, indices: Sequence[int] = (), R: np.ndarray | None = None) -> View:
    """A view that looks along +z unless told otherwise."""
    R = np.eye(3) if R is None else R
    return View(1, name, 1000, 800, K, R, -R @ np.asarray(center, float), np.array(indices, dtype=np.int64))


def partners(selection: PairSelection, name: str) -> list[str]:
    return [partner.name for partner in selection.partners[name]]


def without_tracks(scene: Scene, keep_points: bool = False) -> Scene:
    views = tuple(replace(view, point_indices=np.empty(0, np.int64)) for view in scene.views)
    return Scene(views, scene.points if keep_points else np.empty((0, 3)))


@pytest.fixture
def line() -> Scene:
    """Five views a unit apart along x, 10 units from 60 points; view i sees the points 10 i to 10 i + 29.

    Neighbours share 20 points, next but one 10.
    """
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 6, (60, 2)), np.full(60, 10.0)])
    views = [view_at([i, 0, 0], f"{i}.jpg", range(10 * i, min(10 * i + 30, 60))) for i in range(5)]
    return Scene(tuple(views), points)


def test_observers_of_points() -> None:
    """Against a loop over all points, some of which nobody or everybody observes."""
    rng = np.random.default_rng(3)
    observed = [np.flatnonzero(rng.random(50) < share) for share in (0.5, 0.0, 0.9, 0.1)]
    observed = [np.union1d(rows, [7]) if len(rows) else rows for rows in observed]
    observed = [rows[rows != 49] for rows in observed]
    first, observers = observers_of_points(observed, 50)
    found = [observers[first[point] : first[point + 1]].tolist() for point in range(50)]
    assert found == [[k for k, rows in enumerate(observed) if point in rows] for point in range(50)]
    assert (found[7], found[49]) == ([0, 2, 3], [])
    assert observers_of_points([], 2)[0].tolist() == [0, 0, 0]


def test_ranked_by_shared_points(line: Scene) -> None:
    selection = select_pairs(line, FEW)
    assert selection.source == "tracks"
    assert [(p.name, p.shared_points) for p in selection.partners["0.jpg"]] == [("1.jpg", 20), ("2.jpg", 10)]
    # Of two that share the same number the one with more parallax comes first.
    expected = [("3.jpg", 20), ("1.jpg", 20), ("4.jpg", 10), ("0.jpg", 10)]
    assert {(p.name, p.shared_points) for p in selection.partners["2.jpg"]} == set(expected)
    assert [p.shared_points for p in selection.partners["2.jpg"]] == [20, 20, 10, 10]
    assert selection.without_partner == ()


def test_overlapping_views(line: Scene) -> None:
    """Those that share most first, whatever the angle; of views without tracks those whose frusta meet."""
    assert overlapping_views(line, 50)["2.jpg"] == ["1.jpg", "3.jpg", "0.jpg", "4.jpg"]
    assert overlapping_views(line, 3)["0.jpg"] == ["1.jpg", "2.jpg"]
    assert overlapping_views(line, 1)["3.jpg"] == ["2.jpg"]
    # Each sees ten units of ground, and they stand within four.
    by_frusta = overlapping_views(without_tracks(line, keep_points=True), 50)
    assert set(by_frusta["0.jpg"]) == {f"{i}.jpg" for i in range(1, 5)}


def test_angle_is_the_75th_percentile(line: Scene) -> None:
    (pair,) = (pair for pair in select_pairs(line, FEW).partners["1.jpg"] if pair.name == "0.jpg")
    points = line.points[10:30]
    to0, to1 = points - [0, 0, 0], points - [1, 0, 0]
    cosines = (to0 * to1).sum(1) / np.linalg.norm(to0, axis=1) / np.linalg.norm(to1, axis=1)
    assert pair.angle == pytest.approx(np.percentile(np.degrees(np.arccos(cosines)), 75), rel=1e-9)


def test_triangulation_angle_of_known_triangles() -> None:
    points = np.array([[0.0, 0, 1], [0, 0, 1e6], [0, 0, 0.5]])
    angles = triangulation_angles(points, np.array([-1.0, 0, 0]), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(angles, np.degrees(2 * np.arctan(1 / points[:, 2])), rtol=1e-9)


def test_number_of_pairs_and_bounds(line: Scene) -> None:
    assert partners(select_pairs(line, PairOptions(num_pairs=1)), "0.jpg") == ["1.jpg"]
    assert set(partners(select_pairs(line, PairOptions(num_pairs=2)), "2.jpg")) == {"1.jpg", "3.jpg"}
    assert set(partners(select_pairs(line, PairOptions(min_shared_points=11)), "2.jpg")) == {"1.jpg", "3.jpg"}


def test_worth_of_a_candidate() -> None:
    """Closed formula: (what is believed) * (what the parallax is good for), 0 outside the candidate's image."""
    points = np.array([[0.0, 0, 10], [0, 0, 10], [4.99, 0, 10], [0, 0, 200]])
    view, candidate = view_at([0, 0, 0], "a"), view_at([2, 0, 0], "b")
    both = np.array([[True, False, False, False]])
    angles = np.degrees(np.arctan([0.2, 0.2, 0.499, 0.01]) - np.arctan([0, 0, 0.299, 0]))
    assert (angles[:3] > 6).all() and angles[3] < 6
    np.testing.assert_allclose(
        worth_of(view, [candidate], points, both)[0], [1, 0.5, 0.5, 0.5 * angles[3] / 6], rtol=1e-6
    )
    away = view_at([-2, 0, 0], "c")  # its image ends at x = 3
    for believed in (0.5, 1.0):
        worth = worth_of(view, [away], points, believed)[0, [0, 2]]
        np.testing.assert_allclose(worth, [0.5 + believed / 2, 0], rtol=1e-6)
    wide = view_at([10 * np.tan(np.radians(60)), 0, 0], "d")  # out of its image, but what is observed is in sight
    np.testing.assert_allclose(worth_of(view, [wide], points, both)[0, :2], [1 / 3, 0], rtol=1e-6)


def test_what_few_see_is_served_before_what_many_see() -> None:
    left, right = np.repeat([1.0, 0], [90, 10]), np.repeat([0, 1.0], [90, 10])
    worths = np.array([left, 0.99 * left, right, 0.98 * left, np.zeros(100), 0.5 * right], np.float32)
    # Seen once, the left side is worth 0.2 * 90 = 18, more than the right one; seen twice, less than that.
    assert choose(worths, 6) == [0, 1, 2, 3, 5, 4]
    assert choose(worths, 3) == [0, 1, 2]
    assert choose(worths[:0], 3) == []


def test_partners_see_what_others_see(data_dir: Path) -> None:
    """With exact depth: what any image sees under a usable angle, partners should see; shared points alone leave
    1.7 % of a view, and 13 % of the worst, to images that are no partners."""
    scene = read_scene(data_dir / "penta" / "sparse" / "0")
    partners_by_name = partners_of(select_pairs(scene, PairOptions()).unique_pairs())
    read = {view.name: data_dir / "penta" / "depth" / f"{Path(view.name).stem}.png" for view in scene.views}
    depths = {name: 0.005 * read_picture(path, cv2.IMREAD_UNCHANGED) for name, path in read.items()}
    missed = []
    for view in scene.views:
        rows, columns = (axis.ravel() for axis in np.mgrid[8 : view.height : 16, 8 : view.width : 16])
        z = depths[view.name][rows, columns]
        rays = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(z))]) @ np.linalg.inv(view.K).T
        points = ((rays * z[:, None])[z > 0] - view.t) @ view.R
        seen, served = np.zeros(len(points), bool), np.zeros(len(points), bool)
        for other in scene.views:
            if other.name != view.name:
                angles = triangulation_angles(points, view.center, other.center)
                visible = in_view(other, depths[other.name], points) & (angles > 2) & (angles < 60)
                seen |= visible
                served |= visible & (other.name in partners_by_name[view.name])
        missed.append(np.mean(seen & ~served))
    assert np.mean(missed) < 0.01 and max(missed) < 0.05


def in_view(view: View, depth: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which points a view sees, going by its exact depth."""
    camera = points @ view.R.T + view.t
    pixels = camera @ view.K.T
    column, row = (np.floor(pixels[:, k] / pixels[:, 2]).astype(int) for k in (0, 1))
    inside = (camera[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < view.width) & (row < view.height)
    exact = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return inside & (np.abs(exact - camera[:, 2]) < 0.005 * camera[:, 2])


def test_unique_pairs(line: Scene) -> None:
    unique = select_pairs(line, FEW).unique_pairs()
    names = [f"{i}.jpg" for i in range(5)]
    assert unique == [(a, b) for a in names for b in names if 0 < int(b[0]) - int(a[0]) <= 2]


def test_no_parallax_no_pair(line: Scene, caplog: pytest.LogCaptureFixture) -> None:
    # 1.jpg was taken from the same place as 0.jpg, 4.jpg sees nothing.
    views = list(line.views)
    views[1] = view_at([1e-3, 0, 0], "1.jpg", views[1].point_indices.tolist())
    views[4] = view_at([4, 0, 0], "4.jpg")
    selection = select_pairs(Scene(tuple(views), line.points), FEW)
    assert partners(selection, "0.jpg") == ["2.jpg"]
    assert selection.without_partner == ("4.jpg",)
    assert "4.jpg has no partner" in caplog.text


def test_wide_angles_come_last(line: Scene) -> None:
    everything = [view_at([x, 0, 0], f"{x}.jpg", range(60)) for x in (0, 8, 3)]
    far = view_at([30, 0, 0], "30.jpg", range(60))
    views = tuple(sorted([*everything, far], key=lambda view: view.name))
    views = tuple(replace(v, point_indices=np.arange(50)) if v.name == "3.jpg" else v for v in views)
    selection = select_pairs(Scene(views, line.points), PairOptions(num_pairs=3))
    # 30.jpg shares all points but under more than 60°, 3.jpg only fifty.
    assert partners(selection, "0.jpg") == ["8.jpg", "3.jpg", "30.jpg"]
    assert selection.partners["0.jpg"][2].angle > 60
    assert partners(select_pairs(Scene(views, line.points), PairOptions(num_pairs=2)), "0.jpg") == [
        "8.jpg",
        "3.jpg",
    ]


def test_values_that_are_not_finite(line: Scene) -> None:
    points = line.points.copy()
    points[12] = np.nan
    views = list(line.views)
    views[3] = view_at([np.nan, 0, 0], "3.jpg", views[3].point_indices.tolist())
    for scene in (Scene(tuple(views), points), without_tracks(Scene(tuple(views), points))):
        selection = select_pairs(scene, FEW)
        assert selection.without_partner == ("3.jpg",)
        assert all("3.jpg" not in pair for pair in selection.unique_pairs())
        assert all(np.isfinite(pair.angle) for pairs in selection.partners.values() for pair in pairs)
    assert select_pairs(Scene(tuple(views), points), FEW).partners["0.jpg"][0].shared_points == 19


def test_no_pair_at_all(line: Scene) -> None:
    with pytest.raises(NoResultError, match="shared points"):
        select_pairs(line, PairOptions(min_shared_points=1000))
    with pytest.raises(NoResultError):
        select_pairs(Scene(line.views[:1], line.points), FEW)
    apart = (view_at([0, 0, 0], "a"), view_at([1, 0, 0], "b", R=np.diag([-1.0, 1, -1])))
    with pytest.raises(NoResultError, match=r"frusta, .*do points without tracks lie on what they show"):
        select_pairs(Scene(apart, np.empty((0, 3))), FEW)
    for explicit in ({}, {"0.jpg": ["gone.jpg"]}):
        with pytest.raises(NoResultError, match=r"comes of patch-match\.cfg; mend or delete it"):
            select_pairs(line, FEW, explicit=explicit)


ANGLES = ("min_triangulation_angle", "max_triangulation_angle")


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (PairOptions(num_pairs=0), ("num_pairs",)),
        (PairOptions(min_triangulation_angle=-1), ANGLES),
        (PairOptions(min_triangulation_angle=61), ANGLES),
        (PairOptions(max_triangulation_angle=181), ANGLES),
        (PairOptions(min_triangulation_angle=float("nan")), ANGLES),
        (PairOptions(min_shared_points=0), ("min_shared_points",)),
    ],
)
def test_options_out_of_bounds(line: Scene, options: PairOptions, names: tuple[str, ...]) -> None:
    assert_refused(options, *names)
    with pytest.raises(OptionError):
        select_pairs(line, options)


def test_patch_match_cfg_is_obeyed(line: Scene, caplog: pytest.LogCaptureFixture) -> None:
    explicit: dict[str, SourceImages] = {
        "4.jpg": ["0.jpg", "gone.jpg"],
        "2.jpg": 20,
        "1.jpg": "__all__",
        "lost.jpg": 20,
    }
    selection = select_pairs(line, PairOptions(num_pairs=2), explicit=explicit)
    assert selection.source == "patch-match.cfg"
    assert list(selection.partners) == ["1.jpg", "2.jpg", "4.jpg"]
    # No gate for what the user wrote; "__auto__" means our choice of our number.
    assert [(p.name, p.shared_points) for p in selection.partners["4.jpg"]] == [("0.jpg", 0)]
    assert np.isnan(selection.partners["4.jpg"][0].angle)
    assert set(partners(selection, "2.jpg")) == {"1.jpg", "3.jpg"}
    assert partners(selection, "1.jpg") == ["0.jpg", "2.jpg", "3.jpg", "4.jpg"]
    assert "gone.jpg" in caplog.text and "lost.jpg" in caplog.text


def test_patch_match_cfg_of_colmap_is_no_choice(line: Scene, caplog: pytest.LogCaptureFixture) -> None:
    """It names all images of the model, those that were left out among them: nobody asked for these."""
    automatic = {view.name: 20 for view in line.views} | {"left_out.jpg": 20}
    assert select_pairs(line, FEW, explicit=automatic) == select_pairs(line, FEW)
    assert "left_out.jpg" not in caplog.text


def write_database(path: Path, names: Sequence[str], inliers: dict[tuple[int, int], int]) -> None:
    database = pycolmap.Database.open(path)
    camera_id = database.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 1000.0, 1000, 800))
    # Ids differ from those of the model.
    ids = [database.write_image(pycolmap.Image(name, np.empty((0, 2)), camera_id, 0)) for name in names]
    for (i, j), count in inliers.items():
        geometry = pycolmap.TwoViewGeometry()
        geometry.inlier_matches = np.column_stack([np.arange(count)] * 2).astype(np.uint32)
        database.write_two_view_geometry(ids[i], ids[j], geometry)
    database.close()


def test_database_stands_in_for_tracks(line: Scene, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "database.db"
    names = ["unregistered.jpg", *(f"{i}.jpg" for i in reversed(range(5)))]  # index k is view 5 - k
    write_database(path, names, {(5, 4): 50, (2, 5): 70, (3, 5): 60, (1, 5): 9, (0, 5): 500, (2, 1): 30})
    before = path.read_bytes()
    with caplog.at_level(logging.INFO):
        selection = select_pairs(without_tracks(line), PairOptions(), matches=read_verified_matches(path))
    assert selection.source == "database"
    found = [(p.name, p.shared_points) for p in selection.partners["0.jpg"]]
    assert sorted(found) == [("1.jpg", 50), ("2.jpg", 60), ("3.jpg", 70)]
    assert partners(selection, "4.jpg") == ["3.jpg"]
    assert "verified matches in the database" in caplog.text
    assert path.read_bytes() == before
    assert select_pairs(line, PairOptions(), matches=read_verified_matches(path)).source == "tracks"


def test_database_that_cannot_be_read(line: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.db"):
        select_pairs(without_tracks(line), FEW, matches=read_verified_matches(tmp_path / "none.db"))
    assert not (tmp_path / "none.db").exists()
    (tmp_path / "text.db").write_text("no database" * 100)
    with pytest.raises(InputError, match=r"text\.db"):
        select_pairs(without_tracks(line), FEW, matches=read_verified_matches(tmp_path / "text.db"))
    sqlite3.connect(tmp_path / "empty.db").close()
    with pytest.raises(InputError, match=r"empty\.db"):
        select_pairs(without_tracks(line), FEW, matches=read_verified_matches(tmp_path / "empty.db"))


def test_real_database(data_dir: Path) -> None:
    model = pycolmap.Reconstruction(data_dir / "brighton" / "sparse" / "0")
    for camera in model.cameras.values():
        camera.params = [*camera.params[:4], 0, 0, 0, 0]
    views = tuple(
        View(
            image.image_id,
            image.name,
            2000,
            1125,
            model.camera(image.camera_id).calibration_matrix(),
            image.cam_from_world().rotation.matrix(),
            image.cam_from_world().translation,
            np.empty(0, np.int64),
        )
        for image in sorted(model.images.values(), key=lambda image: image.name)
    )
    database = data_dir / "brighton" / "database.db"
    selection = select_pairs(
        Scene(views, np.empty((0, 3))), PairOptions(), matches=read_verified_matches(database)
    )
    assert selection.source == "database" and selection.without_partner == ()
    reader = pycolmap.Database.open(database)
    for pair in selection.partners["DJI_0024.jpg"]:
        ids = [image.image_id for image in reader.read_all_images() if image.name in {"DJI_0024.jpg", pair.name}]
        assert pair.shared_points == len(reader.read_two_view_geometry(ids[0], ids[1]).inlier_matches)
    reader.close()


def test_frusta_of_a_regular_strip(caplog: pytest.LogCaptureFixture) -> None:
    views = tuple(view_at([i, 0, 0], f"{i:02d}.jpg") for i in range(12))
    with caplog.at_level(logging.INFO):
        selection = select_pairs(Scene(views, np.empty((0, 3))), PairOptions(num_pairs=4))
    assert selection.source == "frusta" and "overlap of the viewing frusta" in caplog.text
    # By symmetry the nearest overlap most.
    assert set(partners(selection, "05.jpg")) == {"03.jpg", "04.jpg", "06.jpg", "07.jpg"}


def test_few_tracks_do_not_hide_who_overlaps() -> None:
    """A strip with 60 % overlap and a dozen points to a photograph, of which neighbours share no ten."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -3, 10], [24, 3, 10.1], (52, 3))
    points = points[np.argsort(points[:, 0])]
    views = [view_at([4 * i, 0, 0], f"{i}.jpg", range(8 * i, 8 * i + 12)) for i in range(6)]
    strip = Scene(tuple(views), points)
    selection = select_pairs(strip, PairOptions())
    assert selection.source == "frusta" and selection.without_partner == ()
    neighbours = {(f"{i}.jpg", f"{i + 1}.jpg") for i in range(5)}
    assert neighbours <= set(selection.unique_pairs())
    assert set(overlapping_views(strip, 2)["0.jpg"]) == {"1.jpg", "2.jpg"}
    # Verified matches tell more.
    matched = select_pairs(strip, PairOptions(), matches=dict.fromkeys(neighbours, 50))
    assert matched.source == "database" and set(matched.unique_pairs()) == neighbours


def test_real_tracks_agree_with_colmap(data_dir: Path) -> None:
    root = data_dir / "penta"
    scene, model = read_scene(root / "sparse" / "0"), pycolmap.Reconstruction(root / "sparse" / "0")
    shared: Counter[tuple[str, str]] = Counter()
    for point in model.points3D.values():
        names = sorted({model.image(element.image_id).name for element in point.track.elements})
        shared.update(itertools.permutations(names, 2))
    theirs = pycolmap.MVSModel()
    theirs.read_from_colmap(root, "sparse/0", "images")
    radians = theirs.compute_triangulation_angles(75)
    index = theirs.get_image_idx
    selection = select_pairs(scene, PairOptions())
    assert all(len(pairs) == 10 for pairs in selection.partners.values())
    for name, pairs in selection.partners.items():
        for pair in pairs:
            assert pair.shared_points == shared[name, pair.name]
            angle = np.degrees(radians[index(name)][index(pair.name)])
            assert pair.angle == pytest.approx(angle, rel=0.05)


@pytest.mark.parametrize(("keep_points", "share"), [(True, 0.9), (False, 0.8)])
def test_frusta_agree_with_tracks(data_dir: Path, keep_points: bool, share: float) -> None:
    scene = read_scene(data_dir / "penta" / "sparse" / "0")
    best = select_pairs(scene, replace(FEW, num_pairs=20))
    selection = select_pairs(without_tracks(scene, keep_points), PairOptions())
    assert selection.source == "frusta"
    hits = [set(partners(selection, name)) & set(partners(best, name)) for name in selection.partners]
    assert np.mean([len(hit) for hit in hits]) / 10 >= share


def test_large_block_is_fast() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 100], [400, 400, 101], (200_000, 3))
    # 400 views, each of which sees what lies within 30 units.
    order = np.argsort(points[:, 0])
    points = points[order]
    views = []
    for i in range(400):
        x, y = 20 * (i % 20) + 10, 20 * (i // 20) + 10
        first, last = np.searchsorted(points[:, 0], [x - 30, x + 30])
        near = first + np.flatnonzero(np.abs(points[first:last, 1] - y) < 30)
        views.append(view_at([x, y, 0], f"{i:03d}.jpg", near.tolist()))
    start = time.process_time()
    selection = select_pairs(Scene(tuple(views), points), PairOptions())
    assert time.process_time() - start < 10
    assert set(partners(selection, "210.jpg")[:4]) == {"209.jpg", "211.jpg", "190.jpg", "230.jpg"}
