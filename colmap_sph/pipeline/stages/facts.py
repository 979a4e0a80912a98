"""What the stages know of a result without reading it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Facts:
    """What is known of a result without reading it.

    Attributes
    ----------
    coverage : float
        Share of pixels with a depth, 0 to 1, where the stage makes maps.
    points : int
        Points of the cloud, where the stage makes them.
    """

    coverage: float = 0.0
    points: int = 0
