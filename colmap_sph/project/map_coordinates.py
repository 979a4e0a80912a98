"""Models in map coordinates (UTM, ECEF and the like): worked on near the origin, given back as they came.

32-bit floats, in which COLMAP fuses and clouds are usually stored, hold seven digits: at five million metres
they step by half a metre. So the work is done relative to a round point near the cameras, and the cloud gets
its coordinates back as 64-bit floats.
"""

from itertools import islice
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_sph.errors import InputError
from colmap_sph.project.files import atomic_file

# A model is far when its origin is this many times farther away than its own size: 32-bit floats then resolve a
# millionth of its size, a few hundredths of a pixel.
_FAR = 20.0
_SAMPLED_POINTS = 1000
# In whatever unit: what lies beyond comes from damage, and its square may be more than a float holds.
_MAX_COORDINATE = 1e12
# Depth maps are of 32-bit floats, which lose their digits, and whose squares vanish, far below.
_MIN_SIZE = 1e-15
# As a share of how far they are: places nearer to each other are the same, of images of one tripod without points.
_ROUNDING = 1e-12
_CHUNK_POINTS = 1_000_000
_PLY_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1"}


def is_plausible(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) bool: which of (N, 3) world coordinates are finite and not absurdly far."""
    return np.asarray((np.abs(places) < _MAX_COORDINATE).all(axis=1))


def check_size(model: pycolmap.Reconstruction, sparse_dir: Path) -> None:
    """Raise `InputError` where images and points of a model are in a unit in which nothing can be computed.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    sparse_dir : Path
        Where it was read from, for the message.
    """
    centres, places = _places(model)
    centres = centres[(np.abs(centres) < 1e300).all(axis=1)]  # the others are told of one by one
    places = places[is_plausible(places)]
    farthest = float(np.median(np.abs(centres).max(axis=1))) if len(centres) else 0.0
    apart = float(np.ptp(places, axis=0).max()) if len(places) else 0.0
    if farthest >= _MAX_COORDINATE:
        what = f"images of the model in {sparse_dir} lie some {farthest:.0e} units from its origin"
    elif _ROUNDING * np.abs(places).max(initial=0.0) < apart < _MIN_SIZE:
        what = f"images and points of the model in {sparse_dir} lie only {apart:.0e} units apart"
    else:
        return
    raise InputError(f"The {what}; bring it to metres or the like, by COLMAP's model_transformer.")


def _places(model: pycolmap.Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 3) centres of the images of a model, and (M, 3) of these and some of its points."""
    centres = [model.image(image_id).projection_center() for image_id in model.reg_image_ids()]
    points = [point.xyz for point in islice(model.points3D.values(), _SAMPLED_POINTS)]
    return np.array(centres).reshape(-1, 3), np.array(centres + points).reshape(-1, 3)


def local_origin(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """Find the point to work relative to.

    Parameters
    ----------
    model : pycolmap.Reconstruction

    Returns
    -------
    (3,) float64 ndarray
        World coordinates: round numbers near the median of cameras and points where these are far from the
        world's origin, else exactly zero.
    """
    known = _places(model)[1]
    known = known[is_plausible(known)]
    if not len(known):
        return np.zeros(3)
    middle = np.median(known, axis=0)
    size = float(np.median(np.linalg.norm(known - middle, axis=1)))
    if not 0 < _FAR * size < np.linalg.norm(middle):
        return np.zeros(3)
    step = 10.0 ** np.floor(np.log10(size))
    return np.asarray(np.round(middle / step) * step)


def move_model(model: pycolmap.Reconstruction, origin: NDArray[np.float64]) -> None:
    """Move a model in place, so that world point `origin` becomes its origin."""
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), -origin))


def move_cloud(source: Path, target: Path, origin: NDArray[np.float64]) -> None:
    """Write a copy of COLMAP's ``fused.ply`` with `origin` added to its points, as 64-bit floats.

    Parameters
    ----------
    source : Path
        Binary PLY with points as COLMAP writes them.
    target : Path
        The copy: the same properties, but x, y and z of type ``double``.
    origin : (3,) float64 ndarray

    Raises
    ------
    OutputError
        `target` cannot be written.
    """
    with source.open("rb") as file, atomic_file(target) as output:
        names = []
        lines = []
        for line in iter(file.readline, b"end_header\n"):
            words = line.decode().split()
            if words[0] == "property":
                names.append((words[2], _PLY_TYPES[words[1]]))
                line = b"property double %s\n" % words[2].encode() if words[2] in "xyz" else line
            lines.append(line)
        output.write(b"".join([*lines, b"end_header\n"]))
        near = np.dtype(names)
        far = np.dtype([(name, "<f8" if name in "xyz" else kind) for name, kind in names])
        while len(points := np.fromfile(file, near, _CHUNK_POINTS)):
            moved = points.astype(far)
            for axis, offset in zip("xyz", origin, strict=True):
                moved[axis] += offset
            output.write(moved.tobytes())
