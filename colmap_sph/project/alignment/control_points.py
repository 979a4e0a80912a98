"""A point marked in some images → its place in the model's frame, by COLMAP."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.projection import Lens, camera_rays, image_points


@dataclass(frozen=True, eq=False)
class MarkedImage:
    """An image in which points can be marked: its pose, and the camera that maps rays to its pixels.

    The camera is that of the image as people saw it, maybe with distortion, or the lens of an image that was cut
    into views; the pose is the workspace's.
    """

    pose: NDArray[np.float64]
    camera: pycolmap.Camera | Lens

    def ray(self, pixel: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(3,) unit vector in the camera's frame, of image coordinates x and y; None where there is none."""
        if isinstance(self.camera, Lens):
            far = camera_rays(self.camera, pixel[None])[0]
            return far if np.isfinite(far).all() else None
        found = self.camera.cam_from_img(pixel)
        if found is None or not np.isfinite(found).all():
            return None
        ray = np.append(found, 1.0)
        return np.asarray(ray / np.linalg.norm(ray))

    def distance(self, place: NDArray[np.float64], pixel: NDArray[np.float64]) -> float:
        """Pixels between a mark and where a place of the model's frame is seen."""
        there = self.pose[:, :3] @ place + self.pose[:, 3]
        if isinstance(self.camera, Lens):
            return float(np.linalg.norm(image_points(self.camera, there[None])[0] - pixel))
        seen = self.camera.img_from_cam(there)
        return float("inf") if seen is None else float(np.linalg.norm(seen - pixel))


def marked_images(
    model: pycolmap.Reconstruction, cuts: Mapping[str, Cut], photographs: pycolmap.Reconstruction
) -> dict[str, MarkedImage]:
    """Images of a model, by name, with the cameras of the photographs they were made of.

    Of a photograph that was cut into views the pose is that of one of these.
    """
    cameras = {
        photographs.image(i).name: photographs.camera(photographs.image(i).camera_id)
        for i in photographs.reg_image_ids()
    }
    found = {}
    for image in map(model.image, model.reg_image_ids()):
        pose, cut = np.array(image.cam_from_world().matrix()), cuts.get(image.name)
        if image.name in cameras:
            found[image.name] = MarkedImage(pose, cameras[image.name])
        elif cut is not None and cut.original in cameras:
            found[cut.original] = MarkedImage(cut.face.R.T @ pose, cut.lens)
    return found


def triangulated(
    images: Sequence[MarkedImage], pixels: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float] | None:
    """Find a point that is marked in images.

    Parameters
    ----------
    images : sequence of MarkedImage
    pixels : (n, 2) float64 ndarray
        Image coordinates; the first pixel's centre is (0.5, 0.5).

    Returns
    -------
    place : (3,) float64 ndarray
        In the model's frame.
    error : float
        Root mean square of its reprojection error, pixels.
    None where the rays do not meet.
    """
    rays = [image.ray(pixel) for image, pixel in zip(images, pixels, strict=True)]
    known = [(image.pose, ray) for image, ray in zip(images, rays, strict=True) if ray is not None]
    if len(known) < 2:
        return None
    place = pycolmap.triangulate_multi_view_point([pose for pose, _ in known], np.array([ray for _, ray in known]))
    if place is None:
        return None
    place = np.array(place, np.float64).ravel()
    errors = [image.distance(place, pixel) for image, pixel in zip(images, pixels, strict=True)]
    error = float(np.sqrt(np.mean(np.square(errors))))
    return (place, error) if np.isfinite(place).all() and np.isfinite(error) else None
