"""Images of more than 8 bits: which of their values become black and white.

A thermal camera's 500 counts are 2 of 256 grey values. COLMAP cuts images to these, so all images of a project are
stretched alike before: one range of values for all of a kind, so that the same temperature has the same grey.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from colmap_sph.project.images.decoding import read_header, read_pixels, unreadable
from colmap_sph.project.images.jpeg import DamagedError

# Largest value of each kind of number: white, where nothing is stretched.
_WHITE = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}
_KIND_NAMES = {"uint16": "16-bit", "float32": "floating-point"}
# An image is described by so many quantiles, of at most so many of its values.
_QUANTILES = 256
_SAMPLES = 1 << 20
# Values beyond these quantiles may be dead and hot pixels.
_ENDS = (0.001, 0.999)
# Images that use this part of their range are left as they are; alone, those that use this part.
_SENSIBLE_PART = 0.5
_NARROW_PART = 0.125


@dataclass(frozen=True)
class ValueRange:
    """Values, as the file has them, that become black and white."""

    low: float
    high: float


@dataclass(frozen=True)
class ValueSample:
    """What there is in an image of more than 8 bits.

    Attributes
    ----------
    kind : str
        Only images of one kind have values that mean the same: such as "16-bit grey".
    quantiles : tuple of float
        Its values at evenly spaced ranks.
    """

    kind: Annotated[str, Meta(pattern="^(16-bit|floating-point) (grey|colour)$")]
    quantiles: Annotated[tuple[float, ...], Meta(max_length=_QUANTILES)]


def sample_values(path: Path) -> ValueSample | None:
    """Describe the values of an image; None where it has no more than 8 bits.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    try:
        header = read_header(path)
        if not header.is_deep:
            return None
        pixels = read_pixels(path)
    except (OSError, DamagedError) as error:
        raise unreadable(path, error) from error
    colours = "grey" if header.channels == 1 else "colour"
    return ValueSample(f"{_KIND_NAMES[header.dtype]} {colours}", tuple(map(float, _quantiles(pixels))))


def common_ranges(samples: Iterable[ValueSample | None]) -> dict[str, ValueRange]:
    """The range of values, of each kind of images, that is to become black to white.

    Parameters
    ----------
    samples : iterable of ValueSample or None
        Those of all images of a project; None for images of 8 bits.

    Returns
    -------
    dict of str to ValueRange
        By `ValueSample.kind`. Images that use half of what their numbers can hold keep their values. Ends are
        rounded outwards, so that one more image hardly ever changes them.
    """
    by_kind: dict[str, list[float]] = {}
    for sample in samples:
        if sample is not None:
            by_kind.setdefault(sample.kind, []).extend(sample.quantiles)
    return {
        kind: _range_of(np.array(values), _white_of(kind), _SENSIBLE_PART, whole=True)
        for kind, values in sorted(by_kind.items())
    }


def describe_ranges(ranges: Mapping[str, ValueRange]) -> list[str]:
    """A sentence for each kind of images that is stretched."""
    return [
        f"{kind} images: values {found.low:g}..{found.high:g} are stretched to the full range"
        for kind, found in ranges.items()
        if found != ValueRange(0, _white_of(kind))
    ]


def narrow_range(pixels: NDArray[Any]) -> ValueRange | None:
    """What to stretch of an image that nobody has stretched before, if it needs it badly."""
    white = _WHITE[pixels.dtype.name]
    if pixels.dtype == np.uint8:
        return None
    found = _range_of(_quantiles(pixels), white, _NARROW_PART, whole=False)
    return None if found == ValueRange(0, white) else found


def stretched(pixels: NDArray[Any], values: ValueRange | None = None) -> NDArray[np.float32]:
    """Values of a range, else all that their kind of number can hold, → 0..1; what lies beyond is cut off."""
    values = values or ValueRange(0, _WHITE[pixels.dtype.name])
    scaled = pixels.astype(np.float32)
    scaled -= np.float32(values.low)
    scaled /= np.float32(values.high - values.low)
    np.nan_to_num(scaled, copy=False, nan=0.0)
    return np.clip(scaled, 0, 1, out=scaled)


def _white_of(kind: str) -> float:
    return next(_WHITE[dtype] for dtype, name in _KIND_NAMES.items() if kind.startswith(name))


def _quantiles(pixels: NDArray[Any]) -> NDArray[np.float64]:
    """Quantiles of an image's values, without those which mean that there is none.

    These are no number, zero, and the largest 16-bit number: nothing is seen in what is saturated.
    """
    # An odd step, so that not a few columns stand for all.
    step = max(1, pixels.size // _SAMPLES) | 1
    values = pixels.reshape(-1)[::step]
    values = values[np.isfinite(values) & (values != 0)]
    if pixels.dtype == np.uint16:
        values = values[values != _WHITE["uint16"]]
    if not values.size:
        return np.empty(0)
    ranks = (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    return np.asarray(np.quantile(values.astype(np.float64), ranks))


def _range_of(values: NDArray[np.float64], white: float, enough: float, *, whole: bool) -> ValueRange:
    """The range of some values, or from 0 to white, where they use enough of that, and, if `whole`, no more."""
    usual = ValueRange(0, white)
    if not values.size:
        return usual
    low, high = map(float, np.quantile(values, _ENDS))
    used = min(high, white) - max(low, 0)
    inside = low >= 0 and high <= white
    if high == low or (used >= enough * white and (inside or not whole)):
        return usual
    margin = (high - low) / 32
    low -= margin
    high += margin
    step = 2.0 ** np.floor(np.log2(margin))
    return ValueRange(float(np.floor(low / step) * step), float(np.ceil(high / step) * step))
