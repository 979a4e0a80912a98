"""How coarsely JPEG has rounded an image of a workspace: a copy in another format does not say."""

from dataclasses import dataclass
from pathlib import Path

from colmap_sph.project.images.decoding import jpeg_step
from colmap_sph.project.state.records import recorded_facts


@dataclass(frozen=True)
class Rounding:
    """What the record of an undistorted image keeps of its original, see `jpeg_step`."""

    jpeg_step: int = 1


def rounding_of_original(source: Path) -> Rounding:
    """What is to be kept of an original; `OSError` where it cannot be read."""
    return Rounding(jpeg_step(source))


def coarsest_jpeg_step(image: Path, record: Path) -> int:
    """The step of an image of a workspace, or of the original that it was made of where that is larger.

    Parameters
    ----------
    image, record : Path
        Its file, and the record of its undistortion, if there is one.

    Raises
    ------
    OSError
        The image cannot be read.
    """
    made = recorded_facts(record, Rounding)
    return max(jpeg_step(image), made.jpeg_step if made is not None else 1)
