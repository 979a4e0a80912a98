"""Fisheyes and panoramas beyond 90 degrees: rays and pixels against slow references and COLMAP's library."""

import math
from collections.abc import Callable

import numpy as np
import pycolmap
import pytest

from colmap_sph.errors import InputError
from colmap_sph.project.wide.layout import Face, angles_shown, faces_of, shown
from colmap_sph.project.wide.lenses import wide_lenses
from colmap_sph.project.wide.projection import (
    MODELS,
    PANORAMA,
    Lens,
    camera_rays,
    focal_length,
    image_points,
    number_of_parameters,
    turning_angle,
)

SIZE = (480, 480)
PARAMETERS: dict[str, tuple[float, ...]] = {
    "SIMPLE_FISHEYE": (130, 240, 241),
    "FISHEYE": (130, 131, 240, 241),
    "SIMPLE_RADIAL_FISHEYE": (130, 240, 241, 0.02),
    "RADIAL_FISHEYE": (130, 240, 241, 0.03, -0.004),
    "OPENCV_FISHEYE": (129, 129.3, 240, 239, 0.038, -0.008, 0.0083, -0.0027),
    "THIN_PRISM_FISHEYE": (129, 130, 240, 239, 0.03, -0.008, 0.001, -0.002, 0.004, -0.001, 0.0011, -0.0007),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(129, 130, 240, 239, 0.03, -0.008, 0.004, -0.001, 0.0003, 0.0001),
        *(0.001, -0.0012, 0.0004, -0.0003, 0.0002, 0.0005),
    ),
    "FOV": (160, 161, 240, 239, 1.2),
    "EUCM": (140, 141, 240, 239, 0.65, 1.1),
    "SIMPLE_DIVISION": (150, 240, 239, -0.2),
    "DIVISION": (150, 151, 240, 239, -0.2),
    "EQUIRECTANGULAR": (480, 240),
}


def lens(model: str, limit: float = math.pi) -> Lens:
    return Lens(model, tuple(map(float, PARAMETERS[model])), *SIZE, limit)


def rays_up_to(degrees: float, number: int = 400) -> np.ndarray:
    rng = np.random.default_rng(5)
    angle = np.radians(np.append(rng.uniform(0, degrees, number), [0.0, degrees]))
    turn = rng.uniform(0, 2 * np.pi, number + 2)
    return np.column_stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])


# ---- the formulas of COLMAP's documentation, one ray at a time ------------------------------------------------


def of_polynomial(ray: np.ndarray, coefficients: tuple[float, ...]) -> tuple[float, float]:
    angle = math.atan2(math.hypot(ray[0], ray[1]), ray[2])
    radius = angle + sum(k * angle ** (2 * i + 3) for i, k in enumerate(coefficients))
    turn = math.atan2(ray[1], ray[0])
    return radius * math.cos(turn), radius * math.sin(turn)


def of_thin_prism(ray: np.ndarray, extra: tuple[float, ...]) -> tuple[float, float]:
    k1, k2, p1, p2, k3, k4, sx1, sy1 = extra
    u, v = of_polynomial(ray, ())
    r2 = u * u + v * v
    radial = k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return (
        u + u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + sx1 * r2,
        v + v * radial + 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + sy1 * r2,
    )


def of_rad_tan(ray: np.ndarray, extra: tuple[float, ...]) -> tuple[float, float]:
    p0, p1, s0, s1, s2, s3 = extra[6:]
    u, v = of_polynomial(ray, extra[:6])
    r2 = u * u + v * v
    return (
        u + (2 * u * u + r2) * p0 + 2 * u * v * p1 + s0 * r2 + s1 * r2**2,
        v + (2 * v * v + r2) * p1 + 2 * u * v * p0 + s2 * r2 + s3 * r2**2,
    )


def back_from_fov(u: float, v: float, extra: tuple[float, ...]) -> list[float]:
    radius = math.hypot(u, v)
    # tan of the angle off the axis is tan(r omega) / (2 tan(omega / 2)), beyond a right angle, too.
    across = math.sin(radius * extra[0]) / (2 * math.tan(extra[0] / 2))
    radius = max(radius, 1e-15)
    return [across * u / radius, across * v / radius, math.cos(radius * extra[0])]


def back_from_eucm(u: float, v: float, extra: tuple[float, ...]) -> list[float]:
    alpha, beta = extra
    r2 = u * u + v * v
    z = 1 - beta * alpha**2 * r2
    return [u, v, z / (alpha * math.sqrt(1 - (2 * alpha - 1) * beta * r2) + 1 - alpha)]


