"""Images in every format and mode, and images that are damaged, cut, swapped or of another scene."""

import io
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from hostile.cases import Case, Stage, model_run
from hostile.damage import flip_bits
from hostile.grounds import BLOCK_NAMES, NAMES
from hostile.runs import Outcome

_ORIENTATION = 0x0112
# Pixels that differ by more grey levels than what JPEG makes of them, and their share, are damage.
_LEVELS = 24
_SHARE = 0.03

Picture = NDArray[np.uint8]


def make(stage: Stage) -> Case:
    """Sound images of odd formats, damaged ones, or others than they should be."""
    kinds = (_formats, _formats, _damaged, _damaged, _damaged, _others)
    return kinds[int(stage.rng.integers(len(kinds)))](stage)


# ---- sound images -------------------------------------------------------------------------------------------


def _formats(stage: Stage) -> Case:
    """One image, or all, in another format; what COLMAP reads is used, and seen as COLMAP sees it."""
    project = str(stage.pick("plain", "plain", "curved"))
    root = stage.copy_project(project)
    chosen = NAMES if stage.chance(0.5) else [str(stage.pick(*NAMES))]
    formats: list[str] = []
    names = {name: name for name in NAMES}
    is_used = True
    for name in chosen:
        path = root / "images" / name
        picture = cv2.imread(str(path))
        assert picture is not None
        path.unlink()
        word, ending = _write_format(stage, path, np.asarray(picture, np.uint8))
        new = name.removesuffix(".png") + ending
        (root / "images" / f"{name}.new").rename(root / "images" / new)
        _rename_in_model(root, name, new)
        del names[name]
        names[new] = name
        # COLMAP cannot write an undistorted image whose name does not tell its format.
        has_format = project == "plain" or Path(new).suffix.lower() in (".png", ".jpg", ".tif", ".bmp", ".ppm")
        is_used = is_used and has_format and _colmap_reads(root / "images" / new)
        formats.append(word)
    return Case(
        f"{project}: {', '.join(formats)}",
        model_run(root),
        root / "dense",
        project=project,
        names=names,
        whole=is_used,
        codes=frozenset({0} if is_used else {0, 2, 4, 5}),
    )


def _rename_in_model(root: Path, old: str, new: str) -> None:
    path = root / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(old.encode() + b"\0", new.encode() + b"\0"))


def _colmap_reads(path: Path) -> bool:
    """Whether COLMAP's own reader takes the file, and finds its camera's size."""
    try:
        bitmap = pycolmap.Bitmap.read(path, as_rgb=True)
    except (RuntimeError, ValueError, OSError):
        return False
    return bitmap is not None and (bitmap.width, bitmap.height) == (120, 90)


def _write_format(stage: Stage, path: Path, picture: Picture) -> tuple[str, str]:
    """Write ``PATH.new``; returns words for it, and the ending of the name."""
    mode = str(stage.pick("L", "RGB", "RGB", "RGBA", "P", "CMYK", "LA", "16", "16 grey", "F", "YCbCr"))
    file_format = str(stage.pick("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP"))
    turned = int(stage.rng.integers(1, 9)) if stage.chance(0.4) else 0
    target = path.with_name(f"{path.name}.new")
    if mode in ("16", "16 grey", "F"):
        file_format = _write_deep(mode, file_format, target, picture)
        turned = 0
    else:
        image = Image.fromarray(picture[..., ::-1]).convert("RGB" if mode == "P" else mode)
        image = image.quantize(256) if mode == "P" else image
        options: dict[str, object] = {}
        if file_format == "JPEG":
            image = image if mode in ("L", "RGB", "CMYK") else image.convert("RGB")
            options = {"quality": 97, "progressive": stage.chance(0.3), "subsampling": 0}
        elif file_format == "TIFF":
            options = {"compression": str(stage.pick("raw", "tiff_lzw", "tiff_adobe_deflate", "packbits"))}
        elif file_format == "PNG":
            image = image if mode in ("L", "RGB", "RGBA", "P", "LA") else image.convert("RGB")
        else:
            image = image.convert("L" if mode == "L" else "RGB")
        if turned and file_format in ("PNG", "JPEG", "TIFF", "WEBP"):
            options["exif"] = _turn(turned)
        elif file_format == "WEBP":
            options["lossless"] = True
        image.save(target, file_format, **options)
    endings = {"PNG": ".png", "JPEG": ".jpg", "TIFF": ".tif", "BMP": ".bmp", "PPM": ".ppm", "WEBP": ".webp"}
    ending = endings[file_format]
    odd = str(stage.pick(ending, ending, ending, "", ".dat", ".JPG", ".png"))
    return f"{mode} {file_format}{f' turned {turned}' if turned else ''} as '{odd}'", odd


def _write_deep(mode: str, file_format: str, target: Path, picture: Picture) -> str:
    """Write 16 bits or floats; returns the format."""
    file_format = "TIFF" if mode == "F" or file_format == "TIFF" else "PNG"
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if mode == "16 grey" else picture
    deep = grey.astype(np.float32) / 255 if mode == "F" else grey.astype(np.uint16) * 257
    encoded = cv2.imencode(".tif" if file_format == "TIFF" else ".png", deep)[1]
    target.write_bytes(encoded.tobytes())
    return file_format


def _turn(orientation: int) -> bytes:
    exif = Image.Exif()
    exif[_ORIENTATION] = orientation
    return exif.tobytes()


# ---- damaged images -----------------------------------------------------------------------------------------


