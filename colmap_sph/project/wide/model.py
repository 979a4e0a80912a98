"""Model of wide images → the model of the views cut from them: what a camera of a rig was are several now.

The views of an image are sensors of its rig, the first of them in the place of its camera; what is observed is
observed by every view that shows it.
"""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.project.wide.cuts import Cuts
from colmap_sph.project.wide.layout import Face
from colmap_sph.project.wide.projection import camera_rays

Float = NDArray[np.float64]
Straight = Callable[[pycolmap.Camera], pycolmap.Camera]
"""A camera that is not wide → that of its undistorted image."""
Moved = Callable[[pycolmap.Camera, Float], Float]
"""The same for (n, 2) image coordinates."""


def model_of_views(
    model: pycolmap.Reconstruction, cuts: Cuts, names: Collection[str], straight: Straight, moved: Moved
) -> pycolmap.Reconstruction:
    """Return the model of views.

    Parameters
    ----------
    model : pycolmap.Reconstruction
        Of the original images.
    cuts : Cuts
        Of this model.
    names : collection of str
        Views to be in the new model, and images that are not cut.
    straight, moved : callable
        What becomes of the cameras of the latter, and of their image coordinates.
    """
    return _Maker(model, cuts, frozenset(names), straight, moved).made()


@dataclass(frozen=True)
class _Part:
    """An image of the new model.

    Attributes
    ----------
    name : str
    camera_id, image_id : int
    xy, points : (n, 2) float64 and (n,) int64 ndarray
        What it observes, and ids of the points; -1: none.
    """

    name: str
    camera_id: int
    image_id: int
    xy: Float
    points: NDArray[np.int64]


