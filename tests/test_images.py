"""Images are read as COLMAP reads them, damage is noticed, and copies have lost the tag that turns them."""

import io
import itertools
import os
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pycolmap
import pytest
from PIL import Image, ImageOps, JpegImagePlugin, PngImagePlugin
from projects import read_picture

from colmap_sph.errors import InputError
from colmap_sph.pipeline.stages.check_images import ImageFile, check_image
from colmap_sph.project.images import decoding, jpeg
from colmap_sph.project.images.decoding import jpeg_step, read_header, read_pixels
from colmap_sph.project.images.orientation import copy_without_orientation
from colmap_sph.project.images.reading import (
    Unsupported,
    image_problem,
    read_colours,
    read_grey,
    read_whole_grey,
)
from colmap_sph.project.images.undistorting import write_undistorted

WIDTH, HEIGHT = 53, 37
TIFF_LAYOUTS: list[dict[str, object]] = [
    {"compression": "none"},
    {"compression": "lzw"},
    {"compression": "zip"},
    {"planarconfig": "separate"},
    {"tile_width": 16, "tile_height": 16},
]
DEPTHS = {
    "jpg": ["uint8"],
    "bmp": ["uint8"],
    "ppm": ["uint8", "uint16"],
    "png": ["uint8", "uint16"],
    "tif": ["uint8", "uint16", "half", "float"],
    "exr": ["half", "float"],
}


def noise(channels: int, dtype: str) -> np.ndarray:
    values = np.random.default_rng(channels).integers(0, 65536, (HEIGHT, WIDTH, channels))
    if dtype == "uint8":
        return (values >> 8).astype(np.uint8)
    if dtype == "uint16":
        return values.astype(np.uint16)
    # Some of it below black and above white.
    return (values / 50000 - 0.1).astype(np.float16 if dtype == "half" else np.float32)


