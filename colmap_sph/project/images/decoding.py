"""Image files → pixels as COLMAP sees them: the raster as it is stored, with whatever tag to turn it.

COLMAP reads with OpenImageIO, and takes an image that is damaged without a word. So do we, but for the words.
JPEG, where OpenImageIO does not pass on what libjpeg warns of, is decoded by libjpeg itself, to the same bytes.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio  # noqa: N813
from numpy.typing import NDArray

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.images import jpeg, tiff
from colmap_sph.project.images.jpeg import DamagedError

# The kinds that COLMAP's library surely reads; it has others, of which some end the process.
_FORMATS = {"bmp", "dpx", "hdr", "jpeg", "openexr", "png", "pnm", "sgi", "targa", "tiff"}
_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
# Its first chunk: length, kind, width, height, bits, kind of colours, compression, filter, interlacing, checksum.
_PNG_HEADER = struct.Struct(">I4sIIBB3xI")
_PNG_GREY = (0, 4)
# Of what phones write: a box of this kind behind its length, then the file's brands, the second of them a number.
# They tell what an image or a sequence of them is coded in (ISO/IEC 23008-12, AV1 Image File Format), or not even
# that.
_HEIF_BOX = b"ftyp"
_HEIF_BYTES = 256
_HEIF_KINDS = {
    "AVIF": {b"avif", b"avis"},
    "HEIC": {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs"},
    "HEIF": {b"mif1", b"msf1", b"mif2"},
}
# Headers with a preview and profiles of colour are mostly shorter.
_JPEG_HEADER_BYTES = 1 << 17
# COLMAP leaves out the last channel of two or four: transparency.
_COLOUR_CHANNELS = {1: 1, 2: 1, 3: 3, 4: 3}

# `Header.dtype` as OpenImageIO calls it.
_LIBRARY_TYPES = {"uint8": "uint8", "uint16": "uint16", "float32": "float"}

# Worker threads decode an image each.
oiio.attribute("threads", 1)
oiio.attribute("exr_threads", -1)


class UnsupportedError(DamagedError):
    """The file is whole, but of a kind that is not read; the message names the kind."""


@dataclass(frozen=True)
class Header:
    """What an image file says of itself.

    Attributes
    ----------
    width, height : int
        Of the raster as it is stored.
    channels : int
        1 or 3: grey or colours, without transparency.
    dtype : str
        "uint8", "uint16", or "float32" for all else, where 0 is black and 1 is white.
    """

    width: int
    height: int
    channels: int
    dtype: str

    @property
    def is_deep(self) -> bool:
        """Whether it has more than 8 bits."""
        return self.dtype != "uint8"


def check_end(path: Path) -> None:
    """Raise `OSError` where a PNG or OpenEXR image that OpenImageIO has just written is cut off.

    The library does not notice when a disk is full for the last of its bytes.
    """
    if path.suffix == ".png":
        is_whole = path.read_bytes().endswith(_PNG_END)
    else:
        image = oiio.ImageInput.open(str(path))
        is_whole = image is not None and _last_row(image) is not None
        oiio.geterror()  # which is kept otherwise, and printed at the end
    if not is_whole:
        raise OSError("the file is cut off")


def _last_row(image: oiio.ImageInput) -> NDArray[Any] | None:
    spec = image.spec()
    row: NDArray[Any] | None = image.read_scanlines(
        0, 0, spec.height - 1, spec.height, 0, 0, spec.nchannels, "float"
    )
    return row


def is_jpeg(path: Path) -> bool:
    """Whether a file holds a JPEG image, whatever its name."""
    return _starts_with(path, jpeg.START)


def jpeg_step(path: Path) -> int:
    """See `jpeg.rounding_step`; 1 for files that are no JPEG images.

    Raises
    ------
    OSError
        It cannot be read.
    """
    if not is_jpeg(path):
        return 1
    with path.open("rb") as file:
        return jpeg.rounding_step(file.read(_JPEG_HEADER_BYTES))


def read_header(path: Path) -> Header:
    """Read what an image file says of itself; nothing is decoded.

    Raises
    ------
    UnsupportedError
        It is an image of a kind that COLMAP does not read.
    DamagedError
        It is no image, or damaged.
    OSError
        It cannot be read.
    """
    if is_jpeg(path) and (found := _jpeg_size(path)) is not None:
        width, height, space = found
        return Header(width, height, 1 if space == "Gray" else 3, "uint8")
    if _starts_with(path, _PNG_START):
        return _png_header(path)
    with _opened(path) as image:
        return _header(image)


def read_pixels(path: Path, *, deep: bool = True) -> NDArray[Any]:
    """Read all pixels of an image.

    Parameters
    ----------
    path : Path
        A regular file, of a size that the caller has compared with what it should be.
    deep : bool
        At the depth of the file; otherwise cut to 8 bits, as COLMAP does.

    Returns
    -------
    (H, W, 1 or 3) uint8, uint16 or float32 ndarray
        Grey, or red, green and blue; as `Header.dtype` says.

    Raises
    ------
    DamagedError
        The decoder has something to say.
    OSError
        It cannot be read.
    """
    if is_jpeg(path):
        data = path.read_bytes()
        found = jpeg.jpeg_size(data)
        if found is not None and found[2] in ("CMYK", "YCCK"):
            jpeg.decode_jpeg(data, "CMYK")  # for its warnings: COLMAP's way to colours is OpenImageIO's
        elif found is not None:
            pixels = jpeg.decode_jpeg(data, "GRAY" if found[2] == "Gray" else "BGR")
            return pixels[..., ::-1]
    if _starts_with(path, _PNG_START):
        _check_png(path.read_bytes())
    elif any(_starts_with(path, start) for start in tiff.STARTS):
        tiff.check_tiff(path.read_bytes())
    with _opened(path) as image:
        header = _header(image)
        pixels = image.read_image(0, 0, 0, header.channels, _LIBRARY_TYPES[header.dtype if deep else "uint8"])
        if pixels is None or image.has_error:
            raise DamagedError(_in_short(image.geterror(), path))
    return np.asarray(pixels).reshape(header.height, header.width, header.channels)


def unreadable(path: Path, error: Exception, remedy: str = "mend or remove it") -> InputError:
    """What is said of an image whose header or pixels cannot be read, with what to do."""
    return InputError(f"{path} cannot be read as an image ({reason_of(error)}); {remedy}.")


def date_of(path: Path) -> str:
    """The date that an image file holds, as 2001:02:03 04:05:06; empty where it holds none, or cannot be read."""
    try:
        with _opened(path) as image:
            return str(image.spec().getattribute("DateTime") or "")
    except (OSError, DamagedError):
        return ""


def _jpeg_size(path: Path) -> tuple[int, int, str] | None:
    """As `jpeg.jpeg_size`; of a file whose header ends soon the rest is not read."""
    with path.open("rb") as file:
        start = file.read(_JPEG_HEADER_BYTES)
        return jpeg.jpeg_size(start) or jpeg.jpeg_size(start + file.read())


def _starts_with(path: Path, start: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(start)) == start


def _heif_kind(path: Path) -> str | None:
    """What a file of phones is called that OpenImageIO does not know; None: it is none."""
    with path.open("rb") as file:
        start = file.read(_HEIF_BYTES)
    if start[4:8] != _HEIF_BOX:
        return None
    end = int.from_bytes(start[:4], "big")
    brands = {start[place : place + 4] for place in (8, *range(16, min(end, len(start)), 4))}
    return next((kind for kind, known in _HEIF_KINDS.items() if brands & known), None)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    # As COLMAP does.
    config = oiio.ImageSpec()
    config.attribute("oiio:reorient", 0)
    config.attribute("oiio:UnassociatedAlpha", 1)
    try:
        image = oiio.ImageInput.open(str(path), config)
    except (UnicodeError, TypeError):
        raise DamagedError("its name is not UTF-8") from None
    if image is None:
        message = oiio.geterror()
        if (kind := _heif_kind(path)) is not None:
            raise UnsupportedError(f"{kind} files are not read")
        raise DamagedError(_in_short(message, path))
    try:
        yield image
    finally:
        image.close()


def _header(image: Any) -> Header:
    spec = image.spec()
    if image.format_name() not in _FORMATS:
        raise UnsupportedError(f"{image.format_name()} files are not read")
    if spec.deep or spec.depth > 1 or spec.nchannels not in _COLOUR_CHANNELS:
        raise UnsupportedError(f"images of {spec.nchannels} channels are not read")
    stored = str(spec.format)
    dtype = {"uint8": "uint8", "int8": "uint8", "uint16": "uint16"}.get(stored, "float32")
    return Header(spec.width, spec.height, _COLOUR_CHANNELS[spec.nchannels], dtype)


def _in_short(message: str, path: Path) -> str:
    """The first line of a library's message, without the name of the file."""
    lines = [line for line in message.replace(f'"{path}"', "").replace(str(path), "").splitlines() if line.strip()]
    if not lines or "could not find a format reader" in lines[0]:
        return "no known kind of image"
    return " ".join(lines[0].split()).rstrip(".")


