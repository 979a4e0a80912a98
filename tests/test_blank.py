"""What says nothing gets no depth: clear sky and blank walls, on rendered pictures as cameras save them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import whole

import colmap_sph
from colmap_sph import synthetic as syn
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.project.images.jpeg import rounding_step
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.blank import blank_pixels, drop_scattered, faint_pixels, faint_rays
from colmap_sph.stereo.matching import MatchingOptions, match_pair

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
DETAIL = syn.Noise(0.025, seed=3)
SKY, GROUND, BLANK, BLOWN_OUT, WEAK = -1, 0, 1, 2, 3


@dataclass(frozen=True)
class Paint:
    """An even colour in even light."""

    value: float

    def colour(self, coordinates):
        return np.full((coordinates.shape[1], 3), self.value, dtype=np.float32)


def scene():
    """Three panels before the sky, on textured ground; between them pillars of the ground's texture."""
    stone = syn.Mottled(DETAIL, contrast=0.25)
    panels: tuple[syn.Material, ...] = (
        Paint(0.7),
        Paint(3.0),
        syn.Mottled(DETAIL, (0.8, 0.8, 0.8), contrast=0.02),
    )
    surfaces: list[syn.Surface] = [syn.Plane((0, 0, 0), (0, 0, 1), stone, half_size=(8, 8))]
    surfaces += [syn.box((3 * k - 3, 6, 0), (2.4, 0.3, 3), (panel,)) for k, panel in enumerate(panels)]
    return surfaces + [syn.box((3 * k - 4.5, 5.7, 0), (0.6, 0.6, 3.4), (stone,)) for k in range(4)]


def cameras():
    places = [(0.6 * k - 1.5, -0.3 * (k % 2), 1.4 + 0.3 * (k % 3)) for k in range(6)]
    poses = [syn.look_at(place, (0.5 * place[0], 6, 1.9)) for place in places]
    return [syn.Camera(syn.pinhole(FOCAL, WIDTH, HEIGHT), R, t, WIDTH, HEIGHT) for R, t in poses]


def photograph(camera, seed, quality=90, noise=2.0):
    """(H, W, 3) BGR picture with a sky that is brighter lower down, sensor noise and JPEG's rounding."""
    view = syn.render(scene(), camera.K, camera.R, camera.t, WIDTH, HEIGHT)
    picture = view.image.astype(np.float32)
    picture[view.surface == SKY] += np.linspace(-30, 20, HEIGHT)[np.nonzero(view.surface == SKY)[0], None]
    picture += np.random.default_rng(seed).normal(0, noise, picture.shape)
    saved = np.clip(np.rint(picture), 0, 255).astype(np.uint8)[..., ::-1]
    return cv2.imdecode(encoded(saved, quality), cv2.IMREAD_COLOR)


def encoded(picture, quality):
    """A JPEG file's bytes."""
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]


def surfaces_of(camera):
    """(H, W) numbers of the surfaces at the pixels, and their exact depth, where COLMAP has it."""
    depth, _, number = syn.exact_geometry(scene(), camera, origin=0.0)
    return number, depth


def write_project(root: Path) -> Path:
    """The pictures and a model with exact poses and points; none on what is blank."""
    names = [f"{k}.png" for k in range(len(cameras()))]
    (root / "images").mkdir()
    for k, (name, camera) in enumerate(zip(names, cameras(), strict=True)):
        cv2.imwrite(str(root / "images" / name), photograph(camera, k))
    sparse = syn.sample_sparse_points(scene(), cameras(), 800, np.random.default_rng(0))
    syn.write_reconstruction(syn.build_reconstruction(names, cameras(), sparse), root / "sparse" / "0")
    return root / "sparse" / "0"


# ---- the mask ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def masks():
    """For each camera: which pixels are found blank, and the surfaces' numbers."""
    pictures = [cv2.cvtColor(photograph(camera, k), cv2.COLOR_BGR2GRAY) for k, camera in enumerate(cameras())]
    return [
        (blank_pixels(picture), surfaces_of(camera)[0])
        for picture, camera in zip(pictures, cameras(), strict=True)
    ]


def masks_of(quality=90, noise=2.0):
    """As `masks`, of other pictures, with what their files say of JPEG's rounding."""
    found = []
    for k, camera in enumerate(cameras()):
        picture = photograph(camera, k, quality, noise)
        step = rounding_step(bytes(encoded(picture, quality)))
        found.append((blank_pixels(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), step), surfaces_of(camera)[0]))
    return found


