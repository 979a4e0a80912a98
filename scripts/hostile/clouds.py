"""Clouds, meshes and exact depth maps for `evaluate`, sound and damaged."""

import json
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import laspy
import numpy as np
from numpy.typing import NDArray

from hostile.cases import Case, Random, Stage
from hostile.damage import COUNTS, damage_bytes, damage_text, png_bomb
from hostile.grounds import BLOCK_NAMES
from hostile.runs import Outcome

# What a file is cut off to must be refused: these formats say how much there is.
_COUNTED = ("ply", "binary ply", "big ply", "mesh ply", "las", "npy", "png")


def make(stage: Stage) -> Case:
    """Damage the cloud or the reference, or both may be sound."""
    world = stage.world
    scores = world / "out" / "scores.json"
    scores.parent.mkdir()
    if stage.chance(0.35):
        word, arguments = _depth_case(stage)
        codes = frozenset({2, 3, 4, 6}) if word.startswith("cut") else frozenset({0, 2, 3, 4, 6})
    else:
        points = _points(stage.rng)
        right = world / "right.ply"
        _write_ply(right, points, "<", [])
        kind = str(stage.pick(*_WRITERS))
        path = world / f"tried.{'las' if 'las' in kind else 'obj' if 'obj' in kind else 'ply'}"
        _WRITERS[kind](path, points, stage.rng)
        how = _damage(stage, path, kind)
        pair = [str(path), str(right)] if stage.chance(0.5) else [str(right), str(path)]
        more = ("--register", "False") if stage.chance(0.6) else ()
        arguments = [pair[0], "--reference", pair[1], *more]
        word = f"{how} {kind}"
        is_cut = how == "cut" and kind in _COUNTED
        codes = frozenset({2} if is_cut else {0} if how == "sound" else {0, 2, 3, 4, 6})
    return Case(
        word,
        ("evaluate", *arguments, "--tau", "0.5", "--json", str(scores)),
        scores.parent,
        codes=codes,
        checks=(partial(_wrong_scores, scores),),
    )


def _wrong_scores(path: Path, outcome: Outcome) -> str | None:
    """What is wrong with the file of scores of an evaluation that says it has worked."""
    if outcome.code != 0:
        return "scores of a failed evaluation" if path.exists() else None
    try:
        content = json.loads(path.read_text(), parse_constant=lambda word: float("inf"))
    except (OSError, ValueError) as error:
        return f"no scores: {error}"
    shares = [each for each in _numbers(content) if not np.isfinite(each)]
    return f"{len(shares)} numbers of the scores are not finite" if shares else None


def _numbers(value: object) -> list[float]:
    if isinstance(value, dict):
        return [number for each in value.values() for number in _numbers(each)]
    if isinstance(value, list):
        return [number for each in value for number in _numbers(each)]
    return [float(value)] if isinstance(value, (int, float)) else []


# ---- clouds ------------------------------------------------------------------------------------------------


def _points(rng: Random) -> NDArray[np.float64]:
    flat = rng.uniform(0, 20, (400, 2))
    return np.column_stack([flat, np.sin(flat[:, 0]) + 0.1 * flat[:, 1]])


def _write_ply(path: Path, points: NDArray[np.float64], order: str, faces: list[list[int]]) -> None:
    word = {"<": "binary_little_endian", ">": "binary_big_endian", "a": "ascii"}[order]
    head = f"ply\nformat {word} 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    if faces:
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    if order == "a":
        rows = [" ".join(f"{number:.6f}" for number in point) for point in points]
        rows += [" ".join(map(str, [len(face), *face])) for face in faces]
        body = ("\n".join(rows) + "\n").encode()
    else:
        body = points.astype(f"{order}f4").tobytes()
        body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
    path.write_bytes(f"{head}end_header\n".encode() + body)


def _faces(rng: Random, number: int) -> list[list[int]]:
    return [[int(i) for i in rng.choice(number, 3, replace=False)] for _ in range(50)]


def _write_obj(path: Path, points: NDArray[np.float64], rng: Random) -> None:
    rows = ["mtllib none.mtl", *("v {:.6f} {:.6f} {:.6f}".format(*point) for point in points)]
    rows += ["f " + " ".join(f"{i + 1}//" for i in face) for face in _faces(rng, len(points))]
    path.write_text("\n".join(rows) + "\n")


def _write_las(path: Path, points: NDArray[np.float64], rng: Random) -> None:
    header = laspy.LasHeader(point_format=int(rng.choice([0, 3, 6])), version="1.4")
    header.scales = np.full(3, 0.001)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(str(path), do_compress=False)


_WRITERS: dict[str, Callable[[Path, NDArray[np.float64], Random], None]] = {
    "ply": lambda path, points, rng: _write_ply(path, points, "a", []),
    "binary ply": lambda path, points, rng: _write_ply(path, points, "<", []),
    "big ply": lambda path, points, rng: _write_ply(path, points, ">", []),
    "mesh ply": lambda path, points, rng: _write_ply(path, points, "<", _faces(rng, len(points))),
    "text mesh ply": lambda path, points, rng: _write_ply(path, points, "a", _faces(rng, len(points))),
    "obj": _write_obj,
    "las": _write_las,
}


