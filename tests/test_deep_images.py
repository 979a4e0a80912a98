"""Images of more than 8 bits keep their depth through undistortion, and images under odd names are written."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import keep_images
from PIL import Image
from projects import FOUR_NAMES, make_context, prepare, read_picture
from test_images import colmaps, orientation, write
from test_undistortion import make_project

import colmap_sph
from colmap_sph.evaluation import compare_depth_map
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.check_images import KnownImage, read_known, write_known
from colmap_sph.project.images.decoding import read_pixels
from colmap_sph.project.images.depth import ValueRange, ValueSample, common_ranges, describe_ranges, sample_values
from colmap_sph.project.images.reading import read_grey
from colmap_sph.project.images.undistorting import undistort_deep, write_undistorted
from colmap_sph.project.map_files import read_depth_map
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.partners.pairs import PairOptions
from colmap_sph.synthetic import DemoBlock

WIDTH, HEIGHT = 211, 150
WHOLE = ValueRange(0, 65535)
OPTIONS = RunOptions(threads=1, pairs=PairOptions(num_pairs=2))


def picture() -> np.ndarray:
    values = np.random.default_rng(1).standard_normal((HEIGHT, WIDTH, 3))
    return np.clip(cv2.GaussianBlur(values, (0, 0), 1.5) * 500 + 128, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("max_image_size", [-1, 180, 100, 60])
@pytest.mark.parametrize(
    ("model", "extra"),
    [
        ("OPENCV", (0.1, 0.01, 1e-3, -1e-3)),
        ("SIMPLE_RADIAL", (-0.2,)),
        ("SIMPLE_RADIAL_FISHEYE", (0.1,)),
        ("PINHOLE", ()),
    ],
)
def test_undistorted_as_by_colmap(
    tmp_path: Path, model: str, extra: tuple[float, ...], max_image_size: int
) -> None:
    """To the rounding of COLMAP's 8 bits, twice where it also reduces the picture."""
    camera = pycolmap.Camera.create_from_model_name(1, model, 150.0, WIDTH, HEIGHT)
    camera.params = [*camera.params[: len(camera.params) - len(extra)], *extra]
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_image_size
    bitmap = pycolmap.Bitmap.from_array(picture())
    truth = pycolmap.undistort_image(options, bitmap, camera)[0].to_array()
    if model == "PINHOLE" and max_image_size < 0:
        truth = picture()  # which `undistort_images` copies
    write(tmp_path / "source.png", picture().astype(np.uint16) * 257, "uint16")
    undistort_deep(tmp_path / "source.png", camera, options, tmp_path / "sub" / "target.tif", WHOLE)
    found = read_pixels(tmp_path / "sub" / "target.tif")
    assert found.dtype == np.uint16
    assert found.shape == truth.shape
    assert np.abs(found / 257 - truth).max() < (0.51 if max_image_size in (-1, 180) else 1)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.exr", "a.jpg", "a", "a.b"])
def test_what_is_written_is_read_by_everybody(tmp_path: Path, name: str) -> None:
    """COLMAP sees 8 well exposed bits of it."""
    counts = np.linspace(7000, 8500, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH, 1).astype(np.uint16)
    write(tmp_path / "source.tif", counts, "uint16", Orientation=6)
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 150.0, WIDTH, HEIGHT)
    options = pycolmap.UndistortCameraOptions()
    target = tmp_path / name
    undistort_deep(tmp_path / "source.tif", camera, options, target, ValueRange(7250, 8250))
    expected = np.clip((counts[..., 0] - 7250.0) / 1000, 0, 1)
    bitmap = pycolmap.Bitmap.read(target, as_rgb=False)
    assert bitmap is not None
    np.testing.assert_allclose(bitmap.to_array(), expected * 255, atol=0.51)
    np.testing.assert_allclose(read_picture(target, cv2.IMREAD_UNCHANGED), expected * 65535, atol=1)
    assert orientation(target) == 1


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.JPG", "a.tif", "a", "a.photo", "a.jpg.1"])
def test_undistorted_images_of_8_bits(tmp_path: Path, name: str) -> None:
    """Under names for which COLMAP does not know what to write, too, and never turned."""
    exif = Image.Exif()
    exif[274] = 6
    source = tmp_path / "source"
    Image.fromarray(picture()).save(source, "JPEG", exif=exif)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 150.0, WIDTH, HEIGHT)
    camera.params = [*camera.params[:-1], 0.1]
    bitmap = pycolmap.Bitmap.read(source, as_rgb=True)
    assert bitmap is not None
    undistorted, pinhole = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, camera)
    write_undistorted(undistorted, source, tmp_path / "images" / name)
    assert [path.name for path in (tmp_path / "images").iterdir()] == [name]
    assert orientation(tmp_path / "images" / name) == 1
    ending = Path(name).suffix
    usual = tmp_path / f"usual{ending if ending in ('.png', '.tif', '.JPG') else '.jpg'}"
    undistorted.write(usual)
    np.testing.assert_array_equal(colmaps(tmp_path / "images" / name), colmaps(usual))
    assert read_picture(tmp_path / "images" / name).shape == (pinhole.height, pinhole.width, 3)