def _png_header(path: Path) -> Header:
    # Not by libpng, which writes what it finds wrong to the terminal.
    with path.open("rb") as file:
        data = file.read(len(_PNG_START) + _PNG_HEADER.size)
    if len(data) < len(_PNG_START) + _PNG_HEADER.size:
        raise DamagedError("the file is cut off")
    length, kind, width, height, bits, colours, crc = _PNG_HEADER.unpack_from(data, len(_PNG_START))
    if (length, kind) != (13, b"IHDR") or crc != zlib.crc32(data[12:-4]):
        raise DamagedError("IHDR: CRC error")
    return Header(width, height, 1 if colours in _PNG_GREY else 3, "uint16" if bits == 16 else "uint8")


def _check_png(data: bytes) -> None:
    """Raise `DamagedError` unless all chunks that matter are whole: libpng stops at the last pixel."""
    for kind, start, end in png_chunks(data):
        (crc,) = struct.unpack_from(">I", data, end - 4)
        if kind[:1].isupper() and zlib.crc32(memoryview(data)[start + 4 : end - 4]) != crc:
            raise DamagedError(f"{kind.decode('latin-1')}: CRC error")


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, begin and end of each chunk of a PNG file, length and checksum included.

    Raises
    ------
    DamagedError
        The file is cut off.
    """
    kind = b""
    end = len(_PNG_START)
    while kind != b"IEND":
        start = end
        kind = data[start + 4 : start + 8]
        end = start + 12 + int.from_bytes(data[start : start + 4], "big")
        if end > len(data) or len(kind) < 4:
            raise DamagedError("the file is cut off")
        yield kind, start, end
