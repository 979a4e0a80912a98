"""LAS and LAZ files → points and coordinate system, by laspy, once their header is known to fit the file.

laspy and its decompressor trust the header: 2³² records of variable length keep them busy for hours, and a table
of chunks that does not fit may end the process.
"""

from __future__ import annotations

import importlib
import logging
import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from colmap_sph.errors import counted
from colmap_sph.evaluation.neighbours import Points

logger = logging.getLogger(__name__)

_CHUNK_BYTES = 64 << 20
_HEADER_BYTES = 375
_SHORTEST_HEADER = 227
_RECORD_HEADER_BYTES = 54
_EXTENDED_HEADER_BYTES = 60
_COMPRESSED = 0x80
# Of the point formats 0 to 10.
_POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
_LASZIP = (b"laszip encoded", 22204)
_LASZIP_BYTES = 34
# Layers that a chunk has of each item of the point formats 6 to 10, by the item's kind; of extra bytes one each.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES = 14

# Classes of LAS: low point and high noise.
_NOISE = (7, 18)
_WKT_PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS")
_WKT_GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEODCRS", "GEOGRAPHICCRS")
_GEOTIFF_MODEL_TYPE = 1024
_GEOTIFF_PROJECTED = 1
_GEOTIFF_GEOGRAPHIC = 2
_GEOTIFF_PROJECTED_CODE = 3072


