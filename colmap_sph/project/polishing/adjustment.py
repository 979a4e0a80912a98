"""A sparse model and tracks that were measured beside it → the model with adjusted poses: a bundle adjustment.

The work is COLMAP's (Ceres). The model's own tracks take part: they hold the directions that ties leave weak. What
neither holds is kept by weak priors: on the centres and, without tracks, on the turns. The result is laid over the
given model.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.colmap_library import quiet_colmap
from colmap_sph.project.map_coordinates import local_origin
from colmap_sph.project.polishing.options import Polishing
from colmap_sph.project.sparse_model import image_names, submodel

_FEWEST_IMAGES = 3
_INSIST = "; --polish-poses always polishes them, too"
# Beyond what is usual a residual counts linearly: mismatches, and what moves. What is usual is measured, between
# these bounds, pixels; the least of a model without tracks, as what its ties miss by may be its poses alone.
_LEAST_USUAL = 0.1
_MOST_USUAL = 1.0
# Centres that are trusted count so many times more than what they look at.
_CENTER_WEIGHT = 100
# Standard deviation of a given centre, in what a pixel covers at the median depth of the image's points; and of
# its ties where it has none, which hardly tell a turn of the camera from a step.
_CENTER_PIXELS = 5.0
_CENTER_PIXELS_BY_TIES = 1.0
# Stars are so many times farther away than ties are from each other: seen in the same direction from everywhere.
_STAR_DISTANCE = 1e6
# COLMAP's tracks have two observations at least.
_STAR_OBSERVATIONS = 2
_MAX_ITERATIONS = 100
_CONVERGED = 1e-7


@dataclass(frozen=True, eq=False)
class Observations:
    """Tracks to be added to a model.

    Attributes
    ----------
    names : sequence of str
        Names of images.
    track, image : (m,) int64 ndarray
        Number of the track of each observation, and index of its image in `names`.
    pixels : (m, 2) float64 ndarray
        Image coordinates, of the model's images.
    points : (n, 3) float64 ndarray
        Where each track is about, in the model's frame.
    error : float
        What they usually miss these by, pixels.
    """

    names: Sequence[str]
    track: NDArray[np.int64]
    image: NDArray[np.int64]
    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    error: float


def reason_to_keep(model: pycolmap.Reconstruction, polishing: Polishing) -> str:
    """Why the poses of a model are not touched, as the end of a sentence; empty where they may be."""
    if model.num_reg_images() < _FEWEST_IMAGES:
        return f"fewer than {_FEWEST_IMAGES} images cannot check each other"
    if polishing == "always":
        return ""
    if any(rig.num_sensors() > 1 for rig in model.rigs.values()):
        return f"images were taken by a rig of cameras, whose poses belong together{_INSIST}"
    if local_origin(model).any():
        return f"the model is in map coordinates, and its poses may come from a survey{_INSIST}"
    if not any(point.track.length() > 1 for point in model.points3D.values()):
        return f"the model has no tracks, so its poses were not made from these images{_INSIST}"
    return ""


def adjusted_model(
    given: pycolmap.Reconstruction,
    observations: Observations,
    *,
    refine_distortion: bool = False,
    trust_centers: bool = False,
) -> pycolmap.Reconstruction | None:
    """Adjust the poses and points of a model.

    Parameters
    ----------
    given : pycolmap.Reconstruction
        Not changed.
    observations : Observations
    refine_distortion : bool
        Whether the distortion of each camera is adjusted, too; focal length and principal point stay.
    trust_centers : bool
        Whether the result is laid over the given centres rather than over what they look at as well: where cameras
        were wrong, so were the points.

    Returns
    -------
    pycolmap.Reconstruction or None
        With the images, observations and tracks of the given one, each image a rig of its own; None where the
        adjustment does not converge.
    """
    model = submodel(given, set(image_names(given)))
    own_points = sorted(model.points3D)
    with_ties = _with_observations(model, observations)
    priors = _priors(model, with_ties)
    stars = [] if own_points else _with_stars(with_ties, observations.points)
    with quiet_colmap(int(pycolmap.logging.ERROR)):  # it warns of centres in a row, and does without their priors
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            _options(observations.error if own_points else _LEAST_USUAL, refine_distortion=refine_distortion),
            pycolmap.PosePriorBundleAdjustmentOptions(),
            _config(with_ties, stars, refine_distortion=refine_distortion),
            priors,
            with_ties,
        )
        summary = adjuster.solve()
    if not summary.is_solution_usable():
        return None
    _lay_over(with_ties, model, own_points, _CENTER_WEIGHT if trust_centers else 1)
    _take_over(model, with_ties, own_points)
    return model if _is_finite(model) else None


def _with_observations(model: pycolmap.Reconstruction, observations: Observations) -> pycolmap.Reconstruction:
    """A copy of a model with more observations and their tracks; points of the model keep their ids."""
    ids = {image.name: image_id for image_id, image in model.images.items()}
    pixels = {image_id: [point.xy for point in image.points2D] for image_id, image in model.images.items()}
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    observed = zip(observations.track.tolist(), observations.image.tolist(), observations.pixels, strict=True)
    for track, image, place in observed:
        image_id = ids[observations.names[image]]
        tracks.setdefault(track, []).append(pycolmap.TrackElement(image_id, len(pixels[image_id])))
        pixels[image_id].append(place)
    larger = pycolmap.Reconstruction()
    for camera_id in sorted(model.cameras):
        larger.add_camera_with_trivial_rig(model.camera(camera_id))
    for image_id in sorted(model.images):
        image = model.image(image_id)
        copy = pycolmap.Image(image.name, pixels[image_id], image.camera_id, image_id)
        larger.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point_id in sorted(model.points3D):
        larger.add_point3D_with_id(point_id, model.point3D(point_id))
    for track, elements in sorted(tracks.items()):
        larger.add_point3D(observations.points[track], pycolmap.Track(elements))
    return larger


def _with_stars(model: pycolmap.Reconstruction, points: NDArray[np.float64]) -> list[int]:
    """Add a star to each image, in the middle, that holds how its camera is turned; returns their point ids.

    Ties are short: where all cameras turn a little towards each other, they still meet, at other depths.
    """
    distance = _STAR_DISTANCE * float(np.ptp(points, axis=0).max())
    stars = []
    for image_id in sorted(model.images):
        image = model.image(image_id)
        first = len(image.points2D)
        middle = model.camera(image.camera_id).img_from_cam(np.array([0.0, 0.0, 1.0]))
        image.points2D.extend([pycolmap.Point2D(middle)] * _STAR_OBSERVATIONS)
        elements = [pycolmap.TrackElement(image_id, first + number) for number in range(_STAR_OBSERVATIONS)]
        star = image.cam_from_world().inverse() * np.array([0.0, 0.0, distance])
        stars.append(model.add_point3D(star, pycolmap.Track(elements)))
    return stars


def _options(usual_error: float, *, refine_distortion: bool) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = refine_distortion
    options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = float(np.clip(usual_error, _LEAST_USUAL, _MOST_USUAL))
    solver = options.ceres.solver_options
    solver.max_num_iterations = _MAX_ITERATIONS
    solver.function_tolerance = _CONVERGED
    solver.num_threads = 1  # sums of several threads differ in their last digits from run to run
    return options


def _config(
    model: pycolmap.Reconstruction, stars: Sequence[int], *, refine_distortion: bool
) -> pycolmap.BundleAdjustmentConfig:
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.images):
        config.add_image(image_id)
    for star in stars:
        config.add_constant_point(star)
    if not refine_distortion:
        for camera_id in sorted(model.cameras):
            config.set_constant_cam_intrinsics(camera_id)
    return config


def _priors(model: pycolmap.Reconstruction, larger: pycolmap.Reconstruction) -> list[pycolmap.PosePrior]:
    """Where the centres were given, known as well as some pixels tell."""
    deviations = {
        image_id: _CENTER_PIXELS * _pixel_size(model, image_id)
        or _CENTER_PIXELS_BY_TIES * _pixel_size(larger, image_id)
        for image_id in sorted(model.images)
    }
    known = [deviation for deviation in deviations.values() if deviation > 0]
    usual = float(np.median(known)) if known else 1.0
    priors = []
    for image_id, deviation in deviations.items():
        prior = pycolmap.PosePrior()
        prior.corr_data_id = larger.image(image_id).data_id
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        prior.position = model.image(image_id).projection_center()
        prior.position_covariance = np.eye(3) * (deviation or usual) ** 2
        priors.append(prior)
    return priors


def _pixel_size(model: pycolmap.Reconstruction, image_id: int) -> float:
    """What a pixel covers at the median depth of an image's points, model units; zero without any."""
    points = _points_of(model, image_id)
    if not len(points):
        return 0.0
    image = model.image(image_id)
    pose = image.cam_from_world().matrix()
    depth = float(np.median(points @ pose[2, :3] + pose[2, 3]))
    return max(depth, 0.0) / float(model.camera(image.camera_id).mean_focal_length())


