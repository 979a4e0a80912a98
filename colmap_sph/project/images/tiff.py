"""The directories of a TIFF file, and of Exif data, which are built like one; checksums of its pixels."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

from colmap_sph.project.images.jpeg import DamagedError

STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

# More directories than any file has; damaged ones go round in circles.
_MAX_DIRECTORIES = 1000
_COMPRESSION = 259
_FILL_ORDER = 266
# Where the strips or tiles are, and how long.
_PARTS = ((273, 279), (324, 325))
_DEFLATE = (8, 32946)
_NUMBERS = {3: "H", 4: "I", 16: "Q"}
_BLOCK_BYTES = 1 << 20


@dataclass(frozen=True)
class Entry:
    """An entry of a directory.

    Attributes
    ----------
    order : str
        Byte order, as for `struct`.
    directory : int
        Which of the file's directories it is in.
    tag, kind, number : int
        What it is, the type of its values, and how many there are.
    place : int
        Where the file has the values, or else where they are, by a number of format `offset`.
    offset : str
    """

    order: str
    directory: int
    tag: int
    kind: int
    number: int
    place: int
    offset: str

    def values(self, data: bytes) -> tuple[int, ...]:
        """Its whole numbers; none where they are of another kind."""
        code = _NUMBERS.get(self.kind)
        if code is None or self.number > len(data):
            return ()
        layout = f"{self.order}{self.number}{code}"
        place = self.place
        if struct.calcsize(layout) > struct.calcsize(self.offset):
            (place,) = struct.unpack_from(self.order + self.offset, data, place)
        return struct.unpack_from(layout, data, place)


def entries(data: bytes) -> Iterator[Entry]:
    """All entries of all directories.

    Raises
    ------
    struct.error
        The file is cut off.
    """
    order = "<" if data.startswith(b"II") else ">"
    (version,) = struct.unpack_from(order + "H", data, 2)
    if version not in (42, 43):
        return
    is_big = version == 43
    count_format, entry_format, offset = ("Q", "HHQ", "Q") if is_big else ("H", "HHI", "I")
    (directory,) = struct.unpack_from(order + offset, data, 8 if is_big else 4)
    seen: list[int] = []
    while directory and directory not in seen and len(seen) < _MAX_DIRECTORIES:
        (count,) = struct.unpack_from(order + count_format, data, directory)
        at = directory + struct.calcsize(order + count_format)
        for _ in range(count):
            tag, kind, number = struct.unpack_from(order + entry_format, data, at)
            place = at + struct.calcsize(order + entry_format)
            yield Entry(order, len(seen), tag, kind, number, place, offset)
            at = place + struct.calcsize(offset)
        seen.append(directory)
        (directory,) = struct.unpack_from(order + offset, data, at)


def check_tiff(data: bytes) -> None:
    """Raise `DamagedError` unless all that is deflated has its checksum: libtiff often stops at the last pixel."""
    found: dict[int, tuple[int, ...]] = {}
    with suppress(struct.error):  # libtiff knows better what is wrong with a directory
        for entry in entries(data):
            if entry.directory:
                break
            found[entry.tag] = entry.values(data)
    if found.get(_COMPRESSION, ())[:1] not in [(kind,) for kind in _DEFLATE] or found.get(_FILL_ORDER) == (2,):
        return
    for places, lengths in _PARTS:
        for start, length in zip(found.get(places, ()), found.get(lengths, ()), strict=False):
            _check_deflated(memoryview(data)[start : start + length])


def _check_deflated(part: memoryview) -> None:
    stream = zlib.decompressobj()
    try:
        while part and not stream.eof:
            stream.decompress(part, _BLOCK_BYTES)
            part = memoryview(stream.unconsumed_tail)
    except zlib.error as error:
        raise DamagedError(str(error).split(": ")[-1]) from None