def read_las(path: Path, laspy: Any) -> tuple[Points, str | None]:
    """Read a cloud.

    Parameters
    ----------
    path : Path
        A regular file.
    laspy : module

    Returns
    -------
    points : (N, 3) float64 ndarray
        Without those that are marked as withheld or as noise, which is warned of.
    crs : str or None
        The coordinate system as 'projected (NAME)' or 'geographic (NAME)'; None without one.

    Raises
    ------
    ValueError, struct.error
        The header does not fit the file, or points are missing; the text says why.
    Exception
        Whatever laspy and its decompressor raise at damaged points.
    """
    with path.open("rb") as file:
        point_bytes = _check(file)
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
        count = reader.header.point_count
        chunks = list(map(_places, reader.chunk_iterator(max(1, _CHUNK_BYTES // point_bytes))))
        crs = _las_crs(reader.header)
    points = np.concatenate([places for places, _ in chunks]) if chunks else np.empty((0, 3))
    if len(points) != count:
        raise ValueError(f"its header states {counted(count, 'point')}, it has {len(points)}")
    kept = np.concatenate([is_good for _, is_good in chunks]) if chunks else np.ones(0, bool)
    if kept.all():
        return points, crs
    logger.warning(
        "%s: %s of %d are marked as withheld or as noise; left out",
        path,
        counted(int(count - kept.sum()), "point"),
        count,
    )
    return points[kept], crs


def _places(points: Any) -> tuple[Points, NDArray[np.bool_]]:
    """(n, 3) coordinates of some points, and which of them their file means to be used."""
    is_noise = np.isin(np.asarray(points.classification), _NOISE)
    return np.stack([points.x, points.y, points.z], axis=1), ~(is_noise | (np.asarray(points.withheld) != 0))


def _check(file: BinaryIO) -> int:
    """Return the bytes of a point; `ValueError` where what the header announces does not fit the file."""
    size = os.fstat(file.fileno()).st_size
    header = file.read(_HEADER_BYTES)
    if not header.startswith(b"LASF") or len(header) < _SHORTEST_HEADER:
        raise ValueError("it has no LAS header")
    version = struct.unpack_from("<BB", header, 24)
    header_bytes, start, num_records, kind, point_bytes, count = struct.unpack_from("<HIIBHI", header, 94)
    if version not in [(1, minor) for minor in range(5)]:
        raise ValueError(f"its version {version[0]}.{version[1]} is none of 1.0 to 1.4")
    if version == (1, 4):
        extended_start, num_extended, count = struct.unpack_from("<QIQ", header.ljust(_HEADER_BYTES, b"\0"), 235)
        _check_records(file, (extended_start, size), num_extended, _EXTENDED_HEADER_BYTES)
    if not _SHORTEST_HEADER <= header_bytes <= start <= size:
        raise ValueError("its header is longer than the file")
    scales_and_offsets = np.frombuffer(header, "<f8", 6, 131)
    if not np.isfinite(scales_and_offsets).all() or not scales_and_offsets[:3].all():
        raise ValueError("the scales or offsets of its coordinates are not usable")
    if kind & ~_COMPRESSED >= len(_POINT_BYTES) or point_bytes < _POINT_BYTES[kind & ~_COMPRESSED]:
        raise ValueError(f"its point format {kind & ~_COMPRESSED} with {point_bytes} bytes per point is unknown")
    zipped = _check_records(file, (header_bytes, start), num_records, _RECORD_HEADER_BYTES)
    if kind & _COMPRESSED:
        _check_compressed(file, start, size, count, zipped, point_bytes)
    elif start + count * point_bytes > size:
        raise ValueError(f"its header states {counted(count, 'point')}, and it is cut off")
    return int(point_bytes)


def _check_records(file: BinaryIO, span: tuple[int, int], count: int, header_bytes: int) -> bytes:
    """Walk records of variable length, all within a span of the file; return that of the decompressor."""
    offset, end = span
    zipped = b""
    for _ in range(count):
        if offset + header_bytes > end:
            raise ValueError("its header states more records than there are")
        file.seek(offset)
        header = file.read(header_bytes)
        user = header[2:18].rstrip(b"\0")
        (record,) = struct.unpack_from("<H", header, 18)
        (length,) = struct.unpack_from("<H" if header_bytes == _RECORD_HEADER_BYTES else "<Q", header, 20)
        offset += header_bytes + length
        if offset > end:
            raise ValueError("a record is longer than its file")
        if (user, record) == _LASZIP:
            zipped = file.read(length)
    return zipped


def _check_compressed(file: BinaryIO, start: int, size: int, count: int, zipped: bytes, point_bytes: int) -> None:
    """The items of the decompressor must make up a point, and the table of chunks lie in the file."""
    if len(zipped) < _LASZIP_BYTES:
        raise ValueError("it lacks the record of its compression")
    (chunk_points,) = struct.unpack_from("<I", zipped, 12)
    (num_items,) = struct.unpack_from("<H", zipped, 32)
    items = zipped[_LASZIP_BYTES : _LASZIP_BYTES + 6 * num_items]
    if sum(bytes_ for _, bytes_ in _items(items)) != point_bytes:
        raise ValueError("the record of its compression does not fit its points")
    if not count:
        return
    file.seek(start)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written without looking back: it stands at the end
        file.seek(size - 8)
        (table,) = struct.unpack("<q", file.read(8))
    if not start + 8 <= table <= size - 8:
        raise ValueError("its table of chunks is not in the file")
    file.seek(table)
    _, num_chunks = struct.unpack("<II", file.read(8))
    # Every chunk begins with a whole point; of chunks of one length there are just as many as needed.
    needed = num_chunks if chunk_points == 0xFFFFFFFF else -(-count // max(chunk_points, 1))
    if num_chunks != needed or not chunk_points or start + 8 + num_chunks * point_bytes > table:
        raise ValueError("its table of chunks does not fit its points")
    layers = sum(_LAYERS.get(kind, bytes_ if kind == _EXTRA_BYTES else 0) for kind, bytes_ in _items(items))
    if layers:
        file.seek(start)
        _check_layers(file, [bytes_ for _, bytes_ in _chunk_table(file, zipped)], table, layers, point_bytes)


def _check_layers(file: BinaryIO, chunks: list[int], end: int, layers: int, point_bytes: int) -> None:
    """Each chunk of formats 6 to 10 has a point, its number of points, the sizes of its layers, and these."""
    for chunk_bytes in chunks:
        start = file.tell()
        if start + chunk_bytes > end:
            raise ValueError("its table of chunks does not fit its points")
        sizes = file.read(point_bytes + 4 + 4 * layers)[point_bytes + 4 :]
        if (
            len(sizes) < 4 * layers
            or len(sizes) + point_bytes + 4 + sum(np.frombuffer(sizes, "<u4")) > chunk_bytes
        ):
            raise ValueError("a chunk of its points does not hold what it says")
        file.seek(start + chunk_bytes)


def _chunk_table(file: BinaryIO, zipped: bytes) -> list[tuple[int, int]]:
    """Points and bytes of each chunk; the file is left at the first one."""
    lazrs = importlib.import_module("lazrs")
    chunks: list[tuple[int, int]] = lazrs.read_chunk_table(file, lazrs.LazVlr(zipped))
    return chunks


def _items(data: bytes) -> list[tuple[int, int]]:
    """Kind and bytes of each item of a point."""
    return [(kind, bytes_) for kind, bytes_, _ in struct.iter_unpack("<HHH", data[: len(data) // 6 * 6])]


def _las_crs(header: Any) -> str | None:
    for record in [*header.vlrs, *(header.evlrs or [])]:
        wkt = str(getattr(record, "string", "")).strip("\0 ").upper() if record.record_id == 2112 else ""
        for kind, words in (("projected", _WKT_PROJECTED), ("geographic", _WKT_GEOGRAPHIC)):
            if any(f"{word}[" in wkt for word in words):
                name = str(record.string).split('"')
                return f"{kind} ({name[1]})" if len(name) > 1 else kind
    for record in header.vlrs:
        keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", [])}
        if keys.get(_GEOTIFF_MODEL_TYPE) == _GEOTIFF_PROJECTED:
            return f"projected (EPSG:{keys.get(_GEOTIFF_PROJECTED_CODE, '?')})"
        if keys.get(_GEOTIFF_MODEL_TYPE) == _GEOTIFF_GEOGRAPHIC:
            return "geographic (degrees)"
    return None
