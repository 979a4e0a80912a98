"""What is cut from the wide images of a model: views with names of their own, in place of these images."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import PurePosixPath

import pycolmap

from colmap_sph.project.wide.layout import Face, faces_of
from colmap_sph.project.wide.lenses import wide_lenses
from colmap_sph.project.wide.projection import Lens


@dataclass(frozen=True)
class Cut:
    """A view that is cut from an image.

    Attributes
    ----------
    original : str
        Name of the image.
    lens : Lens
        Of the image.
    face : Face
        The view.
    """

    original: str
    lens: Lens
    face: Face


@dataclass(frozen=True, eq=False)
class Cuts:
    """All views that are cut from images of a model.

    Attributes
    ----------
    faces : mapping of int to tuple of Face
        By the id of the images' camera.
    views : mapping of str to Cut
        By the view's name.
    """

    faces: Mapping[int, tuple[Face, ...]] = field(default_factory=dict)
    views: Mapping[str, Cut] = field(default_factory=dict)

    def names(self, originals: Iterable[str]) -> list[str]:
        """Sorted names of the views that come in place of some images; an image that is not cut stays itself."""
        names = []
        for original in originals:
            names += [name for name, _ in self.of[original]] if original in self.of else [original]
        return sorted(names)

    def original(self, name: str) -> str:
        """The image that a view comes from."""
        cut = self.views.get(name)
        return name if cut is None else cut.original

    @cached_property
    def of(self) -> Mapping[str, list[tuple[str, Cut]]]:
        """Views cut from each image, with their names, in the order of its camera's faces."""
        views: dict[str, list[tuple[str, Cut]]] = {}
        for name, cut in self.views.items():
            views.setdefault(cut.original, []).append((name, cut))
        return views


NO_CUTS = Cuts()


def cuts_of(model: pycolmap.Reconstruction, place: str, *, scale: float, max_size: int) -> Cuts:
    """Find what is to be cut from the wide images of a model.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    place : str
        Where the model is, for messages.
    scale, max_size
        See `faces_of`.

    Raises
    ------
    InputError
        A camera is none, see `wide_lenses`.
    """
    lenses = wide_lenses(model, place)
    if not lenses:
        return NO_CUTS
    faces = {camera_id: faces_of(lens, scale, max_size) for camera_id, lens in lenses.items()}
    cameras = {model.image(i).name: model.image(i).camera_id for i in model.reg_image_ids()}
    taken = _Names(name for name, camera_id in cameras.items() if camera_id not in lenses)
    views: dict[str, Cut] = {}
    for original in sorted(name for name, camera_id in cameras.items() if camera_id in lenses):
        camera_id = cameras[original]
        for name, face in zip(taken.for_views(original, faces[camera_id]), faces[camera_id], strict=True):
            views[name] = Cut(original, lenses[camera_id], face)
    return Cuts(faces, views)


class _Names:
    """Names of files that are taken, and of folders."""

    def __init__(self, files: Iterable[str]) -> None:
        self._files: set[str] = set()
        self._folders: set[str] = set()
        for name in files:
            self._take(name)

    def for_views(self, original: str, faces: Sequence[Face]) -> list[str]:
        """Names of the views of an image: DIR/FACE/BASE.png, or with more at the end where that is taken."""
        path = PurePosixPath(original)
        for base in _bases(path):
            names = [str(path.parent / face.name / f"{base}.png") for face in faces]
            if all(map(self._is_free, names)):
                break
        for name in names:
            self._take(name)
        return names

    def _is_free(self, name: str) -> bool:
        is_taken = name in self._files or name in self._folders
        return not is_taken and not any(str(folder) in self._files for folder in PurePosixPath(name).parents)

    def _take(self, name: str) -> None:
        self._files.add(name)
        self._folders.update(str(folder) for folder in PurePosixPath(name).parents)


def _bases(path: PurePosixPath) -> Iterator[str]:
    yield path.stem
    yield path.name
    number = 2
    while True:
        yield f"{path.name}-{number}"
        number += 1
