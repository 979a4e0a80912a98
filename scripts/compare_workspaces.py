"""Maps and clouds of two dense workspaces, byte for byte.

    python scripts/compare_workspaces.py BEFORE AFTER

Prints the files that differ. Exit code 0: identical; 1: something differs; 2: nothing to compare. Of the package
nothing is used: maps are read here by COLMAP's definition of their format.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_PATTERNS = ("stereo/**/*.bin", "fused.ply", "fused.ply.vis", "colmap_sph/local/fused.ply")
_HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")
_BLOCK = 1 << 24


@dataclass(frozen=True)
class Difference:
    """A file that is not the same in both workspaces.

    Attributes
    ----------
    name : str
        Below the workspace.
    only : str
        "before" or "after" where the other workspace lacks it, else empty.
    bytes : int
        Bytes that differ, those counted that only the longer file has.
    pixels : int or None
        Pixels of a map that differ in any channel, by their bytes; None of other files, and where the maps have
        not the same size.
    depth : float or None
        Of depth maps, where both have a depth: the largest difference, in units of the model.
    """

    name: str
    only: str = ""
    bytes: int = 0
    pixels: int | None = None
    depth: float | None = None

    def __str__(self) -> str:
        if self.only:
            return f"{self.name}: only {self.only}"
        words = [f"{self.bytes:,} bytes differ"]
        words += [] if self.pixels is None else [f"in {self.pixels:,} pixels"]
        words += [] if self.depth is None else [f"depths by up to {self.depth:.3g}"]
        return f"{self.name}: {', '.join(words)}"


@dataclass(frozen=True)
class Comparison:
    """Number of maps and files of the cloud in either workspace, their bytes, and those that differ, by name."""

    files: int
    bytes: int
    differences: tuple[Difference, ...]


def compare(before: Path, after: Path) -> Comparison:
    """Compare all maps and clouds of two workspaces."""
    in_before, in_after = result_files(before), result_files(after)
    differences = [Difference(str(name), only="before") for name in in_before - in_after]
    differences += [Difference(str(name), only="after") for name in in_after - in_before]
    for name in in_before & in_after:
        different = differing_bytes(before / name, after / name)
        if different:
            of_maps = map_difference(before / name, after / name) if name.suffix == ".bin" else (None, None)
            differences.append(Difference(str(name), "", different, *of_maps))
    size = sum((after / name).stat().st_size for name in in_after)
    return Comparison(len(in_before | in_after), size, tuple(sorted(differences, key=lambda d: d.name)))


def result_files(workspace: Path) -> set[Path]:
    """Maps and files of the cloud of a workspace, below its folder."""
    return {path.relative_to(workspace) for pattern in _PATTERNS for path in workspace.glob(pattern)}


def differing_bytes(before: Path, after: Path) -> int:
    """Bytes that differ between two files, those counted that only the longer one has."""
    different = abs(before.stat().st_size - after.stat().st_size)
    for one, other in zip(_blocks(before), _blocks(after), strict=False):
        if one != other:
            shared = min(len(one), len(other))
            pair = [np.frombuffer(block, np.uint8, shared) for block in (one, other)]
            different += int(np.count_nonzero(pair[0] != pair[1]))
    return different


def _blocks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            yield block


def map_difference(before: Path, after: Path) -> tuple[int | None, float | None]:
    """Pixels that differ between two map files, and the largest difference of depths (see `Difference`)."""
    one, other = read_map(before), read_map(after)
    if one is None or other is None or one.shape != other.shape:
        return None, None
    # As bits: NaN is not equal to itself, and -0 is equal to 0.
    pixels = int(np.count_nonzero((one.view(np.uint32) != other.view(np.uint32)).any(axis=0)))
    both = (one > 0) & (other > 0)
    if len(one) != 1 or not both.any():
        return pixels, None
    return pixels, float(np.abs(one[both].astype(np.float64) - other[both]).max())


def read_map(path: Path) -> NDArray[np.float32] | None:
    """A COLMAP depth or normal map as a (channels, H, W) array; None where the file is none or is cut off."""
    content = path.read_bytes()
    header = _HEADER.match(content)
    if header is None:
        return None
    width, height, channels = (int(number) for number in header.groups())
    if len(content) - header.end() != 4 * width * height * channels:
        return None
    return np.frombuffer(content, np.dtype("<f4"), offset=header.end()).reshape(channels, height, width)


def as_dict(difference: Difference) -> dict[str, Any]:
    """A difference for JSON, with its sentence as ``text``."""
    return asdict(difference) | {"text": str(difference)}


def main() -> int:
    """Compare, print, return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="dense workspace")
    parser.add_argument("after", type=Path, help="dense workspace")
    parser.add_argument("--json", action="store_true", help="print all of it as JSON")
    arguments = parser.parse_args()
    comparison = compare(arguments.before, arguments.after)
    if not comparison.files:
        print(f"error: no maps and no cloud in {arguments.before} and {arguments.after}", file=sys.stderr)
        return 2
    if arguments.json:
        print(json.dumps(asdict(comparison) | {"differences": [as_dict(d) for d in comparison.differences]}))
    else:
        for difference in comparison.differences:
            print(difference)
        print(f"{len(comparison.differences)} of {comparison.files} files differ")
    return int(bool(comparison.differences))


if __name__ == "__main__":
    sys.exit(main())