def write(path: Path, pixels: np.ndarray, dtype: str, **attributes: object) -> bool:
    """Write an image with OpenImageIO; False where its format has no such images."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], dtype)
    if pixels.shape[2] in (2, 4):
        spec.alpha_channel = pixels.shape[2] - 1
    for name, value in attributes.items():
        if name.startswith("tile_"):
            setattr(spec, name, value)
        else:
            spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output is not None
    if not output.open(str(path), spec):
        output.geterror()
        return False
    assert output.write_image(pixels)
    assert output.close()
    return True


def colmaps(path: Path) -> np.ndarray:
    bitmap = pycolmap.Bitmap.read(path, as_rgb=True)
    assert bitmap is not None, path
    return bitmap.to_array()


def orientation(path: Path) -> int:
    bitmap = pycolmap.Bitmap.read(path, as_rgb=True)
    assert bitmap is not None, path
    return bitmap.exif_orientation() or 1


def files(folder: Path, extension: str) -> Iterator[tuple[Path, str]]:
    """Images of all channels, depths, layouts and orientations that a format has, with their depth."""
    turned = range(1, 9) if extension in ("jpg", "png", "tif") else [1]
    layouts = TIFF_LAYOUTS if extension == "tif" else [{}]
    kinds = itertools.product(DEPTHS[extension], (1, 2, 3, 4), turned, layouts)
    for number, (dtype, channels, tag, layout) in enumerate(kinds):
        path = folder / f"{number}.{extension}"
        attributes = layout if tag == 1 else {"Orientation": tag, **layout}
        if write(path, noise(channels, dtype), dtype, **attributes):
            yield path, dtype


@pytest.mark.parametrize("extension", DEPTHS)
def test_pixels_are_those_that_colmap_sees(tmp_path: Path, extension: str) -> None:
    """Whatever the file is called."""
    count = 0
    for path, dtype in files(tmp_path, extension):
        truth = colmaps(path)
        for called in ("image", "image.dat", "image.png", "image.jpg", "image.tif"):
            other = tmp_path / called
            other.write_bytes(path.read_bytes())
            assert image_problem(other, WIDTH, HEIGHT) is None
            difference = np.abs(read_colours(other)[..., ::-1].astype(int) - truth)
            # Two versions of a library round values halfway between two grey values.
            assert difference.max() <= (dtype != "uint8"), (path, called)
            assert (difference > 0).mean() < 0.01
        count += 1
    assert count >= len(DEPTHS[extension])


@pytest.mark.parametrize("extension", ["jpg", "png", "tif"])
def test_copies_are_not_turned(tmp_path: Path, extension: str) -> None:
    """Nobody turns them, and COLMAP sees the same pixels."""
    turned = 0
    for path, dtype in files(tmp_path, extension):
        truth = colmaps(path)
        copy = tmp_path / f"copy.{extension}"
        copy_without_orientation(path, copy)
        np.testing.assert_array_equal(colmaps(copy), truth)
        assert orientation(copy) == 1
        assert (copy.read_bytes() == path.read_bytes()) == (orientation(path) == 1)
        turned += orientation(path) != 1
        if dtype.startswith("uint") and oiio.ImageBuf(str(path)).nchannels > 2:  # it misreads others in tiles
            assert np.abs(read_picture(copy)[..., ::-1].astype(int) - truth).max() <= 1
            with Image.open(copy) as image:
                if image.mode in ("L", "RGB"):
                    shown = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
                    assert np.abs(shown.astype(int) - truth).max() <= 1
    assert turned >= 7 * 3


@pytest.mark.parametrize("ending", ["tif", "exr"])
@pytest.mark.parametrize("date", [None, "2001:02:03 04:05:06"])
@pytest.mark.parametrize("kind", ["tif", "png"])
def test_the_same_image_is_undistorted_to_the_same_bytes_at_any_time(
    tmp_path: Path, kind: str, date: str | None, ending: str
) -> None:
    """COLMAP's library puts the time of writing into files of which no date is known; a known one stays.

    It writes TIFF files from PNG with Exif data, and before that twice.
    """
    pixels, source = noise(3, "uint8"), tmp_path / f"a.{kind}"
    exif = Image.Exif()
    if date is not None:
        exif[306] = date
    Image.fromarray(pixels).save(source, exif=exif)
    bitmap = pycolmap.Bitmap.read(source, True)
    assert bitmap is not None
    made = [tmp_path / f"{name}.{ending}" for name in "bc"]
    for path in made:
        write_undistorted(bitmap, source, path)
        time.sleep(1.1)  # dates have seconds
    assert made[0].read_bytes() == made[1].read_bytes()
    assert (date or "").encode() in made[0].read_bytes()
    again = pycolmap.Bitmap.read(made[0], True)
    assert again is not None
    np.testing.assert_allclose(again.to_array(), pixels, atol=1 if ending == "exr" else 0)


def test_orientation_in_xmp_goes_too(tmp_path: Path) -> None:
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description tiff:Orientation="6"/></x:xmpmeta>'
    picture = Image.fromarray(noise(3, "uint8"))
    picture.save(tmp_path / "a.jpg", xmp=xmp)
    text = PngImagePlugin.PngInfo()
    text.add_itxt("XML:com.adobe.xmp", xmp.decode())
    picture.save(tmp_path / "a.png", pnginfo=text)
    zipped = PngImagePlugin.PngInfo()
    zipped.add_itxt("XML:com.adobe.xmp", xmp.decode(), zip=True)
    picture.save(tmp_path / "b.png", pnginfo=zipped)
    picture.save(tmp_path / "a.tif", tiffinfo={700: xmp})
    for name in ("a.jpg", "a.png", "b.png", "a.tif"):
        with Image.open(tmp_path / name) as image:
            assert ImageOps.exif_transpose(image).size == (HEIGHT, WIDTH), name
        copy = tmp_path / f"copy_{name}"
        copy_without_orientation(tmp_path / name, copy)
        with Image.open(copy) as image:
            assert ImageOps.exif_transpose(image).size == (WIDTH, HEIGHT), name
        np.testing.assert_array_equal(colmaps(copy), colmaps(tmp_path / name))


def test_damaged_metadata_is_copied_as_it_is(tmp_path: Path) -> None:
    """Directories that go round in circles, segments that end nowhere."""
    exif = b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<HHHIII", 1, 274, 3, 1, 6, 8)
    picture = bytes(cv2.imencode(".jpg", noise(3, "uint8"))[1])
    for segment in (exif, exif[:-5], exif[:12], b"Exif\0\0MM\0*\xff\xff\xff\xff"):
        app1 = b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment
        (tmp_path / "a.jpg").write_bytes(picture[:2] + app1 + picture[2:])
        copy_without_orientation(tmp_path / "a.jpg", tmp_path / "b.jpg")
        assert len((tmp_path / "b.jpg").read_bytes()) == len(picture) + len(app1)
        np.testing.assert_array_equal(colmaps(tmp_path / "b.jpg"), colmaps(tmp_path / "a.jpg"))
    for data in (b"II*\0", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"", b"II*\0\xff\xff\xff\xff"):
        (tmp_path / "c").write_bytes(data)
        copy_without_orientation(tmp_path / "c", tmp_path / "d")
        assert (tmp_path / "d").read_bytes() == data


# ---- damage ------------------------------------------------------------------------------------------------


def smooth() -> np.ndarray:
    """A picture that compresses like a photograph."""
    picture = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((300, 400, 3)), (0, 0), 4)
    return np.clip(picture * 1000 + 128, 0, 255).astype(np.uint8)


def png(chunks: list[tuple[bytes, bytes]]) -> bytes:
    parts = [struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def damaged_pngs() -> dict[str, bytes]:
    whole = bytes(cv2.imencode(".png", smooth())[1])
    header = (b"IHDR", whole[16:29])
    rows = [b"\0" + row.tobytes() for row in smooth()]
    pixels = zlib.compress(b"".join(rows))
    end = (b"IEND", b"")
    sound = png([header, (b"IDAT", pixels), end])
    wrong_sum = bytearray(sound)
    wrong_sum[-14] ^= 1
    flipped = bytearray(sound)
    flipped[len(sound) // 2] ^= 16
    return {
        "half of the pixels": png([header, (b"IDAT", pixels[: len(pixels) // 2]), end]),
        "half of the rows": png([header, (b"IDAT", zlib.compress(b"".join(rows[:150]))), end]),
        "a wrong checksum": bytes(wrong_sum),
        "a flipped bit": bytes(flipped),
        "no end": sound[:-12],
    }


def damaged_jpegs(extra: list[int]) -> dict[str, bytes]:
    whole = bytes(cv2.imencode(".jpg", smooth(), extra)[1])
    middle = len(whole) // 2
    return {
        "zeros inside": whole[:middle] + bytes(600) + whole[middle + 600 :],
        "zeros to the end": whole[:middle] + bytes(len(whole) - middle - 2) + whole[-2:],
        "a part lost": whole[:middle] + whole[middle + 600 :],
        "no second half": whole[:middle] + whole[-2:],
        "no end": whole[:-2],
        "foreign bytes": whole[:middle] + np.random.default_rng(0).bytes(600) + whole[middle + 600 :],
    }


DAMAGED = {
    **{f"png {name}": data for name, data in damaged_pngs().items()},
    **{f"jpeg {name}": data for name, data in damaged_jpegs([]).items()},
    **{f"progressive {n}": d for n, d in damaged_jpegs([cv2.IMWRITE_JPEG_PROGRESSIVE, 1]).items()},
    **{f"restarts {n}": d for n, d in damaged_jpegs([cv2.IMWRITE_JPEG_RST_INTERVAL, 5]).items()},
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damage_is_noticed(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "image"
    path.write_bytes(DAMAGED[damage])
    problem = image_problem(path, 400, 300)
    assert problem is not None
    assert problem.startswith("is damaged")
    for read in (read_grey, read_colours):
        with pytest.raises(InputError, match="cannot be read as an image"):
            read(path)
    for detail_size in (None, (400, 300)):
        with pytest.raises(InputError) as told:
            check_image(ImageFile(path, (400, 300), detail_size))
        assert str(told.value) == f"{path} {problem}"


@pytest.mark.parametrize("end", ["jpg", "png"])
@pytest.mark.parametrize("detail_size", [None, (400, 300)])
def test_a_check_decodes_an_image_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str, detail_size: tuple[int, int] | None
) -> None:
    path = tmp_path / f"image.{end}"
    path.write_bytes(bytes(cv2.imencode(f".{end}", smooth())[1]))
    decoded: list[str] = []

    def counted(decode: Callable[..., Any]) -> Callable[..., Any]:
        def decode_and_count(*given: object) -> Any:
            decoded.append(decode.__name__)
            return decode(*given)

        return decode_and_count

    monkeypatch.setattr(jpeg, "decode_jpeg", counted(jpeg.decode_jpeg))
    monkeypatch.setattr(decoding, "_check_png", counted(decoding._check_png))
    assert (check_image(ImageFile(path, (400, 300), detail_size)).detail is None) == (detail_size is None)
    assert len(decoded) == 1


@pytest.mark.parametrize("layout", [{}, {"tile_width": 16, "tile_height": 16}, {"planarconfig": "separate"}])
def test_every_flipped_bit_of_a_deflated_tiff_is_noticed(tmp_path: Path, layout: dict[str, object]) -> None:
    """libtiff compares no checksum of a short last strip and of tiles; other bits may change nothing."""
    path = tmp_path / "image.tif"
    write(path, smooth(), "uint8", compression="zip", rowsperstrip=64, **layout)
    whole = path.read_bytes()
    pixels = read_pixels(path)
    for place in np.random.default_rng(0).integers(8, len(whole), 150):
        changed = bytearray(whole)
        changed[place] ^= 16
        path.write_bytes(changed)
        if image_problem(path, 400, 300) is None:
            np.testing.assert_array_equal(read_pixels(path), pixels)


def spoil_jpeg(kind: str) -> bytes:
    """A JPEG file at which libjpeg warns, though all its pixels are right."""
    whole = bytes(cv2.imencode(".jpg", smooth())[1])
    tables = whole.index(b"\xff\xdb")
    scan = whole.index(b"\xff\xda")
    pixels = scan + 2 + int.from_bytes(whole[scan + 2 : scan + 4], "big")
    fill = {"zeros": bytes(700), "one byte": b"\x7f", "ones": b"\xff\0" * 20, "end of line": b"\r\n"}
    if kind in fill:
        return whole[:-2] + fill[kind] + whole[-2:]
    return {
        "rubbish in the header": whole[:tables] + b"abc" + whole[tables:],
        "version": whole.replace(b"JFIF\0\1", b"JFIF\0\x09", 1),
        "scan parameters": whole[: pixels - 3] + bytes(3) + whole[pixels:],
        "behind the end": whole + bytes(1000),
        "fill bytes": whole[:-2] + b"\xff" * 9 + whole[-2:],
    }[kind]


HARMLESS = ["zeros", "one byte", "ones", "end of line", "rubbish in the header", "version", "scan parameters"]


@pytest.mark.parametrize("kind", [*HARMLESS, "behind the end", "fill bytes"])
def test_a_good_photograph_is_not_lost(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "image.jpg"
    path.write_bytes(bytes(cv2.imencode(".jpg", smooth())[1]))
    colours, grey = read_colours(path), read_grey(path)
    path.write_bytes(spoil_jpeg(kind))
    assert image_problem(path, 400, 300) is None
    np.testing.assert_array_equal(read_colours(path), colours)
    np.testing.assert_array_equal(read_grey(path), grey)


@pytest.mark.parametrize("kind", ["rubbish in the header", "version", "scan parameters"])
def test_a_harmless_warning_hides_no_other(tmp_path: Path, kind: str) -> None:
    """libjpeg tells the first of its warnings only."""
    whole = spoil_jpeg(kind)
    middle = len(whole) // 2
    path = tmp_path / "image.jpg"
    path.write_bytes(whole[:middle] + bytes(600) + whole[middle + 600 :])
    assert str(image_problem(path, 400, 300)).startswith("is damaged")


def test_huge_images_are_not_decoded(tmp_path: Path) -> None:
    """A file of a few bytes can hold one; nor are files read that never end."""
    size = struct.pack(">II", 100_000, 90_000)
    header = (b"IHDR", size + bytes([8, 2, 0, 0, 0]))
    rows = zlib.compress(bytes(10_000_000))
    path = tmp_path / "bomb.png"
    path.write_bytes(png([header, (b"IDAT", rows), (b"IEND", b"")]))
    assert image_problem(path, WIDTH, HEIGHT) == "has 100000 x 90000 pixels, but its camera 53 x 37"
    os.mkfifo(tmp_path / "fifo.png")
    for strange in (tmp_path / "fifo.png", Path("/dev/zero"), tmp_path):
        assert image_problem(strange, 53, 37) == "is not a regular file"
    assert image_problem(tmp_path / "none.png", 53, 37) == "is missing"
    assert "too long" in str(image_problem(tmp_path / ("x" * 300), 53, 37))
    path = tmp_path / os.fsdecode(b"\xff.png")
    path.write_bytes(b"\x89PNG")
    assert "not UTF-8" in str(image_problem(path, 53, 37))


@pytest.mark.parametrize("extension", ["jpg", "png", "tif", "bmp"])
def test_image_check_by_format(tmp_path: Path, extension: str) -> None:
    path = tmp_path / f"image.{extension}"
    pixels = np.random.default_rng(0).integers(0, 255, (40, 50, 3), dtype=np.uint8)
    cv2.imwrite(str(path), pixels)
    assert image_problem(path, 50, 40) is None
    assert image_problem(path, 40, 50) == "has 50 x 40 pixels, but its camera 40 x 50"
    data = path.read_bytes()
    for length in (1, 3, 12, len(data) // 2, len(data) - 20):
        path.write_bytes(data[:length])
        assert str(image_problem(path, 50, 40)).startswith("is damaged")


def test_image_check_with_preview_and_trailer(tmp_path: Path) -> None:
    encode = {"image": (40, 50), "preview": (8, 10)}
    files = {
        name: bytes(cv2.imencode(".jpg", np.full((*size, 3), 90, np.uint8))[1]) for name, size in encode.items()
    }
    app1 = b"\xff\xe1" + (len(files["preview"]) + 2).to_bytes(2, "big") + files["preview"]
    with_preview = files["image"][:2] + app1 + files["image"][2:]
    path = tmp_path / "image.jpg"
    path.write_bytes(with_preview + bytes(1000))
    assert image_problem(path, 50, 40) is None
    path.write_bytes(with_preview[:-20])
    assert str(image_problem(path, 50, 40)).startswith("is damaged")


@pytest.mark.parametrize("channels", [5, 6])
def test_what_colmap_cannot_read_is_refused(tmp_path: Path, channels: int) -> None:
    path = tmp_path / "bands.tif"
    write(path, noise(channels, "uint8"), "uint8")
    assert f"images of {channels} channels are not read" in str(image_problem(path, WIDTH, HEIGHT))
    write(tmp_path / "image.fits", noise(1, "uint16"), "uint16")
    assert "fits files are not read" in str(image_problem(tmp_path / "image.fits", WIDTH, HEIGHT))


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        ("webp", cv2.imencode(".webp", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()),
        ("jpeg2000", cv2.imencode(".jp2", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes()),
        ("HEIC", b"\0\0\0\x1cftypheic\0\0\0\0mif1heicmiaf" + bytes(100)),
        ("AVIF", b"\0\0\0\x1cftypavif\0\0\0\0avifmif1miaf" + bytes(100)),
        # Sequences of images, and a general brand before the one that tells what they are coded in.
        *(
            ("HEIC", b"\0\0\0\x18ftyp" + brand + b"\0\0\0\0msf1" + brand + bytes(100))
            for brand in (b"hevc", b"hevx", b"heim", b"heis", b"hevm", b"hevs")
        ),
        ("HEIC", b"\0\0\0\x18ftypmif1\0\0\0\0mif1heic" + bytes(100)),
        ("AVIF", b"\0\0\0\x18ftypmif1\0\0\0\0mif1avif" + bytes(100)),
        ("HEIF", b"\0\0\0\x14ftypmif1\0\0\0\0mif1avif" + bytes(100)),  # what is behind the box is no brand
    ],
)
def test_whole_images_of_other_kinds_are_not_called_damaged(tmp_path: Path, kind: str, data: bytes) -> None:
    """The remedy is another than for those: a PNG file under the same name is read."""
    path = tmp_path / f"image.{kind}"
    path.write_bytes(data)
    assert pycolmap.Bitmap.read(path, as_rgb=True) is None
    problem = image_problem(path, WIDTH, HEIGHT)
    assert isinstance(problem, Unsupported)
    assert f"{kind} files are not read (convert it to PNG, under the same name)" in problem
    path.write_bytes(cv2.imencode(".png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))[1].tobytes())
    assert image_problem(path, WIDTH, HEIGHT) is None


# ---- values ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extension", ["png", "tif"])
def test_grey_values_keep_their_depth(tmp_path: Path, extension: str) -> None:
    red, green, blue = (noise(3, "uint16")[..., k] / 257 for k in range(3))
    path = tmp_path / f"image.{extension}"
    write(path, noise(3, "uint16"), "uint16")
    # The luma of ITU-R BT.601.
    np.testing.assert_allclose(read_grey(path), 0.299 * red + 0.587 * green + 0.114 * blue, atol=1e-3)
    write(path, noise(1, "uint16"), "uint16")
    np.testing.assert_allclose(read_grey(path), noise(1, "uint16")[..., 0] / 257, atol=1e-4)
    assert read_pixels(path).dtype == np.uint16


@pytest.mark.parametrize(("extension", "dtype"), [("tif", "float"), ("exr", "half"), ("tif", "double")])
def test_floating_point_images(tmp_path: Path, extension: str, dtype: str) -> None:
    """0 is black, 1 is white; what lies beyond is cut off, and no number is black."""
    values = noise(1, dtype)
    values[3, 4] = np.nan
    path = tmp_path / f"image.{extension}"
    write(path, values.astype(np.float64) if dtype == "double" else values, dtype)
    assert read_pixels(path).dtype == np.float32
    expected = np.nan_to_num(np.clip(values[..., 0].astype(np.float64), 0, 1) * 255)
    np.testing.assert_allclose(read_grey(path), expected, atol=1e-3)
    np.testing.assert_array_equal(read_whole_grey(path), np.rint(read_grey(path)))


def test_numbers_with_a_sign(tmp_path: Path) -> None:
    """As of 16-bit TIFF files: the largest is white, and what is below zero black."""
    values = np.linspace(-32768, 32767, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH, 1).astype(np.int16)
    write(tmp_path / "image.tif", values, "int16")
    np.testing.assert_allclose(
        read_grey(tmp_path / "image.tif"), np.clip(values[..., 0] / 32767, 0, 1) * 255, atol=1e-3
    )


def test_an_image_of_few_values_is_stretched_to_be_matched(tmp_path: Path) -> None:
    """In a workspace that others made: no grey values fall together."""
    counts = np.linspace(7600, 8111, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH, 1).astype(np.uint16)
    write(tmp_path / "image.png", counts, "uint16")
    grey = read_grey(tmp_path / "image.png")
    assert grey.max() - grey.min() > 200
    slope, offset = np.polyfit(counts.ravel(), grey.ravel(), 1)
    np.testing.assert_allclose(grey, slope * counts[..., 0] + offset, atol=0.01)
    np.testing.assert_array_equal(
        read_colours(tmp_path / "image.png")[..., 0], colmaps(tmp_path / "image.png")[..., 0]
    )


def test_grey_values_of_lossless_files_keep_their_fractions(tmp_path: Path) -> None:
    blue, green, red = colours = np.random.default_rng(0).integers(0, 256, (3, 300, 50), dtype=np.uint8)
    for extension in ("png", "tif"):
        path = tmp_path / f"image.{extension}"
        cv2.imwrite(str(path), np.moveaxis(colours, 0, -1))
        # The luma of ITU-R BT.601.
        np.testing.assert_allclose(read_grey(path), 0.299 * red + 0.587 * green + 0.114 * blue, atol=1e-3)
    path.unlink()
    with pytest.raises(InputError, match=r"image\.tif cannot be read"):
        read_grey(path)


def test_grey_values_of_jpeg_files_are_those_stored(tmp_path: Path) -> None:
    """A grey file comes back as it was written: whole numbers, up to JPEG's own loss."""
    path = tmp_path / "image.JPG"
    row, column = np.indices((40, 50))
    grey = (row + 2 * column).astype(np.uint8)
    cv2.imwrite(str(path), grey, [cv2.IMWRITE_JPEG_QUALITY, 100])
    read = read_grey(path)
    assert read.dtype == np.uint8
    np.testing.assert_allclose(read.astype(int), grey, atol=1)


