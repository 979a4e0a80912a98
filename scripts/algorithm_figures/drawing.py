"""How all figures look, and their files: PNGs of few colours."""

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

matplotlib.use("Agg")
from matplotlib import pyplot as plt

_DPI = 100
_COLOURS = 160

plt.rcParams.update(
    {
        "font.size": 9,
        "axes.titlesize": 9.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "image.interpolation": "nearest",
    }
)

LINES = ("#e41a1c", "#ffd21f", "#35b8f0", "#ff7f0e", "#e377c2")
"""Colours for rows and epipolar lines, seen on green and grey."""


def save(figure: Any, path: Path) -> None:
    """Write a figure with a palette, which no reader tells from the full colours."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=_DPI, facecolor="white", metadata={"Software": None})
    plt.close(figure)
    picture = Image.open(buffer).convert("RGB")
    # Of the methods, this one keeps lines and marks of few pixels in their colours.
    few = picture.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)
    print(f"{path}: {picture.width} x {picture.height}, {path.stat().st_size / 1024:.0f} KiB", flush=True)


def show(axes: Any, picture: NDArray[Any], title: str = "", **style: Any) -> Any:
    """Draw an image without ticks."""
    drawn = axes.imshow(picture, **style)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return drawn


def masked(values: NDArray[Any], kept: NDArray[np.bool_]) -> Any:
    """Values where they are `kept`, white elsewhere."""
    return np.ma.masked_array(values, ~kept)


def faded(picture: NDArray[np.uint8], strength: float = 0.5) -> NDArray[np.uint8]:
    """A pale grey copy, to draw on."""
    grey = picture.mean(axis=-1) if picture.ndim == 3 else picture
    pale = 255 - strength * (255 - grey)
    return np.repeat(pale[..., None], 3, axis=-1).astype(np.uint8)