def share(masks, surface):
    return sum(blank[number == surface].sum() for blank, number in masks) / sum(
        (number == surface).sum() for _, number in masks
    )


def test_sky_and_blown_out_walls_are_blank(masks):
    assert share(masks, SKY) > 0.95  # all but its edges
    assert share(masks, BLOWN_OUT) > 0.95
    assert share(masks, BLANK) > 0.75  # some pictures show but a narrow strip of it


def test_texture_is_not_blank_however_weak(masks):
    assert share(masks, WEAK) < 0.02  # at its edges; its texture is no stronger than the noise
    assert share(masks, GROUND) < 0.01


@pytest.mark.parametrize("quality", [80, 70, 60, 50])
def test_coarse_jpeg_does_not_make_texture_of_the_sky(quality):
    masks = masks_of(quality)
    assert share(masks, SKY) > 0.95
    assert share(masks, BLOWN_OUT) > 0.95
    assert share(masks, WEAK) < 0.03
    assert share(masks, GROUND) < 0.01


@pytest.mark.parametrize("noise", [4, 8, 12])
def test_strong_noise_does_not_make_texture_of_the_sky(noise):
    masks = masks_of(noise=noise)
    assert share(masks, SKY) > 0.95
    assert share(masks, BLOWN_OUT) > 0.95  # its noise is cut off, and tells nothing of the sky's
    assert share(masks, GROUND) < 0.015


def test_texture_that_is_weaker_than_strong_noise_is_not_blank():
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.standard_normal((400, 600)), (0, 0), 4)
    for noise in (3, 6, 9):
        picture = 120 + 0.5 * noise * texture / texture.std() + noise * rng.standard_normal(texture.shape)
        assert blank_pixels(picture.astype(np.float32)).mean() < 0.01


def test_pictures_too_small_to_tell_have_no_blank_pixels():
    assert not blank_pixels(np.full((127, 200), 90, np.uint8)).any()
    assert blank_pixels(np.full((128, 200), 90, np.uint8)).all()


def test_noise_of_any_strength_is_blank_and_fine_texture_is_not():
    rng = np.random.default_rng(0)
    for strength in (0, 0.5, 1, 2, 4, 8):
        assert blank_pixels((120 + strength * rng.standard_normal((200, 300))).astype(np.float32)).mean() > 0.99
    gravel = 120 + 20 * rng.standard_normal((200, 300))  # white as noise is, but stronger than any camera's
    assert not blank_pixels(gravel.astype(np.float32)).any()
    soft = 120 + 20 * cv2.GaussianBlur(gravel - 120, (0, 0), 1.2) / 20  # weaker, as through a lens
    assert not blank_pixels(soft.astype(np.float32)).any()


def test_an_object_before_a_white_backdrop_is_not_blank():
    """The backdrop's noise is cut off at white, so that only the object could tell what noise there is."""
    stone = syn.Mottled(syn.Noise(0.0042, seed=1), (0.4, 0.35, 0.3), contrast=0.22)
    body = syn.Ellipsoid(np.array([0, 0, 0.5]), np.array([0.25, 0.25, 0.5]), stone)
    R, t = syn.look_at((2.3, 0, 1.2), (0, 0, 0.5))
    view = syn.render([body], syn.pinhole(520, 480, 360), R, t, 480, 360)
    is_body = view.surface >= 0
    picture = np.where(is_body[..., None], view.image, 250).mean(axis=2)
    picture = np.clip(np.rint(picture + np.random.default_rng(0).normal(0, 1.5, picture.shape)), 0, 255)
    blank = blank_pixels(picture.astype(np.uint8))
    assert blank[is_body].mean() < 0.02
    assert blank[~is_body].mean() > 0.95


# ---- faint places ------------------------------------------------------------------------------------------


def clouds_over_a_field(rng):
    """(400, 600) picture: clouds with nothing finer than 100 pixels in its upper half, below them a texture."""
    clouds = cv2.GaussianBlur(rng.standard_normal((400, 600)), (0, 0), 25)
    field = cv2.GaussianBlur(rng.standard_normal((400, 600)), (0, 0), 3)
    picture = 150 + 15 * clouds / clouds.std()
    picture[200:] += 8 * (field / field.std())[200:]
    return (picture + rng.standard_normal(picture.shape)).astype(np.float32)


def test_clouds_are_faint_and_not_blank():
    picture = clouds_over_a_field(np.random.default_rng(0))
    assert not blank_pixels(picture)[:190].any()
    assert faint_pixels(picture)[:190].mean() > 0.8
    assert not faint_pixels(picture)[210:].any()


