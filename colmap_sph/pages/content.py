"""What a page tells, gathered: the records that its parts are drawn from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_sph.pages.block_map import Frame, Ground
from colmap_sph.pages.image_facts import ImageFacts
from colmap_sph.pages.pair_facts import PairFacts
from colmap_sph.pages.products import ProductFile, ProductPicture
from colmap_sph.pages.run_facts import RunFacts
from colmap_sph.pages.small_cloud import SmallCloud
from colmap_sph.project.workspace import Workspace
from colmap_sph.scene import Photograph, Scene


@dataclass(frozen=True, eq=False)
class CloudSample:
    """Some points of the cloud.

    Attributes
    ----------
    points : (n, 3) float64 ndarray
        The scene's frame.
    colours : (n, 3) uint8 ndarray
    total : int
        Points of the whole cloud.
    lack : str
        Why there are none.
    doubt : str
        Why they may not be of the maps that are shown.
    is_of_others : bool
        Whether the cloud is left out as it is not of the maps that are shown.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    total: int
    lack: str
    doubt: str = ""
    is_of_others: bool = False


@dataclass(frozen=True, eq=False)
class CloudDrawing:
    """What a cloud with points looks like.

    Attributes
    ----------
    small : SmallCloud
        Along the axes of the map.
    colours, heights : str
        Pictures of it from above, as URIs.
    height_ends : (float, float)
        Least and largest height of the scale, relative to the least.
    """

    small: SmallCloud
    colours: str
    heights: str
    height_ends: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Content:
    """What a page tells.

    Attributes
    ----------
    workspace : Workspace
    scene : Scene
    run : RunFacts or None
        None where no run has come to its end.
    photographs : list of Photograph
        By their names.
    images : list of ImageFacts
        Of the photographs, in their order.
    pairs : list of PairFacts
    cloud : CloudSample
    drawing : CloudDrawing or None
        Of the cloud; None where that has no points.
    frame : Frame
    ground : Ground
    missing : str
        What is missing of a finished run.
    products : list of ProductFile
    product_pictures : list of ProductPicture
    """

    workspace: Workspace
    scene: Scene
    run: RunFacts | None
    photographs: list[Photograph]
    images: list[ImageFacts]
    pairs: list[PairFacts]
    cloud: CloudSample
    drawing: CloudDrawing | None
    frame: Frame
    ground: Ground
    missing: str
    products: list[ProductFile]
    product_pictures: list[ProductPicture]