def back_from_division(u: float, v: float, extra: tuple[float, ...]) -> list[float]:
    return [u, v, 1 + extra[0] * (u * u + v * v)]


FORWARD: dict[str, Callable[[np.ndarray, tuple[float, ...]], tuple[float, float]]] = {
    "THIN_PRISM_FISHEYE": of_thin_prism,
    "RAD_TAN_THIN_PRISM_FISHEYE": of_rad_tan,
}
BACKWARD = {
    "FOV": back_from_fov,
    "EUCM": back_from_eucm,
    "SIMPLE_DIVISION": back_from_division,
    "DIVISION": back_from_division,
}


def split(model: str) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
    values = PARAMETERS[model]
    number = 1 if MODELS[model][0] else 2
    return np.array([values[0], values[number - 1]]), np.array(values[number : number + 2]), values[number + 2 :]


@pytest.mark.parametrize("model", sorted(PARAMETERS.keys() - BACKWARD.keys() - {PANORAMA}))
def test_pixels_of_rays_beyond_a_right_angle(model: str) -> None:
    focal, principal, extra = split(model)
    rays = rays_up_to(100)
    expected = np.array([FORWARD.get(model, of_polynomial)(ray, extra) for ray in rays]) * focal + principal
    np.testing.assert_allclose(image_points(lens(model), rays), expected, atol=1e-6)
    np.testing.assert_allclose(camera_rays(lens(model), expected), rays, atol=1e-6)


@pytest.mark.parametrize("model", sorted(BACKWARD))
def test_rays_of_pixels_beyond_a_right_angle(model: str) -> None:
    focal, principal, extra = split(model)
    points = image_points(lens(model), rays_up_to(100))
    expected = np.array([BACKWARD[model](u, v, extra) for u, v in (points - principal) / focal])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert expected[:, 2].min() < -0.17
    np.testing.assert_allclose(camera_rays(lens(model), points), expected, atol=1e-6)
    np.testing.assert_allclose(rays_up_to(100), expected, atol=1e-6)


@pytest.mark.parametrize("model", sorted(PARAMETERS))
def test_colmap_agrees_up_to_a_right_angle(model: str) -> None:
    camera = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=PARAMETERS[model])
    rays = rays_up_to(180 if model == PANORAMA else 85)
    points = image_points(lens(model), rays)
    np.testing.assert_allclose(points, np.asarray(camera.img_from_cam(rays), np.float64), atol=1e-6)
    assert number_of_parameters(model) == len(camera.params)
    np.testing.assert_allclose(camera_rays(lens(model), points), rays, atol=1e-6)


def test_panorama_is_colmaps() -> None:
    camera = pycolmap.Camera(model=PANORAMA, width=480, height=240, params=[480, 240])
    points = np.random.default_rng(1).uniform(0, [480, 240], (300, 2))
    found = camera_rays(Lens(PANORAMA, (480.0, 240.0), 480, 240), points)
    np.testing.assert_allclose(found, np.asarray(camera.cam_ray_from_img(points), np.float64), atol=1e-9)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("EUCM", (1000.0, 1000.0, 2000.0, 1500.0, 0.9995, 1.2)),
        ("SIMPLE_DIVISION", (1000.0, 2000.0, 1500.0, 0.25)),
        ("RADIAL_FISHEYE", (1000.0, 2000.0, 1500.0, -0.12, 0.002)),
    ],
)
def test_rays_are_found_up_to_where_a_lens_ends(model: str, params: tuple[float, ...]) -> None:
    """There radii hardly grow with the angle, or ever faster."""
    of = Lens(model, params, 4000, 3000)
    angle = turning_angle(of) * np.linspace(0, 0.9995, 3000)
    rays = np.column_stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)])
    points = image_points(of, rays)
    is_near = np.abs(points[:, 0]) < 1e5
    found = camera_rays(of, points[is_near])
    np.testing.assert_allclose(found, rays[is_near], atol=1e-6)


def test_nothing_beyond_where_the_polynomial_turns() -> None:
    folded = Lens("SIMPLE_RADIAL_FISHEYE", (130.0, 240.0, 240.0, -0.15), 480, 480)
    turn = math.degrees(turning_angle(folded))
    # d/da (a - 0.15 a^3) = 0.
    assert turn == pytest.approx(math.degrees(1 / math.sqrt(0.45)), abs=0.05)
    beyond = rays_up_to(100)
    points = image_points(folded, beyond)
    angle = np.degrees(np.arccos(beyond[:, 2]))
    assert np.isnan(points[angle > turn + 0.1]).all()
    assert np.isfinite(points[angle < turn - 0.1]).all()
    assert np.isnan(camera_rays(folded, np.array([[479.0, 479.0]]))).all()


