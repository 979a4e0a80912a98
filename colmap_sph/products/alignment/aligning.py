"""Camera positions or control points → the georeference of a workspace, and what is left at each."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import InputError, NoResultError, counted
from colmap_sph.products.alignment.tables import ControlPoint, Positions
from colmap_sph.products.georeference import AlignedBy, Georeference, Residual
from colmap_sph.project.alignment.control_points import MarkedImage, marked_images, triangulated
from colmap_sph.project.alignment.gps import read_gps
from colmap_sph.project.alignment.similarity import estimate_similarity
from colmap_sph.project.lens.files import read_lens_fields
from colmap_sph.project.sparse_model import load_model
from colmap_sph.project.wide.table import read_cuts
from colmap_sph.project.workspace import Workspace, checked_name
from colmap_sph.scene import Scene

logger = logging.getLogger(__name__)

_NAMED = 3


def positions_of_photographs(folder: Path, scene: Scene) -> Positions:
    """Where GPS says that a scene's photographs in a folder were taken.

    Raises
    ------
    InputError
        Fewer than three of them say so.
    """
    found = {view.photograph: read_gps(folder / checked_name(view.photograph)) for view in scene.views}
    places = {name: place for name, place in found.items() if place is not None}
    if len(places) < 3:
        number = f"only {len(places)}" if places else "none"
        raise InputError(
            f"Of the {len(found)} images of the model {number} in {folder} has a GPS position in its Exif data; "
            "give the folder of the original photographs as --align, or a CSV with camera positions or control "
            "points."
        )
    if len(places) < len(found):
        logger.warning("%d of %d photographs have no GPS position", len(found) - len(places), len(found))
    return Positions(places, is_geographic=True)


def align_by_positions(scene: Scene, positions: Mapping[str, NDArray[np.float64]], source: Path) -> Georeference:
    """Align a scene by where its cameras are on the map; gross errors are found and left out.

    Parameters
    ----------
    scene : Scene
    positions : mapping of str to (3,) float64 ndarray
        Map coordinates, by the name of the image.
    source : Path
        What they come from, for messages.

    Raises
    ------
    InputError
        They do not tell where the model lies.
    """
    centers = {view.photograph: view.center + scene.origin for view in scene.views}
    names = _matched(positions, centers, source)
    if len(names) < 3:
        raise InputError(_few_names(source, positions, centers))
    if len(set(names.values())) < len(names):
        called = list(names.values())
        twice = next(name for name in called if called.count(name) > 1)
        raise InputError(f"{source} has the image {twice} under two names; leave one of the two lines out.")
    places = np.array([positions[name] for name in names])
    own = np.array([centers[matched] for matched in names.values()])
    return _aligned(
        list(names.values()), own, places, np.zeros(len(own), bool), [None] * len(own), source, "positions"
    )


def align_by_points(
    workspace: Workspace, points: Sequence[ControlPoint], photographs: Path, source: Path
) -> Georeference:
    """Align a workspace's model by control points that are marked in its images.

    Parameters
    ----------
    workspace : Workspace
    points : sequence of ControlPoint
    photographs : Path
        Model with the cameras of the images in which they are marked.
    source : Path
        The table, for messages.

    Raises
    ------
    InputError
        They do not tell where the model lies, or a mark lies outside of its image.
    """
    if read_lens_fields(photographs):
        logger.warning("%s has lens fields, which marks of control points do not take into account", photographs)
    cuts = read_cuts(workspace.sparse_dir)
    images = marked_images(load_model(workspace.sparse_dir), cuts, load_model(photographs))
    mentioned = dict.fromkeys(image for point in points for image, *_ in point.marks)
    called = _matched(mentioned, images, source)
    found = {point.name: _triangulated(point, images, called, source) for point in points}
    known = [point for point in points if found[point.name] is not None]
    used = sum(not point.is_check for point in known)
    if used < 3:
        raise InputError(
            f"{source} has {counted(used, 'control point')} that two or more images of "
            f"{workspace.sparse_dir} show, and three are needed; mark more, by the names that the images have in "
            f"the model, such as {next(iter(images), 'none')}."
        )
    for point in points:
        if found[point.name] is None:
            logger.warning(
                "%s: the point %s is not marked in two images of the model; left out", source, point.name
            )
    places = np.array([point.place for point in known])
    triangulations = [each for point in known if (each := found[point.name]) is not None]
    own = np.array([place for place, _ in triangulations])
    pixels: list[float | None] = [error for _, error in triangulations]
    is_check = np.array([point.is_check for point in known])
    return _aligned([point.name for point in known], own, places, is_check, pixels, source, "points")


def _triangulated(
    point: ControlPoint, images: Mapping[str, MarkedImage], called: Mapping[str, str], source: Path
) -> tuple[NDArray[np.float64], float] | None:
    marks = [mark for mark in point.marks if mark[0] in called]
    for name, column, row, number in marks:
        camera = images[called[name]].camera
        if not (0 <= column <= camera.width and 0 <= row <= camera.height):
            raise InputError(
                f"{source}, line {number}: {column:g}, {row:g} lies outside of {name}, which has {camera.width} x "
                f"{camera.height} pixels; correct it, or give the model of the images in which it was marked."
            )
    if twice := _marked_twice(marks, called):
        raise InputError(
            f"{source}, line {twice[-1]}: the point {point.name!r} is marked in {twice[0]} before; leave out "
            "one of the two lines."
        )
    if len(marks) < 2:
        return None
    return triangulated([images[called[mark[0]]] for mark in marks], np.array([mark[1:3] for mark in marks]))


def _marked_twice(
    marks: Sequence[tuple[str, float, float, int]], called: Mapping[str, str]
) -> tuple[str, float, float, int] | None:
    """The first mark in an image that has one already: two rays of one image meet in its camera."""
    seen: set[str] = set()
    for mark in marks:
        if called[mark[0]] in seen:
            return mark
        seen.add(called[mark[0]])
    return None


def _aligned(
    names: Sequence[str],
    own: NDArray[np.float64],
    places: NDArray[np.float64],
    is_check: NDArray[np.bool_],
    pixels: Sequence[float | None],
    source: Path,
    by: AlignedBy,
) -> Georeference:
    try:
        found = estimate_similarity(own[~is_check], places[~is_check], robust=by == "positions")
    except NoResultError as error:
        raise InputError(
            f"{source} does not tell where the model lies: {error}; give more places, or others."
        ) from error
    unused = is_check.copy()
    unused[~is_check] = ~found.used
    differences = (found(own) - places).tolist()
    residuals = tuple(
        Residual(name, (x, y, z), bool(left_out), error)
        for name, (x, y, z), left_out, error in zip(names, differences, unused, pixels, strict=True)
    )
    return Georeference(
        scale=found.scale,
        rotation=found.rotation,
        translation=found.translation,
        aligned_by=by,
        residuals=residuals,
    )


# ---- names --------------------------------------------------------------------------------------------------


def _matched(names: Iterable[str], known: Mapping[str, object], source: Path) -> dict[str, str]:
    """Names of a table that are images of the model, and their names there; tells of the others.

    A table may leave out folders where one image alone has the name.
    """
    by_file: dict[str, list[str]] = {}
    for name in known:
        by_file.setdefault(PurePosixPath(name).name, []).append(name)
    alike: Callable[[str], list[str]] = lambda name: [name] if name in known else by_file.get(name, [])  # noqa: E731
    matched = {name: alike(name)[0] for name in names if len(alike(name)) == 1}
    missing = [name for name in names if name not in matched]
    if missing and matched:
        more = ", …" if len(missing) > _NAMED else ""
        logger.warning(
            "%s: %d names are no images of the model (%s%s); left out",
            source,
            len(missing),
            ", ".join(missing[:_NAMED]),
            more,
        )
    return matched


def _few_names(source: Path, names: Iterable[str], known: Iterable[str]) -> str:
    found = len(set(names) & set(known))
    called = f"it names {next(iter(names), 'none')}, and the model {next(iter(known), 'none')}"
    return (
        f"{source} has positions of {counted(found, 'image')} of the model, and three are needed; "
        f"{'give those of more' if found else called}."
    )
