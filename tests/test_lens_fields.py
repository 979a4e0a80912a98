"""Lens fields against a bend of known formula: what they do to rays, images and models; how they are found."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from projects import prepare, read_picture
from scipy.spatial.transform import Rotation

import colmap_sph
from colmap_sph import synthetic as syn
from colmap_sph.errors import InputError
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.refine_cameras import CamerasToRefine, refine_cameras
from colmap_sph.project.lens.field import LensField
from colmap_sph.project.lens.files import LENS_FIELDS_NAME, read_lens_fields, write_lens_fields
from colmap_sph.project.polishing import PolishOptions
from colmap_sph.project.polishing.adjustment import Observations
from colmap_sph.project.polishing.lens_adjustment import Bundle, Sights, empty_field, fitted_fields
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import NO_SCENE
from colmap_sph.stereo.poses.tracks import Tracks
from colmap_sph.synthetic.photographs.bending import Bending
from colmap_sph.synthetic.photographs.structure_from_motion import disturb

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
CORNER = np.array([WIDTH, HEIGHT]) / 2 / FOCAL
BEND = Bending.draw(1.2, WIDTH, HEIGHT, np.random.default_rng(4))
"""The pixel at a place shows what belongs at the place plus its displacement."""


def displaced(rays: np.ndarray) -> np.ndarray:
    """Displacement of rays by the known formula."""
    x, y = (rays * FOCAL + K[:2, 2]).T
    return BEND.displacement(x, y).T / FOCAL


def field_of_bend() -> LensField:
    """The field that says so: its coefficients by least squares from the formula."""
    field = LensField.zero(-1.05 * CORNER, 1.05 * CORNER, (6, 8))
    rays = field.nodes(40)
    basis = field.basis(rays).toarray()
    coefficients = np.linalg.lstsq(basis, displaced(rays), rcond=None)[0]
    return replace(field, coefficients=coefficients.T.reshape(field.coefficients.shape))


def some_rays(number: int = 500) -> np.ndarray:
    return np.random.default_rng(2).uniform(-CORNER, CORNER, (number, 2))


# ---- rays ---------------------------------------------------------------------------------------------------


def test_a_cubic_bend_is_a_field() -> None:
    rays = some_rays()
    np.testing.assert_allclose(field_of_bend().at(rays), displaced(rays), atol=1e-9)


def test_bending_undoes_straightening() -> None:
    rays = some_rays()
    field = field_of_bend()
    np.testing.assert_allclose(field.bent(field.straightened(rays)), rays, atol=1e-10)


def test_a_grid_is_bent_as_its_rays_are() -> None:
    x, y = (np.linspace(-0.95 * corner, 0.95 * corner, 31 - 4 * k) for k, corner in enumerate(CORNER))
    field = field_of_bend()
    rays = np.stack(np.meshgrid(x, y), axis=2)
    bent = field.bent(rays.reshape(-1, 2)).reshape(rays.shape)
    np.testing.assert_allclose(field.bent_grid(x, y), bent, atol=1e-4 / FOCAL)


# ---- files --------------------------------------------------------------------------------------------------


def test_fields_come_back_from_disk(tmp_path: Path) -> None:
    assert read_lens_fields(tmp_path) == {}
    write_lens_fields({3: field_of_bend()}, tmp_path)
    read = read_lens_fields(tmp_path)
    assert list(read) == [3]
    np.testing.assert_array_equal(read[3].at(some_rays()), field_of_bend().at(some_rays()))


def spoilt(change: Callable[[dict], object]) -> str:
    grid = LensField.zero(-CORNER, CORNER, (6, 8)).coefficients.tolist()
    field = {"low": [-1.0, -1.0], "high": [1.0, 1.0], "x": grid[0], "y": grid[1]}
    change(field)
    return json.dumps({"version": 1, "cameras": {"1": field}})


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1, 2",
        '{"version": 2, "cameras": {}}',
        '{"version": 1, "cameras": {"one": 1}}',
        spoilt(lambda field: field["x"][2].pop()),
        spoilt(lambda field: field["x"].pop()),
        spoilt(lambda field: field.update(low=[1.0, 1.0])),
        spoilt(lambda field: field["y"][2].__setitem__(2, 1e3)),
        spoilt(lambda field: field["y"][2].__setitem__(2, float("nan"))),
        spoilt(lambda field: field.update(x=[[0.0] * 5000] * 5)),
        spoilt(lambda field: field.pop("low")),
    ],
)
def test_damaged_fields_are_refused_in_a_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / LENS_FIELDS_NAME).write_text(text)
    with pytest.raises(InputError, match=f"{LENS_FIELDS_NAME} .*refine the cameras again, or remove"):
        read_lens_fields(tmp_path)


# ---- undistortion -------------------------------------------------------------------------------------------


def bent_picture(straight: np.ndarray, bend: Bending) -> np.ndarray:
    """What a lens that bends so makes of a picture."""
    x, y = np.meshgrid(np.arange(bend.width) + 0.5, np.arange(bend.height) + 0.5)
    place: np.ndarray = (np.stack([x, y]) + bend.displacement(x, y) - 0.5).astype(np.float32)
    return cv2.remap(straight, place[0], place[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def bent_project(root: Path, *, deep: bool = False) -> Path:
    """Two bent pictures of a textured wall, its masks, and their model with the field; returns the model."""
    wall = syn.Plane((0, 0, 6.0), (0, 0, -1), syn.Mottled(syn.Noise(0.05, seed=3)), None)
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, *K[:2, 2]])
    camera.camera_id = 1
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    points = np.column_stack([np.random.default_rng(1).uniform(-2, 2, (200, 2)), np.full(200, 6.0)])
    (root / "images").mkdir(parents=True)
    (root / "masks").mkdir()
    field = field_of_bend()
    for number in (1, 2):
        t = np.array([0.2 * number, 0, 0])
        rays = (points + t)[:, :2] / (points + t)[:, 2:]
        pixels = field.bent(rays) * FOCAL + K[:2, 2]
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), t)
        model.add_image_with_trivial_frame(pycolmap.Image(f"{number}.png", pixels, 1, number), pose)
        seen = syn.Camera(K, np.eye(3), t, WIDTH, HEIGHT)
        effects = syn.Imperfections()
        straight = syn.photograph([wall], seen, effects, light=syn.Light((0.2, -0.3, -1.0)), seed=5).image
        picture = bent_picture(straight, BEND)
        picture = picture[..., ::-1]
        if deep:
            picture = picture.astype(np.uint16) * 257
        cv2.imwrite(str(root / f"images/{number}.png"), picture)
        cv2.imwrite(str(root / f"straight{number}.png"), straight[..., ::-1])
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, 100:] = 255
        mask = np.where(bent_picture(mask, BEND) > 127, np.uint8(255), np.uint8(0))
        cv2.imwrite(str(root / f"masks/{number}.png"), mask)
    for index, xyz in enumerate(points):
        elements = [pycolmap.TrackElement(number, index) for number in (1, 2)]
        model.add_point3D(xyz, pycolmap.Track(elements))
    (root / "sparse/0").mkdir(parents=True)
    model.write_binary(root / "sparse/0")
    write_lens_fields({1: field}, root / "sparse/0")
    return root / "sparse/0"


@pytest.mark.parametrize("deep", [False, True])
def test_bent_pictures_come_out_straight(tmp_path: Path, deep: bool) -> None:
    workspace = prepare(bent_project(tmp_path, deep=deep), tmp_path / "dense", masks=tmp_path / "masks")
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    camera = model.cameras[1]
    cut = np.round(K[:2, 2] - [camera.principal_point_x, camera.principal_point_y]).astype(int)
    assert (cut >= 0).all()
    assert (cut < 6).all()
    for number in (1, 2):
        made = read_picture(workspace.image_path(f"{number}.png")).astype(float)
        assert made.shape == (camera.height, camera.width, 3)
        there = (slice(cut[1], cut[1] + camera.height), slice(cut[0], cut[0] + camera.width))
        expected = read_picture(tmp_path / f"straight{number}.png").astype(float)[there]
        bent = read_picture(tmp_path / f"images/{number}.png").astype(float)[there]
        inner = (slice(4, -4), slice(4, -4))
        assert np.abs(made - expected)[inner].mean() < 0.25 * np.abs(bent - expected)[inner].mean()
        assert made.min(axis=2).min() > 0  # no black border
        # Where the mask ends is a straight column again.
        mask = read_picture(workspace.mask_path(f"{number}.png"), cv2.IMREAD_GRAYSCALE)
        ends = 100.5 - cut[0]
        assert (mask[:, : int(ends) - 1] == 0).all()
        assert (mask[:, int(ends) + 3 :] == 255).all()


def test_observations_come_out_straight(tmp_path: Path) -> None:
    workspace = prepare(bent_project(tmp_path), tmp_path / "dense")
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    for image in model.images.values():
        for point in image.points2D:
            expected = model.cameras[1].img_from_cam(image.cam_from_world() * model.points3D[point.point3D_id].xyz)
            np.testing.assert_allclose(point.xy, expected, atol=1e-4)


def test_another_field_is_another_model(tmp_path: Path) -> None:
    model = bent_project(tmp_path)
    prepare(model, tmp_path / "dense")
    prepare(model, tmp_path / "dense")
    (model / LENS_FIELDS_NAME).unlink()
    with pytest.raises(InputError, match="another sparse model"):
        prepare(model, tmp_path / "dense")


# ---- adjustment ---------------------------------------------------------------------------------------------


def turns(rays: np.ndarray) -> np.ndarray:
    """(2 n, 4): what three turns of the camera and another focal length do to rays."""
    x, y = rays.T
    fields = [(1 + x * x, x * y), (x * y, 1 + y * y), (-y, x), (x, y)]
    return np.stack([np.stack(part, axis=1).ravel() for part in fields], axis=1)


def rest(displacement: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(2 n,) displacements in pixels less what turns and a focal length explain."""
    basis = turns(rays)
    flat = displacement.ravel()
    return FOCAL * (flat - basis @ np.linalg.lstsq(basis, flat, rcond=None)[0])


