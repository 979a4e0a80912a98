"""Arrays on disk in a file of our own: a head that is checked before anything is allocated, then the arrays.

::

    magic, 8 bytes            digest of the rest of the head, 16 bytes
    length of the head        kind, 8 bytes    key, 32 bytes    digest of the arrays, 16 bytes
    number of texts, of numbers, of arrays
    texts: length, UTF-8      numbers: 64-bit floats     arrays: type, three sizes
    arrays, one after the other

All is little-endian. Digests are xxh3_128.
"""

import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import xxhash
from numpy.typing import NDArray

from colmap_sph.errors import DamageError, InputError, reason_of
from colmap_sph.project.files import atomic_file, open_regular

SUFFIX = ".sph"
"""Ending of these files."""
OLD_SUFFIX = ".npz"
"""Ending of what earlier versions wrote in their place."""

_MAGIC = b"\x89SPH\r\n\x1a\x01"
_START = struct.Struct("<8s16s")
_FIXED = struct.Struct("<I8s32s16sBBB")
_LENGTH = struct.Struct("<H")
_ARRAY = struct.Struct("<B3I")
_TYPES = tuple(np.dtype(name) for name in ("<u1", "<u2", "<f4"))
_MAX_HEAD = 1 << 15
_READ_BYTES = 1 << 17

ArrayType = tuple[np.dtype[Any], tuple[int, ...]]
"""Type of the elements, and up to three sizes."""


@dataclass(frozen=True)
class Head:
    """What a file says of its arrays.

    Attributes
    ----------
    kind : str
        What it is, such as "pair".
    key : str
        Digest of what it was made from.
    texts : tuple of str
    numbers : tuple of float
    arrays : tuple of ArrayType
    digest : bytes
        Of the arrays.
    size : int
        Bytes before the first array.
    """

    kind: str
    key: str
    texts: tuple[str, ...]
    numbers: tuple[float, ...]
    arrays: tuple[ArrayType, ...]
    digest: bytes = b""
    size: int = 0


def array_type(array: NDArray[Any]) -> ArrayType:
    """Type and sizes of an array."""
    return array.dtype, array.shape


def write_arrays(
    path: Path,
    kind: str,
    key: str,
    arrays: Sequence[NDArray[Any]],
    *,
    texts: Sequence[str] = (),
    numbers: Sequence[float] = (),
) -> None:
    """Write arrays, and what belongs to them.

    Parameters
    ----------
    path : Path
        Target file; its folder exists.
    kind, key, texts, numbers
        See `Head`.
    arrays : sequence of ndarray
        Of uint8, uint16 or float32, with up to three dimensions.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    whole = [np.ascontiguousarray(array, array.dtype.newbyteorder("<")) for array in arrays]
    state = xxhash.xxh3_128()
    for array in whole:
        state.update(_bytes_of(array))
    head = Head(kind, key, tuple(texts), tuple(numbers), tuple(map(array_type, whole)), state.digest())
    with atomic_file(path, sync=False) as file:  # whoever reads it checks every byte
        file.write(_packed(head))
        for array in whole:
            file.write(_bytes_of(array))


def read_arrays(
    path: Path, kind: str, expected: Callable[[Head], Sequence[ArrayType]]
) -> tuple[Head, list[NDArray[Any]]]:
    """Read a file whole, and check every byte.

    Parameters
    ----------
    path : Path
    kind : str
        What it must be.
    expected : callable
        Head → the arrays that the file must have; `ValueError` where the head makes no sense.

    Returns
    -------
    head : Head
    arrays : list of ndarray

    Raises
    ------
    DamageError
        The file is cut off, altered, or of other content. It is removed, so that the next run makes it anew.
    InputError
        It is missing, or cannot be read.
    """
    try:
        with open_regular(path, follow=False) as file:
            head = _read_head(file)
            if head.kind != kind or tuple(expected(head)) != head.arrays:
                raise ValueError(f"it is no {kind} of the size expected")
            return head, _read_payload(file, head)
    except ValueError as error:
        with suppress(OSError):
            path.unlink()
        raise DamageError(f"{path} is damaged ({reason_of(error)}); it was removed, run again.") from error
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({reason_of(error)}); run again, or check its permissions."
        ) from error


def read_head(path: Path) -> Head | None:
    """The head of a file; None where the file is missing, damaged there, or not of the size that it says."""
    try:
        with open_regular(path, follow=False) as file:
            return _read_head(file)
    except (OSError, ValueError):
        return None


def first_array(path: Path, kind: str) -> tuple[Head, NDArray[Any]]:
    """The head of a file, and its first array, of which only what is looked at is read, and nothing checked.

    Raises
    ------
    ValueError, OSError
        It is missing or cannot be read, it is cut off, or it is of another kind.
    """
    with open_regular(path, follow=False) as file:
        head = _read_head(file)
        if head.kind != kind or not head.arrays:
            raise ValueError(f"it is no {kind}")
        dtype, shape = head.arrays[0]
        return head, np.memmap(file, dtype, "r", head.size, shape)


def is_whole(path: Path) -> bool:
    """Whether a file is one of ours, and every byte as it was written; reads it piece by piece."""
    try:
        with open_regular(path, follow=False) as file:
            head = _read_head(file)
            file.seek(head.size)
            state = xxhash.xxh3_128()
            while block := file.read(_READ_BYTES):
                state.update(block)
            return state.digest() == head.digest
    except (OSError, ValueError):
        return False


def is_array_file(path: Path) -> bool:
    """Whether a file is one of ours, of this version or an earlier one, whole or not."""
    try:
        with open_regular(path, follow=False) as file:
            start = file.read(64)
    except OSError:
        return False
    # Of earlier versions' archives the first member was the key.
    is_old = path.suffix == OLD_SUFFIX and start[:4] == b"PK\3\4" and start[30:37] == b"key.npy"
    return is_old or (path.suffix == SUFFIX and start.startswith(_MAGIC))


def _bytes_of(array: NDArray[Any]) -> memoryview:
    return array.reshape(-1).view(np.uint8).data


def _packed(head: Head) -> bytes:
    texts = [text.encode("utf-8", "surrogateescape") for text in head.texts]
    variable = b"".join(
        [
            *(_LENGTH.pack(len(text)) + text for text in texts),
            struct.pack(f"<{len(head.numbers)}d", *head.numbers),
            *(_ARRAY.pack(_TYPES.index(dtype), *_three(shape)) for dtype, shape in head.arrays),
        ]
    )
    size = _START.size + _FIXED.size + len(variable)
    counts = (len(texts), len(head.numbers), len(head.arrays))
    fixed = _FIXED.pack(size, head.kind.encode(), head.key.encode(), head.digest, *counts)
    return _START.pack(_MAGIC, xxhash.xxh3_128_digest(fixed + variable)) + fixed + variable


def _three(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Sizes of an array in three numbers, 0 where it has fewer dimensions: none of ours is empty."""
    return (*shape, 0, 0)[:3]