def test_nothing_beyond_the_limit() -> None:
    small = lens("OPENCV_FISHEYE", math.radians(50))
    rays = rays_up_to(100)
    is_beyond = np.arccos(rays[:, 2]) > math.radians(50)
    np.testing.assert_array_equal(np.isnan(image_points(small, rays)[:, 0]), is_beyond)
    everything = image_points(lens("OPENCV_FISHEYE"), rays)
    np.testing.assert_array_equal(np.isnan(camera_rays(small, everything)[:, 0]), is_beyond)


# ---- layouts -------------------------------------------------------------------------------------------------

LENSES = {
    "190 degrees": Lens("OPENCV_FISHEYE", PARAMETERS["OPENCV_FISHEYE"], 480, 480, math.radians(97)),
    "230 degrees": Lens("FISHEYE", (114.0, 114.0, 240.0, 240.0), 480, 480, math.radians(115)),
    "137 degrees": Lens("FISHEYE", (200.0, 200.0, 240.0, 240.0), 480, 480),
    "low": Lens("FISHEYE", (150.0, 150.0, 240.0, 100.0), 480, 200, math.radians(98)),
    "full frame": Lens("FISHEYE", (200.0, 200.0, 300.0, 200.0), 600, 400),
    "panorama": Lens(PANORAMA, (880.0, 440.0), 880, 440),
    "half a panorama": Lens(PANORAMA, (880.0, 440.0), 440, 440),
}


def margins_of(face: Face, rays: np.ndarray) -> np.ndarray:
    """Degrees within each border of a pinhole, as the angle between the ray and the border's plane."""
    local = rays @ np.array(face.rotation).T
    corners = [((0 - face.x), (face.width - face.x)), ((0 - face.y), (face.height - face.y))]
    margin = np.full(len(rays), np.inf)
    for axis, (low, high) in enumerate(corners):
        for tangent, sign in ((low / face.focal, 1), (high / face.focal, -1)):
            normal = np.zeros(3)
            normal[[axis, 2]] = [sign, -sign * tangent]
            margin = np.minimum(margin, np.degrees(np.arcsin(local @ normal / np.linalg.norm(normal))))
    return margin


def pixel_rays(of: Lens, step: int = 5) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.5, of.width, step), np.arange(0.5, of.height, step))
    rays = camera_rays(of, np.column_stack([x.ravel(), y.ravel()]))
    return rays[np.isfinite(rays).all(axis=1)]


@pytest.mark.parametrize("name", LENSES)
def test_views_show_all_that_the_lens_does(name: str) -> None:
    of = LENSES[name]
    rays = pixel_rays(of)
    faces = faces_of(of, 0.7)
    margin = np.max([margins_of(face, rays) for face in faces], axis=0)
    assert margin.min() > 0
    # Away from the rim they overlap.
    inner = rays[:, 2] > math.cos(math.radians(60))
    assert name == "half a panorama" or margin[inner].min() > 5
    for face in faces:
        np.testing.assert_allclose(face.R @ face.R.T, np.eye(3), atol=1e-12)
        assert face.focal == pytest.approx(0.7 * focal_length(of))
        assert math.degrees(2 * math.atan(max(face.width, face.height) / 2 / face.focal)) < 125


@pytest.mark.parametrize("name", LENSES)
def test_views_end_where_the_lens_does(name: str) -> None:
    of = LENSES[name]
    for face in faces_of(of):
        is_shown = shown(of, image_points(of, face.rays(slice(0, face.height)))).reshape(face.height, face.width)
        rows, columns = face.height // 50 + 4, face.width // 50 + 4
        for border in (is_shown[:rows], is_shown[-rows:], is_shown[:, :columns], is_shown[:, -columns:]):
            assert border.any()


def test_number_of_views() -> None:
    quarters = {"upper_left", "upper_right", "lower_left", "lower_right"}
    assert {face.name for face in faces_of(LENSES["190 degrees"])} == quarters
    # Of an image that is low two views to the sides show all.
    assert [face.name for face in faces_of(LENSES["low"])] == ["left", "right"]
    assert {face.name for face in faces_of(LENSES["230 degrees"])} == {"front", "left", "right", "up", "down"}
    assert {face.name for face in faces_of(LENSES["panorama"])} == {"front", "right", "back", "left", "up", "down"}
    assert "right" not in {face.name for face in faces_of(LENSES["half a panorama"])}