FIELD_OF = np.array([0] * 6 + [1] * 8 + [-1] * 2)


def bent_bundle(noise: float) -> tuple[Sights, Bundle]:
    """Views from above and aslant of a hilly ground, seen through the bent lens; poses and points are off."""
    rng = np.random.default_rng(6)
    points = rng.uniform(-6, 6, (700, 3)) * [1, 1, 0.15]
    tracks, images, rays, poses = [], [], [], []
    for number in range(16):
        aslant = 0.6 * (number % 2)
        R = Rotation.from_euler("zx", [number * np.pi / 4, np.pi - aslant]).as_matrix().T
        center = -R.T @ [0, 0, 8.0] + rng.uniform(-1.5, 1.5, 3) * [1, 1, 0.2]
        t = -R @ center
        in_camera = points @ R.T + t
        true = in_camera[:, :2] / in_camera[:, 2:]
        seen = np.flatnonzero((np.abs(true) < CORNER).all(axis=1) & (in_camera[:, 2] > 0))
        bent = true[seen]
        for _ in range(20 if FIELD_OF[number] >= 0 else 0):
            bent = true[seen] - displaced(bent)
        tracks.append(seen)
        images.append(np.full(len(seen), number))
        rays.append(bent + rng.normal(0, noise / FOCAL, bent.shape))
        turned = Rotation.from_rotvec(rng.normal(0, 1 / FOCAL, 3)).as_matrix() @ R
        poses.append((turned, -turned @ center))
    track = np.concatenate(tracks)
    order = np.argsort(track, kind="stable")
    sights = Sights(track[order], np.concatenate(images)[order], np.concatenate(rays)[order])
    R, t = (np.stack(part) for part in zip(*poses, strict=True))
    points = points + rng.normal(0, 0.02, points.shape)
    # Two cameras of the same bend, and one without a field, which sees straight.
    fields = (empty_field(-CORNER, CORNER),) * 2
    start = Bundle(R, t, points, fields, FIELD_OF, np.full(16, FOCAL))
    return sights, start