def _damaged(stage: Stage) -> Case:
    """One damaged image: used where nothing is to be seen of it, else left out, and named."""
    project = str(stage.pick("plain", "curved"))
    root = stage.copy_project(project)
    name = str(stage.pick(*NAMES))
    path = root / "images" / name
    file_format = str(stage.pick("PNG", "JPEG", "TIFF", "BMP", "PPM"))
    with Image.open(path) as image:
        sound = np.asarray(image.convert("RGB"))
    packed = io.BytesIO()
    options = {"quality": 95} if file_format == "JPEG" else {}
    Image.fromarray(sound).save(packed, file_format, **options)
    how, data = _damage(stage, packed.getvalue())
    path.write_bytes(data)
    must_be_named = how == "cut" or _png_is_broken(data) or _looks_broken(data, sound, how)
    checks = (partial(_unnamed, name),) if must_be_named else ()
    names = {each: each for each in NAMES if each != name or not must_be_named}
    return Case(
        f"{project}: {file_format} {name}: {how}",
        model_run(root),
        root / "dense",
        project=project,
        names=names,
        codes=frozenset({0, 2, 4, 5}),
        checks=checks,
    )


def _damage(stage: Stage, data: bytes) -> tuple[str, bytes]:
    rng = stage.rng
    place = int(rng.integers(len(data) // 8, len(data) - 8))
    size = int(rng.integers(1, len(data) - place))
    kinds: dict[str, Callable[[], bytes]] = {
        "cut": lambda: data[:place],
        "zeros inside": lambda: data[:place] + bytes(size) + data[place + size :],
        "zeros at the end": lambda: data[:place] + bytes(len(data) - place),
        "flipped": lambda: flip_bits(data, rng),
        "a byte less": lambda: data[:place] + data[place + 1 :],
        "noise inside": lambda: data[:place] + rng.bytes(size) + data[place + size :],
        "more at the end": lambda: data + rng.bytes(100),
        "empty": lambda: b"",
    }
    word = str(stage.pick(*kinds))
    return word, kinds[word]()


def _png_is_broken(data: bytes) -> bool:
    """Whether a checksum of a chunk that matters is wrong, or the last one is missing."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return False
    place = 8
    while place + 12 <= len(data):
        (size,) = struct.unpack(">I", data[place : place + 4])
        kind = data[place + 4 : place + 8]
        content = data[place + 4 : place + 8 + size]
        check = data[place + 8 + size : place + 12 + size]
        if kind[:1].isupper() and struct.pack(">I", zlib.crc32(content)) != check:
            return True
        if kind == b"IEND":
            return False
        place += 12 + size
    return True


def _looks_broken(data: bytes, sound: Picture, how: str) -> bool:
    """Whether a decoder that knows about the damage shows many pixels that differ from the sound ones.

    JPEG has no checksums: of flipped bits, and of bytes that are missing, no decoder need know.
    """
    if how in ("flipped", "a byte less", "noise inside") or data[:3] == b"BM" or data[:1] == b"P":
        return False
    try:
        with Image.open(io.BytesIO(data)) as image:
            found = np.asarray(image.convert("RGB")).astype(int)
    except (OSError, ValueError, SyntaxError, struct.error):
        return True
    if found.shape != sound.shape:
        return True
    off = np.abs(found - sound).max(axis=-1) > _LEVELS
    return bool(off.mean() > _SHARE) and how == "zeros inside" and data[:2] == b"\xff\xd8"


def _unnamed(name: str, outcome: Outcome) -> str | None:
    """Whether nothing was said of an image that is not whole."""
    return None if name in outcome.stderr else f"{name} is damaged and was not named"


# ---- other images -------------------------------------------------------------------------------------------


def _others(stage: Stage) -> Case:
    """Images swapped, mirrored, turned, shifted, blank, half the size, or of noise."""
    root = stage.copy_project()
    images = root / "images"
    word = str(
        stage.pick("swapped", "all turned", "mirrored", "blank", "black", "noise", "half", "larger", "shuffled")
    )
    one = images / str(stage.pick(*NAMES))
    picture = cv2.imread(str(one))
    assert picture is not None
    if word in ("swapped", "shuffled"):
        order = list(NAMES) if word == "shuffled" else list(NAMES[:2])
        contents = [(images / name).read_bytes() for name in order]
        for name, content in zip(order, contents[1:] + contents[:1], strict=True):
            (images / name).write_bytes(content)
    elif word == "all turned":
        for name in BLOCK_NAMES:
            turned = cv2.imread(str(images / name))
            assert turned is not None
            cv2.imwrite(str(images / name), turned[::-1, ::-1])
    else:
        changed: dict[str, NDArray[Any]] = {
            "mirrored": picture[:, ::-1],
            "blank": np.full_like(picture, 128),
            "black": np.zeros_like(picture),
            "noise": stage.rng.integers(0, 256, np.shape(picture), np.uint8),
            "half": picture[::2, ::2],
            "larger": np.repeat(picture, 2, axis=1),
        }
        cv2.imwrite(str(one), changed[word])
    # The depth of an image whose picture is another's is nowhere right.
    names = {} if word in ("swapped", "shuffled", "all turned") else {name: name for name in NAMES}
    names.pop(one.relative_to(images).as_posix(), None)
    judged = {name: name for name in NAMES} if word in ("swapped", "shuffled", "all turned") else names
    return Case(f"image {word}", model_run(root), root / "dense", names=judged, codes=frozenset({0, 2, 4, 5}))