class _Maker:
    def __init__(
        self,
        model: pycolmap.Reconstruction,
        cuts: Cuts,
        names: frozenset[str],
        straight: Straight,
        moved: Moved,
    ) -> None:
        self._model = model
        self._cuts = cuts
        self._names = names
        self._straight = straight
        self._moved = moved
        self._new = pycolmap.Reconstruction()
        self._next_image = max(model.images) + 1
        self._camera_ids = self._new_camera_ids()
        self._elements: dict[int, list[tuple[int, int]]] = {}

    def _new_camera_ids(self) -> dict[tuple[int, int], int]:
        """Ids of the new cameras by that of the old one and the number of the face."""
        ids = {}
        following = max(self._model.cameras) + 1
        for camera_id in sorted(self._model.cameras):
            for number in range(len(self._cuts.faces.get(camera_id, (None,)))):
                is_kept = camera_id not in self._cuts.faces
                ids[camera_id, number] = camera_id if is_kept else following
                following += not is_kept
        return ids

    def made(self) -> pycolmap.Reconstruction:
        for (camera_id, number), new_id in self._camera_ids.items():
            self._new.add_camera(self._camera(camera_id, number, new_id))
        for rig in self._model.rigs.values():
            self._new.add_rig(self._rig(rig))
        frames = {self._model.image(i).frame_id for i in self._model.reg_image_ids()}
        for frame_id in sorted(frames):
            self._add_frame(self._model.frame(frame_id))
        self._add_points()
        # Those of the original model are senseless where COLMAP has no rays.
        self._new.update_point_3d_errors()
        return self._new

    def _faces(self, camera_id: int) -> tuple[Face | None, ...]:
        return self._cuts.faces.get(camera_id, (None,))

    def _camera(self, camera_id: int, number: int, new_id: int) -> pycolmap.Camera:
        face = self._faces(camera_id)[number]
        if face is None:
            camera = self._straight(self._model.camera(camera_id))
            camera.camera_id = new_id
            return camera
        params = [face.focal, face.focal, face.x, face.y]
        return pycolmap.Camera(
            camera_id=new_id, model="PINHOLE", width=face.width, height=face.height, params=params
        )

    def _turn(self, camera_id: int, number: int = 0) -> pycolmap.Rigid3d:
        """From an old camera's frame to a new one's."""
        face = self._faces(camera_id)[number]
        turn = np.eye(3) if face is None else face.R
        return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3))

    def _sensors(self, camera_id: int) -> Iterator[tuple[int, pycolmap.sensor_t]]:
        for number in range(len(self._faces(camera_id))):
            new_id = self._camera_ids[camera_id, number]
            yield number, pycolmap.sensor_t(pycolmap.SensorType.CAMERA, new_id)

    def _rig(self, rig: pycolmap.Rig) -> pycolmap.Rig:
        """A rig in the frame of the first view of its reference camera."""
        new = pycolmap.Rig(rig_id=rig.rig_id)
        reference = rig.ref_sensor_id.id
        old_from_new = self._turn(reference).inverse()
        places = {reference: pycolmap.Rigid3d()}
        places |= {sensor.id: place for sensor, place in rig.non_ref_sensors.items() if place is not None}
        for camera_id, place in places.items():
            for number, sensor in self._sensors(camera_id):
                if (camera_id, number) == (reference, 0):
                    new.add_ref_sensor(sensor)
                else:
                    new.add_sensor(sensor, self._turn(camera_id, number) * place * old_from_new)
        return new

    def _add_frame(self, old: pycolmap.Frame) -> None:
        parts = [part for data in old.image_ids for part in self._parts(self._model.image(data.id))]
        if not parts:
            return
        frame = pycolmap.Frame(frame_id=old.frame_id, rig_id=old.rig_id)
        for part in parts:
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, part.camera_id)
            frame.add_data_id(pycolmap.data_t(sensor, part.image_id))
        reference = self._model.rig(old.rig_id).ref_sensor_id.id
        pose = old.rig_from_world
        assert pose is not None  # of a frame with registered images
        frame.rig_from_world = self._turn(reference) * pose
        self._new.add_frame(frame)
        for part in parts:
            image = pycolmap.Image(part.name, part.xy, part.camera_id, part.image_id)
            image.frame_id = frame.frame_id
            self._new.add_image(image)
            for place in np.flatnonzero(part.points >= 0).tolist():
                self._elements.setdefault(int(part.points[place]), []).append((part.image_id, place))
        self._new.register_frame(frame.frame_id)

    def _parts(self, image: pycolmap.Image) -> Iterator[_Part]:
        """What comes in place of an image, of what is wanted."""
        camera_id = image.camera_id
        if camera_id not in self._cuts.faces:
            if image.name in self._names:
                xy = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
                ids = [point.point3D_id if point.has_point3D() else -1 for point in image.points2D]
                moved = self._moved(self._model.camera(camera_id), xy) if len(xy) else xy
                yield _Part(image.name, camera_id, image.image_id, moved, np.array(ids, np.int64))
            return
        seen = image.get_observation_points2D()
        xy = np.array([point.xy for point in seen]).reshape(-1, 2)
        points = np.array([point.point3D_id for point in seen], np.int64)
        views = self._cuts.of[image.name]
        rays = camera_rays(views[0][1].lens, xy)
        for number, (name, cut) in enumerate(views):
            image_id = self._next_image
            self._next_image += 1  # also where a view is left out: ids do not depend on others
            if name in self._names:
                places, inside = cut.face.points(rays)
                new_id = self._camera_ids[camera_id, number]
                yield _Part(name, new_id, image_id, places[inside], points[inside])

    def _add_points(self) -> None:
        """The points of two or more observations, and as in `submodel` those that nobody observed before."""
        for point_id, old in self._model.points3D.items():
            elements = self._elements.get(point_id, [])
            if len(elements) < 2 and old.track.length():
                continue
            point = pycolmap.Point3D()
            point.xyz = old.xyz
            point.color = old.color
            point.error = old.error
            track = pycolmap.Track()
            for image_id, place in elements:
                track.add_element(image_id, place)
            point.track = track
            self._new.add_point3D_with_id(point_id, point)