def test_the_adjustment_finds_the_bend_with_wrong_poses() -> None:
    sights, start = bent_bundle(noise=0.1)
    for number, found in enumerate(fitted_fields(sights, start, 0.2).fields):
        rays = sights.rays[FIELD_OF[sights.image] == number]
        true = rest(displaced(rays), rays)
        left = rest(found.at(rays) - displaced(rays), rays)
        assert np.sqrt(np.mean(true**2)) > 0.8
        assert np.sqrt(np.mean(left**2)) < 0.1
        # Nothing of it is a turn of the camera or another focal length.
        nodes = found.nodes(25)
        share = np.linalg.lstsq(turns(nodes), found.at(nodes).ravel(), rcond=None)[0]
        assert np.abs(FOCAL * share).max() < 0.02


def test_the_adjustment_finds_nothing_in_a_straight_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{__name__}.displaced", np.zeros_like)
    sights, start = bent_bundle(noise=0.1)
    for found in fitted_fields(sights, start, 0.2).fields:
        assert np.sqrt(np.mean((FOCAL * found.at(sights.rays)) ** 2)) < 0.08


# ---- runs ---------------------------------------------------------------------------------------------------

SMALL = syn.BlockOptions(
    width=160,
    height=120,
    nadir_gsd=0.4,
    oblique_gsd=0.44,
    strip_images=4,
    oblique_images=2,
    points=1500,
    keypoint_noise=0.1,
)
_DRAWN = Bending.draw(1.2, SMALL.width, SMALL.height, np.random.default_rng(4))
# Without what other focal lengths would do, which structure from motion finds: 1 and 4 are of y and x alone.
SMALL_BEND = replace(_DRAWN, coefficients=_DRAWN.coefficients * [0, 0, 1, 1, 0, 1, 1, 1, 1, 1])


