"""A JPEG file's bytes → its pixels, or what is wrong with them.

libjpeg mends what it can and merely warns. Here a warning is an error, but for those that say nothing of pixels:
cameras write odd versions, odd scan parameters, rubbish between the header's parts, and padding behind the image.
"""

import re
import struct
from collections.abc import Iterator
from typing import Literal

import numpy as np
import simplejpeg
from numpy.typing import NDArray

START = b"\xff\xd8"
_END = b"\xff\xd9"
_FILL = 0xFF
_SCAN = 0xDA
_JFIF = 0xE0
_SEQUENTIAL_FRAMES = (0xC0, 0xC1)
_TABLES = 0xDB
# Entries of a table, in bytes: of 8 or 16 bits each.
_TABLE_BYTES = (64, 128)
# Markers without a length: TEM, and RST0 to RST7.
_BARE = frozenset((0x01, *range(0xD0, 0xD8)))
# Bytes alike that the decoder may have taken before the padding it found: what it reads ahead.
_RUN_ON = 16
_LEFT_BEFORE_END = re.compile(r"(\d+) extraneous bytes before marker 0xd9")


class DamagedError(ValueError):
    """A file's pixels are not there, or not right; the message says why in a few words."""


def jpeg_size(data: bytes) -> tuple[int, int, str] | None:
    """(width, height, colour space) as the header says; None for a kind of JPEG that is read otherwise."""
    try:
        height, width, space, _ = simplejpeg.decode_jpeg_header(data, strict=False)
    except (ValueError, KeyError):
        return None
    return width, height, space


def decode_jpeg(data: bytes, space: Literal["GRAY", "BGR", "CMYK"]) -> NDArray[np.uint8]:
    """Decode a JPEG image.

    Parameters
    ----------
    data : bytes
    space : str
        What its colours become; "CMYK" for those that are stored so.

    Returns
    -------
    (H, W, C) uint8 ndarray

    Raises
    ------
    DamagedError
        libjpeg warns that pixels are missing or wrong.
    """
    try:
        return np.asarray(simplejpeg.decode_jpeg(data, space))
    except ValueError as error:
        message = str(error)
    try:
        # libjpeg tells its first warning only: a harmless one must not hide another.
        tidy, scan = _tidied(data)
        return np.asarray(simplejpeg.decode_jpeg(tidy, space))
    except (IndexError, struct.error):
        raise DamagedError(message) from None
    except ValueError as error:
        message = str(error)
    if not _is_padding(message, tidy, scan):
        raise DamagedError(message)
    return np.asarray(simplejpeg.decode_jpeg(tidy, space, strict=False))


def decode_small(data: bytes, longest: int) -> NDArray[np.uint8]:
    """Decode a JPEG image at the least of libjpeg's scales whose longest side has `longest` pixels.

    What is missing of a damaged image is grey.

    Returns
    -------
    (H, W, 3) uint8 ndarray
        Blue, green and red.

    Raises
    ------
    DamagedError
        Nothing of it can be decoded.
    """
    try:
        height, width, *_ = simplejpeg.decode_jpeg_header(data, strict=False)
        is_upright = height > width
        side = min(longest, max(height, width))
        sides = {"min_height": side} if is_upright else {"min_width": side}
        return np.asarray(simplejpeg.decode_jpeg(data, "BGR", fastdct=True, strict=False, min_factor=1, **sides))
    except ValueError as error:
        raise DamagedError(str(error)) from None


def rounding_step(data: bytes) -> int:
    """To what multiples of it the brightness of each block was rounded: an eighth of it in grey values.

    Parameters
    ----------
    data : bytes
        A JPEG file, or more than its header.

    Returns
    -------
    int
        The first entry of its first quantization table (ITU-T T.81, B.2.4.1), which is that of the brightness in
        all but odd files; 1 where there is none.
    """
    try:
        for marker, start, end in header_segments(data):
            at = start + 4
            while marker == _TABLES and at < end:
                wide, number = divmod(data[at], 16)
                step = int.from_bytes(data[at + 1 : at + 2 + wide], "big")
                if number == 0:
                    return max(step, 1)
                at += 1 + _TABLE_BYTES[wide]
    except (IndexError, struct.error):
        pass  # the header is cut off
    return 1


def header_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Markers with the begin and end of their segments, up to the first scan's, whose pixels follow.

    Raises
    ------
    IndexError, struct.error
        The header is cut off.
    """
    marker = 0
    at = len(START)
    while marker != _SCAN:
        while data[at] != _FILL or data[at + 1] in (0, _FILL):
            at += 1
        marker = data[at + 1]
        end = at + 2
        if marker not in _BARE:
            end += int(struct.unpack_from(">H", data, end)[0])
            yield marker, at, end
        at = end


def _tidied(data: bytes) -> tuple[bytes, int]:
    """The same image with a header that libjpeg does not warn of, and where its first scan begins."""
    parts = [bytearray(START)]
    sequential = False
    for marker, start, end in header_segments(data):
        segment = bytearray(data[start:end])
        sequential |= marker in _SEQUENTIAL_FRAMES
        if marker == _JFIF and segment[4:9] == b"JFIF\0":
            segment[9] = 1  # the major version
        if marker == _SCAN and sequential:
            segment[-3:] = 0, 63, 0  # all coefficients at once, as libjpeg takes it anyway
        parts.append(segment)
        last = end
    header = b"".join(parts)
    return header + data[last:], len(header)


def _is_padding(message: str, data: bytes, scan: int) -> bool:
    """Whether what a decoder found left over, when it had all pixels, was put there to fill.

    After damage the decoder is out of step: it either lacks data, or has some left, of all kinds. A decoder that
    ran on zeros where data was lost has some of them left, and has taken others for pixels before.
    """
    found = _LEFT_BEFORE_END.search(message)
    if found is None:
        return False
    end = data.find(_END, scan)
    while data[end - 1] == _FILL:  # fill bytes of the marker, which are not counted
        end -= 1
    start = end - int(found[1])
    unit = data[start : start + 2]
    filled = data[start:end] in (unit[:1] * (end - start), unit * ((end - start) // 2))
    before = data[start - _RUN_ON : start]
    return filled and before not in (unit[:1] * _RUN_ON, unit * (_RUN_ON // 2))
