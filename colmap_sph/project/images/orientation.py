"""A copy of an image file without the tag by which programs turn it; its pixels stay as they are stored.

COLMAP ignores the tag, and OpenCV, OpenMVS and viewers obey it: a workspace's images must have none. It is in a
TIFF file itself, in the Exif data of JPEG and PNG files, which are built like a TIFF file, and in XMP.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from colmap_sph.errors import InputError, reason_of
from colmap_sph.project.files import atomic_file, make_dir
from colmap_sph.project.images import jpeg
from colmap_sph.project.images.decoding import png_chunks
from colmap_sph.project.images.jpeg import DamagedError
from colmap_sph.project.images.tiff import entries

# A part of a file, by its begin and end, and what comes in its place.
Edit = tuple[int, int, bytes]

_ORIENTATION = 274
_XMP = 700
_EXIF_START = b"Exif\0\0"
_APP1 = 0xE1
_XMP_ORIENTATION = re.compile(rb"tiff:Orientation\s*(?:=\s*[\"']|>)\s*([2-9])")
_XMP_KEYWORD = b"XML:com.adobe.xmp\0"
# Text chunks in which ImageMagick keeps Exif and XMP, in hexadecimal.
_RAW_PROFILE = re.compile(rb"Raw profile type (?:exif|APP1|xmp)\0", re.IGNORECASE)


def copy_without_orientation(source: Path, target: Path) -> None:
    """Copy an image file, all but its orientation.

    Parameters
    ----------
    source, target : Path
        May be the same.

    Raises
    ------
    InputError
        `source` cannot be read.
    OutputError
        `target` cannot be written.
    """
    try:
        data = source.read_bytes()
    except OSError as error:
        raise InputError(f"{source} cannot be read ({reason_of(error)}); mend or remove it.") from error
    make_dir(target.parent)
    with atomic_file(target) as file, memoryview(data) as view:
        done = 0
        for start, end, instead in sorted(orientation_edits(data)):
            file.write(view[done:start])
            file.write(instead)
            done = end
        file.write(view[done:])


def orientation_edits(data: bytes) -> list[Edit]:
    """What to change in an image file so that nothing in it says how to turn it."""
    finders: dict[bytes, Callable[[bytes], Iterator[Edit]]] = {
        jpeg.START: _in_jpeg,
        b"\x89PNG": _in_png,
        b"II": _in_tiff,
        b"MM": _in_tiff,
    }
    edits: list[Edit] = []
    for start, find in finders.items():
        if data.startswith(start):
            # Metadata that makes no sense says nothing to others either.
            with suppress(IndexError, struct.error, DamagedError):
                edits.extend(find(data))
    return edits


def _in_jpeg(data: bytes) -> Iterator[Edit]:
    for marker, start, end in jpeg.header_segments(data):
        if marker == _APP1:
            yield from _in_metadata(data, start + 4, end)


def _in_png(data: bytes) -> Iterator[Edit]:
    for kind, start, end in png_chunks(data):
        body = data[start + 8 : end - 4]
        is_text = kind in (b"tEXt", b"zTXt", b"iTXt")
        compressed_xmp = kind == b"iTXt" and body.startswith(_XMP_KEYWORD + b"\1")
        if compressed_xmp or (is_text and _RAW_PROFILE.match(body)):
            yield start, end, b""
        elif kind == b"eXIf" or body.startswith(_XMP_KEYWORD):
            changed = bytearray(body)
            for first, last, instead in _in_metadata(body, 0, len(body)):
                changed[first:last] = instead
            checksum = zlib.crc32(kind + changed).to_bytes(4, "big")
            yield start + 8, end, bytes(changed) + checksum


def _in_metadata(data: bytes, start: int, end: int) -> Iterator[Edit]:
    """In Exif, with or without its heading, or else in XMP."""
    body = data[start:end]
    heading = len(_EXIF_START) if body.startswith(_EXIF_START) else 0
    if body[heading : heading + 2] in (b"II", b"MM"):
        first = start + heading
        yield from ((first + a, first + b, instead) for a, b, instead in _in_tiff(body[heading:]))
    else:
        yield from _in_xmp(body, start)


def _in_xmp(body: bytes, start: int) -> Iterator[Edit]:
    for found in _XMP_ORIENTATION.finditer(body):
        yield start + found.start(1), start + found.end(1), b"1"


def _in_tiff(data: bytes) -> Iterator[Edit]:
    for entry in entries(data):
        if entry.tag == _ORIENTATION:
            # One short number, or, by odd writers, a long one.
            one = struct.pack(entry.order + ("H" if entry.kind == 3 else "I"), 1)
            yield entry.place, entry.place + len(one), one
        if entry.tag == _XMP:
            (place,) = struct.unpack_from(entry.order + entry.offset, data, entry.place)
            yield from _in_xmp(data[place : place + entry.number], place)