def bend_block(block: syn.DemoBlock) -> None:
    """Bend the pictures of a block and its keypoints alike, and adjust the model to them, as a user brings it."""
    for path in block.images_dir.iterdir():
        picture = bent_picture(read_picture(path), SMALL_BEND)
        cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    model = pycolmap.Reconstruction(block.sparse_dir)
    for image in model.images.values():
        straight = np.array([point.xy for point in image.points2D])
        bent = straight
        for _ in range(10):
            bent = straight - SMALL_BEND.displacement(*bent.T).T
        for point, xy in zip(image.points2D, bent, strict=True):
            point.xy = xy
    disturb(model, syn.Imperfections(bundle_adjusted=True), seed=1)
    model.write_binary(block.sparse_dir)


def right_share(block: syn.DemoBlock, workspace: Workspace, *, is_bent: bool) -> float:
    """Share of the depths of a workspace that are within two pixels on the ground."""
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    good = []
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        depth = colmap_sph.read_depth_map(workspace.depth_map_path(image.name, "geometric"))
        K = block.cameras[block.names.index(image.name)].K
        x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
        x += K[0, 2] - camera.principal_point_x
        y += K[1, 2] - camera.principal_point_y
        if is_bent:
            x, y = np.stack([x, y]) + SMALL_BEND.displacement(x, y)
        place: np.ndarray = np.stack([x, y]).astype(np.float32)
        exact = cv2.remap(block.truth(image.name)[0], place[0], place[1], cv2.INTER_NEAREST)
        both = (depth > 0) & (exact > 0)
        good.append(np.abs(depth - exact)[both] < 2 * exact[both] / camera.focal_length_x)
    return float(np.concatenate(good).mean())


def test_a_bent_block_is_straightened_by_the_advice(tmp_path: Path) -> None:
    block = syn.make_demo_block(tmp_path, SMALL, threads=2)
    bend_block(block)
    given = (block.sparse_dir / "cameras.bin").read_bytes()
    options = replace(RunOptions(threads=2), pairs=colmap_sph.PairOptions(num_pairs=4))
    polishing = replace(options, polish=PolishOptions("on", cameras=True))
    said = colmap_sph.run(block.sparse_dir, options=polishing).polishing
    refined = tmp_path / "dense/colmap_sph/refined"
    assert "has a lens field of" in said
    assert f"--model {refined} --images {block.images_dir} --output {tmp_path / 'dense_refined'}" in said
    assert (block.sparse_dir / "cameras.bin").read_bytes() == given
    check_fields(block, refined)
    colmap_sph.run(refined, images=block.images_dir, output=tmp_path / "dense_refined", options=options)
    before = right_share(block, Workspace(tmp_path / "dense"), is_bent=True)
    after = right_share(block, Workspace(tmp_path / "dense_refined"), is_bent=False)
    assert after > before + 0.1
    assert after > 0.82


def check_fields(block: syn.DemoBlock, refined: Path) -> None:
    """The fields that were found are the bend, in the middle of images where there are enough ties."""
    model = pycolmap.Reconstruction(refined)
    fields = read_lens_fields(refined)
    assert sorted(fields) == sorted(model.cameras)
    for camera_id, field in fields.items():
        camera = model.cameras[camera_id]
        K = camera.calibration_matrix()
        pixels = np.random.default_rng(3).uniform([15, 15], [SMALL.width - 15, SMALL.height - 15], (400, 2))
        rays = (pixels - K[:2, 2]) / K[0, 0]
        true = rest(SMALL_BEND.displacement(*pixels.T).T / K[0, 0], rays)
        found = rest(field.at(rays), rays)
        assert np.sqrt(np.mean(true**2)) > 0.25
        assert np.sqrt(np.mean((found - true) ** 2)) < 0.08


def test_cameras_with_fields_are_kept(tmp_path: Path) -> None:
    model = bent_project(tmp_path)
    nothing = Tracks(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    used = Observations([], nothing.track, nothing.view, nothing.pixels, np.empty((0, 3)), 0.1)
    task = CamerasToRefine(model, UndistortionOptions(), NO_SCENE, used, nothing, lambda: None)
    said = refine_cameras(task, 0.5, 0.05, tmp_path / "refined")
    assert said == "The cameras are kept as given: they have lens fields already."
    assert not (tmp_path / "refined").exists()
