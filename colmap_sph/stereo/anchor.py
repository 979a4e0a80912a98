"""The scene that a run works in: relative to one of its cameras, the same to the bit wherever the model lies.

At five million metres coordinates step by a nanometre. That is nothing, but it turns single grey values when
images are resampled, and around these the matcher may decide otherwise. So what is computed starts from cameras
on a grid: far coarser than a nanometre, and far finer than any poses are known.

The grid is counted from one of the cameras, since one counted from the model's origin would not move along with
the model. A camera within a nanometre of the border between two places of the grid can still come out in the
other one, and its maps then differ in some pixels: of 4000 models of 11 images, whose pixels cover 2 mm, moved
to random UTM coordinates, 11 had such a camera.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_sph.scene import Scene, View

# Largest step of the grid in pixels, in the image that sees its surroundings finest: cameras move by less than a
# thousandth of a pixel on average.
_STEP_PIXELS = 0.003
# Places of the grid, in steps: round coordinates, whole or half steps, must not lie on the border between two.
_PHASE = 1 / 6
# Half of the cameras lie within one of these from their middle; what lies beyond ten is no place to count from.
_OUTLYING = 10.0
# Coordinates of a model are exact to this part of the largest, a few last digits of 64-bit floats.
_EXACT = 2.0**-46
# Below this, in whatever unit, the number of steps to the farthest camera could be more than a float holds.
_LEAST_STEP = 1e-200


def anchored(scene: Scene) -> Scene:
    """Move a scene to one of its cameras, and its other cameras to a fine grid.

    Parameters
    ----------
    scene : Scene
        As read.

    Returns
    -------
    Scene
        With `Scene.anchor` saying where it lies. Of models that differ by where they lie alone, these differ by
        `Scene.origin` and `Scene.anchor`, and by their points' last digits.
    """
    centers = np.array([view.center for view in scene.views])
    middle = np.median(centers, axis=0)
    distances = np.linalg.norm(centers - middle, axis=1)
    # The first by name, not the nearest: in a regular block several are equally near.
    anchor = centers[np.argmax(distances <= _OUTLYING * np.median(distances))]
    centers = centers - anchor
    points = scene.points - anchor
    step = _grid_step(scene, centers, points, exact=_EXACT * float(np.abs(scene.origin + anchor).max()))
    if step > _LEAST_STEP:
        centers = (np.round(centers / step - _PHASE) + _PHASE) * step
    views = tuple(replace(view, t=-view.R @ center) for view, center in zip(scene.views, centers, strict=True))
    return replace(scene, views=views, points=points, anchor=scene.anchor + anchor)


def _grid_step(scene: Scene, centers: NDArray[np.float64], points: NDArray[np.float64], exact: float) -> float:
    """Return a power of two, which the last digits of the model do not change; zero where there is no scale."""
    sizes = [_pixel_size(view, center, points) for view, center in zip(scene.views, centers, strict=True)]
    known = [size for size in sizes if size > 0]
    if not known:
        from scipy.spatial import cKDTree  # which takes long to load, and is seldom needed

        # Cameras stand nearer to each other than to what they look at.
        nearest = cKDTree(centers).query(centers, k=min(2, len(centers)))[0].reshape(len(centers), -1)[:, -1]
        apart = nearest > 10 * exact
        if not apart.any():
            return 0.0 if exact == 0 else float(2.0 ** np.ceil(np.log2(100 * exact)))
        known = [float(np.median(nearest[apart])) / max(view.K[0, 0], view.K[1, 1]) for view in scene.views]
    return float(2.0 ** np.floor(np.log2(_STEP_PIXELS * min(known))))


def _pixel_size(view: View, center: NDArray[np.float64], points: NDArray[np.float64]) -> float:
    """What a pixel covers at the median depth of the points a view observes; zero where it has none before it."""
    depths = (points[view.point_indices] - center) @ view.viewing_direction
    depths = depths[depths > 0]
    return float(np.median(depths)) / max(view.K[0, 0], view.K[1, 1]) if len(depths) else 0.0