# ---- which values become black and white ----------------------------------------------------------------------


def ranges_of(folder: Path, images: list[np.ndarray]) -> dict[str, ValueRange]:
    samples = []
    for number, pixels in enumerate(images):
        path = folder / f"{number}.tif"
        write(path, pixels, {"f": "float", "u": pixels.dtype.name}[pixels.dtype.kind])
        samples.append(sample_values(path))
    return common_ranges(samples)


def thermal(low: float, high: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(low, high, (120, 160, 1))


def test_a_common_range_of_all_images(tmp_path: Path) -> None:
    """Dead and hot pixels, and a black border, do not count."""
    cold = thermal(7600, 7900).astype(np.uint16)
    warm = thermal(7900, 8111, 1).astype(np.uint16)
    cold[:2, :2] = 0
    warm[5, 5:8] = 65535
    warm[-8:] = 0
    found = ranges_of(tmp_path, [cold, warm])
    assert list(found) == ["16-bit grey"]
    values = found["16-bit grey"]
    assert 7500 < values.low <= 7600
    assert 8111 <= values.high < 8210
    (sentence,) = describe_ranges(found)
    assert sentence == (
        f"16-bit grey images: values {values.low:g}..{values.high:g} are stretched to the full range"
    )
    # One more image of the same kind does not make all of them anew.
    assert ranges_of(tmp_path, [cold, warm, thermal(7650, 8090, 2).astype(np.uint16)]) == found


def test_what_is_saturated_does_not_count(tmp_path: Path) -> None:
    """The sun, a fire, or "no value": 5 % of an image hide the range of the rest no more than 0.01 % do."""
    frame = thermal(7600, 8111).astype(np.uint16)
    frame[:6] = 65535
    values = ranges_of(tmp_path, [frame])["16-bit grey"]
    assert 7500 < values.low <= 7600
    assert 8111 <= values.high < 8210
    # In a workspace of others each image by itself.
    write(tmp_path / "frame.tif", frame, "uint16")
    grey = read_grey(tmp_path / "frame.tif")
    assert (grey[:6] == 255).all()
    assert float(np.ptp(grey[6:])) > 200


def test_kelvin(tmp_path: Path) -> None:
    values = ranges_of(tmp_path, [thermal(288.0, 301.5).astype(np.float32)])["floating-point grey"]
    assert 287 < values.low <= 288
    assert 301.5 <= values.high < 302.5


def test_images_that_use_their_range_are_left_as_they_are(tmp_path: Path) -> None:
    """Photographs; those of 8 bits have no range at all, and other kinds their own."""
    photograph = (np.random.default_rng(0).beta(2, 3, (120, 160, 3)) * 60000).astype(np.uint16)
    drawing = thermal(0, 1).astype(np.float32)
    eight = thermal(0, 255).astype(np.uint8)
    flat = np.full((120, 160, 1), 77, np.uint16)
    found = ranges_of(tmp_path, [photograph, drawing, eight, flat])
    assert found == {
        "16-bit colour": WHOLE,
        "floating-point grey": ValueRange(0, 1),
        "16-bit grey": WHOLE,
    }
    assert describe_ranges(found) == []


# ---- runs ----------------------------------------------------------------------------------------------------


def write_thermal(path: Path, grey: np.ndarray) -> None:
    """Grey values 0..255 as counts 7600..8111."""
    write(path, (7600 + 2 * grey.astype(np.uint16))[..., None], "uint16")


def write_kelvin(path: Path, grey: np.ndarray) -> None:
    write(path, (288 + 0.04 * grey.astype(np.float32))[..., None], "float")


def write_turned(path: Path, grey: np.ndarray) -> None:
    write(path, grey[..., None], "uint8", Orientation=3)


@pytest.mark.parametrize("from_workspace", [False, True], ids=["model", "workspace"])
@pytest.mark.parametrize("write_image", [write_thermal, write_kelvin, write_turned])
def test_depth_is_that_of_8_bits_and_more(
    block: DemoBlock, project: Path, write_image, from_workspace: bool
) -> None:
    """Exact depth is found as in the photographs that were made so."""
    keep_images(project, FOUR_NAMES)
    model = pycolmap.Reconstruction(project / "sparse" / "0")
    for image in model.images.values():
        path = project / "images" / image.name
        image.name = path.with_suffix(".tif").name
        write_image(path.with_suffix(".tif"), read_picture(path, cv2.IMREAD_GRAYSCALE))
    model.write(project / "sparse" / "0")
    if from_workspace:
        dense = project / "dense"
        (dense / "sparse").mkdir(parents=True)
        (project / "images").rename(dense / "images")
        model.write(dense / "sparse")
        report = colmap_sph.run(workspace=dense, options=OPTIONS)
    else:
        report = colmap_sph.run(project / "sparse" / "0", options=OPTIONS)
        assert ("stretched to the full range" in report.stretched) == (write_image is not write_turned)
    assert report.images == len(FOUR_NAMES)
    assert np.mean(list(report.coverage.values())) > 0.72
    for name in FOUR_NAMES:
        truth = block.truth(name)[0]
        depth = read_depth_map(Workspace(project / "dense").depth_map_path(f"{name[:-4]}.tif", "geometric"))
        gsd = truth / block.cameras[block.names.index(name)].K[0, 0]
        assert compare_depth_map(depth, truth, gsd=gsd).within[1] > 0.95, name


def test_a_workspace_is_not_turned(block: DemoBlock, project: Path) -> None:
    """COLMAP's own copies would be, by every program that obeys the tag."""
    keep_images(project, FOUR_NAMES)
    exif = Image.Exif()
    exif[274] = 8
    for name in FOUR_NAMES:
        path = project / "images" / name
        Image.fromarray(read_picture(path)[..., ::-1]).save(path, exif=exif)
    workspace = prepare(project / "sparse" / "0", project / "dense")
    for name in FOUR_NAMES:
        assert orientation(workspace.image_path(name)) == 1
        assert read_picture(workspace.image_path(name)).shape == (240, 320, 3)


@pytest.mark.parametrize("old", [b"16-bit grey", b'"quantiles":[7', b'"check":"', b'"size":[96'])
def test_a_damaged_list_of_images_is_not_believed(old: bytes, tmp_path: Path) -> None:
    """Also where a stranger has made its digest fit."""
    sparse = make_project(tmp_path)
    for number, path in enumerate(sorted((tmp_path / "images").rglob("*.png"))):
        shape = read_picture(path).shape[:2]
        write(path, np.random.default_rng(number).integers(7600, 8100, (*shape, 1)).astype(np.uint16), "uint16")
    workspace = prepare(sparse, tmp_path / "dense")
    known = workspace.state_dir / "originals.json"
    whole = known.read_bytes()
    image = workspace.image_path("a.png").read_bytes()
    assert old in whole
    known.write_bytes(whole.replace(old, old[:-1] + b"5", 1))
    prepare(sparse, workspace.root)
    assert known.read_bytes() == whole
    key = make_context(workspace).keys.known_images()
    images = {"a.png": KnownImage((96, 64), "digest", (1, 2), ValueSample("odd", (1.0,)))}
    assert read_known(known, key)
    write_known(known, key, images)
    assert read_known(known, key) == {}
    prepare(sparse, workspace.root)
    assert workspace.image_path("a.png").read_bytes() == image


def test_what_is_known_of_images_depends_on_the_program(tmp_path: Path) -> None:
    """Another version may find damage in them that this one does not."""
    images = {"a.png": KnownImage((96, 64), "digest", (1, 2))}
    write_known(tmp_path / "images.json", "key", images)
    assert read_known(tmp_path / "images.json", "key") == images
    assert read_known(tmp_path / "images.json", "other") == {}