def test_left_is_left_and_up_is_up() -> None:
    for of in LENSES.values():
        for face in faces_of(of):
            x, y, z = face.R[2]  # its axis, in the camera's frame: x right, y down
            expected = {
                "left": x < 0,
                "right": x > 0,
                "up": y < 0,
                "down": y > 0,
                "front": z > 0.9,
                "back": z < -0.9,
                "upper_left": x < -0.4 and y < -0.4,
                "upper_right": x > 0.4 and y < -0.4,
                "lower_left": x < -0.4 and y > 0.4,
                "lower_right": x > 0.4 and y > 0.4,
            }
            assert expected[face.name]
            if face.name in ("left", "right"):
                assert face.R[1, 1] > 0.9  # upright


def test_largest_size() -> None:
    faces = faces_of(LENSES["panorama"], 1.0, 100)
    assert 95 <= max(max(face.width, face.height) for face in faces) <= 100
    # Where they end is found on a grid: views as fine as this one come out two pixels larger.
    low = Lens("SIMPLE_FISHEYE", (260.0, 400.0, 172.0), 800, 344)
    assert max(max(face.width, face.height) for face in faces_of(low, 1.0, 333)) <= 333
    assert angles_shown(LENSES["137 degrees"]) == pytest.approx((137.2, 137.2), abs=0.1)


# ---- which cameras are wide ----------------------------------------------------------------------------------


def model_of(
    camera: pycolmap.Camera, places: np.ndarray, points: np.ndarray | None = None
) -> pycolmap.Reconstruction:
    """Two images of one pose that observe points (n, 3), one at each place (n, 2)."""
    points = np.tile([0.0, 0.0, 1.0], (len(places), 1)) if points is None else points
    model = pycolmap.Reconstruction()
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for number in (1, 2):
        image = pycolmap.Image(f"{number}.png", places, 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for row in range(len(places)):
        track = pycolmap.Track()
        for number in (1, 2):
            track.add_element(number, row)
        model.add_point3D(points[row], track, np.zeros(3, np.uint8))
    return model


def fisheye(model: str = "OPENCV_FISHEYE", params: tuple[float, ...] | None = None) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=480, height=480, params=params or PARAMETERS[model])


def test_a_lens_is_believed_as_far_as_it_is_observed() -> None:
    seen = image_points(lens("OPENCV_FISHEYE"), rays_up_to(88))
    (found,) = wide_lenses(model_of(fisheye(), seen), "here").values()
    assert math.degrees(found.limit) == pytest.approx(90, abs=0.1)
    few = image_points(lens("OPENCV_FISHEYE"), rays_up_to(50))
    assert wide_lenses(model_of(fisheye(), few), "here") == {}


def test_without_points_the_image_circle_counts() -> None:
    (found,) = wide_lenses(
        model_of(fisheye("FISHEYE", (140.0, 140.0, 240.0, 240.0)), np.empty((0, 2))), "x"
    ).values()
    assert math.degrees(found.limit) == pytest.approx(math.degrees(239.5 / 140), abs=1e-6)


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "SIMPLE_RADIAL"])
def test_perspective_cameras_are_not_wide(model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, 60.0, 480, 480)
    assert wide_lenses(model_of(camera, np.empty((0, 2))), "here") == {}


def test_narrow_fisheyes_are_not_wide() -> None:
    assert wide_lenses(model_of(fisheye("FISHEYE", (300.0, 300.0, 240.0, 240.0)), np.empty((0, 2))), "x") == {}


def test_observations_beyond_the_lens_are_refused() -> None:
    places = np.random.default_rng(2).uniform(5, 475, (200, 2))
    folded = fisheye("SIMPLE_RADIAL_FISHEYE", (130.0, 240.0, 240.0, -0.15))
    with pytest.raises(InputError, match=r"Camera 1 \(SIMPLE_RADIAL_FISHEYE\) in here .* calibrate it again"):
        wide_lenses(model_of(folded, places), "here")


@pytest.mark.parametrize(
    "params", [(240.0, 1.0), (100.0, 120.0), (120.0, 240.0), (math.inf, 120.0), (240.0, -1.0)]
)
def test_spheres_smaller_than_their_images_are_refused(params: tuple[float, ...]) -> None:
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=240, height=120, params=params)
    with pytest.raises(InputError, match=r"Camera 1.* in here .*"):
        wide_lenses(model_of(camera, np.empty((0, 2))), "here")