def _damage(stage: Stage, path: Path, kind: str) -> str:
    """Damage a file; returns how."""
    rng = stage.rng
    data = path.read_bytes()
    how = str(rng.choice(["sound", "bytes", "header", "text", "cut", "odd"], p=[0.05, 0.2, 0.3, 0.2, 0.1, 0.15]))
    if how == "bytes":
        path.write_bytes(damage_bytes(data, rng))
    elif how == "header":
        # LAS has 375 bytes of it.
        path.write_bytes(damage_bytes(data, rng, within=375 if kind == "las" else 150))
    elif how == "text":
        head, mark, body = data.partition(b"end_header\n")
        changed = damage_text(head, rng) + mark + body if mark else damage_text(data, rng)
        path.write_bytes(changed)
    elif how == "cut":
        path.write_bytes(data[: int(len(data) * rng.uniform(0.3, 0.95))])
    elif how == "odd":
        how = _write_odd(path, kind, rng)
    return how


def _write_odd(path: Path, kind: str, rng: Random) -> str:
    """A file that no writer makes; returns what it is."""
    plenty = int(COUNTS[rng.integers(len(COUNTS))])
    corners = " ".join(["1"] * 100_000)
    ply = f"ply\nformat ascii 1.0\nelement vertex {plenty}\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 1 99999999\n"
    odd = {
        "empty": b"",
        "one newline": b"\n",
        "no property": b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n0 0 0\n",
        "count": f"{ply}end_header\n0 0 0\n".encode(),
        "face out of range": ply.replace(str(plenty), "1").encode() + faces.encode(),
        "a face of 100,000 corners": f"v 0 0 0\nf {corners}\n".encode(),
        "short vertices": b"v 0 0\nv 1\nv\nf 1 2 3\n",
        "numbers": b"v nan inf 0\nv 1e400 -1e400 0\nv 0 0 1e38\nf 1 2 3\n",
        "negative indices": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -99\nf 0 0 0\n",
        "noise": rng.bytes(5000),
        "zeros": bytes(5000),
        "list of lists": ply.encode() + b"property list double float a\nend_header\n-1 0 0 nan 0\n",
        "a record count": _las_with(path, kind, 100, plenty) if kind == "las" else rng.bytes(500),
        "a version": _las_with(path, kind, 24, 0x0909)
        if kind == "las"
        else b"ply\nformat ascii 9.9\nend_header\n",
    }
    word = str(rng.choice(list(odd)))
    path.write_bytes(odd[word])
    return word


def _las_with(path: Path, kind: str, place: int, value: int) -> bytes:
    data = path.read_bytes()
    return data[:place] + struct.pack("<I", value % 2**32) + data[place + 4 :]


# ---- exact depth maps ---------------------------------------------------------------------------------------


def _depth_case(stage: Stage) -> tuple[str, list[str]]:
    """Compare a workspace's maps, or its cloud, with exact depth of which one file is damaged."""
    rng = stage.rng
    truth = stage.world / "truth"
    ending = str(stage.pick("png", "tif", "npy"))
    for name in BLOCK_NAMES:
        path = (truth / name).with_suffix(f".{ending}")
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = stage.grounds.truth["plain", name]
        if ending == "npy":
            np.save(path, depth)
        else:
            kind = np.uint16 if ending == "png" else np.float32
            cv2.imwrite(str(path), (depth * (100 if ending == "png" else 1)).astype(kind))
    dense = stage.copy_workspace(stage.grounds.adopted)
    path = truth / f"N_0_0.{ending}"
    data = path.read_bytes()
    how = str(stage.pick("damaged", "damaged header of", "cut", "bomb", "link", "map"))
    if how == "damaged":
        path.write_bytes(damage_bytes(data, rng))
    elif how == "damaged header of":
        path.write_bytes(damage_bytes(data, rng, within=130))
    elif how == "cut":
        path.write_bytes(data[: int(len(data) * rng.uniform(0.1, 0.9))])
    elif how == "bomb":
        path.write_bytes(_depth_bomb(ending, rng))
    elif how == "link":
        path.unlink()
        path.symlink_to("/dev/zero")
    else:
        maps = sorted(dense.glob("stereo/*_maps/*.geometric.bin"))
        chosen = maps[int(rng.integers(len(maps)))]
        chosen.write_bytes(damage_bytes(chosen.read_bytes(), rng, within=20))
    scale = ["--depth-scale", "0.01"] if ending == "png" else []
    what = [["--workspace", str(dense)], [str(dense / "fused.ply"), "--model", str(dense / "sparse")]]
    arguments = ["--reference", str(truth), *scale, *what[int(rng.integers(2 if how != "map" else 1))]]
    # A TIFF's directory may lie at its end or at its beginning, and a cut one may still be whole.
    return f"{how} {ending}" if (how, ending) != ("cut", "tif") else "shortened tif", arguments


def _depth_bomb(ending: str, rng: Random) -> bytes:
    if ending == "npy":
        shape = tuple(int(COUNTS[rng.integers(len(COUNTS))]) for _ in range(2))
        head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
        return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head
    return png_bomb(int(rng.choice([30_000, 65_535])), 60_000, filled=False)
