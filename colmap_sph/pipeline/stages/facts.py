"""What the stages know of a result without reading it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

# Fewer sparse points say nothing of an image, and fewer with a depth nothing of how right that is.
_FEWEST = 10
_FEWEST_FOUND = 30


@dataclass(frozen=True)
class Agreement:
    """How far a view's depth map agrees with its sparse points.

    Attributes
    ----------
    tested : int
        Sparse points in the view's sight, and seen by others under enough parallax to tell their depth.
    found : int
        Those of them with a depth in the map.
    agreeing : int
        Those of them whose depth agrees.
    """

    tested: int = 0
    found: int = 0
    agreeing: int = 0

    def __add__(self, other: "Agreement") -> "Agreement":
        return Agreement(self.tested + other.tested, self.found + other.found, self.agreeing + other.agreeing)

    @property
    def share(self) -> float | None:
        """Agreeing points of those tested (without a depth none agrees); None where these are fewer than ten."""
        return self.agreeing / self.tested if self.tested >= _FEWEST else None

    @property
    def share_of_found(self) -> float | None:
        """Agreeing points of those that have a depth; None where these are fewer than thirty."""
        return self.agreeing / self.found if self.found >= _FEWEST_FOUND else None


@dataclass(frozen=True)
class Polish:
    """What polishing the poses of a model came to.

    Attributes
    ----------
    words : str
        What was done or why not, in sentences.
    is_polished : bool
        Whether the workspace's model is the polished one.
    movement : mapping of str to float
        Image name → how far its points moved in it, pixels (median); empty where nothing moved.
    advice : str
        What would help more, in sentences.
    is_refined : bool
        Whether a model with refined cameras was left in the workspace.
    """

    words: str
    is_polished: bool = False
    movement: Mapping[str, float] = field(default_factory=dict)
    advice: str = ""
    is_refined: bool = False


@dataclass(frozen=True)
class Facts:
    """What is known of a result without reading it.

    Attributes
    ----------
    coverage : float
        Share of pixels with a depth, 0 to 1, where the stage makes maps: of those that show the region, if one is
        asked for.
    in_region : float
        Share of pixels that show it; 1 without a region.
    agreement : Agreement
        How far the depth map agrees with the sparse points, where the stage makes geometric maps.
    points : int
        Points of the cloud, where the stage makes them.
    unread : mapping of str to str
        Image name → why what the result should have been made of could not be read. The result is not complete
        then, and no record vouches for it.
    row_residual : float or None
        Of a pair: how far rows of its rectified images disagree, radians (see `ties`); None where too few ties
        tell.
    polish : Polish or None
        Where the stage polishes poses.
    """

    coverage: float = 0.0
    in_region: float = 1.0
    agreement: Agreement = field(default_factory=Agreement)
    points: int = 0
    unread: Mapping[str, str] = field(default_factory=dict)
    row_residual: float | None = None
    polish: Polish | None = None

    @staticmethod
    def of_map(found: int, pixels: int, shown: int | None) -> "Facts":
        """Of a map of so many pixels and depths; `shown` pixels show the region, where one is asked for."""
        wanted = pixels if shown is None else shown
        return Facts(found / max(wanted, 1), wanted / pixels)