def _points_of(model: pycolmap.Reconstruction, image_id: int) -> NDArray[np.float64]:
    """(n, 3) points that an image observes, in the order of its observations."""
    image = model.image(image_id)
    ids = [point.point3D_id for point in image.points2D if point.has_point3D()]
    return np.array([model.point3D(point_id).xyz for point_id in ids]).reshape(-1, 3)


def _lay_over(
    adjusted: pycolmap.Reconstruction,
    given: pycolmap.Reconstruction,
    own_points: Sequence[int],
    center_weight: int,
) -> None:
    """Move an adjusted model over the given one, by the similarity that fits centres and what they look at best.

    Centres alone leave a turn about them open where they are in a row, and a scale where they are near each other.
    Without points cameras are turned as they were.
    """
    places: list[list[NDArray[np.float64]]] = [[], []]
    own = set(own_points)
    for image_id in sorted(given.images):
        observed = [point for point in given.image(image_id).points2D if point.point3D_id in own]
        for model, there in zip((adjusted, given), places, strict=True):
            there += [model.image(image_id).projection_center()] * center_weight
            if observed:
                points = [model.point3D(point.point3D_id).xyz for point in observed]
                there.append(np.median(points, axis=0))
    if own:
        similarity = pycolmap.estimate_sim3d(*(np.array(there) for there in places))
    else:
        similarity = _similarity_of_cameras(adjusted, given)
    if similarity is not None:
        adjusted.transform(similarity)


