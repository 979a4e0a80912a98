"""Damage to bytes, to lines of text, and to values, at random places."""

import struct
import zlib
from collections.abc import Callable
from typing import Any

from hostile.cases import Random

COUNTS = (0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1)
NUMBERS = (float("nan"), float("inf"), float("-inf"), 0.0, -1.0, 1e300, 1e-300, 1e38, -1e9, 1e15)
WORDS = (
    *("nan", "inf", "-inf", "-1", "0", "-0", "1e300", "1e-300", "1e999", "99999999999999999999", "4294967295"),
    *("18446744073709551615", "abc", "", "é", "0x10", "١", "True", "None", "1,5", "1 2", "\x00", "'", '"'),
)
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 10**30, 1e308, float("nan"), "", "x" * 100_000, "\x1b[31m\n", "../../../etc/passwd"),
    *([], {}, [[]], {"": None}, [None] * 10_000, ["a", 1, {}], {"key": {"key": {}}}),
)


def damage_bytes(data: bytes, rng: Random, *, within: int | None = None) -> bytes:
    """Flip bits, cut off, put in a wrong count, a number or noise, or insert noise; `within` the first bytes."""
    size = min(len(data), within or len(data))
    if not data:
        return rng.bytes(10)
    place = int(rng.integers(max(size - 8, 1)))
    noise = rng.bytes(int(rng.integers(1, 40)))
    count = struct.pack("<Q", COUNTS[rng.integers(len(COUNTS))])[: int(rng.choice([1, 2, 4, 8]))]
    number = struct.pack("<d", NUMBERS[rng.integers(len(NUMBERS))])
    changed: tuple[Callable[[], bytes], ...] = (
        lambda: flip_bits(data, rng, size),
        lambda: data[:place],
        lambda: data[:place] + count + data[place + len(count) :],
        lambda: data[:place] + count[::-1] + data[place + len(count) :],
        lambda: data[:place] + number + data[place + 8 :],
        lambda: data[:place] + noise + data[place:],
        lambda: data[:place] + noise + data[place + len(noise) :],
    )
    return changed[rng.integers(len(changed))]()


def flip_bits(data: bytes, rng: Random, size: int | None = None) -> bytes:
    """Flip one to three bits of the first `size` bytes."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        changed[rng.integers(size or len(data))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def damage_text(data: bytes, rng: Random) -> bytes:
    """Remove, repeat, cut or empty a line, or put another word into it."""
    lines = data.decode(errors="surrogateescape").splitlines()
    number = int(rng.integers(max(len(lines), 1)))
    kind = rng.integers(7)
    if not lines or kind == 0:
        return damage_bytes(data, rng)
    if kind == 1:
        del lines[number]
    elif kind == 2:
        lines.insert(number, lines[int(rng.integers(len(lines)))])
    elif kind == 3:
        lines[number] = lines[number][: int(rng.integers(len(lines[number]) + 1))]
    elif kind == 4:
        lines[number] = lines[number] * 2000
    else:
        words = lines[number].split(" ")
        words[int(rng.integers(min(len(words), 14)))] = WORDS[int(rng.integers(len(WORDS)))]
        lines[number] = " ".join(words)
    return "\n".join(lines).encode(errors="surrogateescape")


def damage_value(value: Any, rng: Random) -> Any:
    """Put an odd value somewhere into a tree of lists and dicts, or take a key away, or nest it deeply."""
    kind = rng.integers(8)
    if kind == 0:
        return ODD_VALUES[rng.integers(len(ODD_VALUES))]
    if kind == 1:
        deep: Any = value
        for _ in range(int(rng.choice([3, 900]))):
            deep = [deep]
        return deep
    if isinstance(value, dict) and value:
        name = list(value)[int(rng.integers(len(value)))]
        if kind == 2:
            return {key: each for key, each in value.items() if key != name}
        if kind == 3:
            return value | {"another": 1}
        return value | {name: damage_value(value[name], rng)}
    if isinstance(value, list) and value:
        place = int(rng.integers(len(value)))
        return [*value[:place], damage_value(value[place], rng), *value[place + 1 :]]
    return ODD_VALUES[rng.integers(len(ODD_VALUES))]


def png_chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a PNG file with its right checksum."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_bomb(width: int, height: int, *, filled: bool) -> bytes:
    """A grey PNG that claims to be this large, and that may be; a few bytes per thousand pixels."""
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    squeeze = zlib.compressobj(9)
    rows = squeeze.compress(bytes((width + 1) * (height if filled else 1))) + squeeze.flush()
    return b"\x89PNG\r\n\x1a\n" + head + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")
