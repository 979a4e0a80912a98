"""A workspace → the folder that MVSNet and its successors read: ``cams/``, ``images/`` and ``pair.txt`` [1]_.

Images have numbers in the order of their names. Cameras count pixels from the centre of the first one, as the
warps of these programs do. Each image has its partners, best first, with the number of sparse points that both
observe.

References
----------
.. [1] https://github.com/YoYo000/MVSNet, *File formats*.
"""

from pathlib import Path

import cv2
import numpy as np

from colmap_sph.errors import InputError, printable
from colmap_sph.platforms.files import write_text
from colmap_sph.platforms.links import link
from colmap_sph.products.publishing import published_folder
from colmap_sph.products.scenes.links import check_images
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Scene, View
from colmap_sph.stereo.partners.frusta import points_in_view
from colmap_sph.stereo.partners.pairs import PairOptions, PairSelection, select_pairs

_PLANES = 192
_JPEG = (".jpg", ".jpeg")
_JPEG_QUALITY = 98
# As COLMAP: percentiles of the depth of the points that an image observes, and room beyond these.
_RANGE = (1, 99)
_ROOM = (0.75, 1.25)


def write_mvsnet(workspace: Workspace, folder: Path) -> None:
    """Write a folder for MVSNet.

    Raises
    ------
    InputError
        An image is not whole, or the model has no points.
    NoResultError
        No image has a partner.
    OutputError
        The folder cannot be written.
    """
    scene = read_scene(workspace.sparse_dir)
    selection = select_pairs(scene, PairOptions())
    points, seen, _ = points_in_view(scene)
    check_images(workspace, scene.views)
    with published_folder(folder) as made:
        (made / "cams").mkdir()
        (made / "images").mkdir()
        for number, view in enumerate(scene.views):
            camera = _camera(view, points[seen[number]] if len(seen[number]) else points)
            write_text(made / "cams" / f"{number:08d}_cam.txt", camera)
            _put_image(workspace, view, made, folder, number)
        write_text(made / "pair.txt", _pairs(scene, selection))
        names = "".join(f"{number:08d} {printable(view.name)}\n" for number, view in enumerate(scene.views))
        write_text(made / "names.txt", names)


def _camera(view: View, points: np.ndarray) -> str:
    K = view.resized(*view.file_size).K.copy()
    K[:2, 2] -= 0.5
    depth = (points @ view.R.T + view.t)[:, 2]
    if not (depth > 0).any():
        raise InputError(f"The model has no point in front of the image {view.name}; run COLMAP's mapper again.")
    near, far = np.percentile(depth[depth > 0], _RANGE) * _ROOM
    extrinsic = np.vstack([view.cam_from_world, [0, 0, 0, 1]])
    lines = ["extrinsic", *_rows(extrinsic), "", "intrinsic", *_rows(K), ""]
    step = (far - near) / (_PLANES - 1)
    return "\n".join([*lines, f"{near:.9g} {step:.9g} {_PLANES} {far:.9g}", ""])


def _rows(matrix: np.ndarray) -> list[str]:
    return [" ".join(map(repr, row)) for row in matrix.tolist()]


def _pairs(scene: Scene, selection: PairSelection) -> str:
    lines = [str(len(scene.views))]
    for number, view in enumerate(scene.views):
        partners = selection.partners.get(view.name, ())
        words = [f"{scene.index_of[partner.name]} {partner.shared_points}" for partner in partners]
        lines += [str(number), " ".join([str(len(partners)), *words])]
    return "\n".join([*lines, ""])


def _put_image(workspace: Workspace, view: View, made: Path, folder: Path, number: int) -> None:
    """Link an image by its number, or convert it, where it is no JPEG."""
    source = workspace.image_path(view.name)
    target = made / "images" / f"{number:08d}.jpg"
    if source.suffix.lower() in _JPEG:
        link(target, source, seen_from=folder / "images")
        return
    # Not by OpenCV's own functions of files, which on Windows know names in one alphabet only.
    image = cv2.imdecode(np.fromfile(source, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"The image {source} cannot be read; run `colmap_sph run` on its project again.")
    target.write_bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes())