PARTS = {
    "whole": ((240, 120), (240.0, 120.0), 0, None),
    "left half": ((120, 120), (240.0, 120.0), 0, None),
    "right half, counted from the left of the whole": ((120, 120), (240.0, 120.0), 0, "outside of its images"),
    "right half as if it were the left": ((120, 120), (240.0, 120.0), 120, "degrees beside"),
    "right half as if it were the whole": ((120, 120), (120.0, 120.0), 120, "degrees beside"),
    "left half as if it were the whole": ((120, 120), (120.0, 120.0), 0, "degrees beside"),
}


@pytest.mark.parametrize("part", PARTS)
def test_panoramas_are_whole_or_say_which_part_they_are(part: str) -> None:
    size, params, cut, told = PARTS[part]
    low = 120 if "right" in part else 0
    high = 240 if part == "whole" else low + 120
    x, y = np.meshgrid(np.arange(low, high, 10) + 5.0, np.arange(5.0, 120, 10))
    east, down = (x.ravel() / 240 - 0.5) * 2 * np.pi, (y.ravel() / 120 - 0.5) * np.pi
    points = 7 * np.stack([np.sin(east) * np.cos(down), np.sin(down), np.cos(east) * np.cos(down)], axis=1)
    places = np.stack([x.ravel() - cut, y.ravel()], axis=1)
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=params)
    model = model_of(camera, places, points)
    if told is None:
        assert set(wide_lenses(model, "here")) == {1}
        return
    with pytest.raises(InputError, match=rf"amera 1 \(EQUIRECTANGULAR\) in here .*{told}.*Fill other parts up"):
        wide_lenses(model, "here")


@pytest.mark.parametrize(
    ("size", "params"), [((240, 80), (240.0, 80.0)), ((240, 60), (240.0, 120.0)), ((240, 120), (239.6, 119.8))]
)
def test_spheres_of_any_shape_are_panoramas(size: tuple[int, int], params: tuple[float, ...]) -> None:
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=size[0], height=size[1], params=params)
    assert set(wide_lenses(model_of(camera, np.empty((0, 2))), "here")) == {1}


@pytest.mark.parametrize(
    "params", [(130.0, 130.0, 240.0, 240.0, *([math.nan] * 4)), (-1.0, -1.0, 240.0, 240.0, 0.0, 0.0, 0.0, 0.0)]
)
def test_no_lens_is_refused(params: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="describes no lens"):
        wide_lenses(model_of(fisheye("OPENCV_FISHEYE", params), np.empty((0, 2))), "here")


@pytest.mark.parametrize(
    ("model", "extra", "said"),
    [
        ("EUCM", (-0.01, 1.1), r"alpha = -0\.01"),
        ("EUCM", (1.01, 1.1), r"alpha = 1\.01"),
        ("EUCM", (math.nan, 1.1), "alpha = nan"),
        ("EUCM", (0.6, 0.0), "beta = 0"),
        ("EUCM", (5.0, -3.0), "alpha = 5"),
        ("EUCM", (0.6, -3.0), "beta = -3"),
        ("FOV", (math.pi,), r"omega = 3\.14159"),
        ("FOV", (-7.0,), "omega = -7"),
        ("FOV", (math.inf,), "omega = inf"),
    ],
)
@pytest.mark.parametrize("focal", [140.0, 1400.0])
def test_parameters_outside_of_a_formula_are_refused(
    model: str, extra: tuple[float, ...], said: str, focal: float
) -> None:
    camera = fisheye(model, (focal, focal, 240.0, 240.0, *extra))
    with pytest.raises(InputError, match=rf"^Camera 1 \({model}\) in here has {said}, which must be .*calibrate"):
        wide_lenses(model_of(camera, np.empty((0, 2))), "here")


@pytest.mark.parametrize(
    ("model", "extra"), [("EUCM", (0.0, 1.0)), ("EUCM", (1.0, 1.0)), ("FOV", (0.0,)), ("FOV", (-0.9,))]
)
def test_parameters_at_the_ends_of_a_formula_are_lenses(model: str, extra: tuple[float, ...]) -> None:
    camera = fisheye(model, (1400.0, 1400.0, 240.0, 240.0, *extra))
    assert wide_lenses(model_of(camera, np.empty((0, 2))), "here") == {}