def test_a_faint_place_keeps_its_depths_where_they_are_many():
    rng = np.random.default_rng(0)
    faint = np.zeros((600, 500), np.uint8)
    faint[:, 100:] = 1
    seam = np.zeros(faint.shape, np.float32)
    seam[:, :112] = 5
    whole = np.where(rng.random(faint.shape) < 0.8, np.float32(5), np.float32(0))
    wall = np.where(np.arange(500) < 300, whole, 0)
    for depth, kept in ((seam, faint == 0), (whole, True), (wall, True)):
        found = depth.copy()
        drop_scattered(found, faint)
        np.testing.assert_array_equal(found, np.where(kept, depth, 0))


def test_rays_of_a_faint_sky_are_found_along_silhouettes():
    """Depth maps are of pixels' corners: many of the sky's rays pass a pixel of what stands before it."""
    for camera in cameras():
        is_sky = surfaces_of(camera)[0] == SKY
        of_pixels = syn.exact_geometry(scene(), camera, origin=0.5)[2] == SKY
        edge = is_sky & ~of_pixels
        assert edge.sum() > 50
        found = faint_rays(of_pixels.astype(np.uint8)) > 0
        assert found[edge].mean() > 0.98  # all but tips
        assert (found & ~is_sky).sum() < 0.01 * (~is_sky).sum()


# ---- what comes of it --------------------------------------------------------------------------------------


def shares_with_depth(dense):
    """Of sky; of even walls, wrong by more than 2 pixels on the ground; of the weak wall, right within them."""
    found = dict.fromkeys(("sky", "walls", "weak"), 0)
    total = dict(found)
    for k, camera in enumerate(cameras()):
        number, depth = surfaces_of(camera)
        ours = read_depth_map(Workspace(dense).depth_map_path(f"{k}.png", "geometric"))
        wrong = np.abs(ours - depth) > 2 * depth / FOCAL
        for name, region, counted in (
            ("sky", number == SKY, ours > 0),
            ("walls", (number == BLANK) | (number == BLOWN_OUT), (ours > 0) & wrong),
            ("weak", number == WEAK, (ours > 0) & ~wrong),
        ):
            found[name] += (region & counted).sum()
            total[name] += region.sum()
    return {name: found[name] / total[name] for name in found}


def test_nothing_is_found_where_there_is_nothing(tmp_path):
    model = write_project(tmp_path)
    found = {}
    for keep_blank in (False, True):
        options = RunOptions(threads=2, matching=MatchingOptions(keep_blank=keep_blank))
        output = tmp_path / str(keep_blank)
        colmap_sph.run(model, output=output, options=options)
        found[keep_blank] = shares_with_depth(output)
    assert found[False]["sky"] < 0.005 < found[True]["sky"]
    assert found[False]["walls"] < 0.01 < found[True]["walls"]
    # Edges are all that it loses.
    assert found[False]["weak"] > max(0.75, found[True]["weak"] - 0.03)


# ---- clouds ------------------------------------------------------------------------------------------------


def clouds_behind_a_wall():
    """A rectified pair: a textured wall at disparity 30 before soft clouds at disparity 0, and where it stands."""
    rng = np.random.default_rng(1)
    height, width = 256, 400
    clouds: np.ndarray = 190 + 150 * cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), 6)
    wall = 110 + 200 * cv2.GaussianBlur(rng.standard_normal((height, 120)), (0, 0), 1.5)
    images = []
    for first in (160, 130):
        image = clouds.copy()
        image[100:, first : first + 120] = wall[100:]
        image += rng.normal(0, 1, image.shape)
        images.append(whole(image))
    is_wall = np.zeros((height, width), bool)
    is_wall[100:, 160:280] = True
    return *images, is_wall


def test_clouds_at_infinity_are_not_matched_within_the_range():
    left, right, is_wall = clouds_behind_a_wall()
    sky = ~cv2.dilate(is_wall.astype(np.uint8), np.ones((33, 33), np.uint8)).astype(bool)
    sky[:, :60] = False  # has no counterpart
    near = match_pair(left, right, 5, 60, MatchingOptions())
    far = match_pair(left, right, 5, 60, MatchingOptions(), infinity=0)
    assert np.isfinite(far[sky]).mean() < 0.0002 < np.isfinite(near[sky]).mean()
    assert (np.abs(far[is_wall] - 30) < 1).mean() > 0.99
