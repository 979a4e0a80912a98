"""Damages clouds, meshes and exact depth maps at random, by seed, and tells what is made of them.

A process of its own: ``python stranger_files.py FOLDER FIRST LAST`` prints a line before and after each case. A
case is one file, read within 5 seconds and 2 GiB more than the libraries take; what comes of it is a result that
can be measured, or one sentence.
"""

import logging
import resource
import signal
import sys
import warnings
from pathlib import Path

import cv2
import laspy
import numpy as np
from corruption import damage_bytes, damage_text

from colmap_sph.errors import ColmapSphError
from colmap_sph.evaluation import EvaluationOptions, Mesh, evaluate_cloud, make_reference, read_geometry
from colmap_sph.evaluation.depth_files import read_exact_depth

SHAPE = (12, 16)
_SECONDS = 5
_BYTES = 2 << 30
_HEADER = 400
_RNG = np.random.default_rng(0)
_POINTS = _RNG.random((60, 3)) * 10
_FACES = np.stack([np.arange(58), np.arange(1, 59), np.arange(2, 60)], axis=1)
_DEPTH = _RNG.uniform(1, 9, SHAPE)


def ply_of(style: str, *, polygons: bool) -> bytes:
    """A cloud, or a mesh of triangles and one quad; with a property more, and a comment."""
    header = f"ply\nformat {style} 1.0\ncomment made by hand\nelement vertex {len(_POINTS)}\n"
    header += "property double x\nproperty float y\nproperty float z\nproperty uchar red\n"
    corners = [list(face) for face in _FACES] + ([[0, 1, 2, 3]] if style == "ascii" else [])
    if polygons:
        header += f"element face {len(corners)}\nproperty list uchar int vertex_indices\n"
    header += "end_header\n"
    if style == "ascii":
        rows = [f"{x:.6f} {y:.6f} {z:.6f} 7" for x, y, z in _POINTS]
        rows += [" ".join(map(str, [len(face), *face])) for face in corners] if polygons else []
        return (header + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in style else ">"
    table = np.zeros(len(_POINTS), [("x", f"{order}f8"), ("yz", f"{order}f4", 2), ("red", "u1")])
    table["x"] = _POINTS[:, 0]
    table["yz"] = _POINTS[:, 1:]
    triangles = np.zeros(len(corners), [("n", "u1"), ("rows", f"{order}i4", 3)])
    triangles["n"] = 3
    triangles["rows"] = corners
    return header.encode() + table.tobytes() + (triangles.tobytes() if polygons else b"")


def obj() -> bytes:
    """A mesh with colours, texture, and a face that counts back."""
    rows = [f"v {x:.6f} {y:.6f} {z:.6f} 0.5 0.5 0.5" for x, y, z in _POINTS]
    rows += [f"f {a + 1}/1 {b + 1}/1 {c + 1}/1" for a, b, c in _FACES]
    return ("# made by hand\no thing\n" + "\n".join([*rows, "f -1 -2 -3 -4"]) + "\n").encode()


def las(path: Path) -> bytes:
    """Points in a format of version 1.4, compressed or not by the ending of the path."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-3)
    content = laspy.LasData(header)
    content.xyz = _POINTS
    content.write(path)
    return path.read_bytes()


def image(ending: str, depth: np.ndarray) -> bytes:
    return bytes(cv2.imencode(ending, depth)[1].tobytes())


def npy(path: Path) -> bytes:
    np.save(path, _DEPTH)
    return path.read_bytes()


def make_files(folder: Path) -> dict[str, bytes]:
    """Small files that are right, one of each kind, by name."""
    millimetres = (_DEPTH * 1000).astype(np.uint16)
    return {
        "cloud.ply": ply_of("binary_little_endian", polygons=False),
        "text.ply": ply_of("ascii", polygons=False),
        "mesh.ply": ply_of("binary_little_endian", polygons=True),
        "big.ply": ply_of("binary_big_endian", polygons=True),
        "mesh text.ply": ply_of("ascii", polygons=True),
        "mesh.obj": obj(),
        "cloud.las": las(folder / "right.las"),
        "cloud.laz": las(folder / "right.laz"),
        "depth.png": image(".png", millimetres),
        "depth.tif": image(".tif", _DEPTH.astype(np.float32)),
        "depth.npy": npy(folder / "right.npy"),
    }


def damaged(data: bytes, name: str, rng: np.random.Generator) -> bytes:
    """Three quarters of the damage to the header, where there are counts."""
    is_text = "text" in name or name.endswith(".obj")
    if is_text and rng.random() < 0.7:
        return damage_text(data, rng)
    if rng.random() < 0.75:
        return damage_bytes(data[:_HEADER], rng) + data[_HEADER:]
    return damage_bytes(data, rng)


def outcome(path: Path) -> str:
    """What is made of a file: OK, the sentence of a refusal, or BROKEN with what should not have come."""
    try:
        if path.name.startswith("depth"):
            depth = read_exact_depth(path, shape=SHAPE, depth_scale=0.001)
            sound = depth.shape == SHAPE and depth.dtype == np.float32 and np.isfinite(depth).all()
            return "OK" if sound else f"BROKEN {depth.dtype} {depth.shape}"
        geometry = read_geometry(path)
        if isinstance(geometry, Mesh):  # measured by millions of samples, whatever is in it
            return "OK" if len(geometry.faces) else "BROKEN a mesh without faces"
        options = EvaluationOptions(tau=(0.5,), register=False)
        evaluate_cloud(geometry, make_reference(geometry, options), options)
        return "OK"
    except ColmapSphError as error:
        return str(error) if "\n" not in str(error) else f"BROKEN {error!r}"


def main(folder: Path, first: int, last: int) -> None:
    """Run cases `first` to `last` - 1."""
    warnings.simplefilter("error")
    logging.disable(logging.WARNING)
    files = make_files(folder)
    # Once before memory is limited: what libraries take for themselves.
    for name, data in files.items():
        (folder / name).write_bytes(data)
        print("RIGHT", name, outcome(folder / name), flush=True)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + _BYTES, taken + _BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    names = list(files)
    for seed in range(first, last):
        name = names[seed % len(names)]
        path = folder / f"{name[: name.index('.')]}-{seed}{name[name.index('.') :]}"
        path.write_bytes(damaged(files[name], name, np.random.default_rng(seed)))
        print("BEGIN", seed, name, flush=True)
        signal.alarm(_SECONDS)
        try:
            result = outcome(path)
        except BaseException as error:
            result = f"BROKEN {error!r}".replace("\n", " ")
        signal.alarm(0)
        print("END", seed, result, flush=True)
        path.unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