def _read_head(file: BinaryIO) -> Head:
    """Read the head; `ValueError` unless it is whole, and the file as long as it says."""
    start = file.read(_START.size + _FIXED.size)
    if len(start) < _START.size + _FIXED.size or not start.startswith(_MAGIC):
        raise ValueError("it is not in this program's format")
    _, check = _START.unpack_from(start)
    size, kind, key, digest, *counts = _FIXED.unpack_from(start, _START.size)
    if not len(start) <= size <= _MAX_HEAD:
        raise ValueError("its head is damaged")
    data = start + file.read(size - len(start))
    if len(data) != size or xxhash.xxh3_128_digest(data[_START.size :]) != check:
        raise ValueError("its head is damaged")
    head = _parsed(data, kind.rstrip(b"\0").decode(), key.rstrip(b"\0").decode(), digest, counts)
    file.seek(0, 2)
    if file.tell() != size + sum(map(_num_bytes, head.arrays)):
        raise ValueError("it is cut off")
    return head


def _parsed(data: bytes, kind: str, key: str, digest: bytes, counts: Sequence[int]) -> Head:
    """Take a whole head apart; `ValueError` where it does not hold what it counts."""
    num_texts, num_numbers, num_arrays = counts
    place = _START.size + _FIXED.size
    texts = []
    try:
        for _ in range(num_texts):
            (length,) = _LENGTH.unpack_from(data, place)
            place += _LENGTH.size
            texts.append(data[place : place + length].decode("utf-8", "surrogateescape"))
            place += length
        numbers = struct.unpack_from(f"<{num_numbers}d", data, place)
        place += 8 * num_numbers
        fields = [_ARRAY.unpack_from(data, place + index * _ARRAY.size) for index in range(num_arrays)]
        arrays = tuple((_TYPES[code], tuple(filter(None, sizes))) for code, *sizes in fields)
    except (struct.error, IndexError) as error:
        raise ValueError("its head is damaged") from error
    return Head(kind, key, tuple(texts), numbers, arrays, digest, len(data))


def _num_bytes(array: ArrayType) -> int:
    dtype, shape = array
    return dtype.itemsize * prod(shape)


def _read_payload(file: BinaryIO, head: Head) -> list[NDArray[Any]]:
    file.seek(head.size)
    state = xxhash.xxh3_128()
    arrays = []
    for dtype, shape in head.arrays:
        array = np.empty(shape, dtype)
        if file.readinto(_bytes_of(array)) != array.nbytes:  # type: ignore[attr-defined]
            raise ValueError("it is cut off")
        state.update(_bytes_of(array))
        arrays.append(array)
    if state.digest() != head.digest:
        raise ValueError("its content is not what was written")
    return arrays
