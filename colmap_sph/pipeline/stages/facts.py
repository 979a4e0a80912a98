"""What the stages know of a result without reading it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from colmap_sph.stereo.agreement import Agreement


@dataclass(frozen=True)
class Facts:
    """What is known of a result without reading it.

    Attributes
    ----------
    coverage : float
        Share of pixels with a depth, 0 to 1, where the stage makes maps.
    agreement : Agreement
        How far the depth map agrees with the sparse points, where the stage makes geometric maps.
    points : int
        Points of the cloud, where the stage makes them.
    unread : mapping of str to str
        Image name → why what the result should have been made of could not be read. The result is not complete
        then, and no record vouches for it.
    """

    coverage: float = 0.0
    agreement: Agreement = field(default_factory=Agreement)
    points: int = 0
    unread: Mapping[str, str] = field(default_factory=dict)
