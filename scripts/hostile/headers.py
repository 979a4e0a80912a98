"""Headers of every binary format that is read: damaged, and claiming more than there is."""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

from hostile.cases import Case, Stage, all_names, files_below, model_run, workspace_run
from hostile.damage import COUNTS, damage_bytes, png_bomb, png_chunk

_LARGE = (1, 20_000, 65_535, 10**6, 2**31 - 1, 2**32 - 1)


def make(stage: Stage) -> Case:
    """Damage the header of a model's file, a map, a file of ours, or an image."""
    kinds: dict[str, Callable[[Stage], Case]] = {"model": _model, "ours": _ours, "image": _image, "mask": _mask}
    return kinds[str(stage.pick(*kinds))](stage)


def _model(stage: Stage) -> Case:
    if stage.chance(0.3):
        dense = stage.copy_workspace(stage.grounds.prepared)
        path = _damaged(stage, files_below(dense / "sparse"))
        return Case(f"header of {path.name}", workspace_run(dense), dense, names=all_names())
    root = stage.copy_project()
    path = _damaged(stage, files_below(root / "sparse"))
    return Case(f"header of {path.name}", model_run(root), root / "dense", names=all_names())


def _ours(stage: Stage) -> Case:
    """A map, or a file in our folder; the text files among these have a kind of their own."""
    dense = stage.copy_workspace(stage.grounds.adopted)
    files = (
        files_below(dense / "colmap_sph") + files_below(dense / "stereo", "*.bin") + files_below(dense, "fused*")
    )
    path = _damaged(stage, [path for path in files if path.suffix not in (".json", ".txt")])
    run = workspace_run(dense)
    # What a header lies about may show only as the file is read, and the next run makes it anew.
    more = ("--normals.radius", "3") if stage.chance(0.5) else ()
    return Case(
        f"header of {path.relative_to(dense)} {' '.join(more)}",
        (*run, *more),
        dense,
        names=all_names(),
        same_as=None if more else stage.grounds.adopted,
        again=run,
        attempts=2,
    )


def _damaged(stage: Stage, files: list[Path]) -> Path:
    path = files[int(stage.rng.integers(len(files)))]
    path.write_bytes(damage_bytes(path.read_bytes(), stage.rng, within=160))
    return path


def _image(stage: Stage) -> Case:
    root = stage.copy_project()
    path = root / "images" / str(stage.pick("N_0_0.png", "N_0_1.png"))
    word = _write_bomb(stage, path)
    return Case(f"image {path.name}: {word}", model_run(root), root / "dense", names=all_names())


def _mask(stage: Stage) -> Case:
    dense = stage.copy_workspace(stage.grounds.prepared)
    shutil.copytree(dense / "images", stage.world / "masks")
    path = stage.world / "masks" / "N_0_0.png.png"
    word = _write_bomb(stage, path)
    arguments = workspace_run(dense, "--masks", str(path.parent))
    return Case(f"mask {path.name}: {word}", arguments, dense, names=all_names())


def _write_bomb(stage: Stage, path: Path) -> str:
    """A picture that claims to be far larger than it is, or than it should be."""
    width = int(stage.rng.choice(_LARGE))
    height = int(stage.rng.choice(_LARGE))
    word = str(
        stage.pick("png", "full png", "right png", "ppm", "pfm", "bmp", "tiff", "jpeg", "hdr", "exr", "webp")
    )
    path.write_bytes(_bomb(stage, word, width, height))
    return f"{word} of {width} x {height}"


def _bomb(stage: Stage, word: str, width: int, height: int) -> bytes:
    rng = stage.rng
    odd = COUNTS[rng.integers(len(COUNTS))] % 2**32
    side = int(rng.choice([8_000, 20_000]))
    makers: dict[str, Callable[[], bytes]] = {
        "png": lambda: png_bomb(min(width, 70_000), height, filled=False),
        "full png": lambda: png_bomb(side, side, filled=True),
        # The right size, and a chunk of text that unpacks to 200 MB.
        "right png": lambda: png_bomb(120, 90, filled=True)[:-12] + png_chunk(b"iCCP", rng.bytes(100)) + _end(),
        "ppm": lambda: f"P{rng.integers(1, 8)}\n{width} {height}\n{odd}\n".encode() + rng.bytes(100),
        "pfm": lambda: f"PF\n{width} {height}\n-1.0\n".encode() + rng.bytes(100),
        "bmp": lambda: (
            b"BM" + struct.pack("<IIIIIIHHIIIIII", odd, 0, 54, 40, width, height, 1, 24, 0, odd, 0, 0, 0, 0)
        ),
        "tiff": lambda: _tiff(width, height, odd) + rng.bytes(200),
        "jpeg": lambda: (
            b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", height % 2**16, width % 2**16) + rng.bytes(300)
        ),
        "hdr": lambda: f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + rng.bytes(50),
        "exr": lambda: b"\x76\x2f\x31\x01\x02\x00\x00\x00" + rng.bytes(300),
        "webp": lambda: b"RIFF" + struct.pack("<I", odd) + b"WEBPVP8X" + rng.bytes(60),
    }
    return makers[word]()


def _end() -> bytes:
    return png_chunk(b"IEND", b"")


def _tiff(width: int, height: int, odd: int) -> bytes:
    """One strip of a grey picture, with counts that are not true."""
    tags = (
        (256, width),
        (257, height),
        (258, 8),
        (259, 1),
        (262, 1),
        (273, 200),
        (277, 1),
        (278, height),
        (279, odd),
    )
    rows = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return b"II*\x00" + struct.pack("<IH", 8, len(tags)) + rows + struct.pack("<I", 0)
