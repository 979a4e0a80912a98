"""Clouds, meshes and exact depth of strangers: measured, or refused in one sentence, soon and in little memory."""

import os
import struct
import subprocess
import sys
import time
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from stranger_files import SHAPE, image, las, make_files, ply_of

from colmap_sph.app import cli
from colmap_sph.errors import InputError
from colmap_sph.evaluation import Mesh, read_geometry
from colmap_sph.evaluation.depth_files import read_exact_depth

NUM_CASES = 1100
XYZ = "".join(f"property float {axis}\n" for axis in "xyz")
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def test_damage_is_measured_or_told(tmp_path: Path) -> None:
    """Seeds 0 to NUM_CASES; more by hand: python tests/stranger_files.py FOLDER FIRST LAST."""
    script = Path(__file__).with_name("stranger_files.py")
    done = subprocess.run(
        [sys.executable, script, tmp_path, "0", str(NUM_CASES)], capture_output=True, text=True, timeout=300
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{lines[-1]}: {done.stderr[-500:]}"
    right = [line for line in lines if line.startswith("RIGHT")]
    assert len(right) == 11 and all(line.endswith(" OK") for line in right)
    ends = [line for line in lines if line.startswith("END")]
    assert len(ends) == NUM_CASES
    assert [line for line in ends if "BROKEN" in line] == []
    # The damage is real, and not the end of everything.
    assert NUM_CASES / 4 < sum(line.endswith(" OK") for line in ends) < 3 * NUM_CASES / 4


def header(*lines: str, style: str = "ascii") -> bytes:
    return "\n".join(["ply", f"format {style} 1.0", *lines, "end_header", ""]).encode()


def faces(rows: str, count: int = 1, kind: str = "uchar") -> bytes:
    """Four vertices, and faces as text."""
    start = header(f"element vertex 4\n{XYZ}element face {count}\nproperty list {kind} int vertex_indices")
    return start + b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n" + rows.encode()


BAD_PLY = {
    "index beyond": faces("3 0 1 4\n"),
    "index below": faces("3 0 1 -1\n"),
    "index of 65 bits": faces("3 0 1 99999999999999999999\n"),
    "index no number": faces("3 0 1 x\n"),
    "list too long": faces("9 0 1 2\n"),
    "list of -1": faces("-1 0 1 2\n", kind="char"),
    "polygon of 100,000": faces("100000 " + "0 1 2 3 " * 25_000 + "\n", kind="int"),
    "strips": faces("4 0 1 3 2\n", kind="int").replace(b"element face", b"element tristrips"),
    "fewer rows": faces("3 0 1 2\n", count=2),
    "no properties": header("element vertex 3") + b"1\n2\n3\n",
    "no z": header("element vertex 1\nproperty float x\nproperty float y") + b"1 2\n",
    "twice x": header("element vertex 1\nproperty float x\n" + XYZ) + b"1 2 3 4\n",
    "twice vertex": header(f"element vertex 1\n{XYZ}element vertex 1\n{XYZ}") + b"1 2 3\n1 2 3\n",
    "no vertex": header("element face 0\nproperty list uchar int vertex_indices"),
    "unknown type": header("element vertex 1\nproperty float128 x\nproperty float y\nproperty float z")
    + b"1 2 3\n",
    "unknown line": header("elements vertex 1"),
    "property of nothing": header(XYZ),
    "float list length": header(f"element vertex 1\n{XYZ}element face 1\nproperty list float int vertex_indices"),
    "no end": header(f"element vertex 1\n{XYZ}")[:-12],
    "negative count": header(f"element vertex -1\n{XYZ}"),
    "count beyond": header(f"element vertex 1000000000000\n{XYZ}", style="binary_little_endian") + bytes(240),
    "count of 30 digits": header(f"element vertex {'9' * 30}\n{XYZ}", style="binary_big_endian") + bytes(240),
    "faces beyond": header(
        f"element vertex 0\n{XYZ}element face 999999999\nproperty list uchar int vertex_indices",
        style="binary_little_endian",
    ),
    "words": header(f"element vertex 2\n{XYZ}") + b"1 2 3\n1 two 3\n",
    "short row": header(f"element vertex 2\n{XYZ}") + b"1 2 3\n1 2\n",
    "long row": header(f"element vertex 1\n{XYZ}") + b"1 2 3 4\n",
    "nan": header(f"element vertex 2\n{XYZ}") + b"1 2 3\n1 nan 3\n",
    "inf": header(f"element vertex 2\n{XYZ}") + b"1 2 3\n1 inf 3\n",
    "1e300": header(f"element vertex 2\n{XYZ}") + b"1 2 3\n1 1e300 3\n",
    "gzip": b"\x1f\x8b\x08" + bytes(100),
    "nothing": b"",
}

BAD_OBJ = {
    "short": b"v 0 0 0\nv 1 0\nv 1 1 0\nf 1 2 3\n",
    "binary": bytes(range(256)) * 50,
    "binary without zeros": bytes(range(1, 256)) * 50 + b"\nv \xff\xfe 1 2\n",
    "index of 10⁹": (SQUARE + "f 1 2 1000000000\n").encode(),
    "index 0": (SQUARE + "f 0 1 2\n").encode(),
    "index before the first": (SQUARE + "f -1 -2 -9\n").encode(),
    "index no number": (SQUARE + "f 1 2 x\n").encode(),
    "index of 65 bits": (SQUARE + "f 1 2 99999999999999999999\n").encode(),
    "nan": b"v 0 0 nan\n",
    "polygon of 100,000": (SQUARE + "f " + "1 2 3 4 " * 25_000 + "\n").encode(),
    "nothing": b"",
}


def refuse_soon(path: Path, content: bytes) -> str:
    """Refused within 30 seconds, and in 64 MB more than twenty times the file."""
    path.write_bytes(content)
    tracemalloc.start()
    start = time.perf_counter()
    with pytest.raises(InputError) as error:
        read_geometry(path)
    assert time.perf_counter() - start < 30
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < (64 << 20) + 20 * len(content)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("case", BAD_PLY)
def test_bad_ply(tmp_path: Path, case: str) -> None:
    refuse_soon(tmp_path / "x.ply", BAD_PLY[case])


@pytest.mark.parametrize("line", ["element e{} 0", "property float x{}"])
def test_a_million_lines_of_header(tmp_path: Path, line: str) -> None:
    refuse_soon(tmp_path / "x.ply", header(*map(line.format, range(1_000_000))))


@pytest.mark.parametrize("case", BAD_OBJ)
def test_bad_obj(tmp_path: Path, case: str) -> None:
    refuse_soon(tmp_path / "x.obj", BAD_OBJ[case])


@pytest.mark.parametrize(
    ("offset", "value", "words"),
    [
        (24, b"\x09\x09", "its version 9.9 is none of 1.0 to 1.4"),
        (100, struct.pack("<I", 2**32 - 1), "more records than there are"),
        (243, struct.pack("<I", 2**32 - 1), "a record is longer than its file"),
        (104, b"\xff", "point format 127"),
        (105, struct.pack("<H", 1), "with 1 bytes per point"),
        (96, struct.pack("<I", 2**31), "header is longer than the file"),
        (247, struct.pack("<Q", 2**60), "states 1,152,921,504,606,846,976 points"),
        (131, struct.pack("<d", 0.0), "scales or offsets"),
        (139, struct.pack("<d", np.nan), "scales or offsets"),
        (155, struct.pack("<d", np.inf), "scales or offsets"),
    ],
)
def test_bad_las(tmp_path: Path, offset: int, value: bytes, words: str) -> None:
    data = bytearray(las(tmp_path / "right.las"))
    data[offset : offset + len(value)] = value
    assert words in refuse_soon(tmp_path / "x.las", bytes(data))


@pytest.mark.parametrize("value", [0, 2**31 - 1, 2**32 - 1])
@pytest.mark.parametrize("what", ["place", "number"])
def test_bad_table_of_chunks(tmp_path: Path, what: str, value: int) -> None:
    data = bytearray(las(tmp_path / "right.laz"))
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    place = start if what == "place" else table + 4
    data[place : place + 4] = struct.pack("<I", value)
    assert "its table of chunks" in refuse_soon(tmp_path / "x.laz", bytes(data))


@pytest.mark.parametrize("style", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_triangles_and_quads_in_one_mesh(tmp_path: Path, style: str) -> None:
    """Cut into triangles about their first corner; elements and properties of others are passed over."""
    start = header(
        "comment café\nelement camera 1\nproperty list uchar float k\nproperty double f\nelement vertex 4\n"
        f"property uchar red\n{XYZ}element face 3\nproperty uchar group\nproperty list ushort uint vertex_index",
        style=style,
    )
    if style == "ascii":
        body = b"2 0.5 0.5 9.5\n7 0 0 0\n7 1 0 0\n\n7 1 1 0\n7 0 1 0\n9 3 0 1 2\n9 4 0 1 2 3\n9 3 1 2 3\n"
    else:
        o = "<" if "little" in style else ">"
        body = struct.pack(f"{o}Bffd", 2, 0.5, 0.5, 9.5)
        body += b"".join(struct.pack(f"{o}Bfff", 7, *xyz) for xyz in [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
        body += struct.pack(f"{o}BH3IBH4IBH3I", 9, 3, 0, 1, 2, 9, 4, 0, 1, 2, 3, 9, 3, 1, 2, 3)
    (tmp_path / "x.ply").write_bytes(start + body)
    mesh = read_geometry(tmp_path / "x.ply")
    assert isinstance(mesh, Mesh)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert sorted(mesh.faces.tolist()) == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [1, 2, 3]]


def test_obj_as_it_may_be_written(tmp_path: Path) -> None:
    r"""Colours of some, a fourth coordinate, counting back, continued lines, comments, CRLF."""
    text = "# x\nmtllib no.mtl\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0 1.0\n f -3//1 -2//2 -1//3 # last\nv 0 \\\n1 0\n"
    (tmp_path / "x.obj").write_bytes(
        (text + "vn 0 0 1\nf 1/1/1 3/2/2 \\\n4\nl 1 2\n").replace("\n", "\r\n").encode()
    )
    mesh = read_geometry(tmp_path / "x.obj")
    assert isinstance(mesh, Mesh)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert sorted(mesh.faces.tolist()) == [[0, 1, 2], [0, 2, 3]]


# ---- exact depth -------------------------------------------------------------------------------------------


def png_bomb(width: int, height: int, bits: int = 16) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    start = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + start + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")


def tiff_bomb(width: int, height: int) -> bytes:
    tags = [(256, 4, width), (257, 4, height), (258, 3, 32), (259, 3, 1), (262, 3, 1), (273, 4, 8)]
    tags += [(277, 3, 1), (278, 4, height), (279, 4, 2**32 - 1), (339, 3, 3)]
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + body + bytes(4)


def npy_of(text: str, data: bytes = b"") -> bytes:
    padded = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + data


def npy_shape(shape: str, kind: str = "<f4") -> bytes:
    return npy_of(f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}")


BAD_DEPTH = {
    "png": (png_bomb(60_000, 60_000), "cannot be read|60000 x 60000 pixels"),
    "png, largest": (png_bomb(2**31 - 1, 2**31 - 1), "cannot be read|pixels"),
    "png of the size": (png_bomb(SHAPE[1], SHAPE[0]), "cannot be read"),
    "tif": (tiff_bomb(2**31, 2**31), "cannot be read|pixels"),
    "tif of the size": (tiff_bomb(SHAPE[1], SHAPE[0]), "cannot be read"),
    "tif, half of it": (image(".tif", np.ones(SHAPE, np.float32))[:300], "cannot be read"),
    "png as ppm": (b"P6 60000 60000 65535\n" + bytes(100), "neither PNG nor TIFF"),
    "png as pfm": (b"Pf\n60000 60000\n-1\n" + bytes(100), "neither PNG nor TIFF"),
    "png as hdr": (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n", "neither PNG nor TIFF"),
    "png as bmp": (b"BM" + struct.pack("<IIIIiiHH", 99, 0, 54, 40, 60_000, 60_000, 1, 24) + bytes(60), "neither"),
    "tif as exr": (b"v/1\x01" + bytes(200), "neither PNG nor TIFF"),
    "npy": (npy_shape("(60000, 60000)"), "cannot be read"),
    "npy of 2⁶²": (npy_shape(f"({2**31}, {2**31})"), "cannot be read"),
    "npy, negative": (npy_shape("(-12, -16)"), "cannot be read|pixels"),
    "npy of objects": (npy_shape("(12, 16)", "|O") + bytes(2000), "cannot be read"),
    "npy of words": (npy_of("{'descr': '<f4', 'shape'"), "cannot be read"),
    "npy of brackets": (npy_of("(" * 100), "cannot be read"),
    "npy, cut off": (npy_shape(f"{SHAPE}")[:-9], "cannot be read"),
    "npy as zip": (b"PK\x03\x04" + bytes(100), "cannot be read"),
    "npy, nothing": (b"", "cannot be read"),
    "png, nothing": (b"", "cannot be read"),
}


@pytest.mark.parametrize("case", BAD_DEPTH)
def test_bad_depth(tmp_path: Path, case: str) -> None:
    content, words = BAD_DEPTH[case]
    path = tmp_path / f"x.{case[:3]}"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match=words) as error:
        read_exact_depth(path, shape=SHAPE, depth_scale=0.001)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 16 << 20 and str(path) in str(error.value)


@pytest.mark.parametrize("name", ["depth.png", "depth.tif", "depth.npy"])
def test_right_depth(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(make_files(tmp_path)[name])
    scale = 0.001 if name == "depth.png" else 1.0
    depth = read_exact_depth(tmp_path / name, shape=SHAPE, depth_scale=scale)
    exact = np.load(tmp_path / "right.npy")
    np.testing.assert_allclose(depth, exact, rtol=0, atol=0.0011 if name == "depth.png" else 1e-6)


# ---- what is no file ---------------------------------------------------------------------------------------


def test_pipes_and_devices(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "right.ply").write_bytes(ply_of("ascii", polygons=False))
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "device.ply").symlink_to("/dev/zero")
    (tmp_path / "folder.ply").mkdir()
    (tmp_path / "link.ply").symlink_to("right.ply")
    read_geometry(tmp_path / "link.ply")
    for name in ("pipe.ply", "device.ply"):
        with pytest.raises(InputError, match="is not a regular file"):
            read_geometry(tmp_path / name)
        path = str(tmp_path / name)
        assert cli.main(["evaluate", path, "--reference", str(tmp_path / "right.ply")]) == 2
        assert cli.main(["evaluate", str(tmp_path / "right.ply"), "--reference", path]) == 2
        assert capsys.readouterr().err.count("is not a regular file") == 2
    with pytest.raises(InputError, match="is not a regular file"):
        read_exact_depth(tmp_path / "pipe.ply", shape=SHAPE)