def _similarity_of_cameras(
    adjusted: pycolmap.Reconstruction, given: pycolmap.Reconstruction
) -> pycolmap.Sim3d | None:
    """The similarity that leaves cameras turned as they were given, and centres where they were; None: none."""
    turns, centers = [], []
    for image_id in sorted(given.images):
        images = [model.image(image_id) for model in (given, adjusted)]
        before, after = (image.cam_from_world().rotation.matrix() for image in images)
        turns.append(before.T @ after)
        centers.append([image.projection_center() for image in images])
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    there, here = np.moveaxis(np.array(centers), 1, 0)
    arms, turned = there - there.mean(axis=0), (here - here.mean(axis=0)) @ turn.T
    scale = (arms * turned).sum() / max((turned**2).sum(), 1e-300)
    if scale <= 0:
        return None
    shift = there.mean(axis=0) - scale * turn @ here.mean(axis=0)
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn), shift)


def _take_over(
    model: pycolmap.Reconstruction, adjusted: pycolmap.Reconstruction, own_points: Sequence[int]
) -> None:
    """Give a model the cameras, poses and points of its adjusted copy."""
    for camera_id, camera in adjusted.cameras.items():
        model.camera(camera_id).params = list(camera.params)
    for image_id in model.images:
        frame = model.frame(model.image(image_id).frame_id)
        frame.rig_from_world = adjusted.image(image_id).cam_from_world()
    for point_id in own_points:
        model.point3D(point_id).xyz = adjusted.point3D(point_id).xyz
    model.update_point_3d_errors()


def _is_finite(model: pycolmap.Reconstruction) -> bool:
    poses = [image.cam_from_world().matrix() for image in model.images.values()]
    points = [point.xyz for point in model.points3D.values()]
    return bool(np.isfinite(poses).all() and np.isfinite(points).all())