@pytest.mark.parametrize("num_segments", [0, 1, 2, 5])
def test_jpeg_headers_of_any_length(num_segments: int, tmp_path: Path) -> None:
    """Up to several times what is read of a file at first."""
    path = tmp_path / "a.jpg"
    assert cv2.imwrite(str(path), noise(3, "uint8"))
    data = path.read_bytes()
    path.write_bytes(data[:2] + num_segments * (b"\xff\xe2\xff\xff" + bytes(65533)) + data[2:])
    header = read_header(path)
    assert (header.width, header.height, header.channels, header.dtype) == (WIDTH, HEIGHT, 3, "uint8")
    assert image_problem(path, WIDTH, HEIGHT) is None


# ---- how coarsely JPEG rounds ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plain", "grey", "progressive", "16-bit table", "with a preview"])
@pytest.mark.parametrize("quality", [5, 50, 80, 100])
def test_the_rounding_step_of_jpeg_is_that_of_its_table(tmp_path: Path, quality: int, kind: str) -> None:
    path = tmp_path / "a.jpg"
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    if kind == "grey":
        picture = picture.convert("L")
    picture.save(path, quality=quality, progressive=kind == "progressive")
    with Image.open(path) as image:
        assert isinstance(image, JpegImagePlugin.JpegImageFile)
        step = image.quantization[0][0]
    data = path.read_bytes()
    if kind == "16-bit table":
        # T.81 allows it in extended files: the same numbers, twice as long.
        start = data.index(b"\xff\xdb")
        table = struct.pack(">HHB64H", 0xFFDB, 131, 0x10, *data[start + 5 : start + 69])
        path.write_bytes(data[:start] + table + data[start + 69 :])
    if kind == "with a preview":
        # A small image of another quality in the header.
        preview = io.BytesIO()
        picture.save(preview, "jpeg", quality=95)
        body = b"preview\0" + preview.getvalue()
        path.write_bytes(data[:2] + struct.pack(">HH", 0xFFE5, len(body) + 2) + body + data[2:])
    assert jpeg_step(path) == step


def test_other_files_have_no_rounding_step(tmp_path: Path) -> None:
    picture = Image.new("RGB", (WIDTH, HEIGHT))
    picture.save(tmp_path / "a.png")
    picture.save(tmp_path / "whole.jpg", quality=30)
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "whole.jpg").read_bytes()[:25])
    (tmp_path / "empty.jpg").write_bytes(b"")
    for name in ("a.png", "cut.jpg", "empty.jpg"):
        assert jpeg_step(tmp_path / name) == 1
