"""Masks: undistorted exactly as the images, and what they ignore appears neither in maps nor in the cloud."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from clouds import read_points
from conftest import keep_images
from PIL import Image
from projects import prepare, read_picture
from test_undistortion import HEIGHT, NAMES, WIDTH, make_project

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.run_command import PARTIAL_EXIT_CODE
from colmap_sph.errors import InputError
from colmap_sph.evaluation import compare_depth_map
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.stages.pair_files import read_estimate
from colmap_sph.project.map_files import read_depth_map, read_normal_map
from colmap_sph.project.masks import check_mask_names, read_mask, undistort_mask
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.undistortion import UndistortionOptions
from colmap_sph.project.workspace import Workspace, mask_path
from colmap_sph.stereo.partners.pairs import PairOptions
from colmap_sph.synthetic import Camera, DemoBlock

NADIR = ["N_0_0.jpg", "N_0_1.jpg", "N_0_2.jpg", "N_1_1.jpg"]
OPTIONS = RunOptions(threads=1, pairs=PairOptions(num_pairs=2))
DISTORTION = (0.1, 0.02, 2e-3, -1e-3)


def blobs(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """A mask of random blobs, half of it black."""
    noise = np.random.default_rng(seed).standard_normal((height, width))
    return np.where(cv2.GaussianBlur(noise, (0, 0), 3) > 0, 255, 0).astype(np.uint8)


def write_masks(folder: Path, names: list[str], height: int = HEIGHT, width: int = WIDTH) -> None:
    for seed, name in enumerate(names):
        path = folder / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), blobs(seed, height, width))


# ---- undistortion ------------------------------------------------------------------------------------------


def test_undistorted_mask_is_exact(tmp_path: Path) -> None:
    """White where all four original pixels around an undistorted pixel's centre are there and white."""
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 90.0, WIDTH, HEIGHT)
    camera.params = [90.0, 91.0, WIDTH / 2, HEIGHT / 2, *DISTORTION]
    mask = blobs(5)
    options = pycolmap.UndistortCameraOptions()
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    undistort_mask(tmp_path / "mask.png", camera, options, tmp_path / "sub" / "out.png")
    found = read_picture(tmp_path / "sub" / "out.png", cv2.IMREAD_UNCHANGED)
    pinhole = pycolmap.undistort_camera(options, camera)
    assert found.shape == (pinhole.height, pinhole.width)
    x, y = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = pinhole.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    source = camera.img_from_cam(np.column_stack([rays, np.ones(len(rays))])) - 0.5
    low, share = np.floor(source).astype(int), source % 1
    # Off the pixels' centres, and off the image's rim, where a weight of nothing decides.
    certain = ((share > 0.01) & (share < 0.99)).all(axis=1)
    inside = ((low >= 0) & (low < [WIDTH - 1, HEIGHT - 1])).all(axis=1)
    column, row = np.clip(low, 0, [WIDTH - 2, HEIGHT - 2]).T
    corners = [mask[row + dy, column + dx] for dy in (0, 1) for dx in (0, 1)]
    expected = inside & (np.min(corners, axis=0) == 255)
    assert certain.mean() > 0.85
    assert 0.3 < expected.mean() < 0.7
    np.testing.assert_array_equal((found.ravel() == 255)[certain], expected[certain])
    assert set(np.unique(found)) == {0, 255}


def test_masks_of_a_workspace(tmp_path: Path) -> None:
    """In the geometry of the undistorted images, reduced with them, and only for images that have one."""
    sparse = make_project(tmp_path, "OPENCV", DISTORTION)
    masked = [NAMES[0], NAMES[2]]
    for name in masked:
        path = tmp_path / "masks" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:, : WIDTH // 2] = 0
        cv2.imwrite(str(path), mask)
        image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
        image[:, : WIDTH // 2] = 0
        cv2.imwrite(str(tmp_path / "images" / name), image)
    for size in (-1, 48):
        output = tmp_path / f"dense{size}"
        workspace = prepare(sparse, output, UndistortionOptions(size), masks=tmp_path / "masks")
        found = sorted(str(path.relative_to(output / "masks")) for path in (output / "masks").rglob("*.png"))
        assert found == [f"{name}.png" for name in masked]
        for name in masked:
            seen = read_picture(workspace.image_path(name), cv2.IMREAD_GRAYSCALE)
            kept = read_picture(workspace.mask_path(name), cv2.IMREAD_GRAYSCALE)
            # The image is white where its mask is: the undistorted mask keeps what is purely white.
            np.testing.assert_array_equal(kept == 255, seen == 255)
            assert 0.3 < np.mean(kept == 255) < 0.55


def test_a_mask_undistorts_with_ideal_fisheyes(tmp_path: Path) -> None:
    """COLMAP copies images of such cameras; ours are undistorted, and their masks with them."""
    sparse = make_project(tmp_path, "OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0))
    write_masks(tmp_path / "masks", NAMES)
    workspace = prepare(sparse, tmp_path / "dense", masks=tmp_path / "masks")
    for seed, name in enumerate(NAMES):
        image = read_picture(workspace.image_path(name), cv2.IMREAD_GRAYSCALE)
        mask = read_picture(workspace.mask_path(name), cv2.IMREAD_GRAYSCALE)
        assert mask.shape == image.shape
        assert not np.array_equal(mask, blobs(seed))


def test_a_changed_mask_is_undistorted_anew(tmp_path: Path) -> None:
    sparse = make_project(tmp_path)
    write_masks(tmp_path / "masks", NAMES)
    masks = tmp_path / "masks"
    workspace = prepare(sparse, tmp_path / "dense", masks=masks)
    before = {name: workspace.mask_path(name).stat().st_mtime_ns for name in NAMES}
    (masks / f"{NAMES[0]}.png").unlink()
    (masks / f"{NAMES[2]}.png").write_bytes((masks / f"{NAMES[1]}.png").read_bytes())
    prepare(sparse, tmp_path / "dense", masks=masks)
    assert not workspace.mask_path(NAMES[0]).exists()
    kept = [read_picture(workspace.mask_path(name), cv2.IMREAD_GRAYSCALE) for name in NAMES[1:3]]
    np.testing.assert_array_equal(kept[0], kept[1])
    for name in (NAMES[1], NAMES[3]):
        assert workspace.mask_path(name).stat().st_mtime_ns == before[name]
    prepare(sparse, tmp_path / "dense")  # without --masks
    assert not list(workspace.masks_dir.rglob("*.png"))


@pytest.mark.parametrize("kind", ["grey", "16 bits", "colour", "alpha", "palette"])
def test_any_png_is_a_mask(tmp_path: Path, kind: str) -> None:
    """What is not black counts, however dark."""
    shape = {"colour": (4, 6, 3), "alpha": (4, 6, 4)}.get(kind, (4, 6))
    mask = np.zeros(shape, np.uint16 if kind == "16 bits" else np.uint8)
    mask[1:3, 2:5] = 2
    if kind == "alpha":
        mask[..., 3] = 255
    if kind == "palette":
        image = Image.fromarray(mask).convert("P")
        image.save(tmp_path / "mask.png")
    else:
        cv2.imwrite(str(tmp_path / "mask.png"), mask)
    expected = np.zeros((4, 6), np.uint8)
    expected[1:3, 2:5] = 255
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png", 6, 4), expected)
    assert read_mask(tmp_path / "none.png", 6, 4) is None


@pytest.mark.parametrize("image", ["a/b.jpg", "a/b.png", "a/b", "a.c/b"])
def test_a_mask_is_found_where_colmap_finds_it(tmp_path: Path, image: str) -> None:
    """``b.jpg.png`` comes before ``b.png``."""
    usual = tmp_path / f"{image}.png"
    usual.parent.mkdir(parents=True)
    other = usual.parent / "b.png"
    assert mask_path(tmp_path, image) == usual
    other.touch()
    has_ending = "." in Path(image).name
    assert mask_path(tmp_path, image) == (other if has_ending else usual)
    usual.touch()
    assert mask_path(tmp_path, image) == usual


def test_masks_of_either_name(tmp_path: Path) -> None:
    """And in the workspace they have the name that all of COLMAP's programs know."""
    sparse = make_project(tmp_path)
    write_masks(tmp_path / "masks", NAMES)
    usual = prepare(sparse, tmp_path / "usual", masks=tmp_path / "masks")
    for name in NAMES:
        (tmp_path / "masks" / f"{name}.png").rename(tmp_path / "masks" / name)
    other = prepare(sparse, tmp_path / "other", masks=tmp_path / "masks")
    for name in NAMES:
        path = other.masks_dir / f"{name}.png"
        np.testing.assert_array_equal(read_picture(path), read_picture(usual.masks_dir / f"{name}.png"))


def test_masks_that_are_not_used_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    sparse = make_project(tmp_path)
    write_masks(tmp_path / "masks", NAMES)
    prepare(sparse, tmp_path / "one", masks=tmp_path / "masks")
    assert not caplog.records
    (tmp_path / "masks" / f"{NAMES[0]}.png").rename(tmp_path / "masks" / "a_mask.png")
    (tmp_path / "masks" / f"{NAMES[2]}.png").rename(tmp_path / "masks" / Path(NAMES[2]).name)
    (tmp_path / "masks" / ".DS_Store").touch()
    prepare(sparse, tmp_path / "two", masks=tmp_path / "masks")
    unused, bare = (record.getMessage() for record in caplog.records)
    assert unused.startswith(f"2 files in {tmp_path / 'masks'} (a_mask.png, c.png) belong to no image")
    assert bare == f"No mask in {tmp_path / 'masks'} for 2 images (a.png, cam/c.png): they are used whole"


@pytest.mark.parametrize(
    ("image", "there", "called"),
    [
        ("b\u00e9.png", "be\u0301.png.png", "b\u00e9.png.png"),
        ("be\u0301.png", "b\u00e9.png", "be\u0301.png"),
        ("b.png", "B.PNG.png", "b.png.png"),
    ],
)
@pytest.mark.parametrize("others", [NAMES[2:], []])
def test_masks_in_another_spelling(tmp_path: Path, image: str, there: str, called: str, others: list[str]) -> None:
    """Accents in two ways look alike, and the image would be used whole; also where it is not the only mask."""
    sparse = make_project(tmp_path)
    model = pycolmap.Reconstruction(sparse)
    next(each for each in model.images.values() if each.name == "b.png").name = image
    model.write(sparse)
    (tmp_path / "images/b.png").rename(tmp_path / "images" / image)
    write_masks(tmp_path / "masks", others)
    write_masks(tmp_path / "masks", [there.removesuffix(".png")])
    with pytest.raises(InputError) as error:
        prepare(sparse, tmp_path / "dense", masks=tmp_path / "masks")
    assert f"mask {there!a} in " in str(error.value) and f"called {called!a} " in str(error.value)
    with pytest.raises(InputError):
        check_mask_names(tmp_path / "masks", [image, *NAMES[2:]], tmp_path / "images")
    assert not (tmp_path / "dense").exists()


def test_a_mask_that_is_listed_in_another_spelling(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As on file systems that take both for one; here it has two names."""
    write_masks(tmp_path / "masks", NAMES)
    masks = tmp_path / "masks"
    other = masks / f"{NAMES[0].upper()}.png"
    if not other.exists():
        other.hardlink_to(masks / f"{NAMES[0]}.png")
    check_mask_names(masks, NAMES, tmp_path)
    assert not caplog.records
    other.unlink()
    write_masks(masks, [NAMES[0].upper(), NAMES[0]])
    check_mask_names(masks, NAMES, tmp_path)
    assert [record.getMessage().split(" belongs")[0] for record in caplog.records] == (
        [f"the file {other.name} in {masks}"] if len(list(masks.glob("*.png"))) > 2 else []
    )


def test_a_link_to_nothing_is_no_mask(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Also where it is called as a mask that is there, but for its case."""
    write_masks(tmp_path / "masks", NAMES)
    link = tmp_path / "masks" / f"{NAMES[0].upper()}.png"
    if not link.exists():
        link.symlink_to("nothing")
    check_mask_names(tmp_path / "masks", NAMES, tmp_path)
    assert not caplog.records


def test_images_that_differ_in_case_alone(tmp_path: Path) -> None:
    """Where files do: the mask of one is not that of the other."""
    write_masks(tmp_path / "masks", ["a.jpg"])
    check_mask_names(tmp_path / "masks", ["a.jpg", "A.jpg"], tmp_path)


def test_masks_beside_their_images(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The images are no masks of other images."""
    sparse = make_project(tmp_path)
    write_masks(tmp_path / "images", NAMES)
    prepare(sparse, tmp_path / "dense", masks=tmp_path / "images")
    assert not caplog.records


def test_images_are_no_masks_of_themselves(tmp_path: Path) -> None:
    """Their dark pixels would be left out. Those that are no PNGs have none, which is told."""
    sparse = make_project(tmp_path)
    with pytest.raises(
        InputError, match=r"--masks .*images is the folder of the images, and has no mask of a\.png"
    ):
        prepare(sparse, tmp_path / "dense", masks=tmp_path / "images")
    assert not (tmp_path / "dense").exists()


def test_a_damaged_mask_is_named(tmp_path: Path) -> None:
    """Half of one would ignore the other half."""
    path = tmp_path / "mask.png"
    cv2.imwrite(str(path), blobs(0))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"mask\.png is damaged .*; mend or remove it"):
        read_mask(path, WIDTH, HEIGHT)
    path.write_bytes(cv2.imencode(".png", np.zeros((5000, 6000), np.uint8))[1].tobytes())
    with pytest.raises(InputError, match=f"6000 x 5000 pixels, but its image {WIDTH} x {HEIGHT}"):
        read_mask(path, WIDTH, HEIGHT)


# ---- a run -------------------------------------------------------------------------------------------------


def world_x(camera: Camera, depth: np.ndarray, origin: float) -> np.ndarray:
    """World x of every pixel's exact surface point; `depth` is that at (col + origin, row + origin)."""
    columns, rows = np.meshgrid(np.arange(camera.width) + origin, np.arange(camera.height) + origin)
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.K).T
    return ((rays * depth[..., None] - camera.t) @ camera.R)[..., 0]


def mask_the_east(block: DemoBlock, folder: Path, border: float) -> None:
    """Masks which ignore all surface east of x = `border`, by exact depth; none for the last image."""
    folder.mkdir()
    for name in NADIR[:-1]:
        camera = block.cameras[block.names.index(name)]
        west = world_x(camera, block.truth(name)[0], 0.0) < border
        # The truth is that of the pixels' corners: a pixel is ignored with any of its four.
        mask = cv2.erode(np.where(west, 255, 0).astype(np.uint8), np.ones((3, 3), np.uint8))
        assert cv2.imwrite(str(folder / f"{name}.png"), mask)


@pytest.mark.parametrize("from_workspace", [False, True], ids=["model", "workspace"])
def test_what_is_masked_is_not_reconstructed(block: DemoBlock, project: Path, from_workspace: bool) -> None:
    keep_images(project, NADIR)
    middle = float(np.mean([c.centre[0] for n, c in zip(block.names, block.cameras, strict=True) if n in NADIR]))
    mask_the_east(block, project / "masks", middle)
    dense = project / "dense"
    if from_workspace:
        pycolmap.undistort_images(dense, project / "sparse" / "0", project / "images")
        report = colmap_sph.run(workspace=dense, masks=project / "masks", options=OPTIONS)
    else:
        report = colmap_sph.run(project / "sparse" / "0", masks=project / "masks", options=OPTIONS)
    assert report.images == len(NADIR)
    workspace = Workspace(dense)
    gsd = block.gsd
    for name in NADIR:
        camera = block.cameras[block.names.index(name)]
        truth = block.truth(name)[0]
        depth = read_depth_map(workspace.depth_map_path(name, "geometric"))
        if name in NADIR[:-1]:
            mask = read_picture(project / "masks" / f"{name}.png", cv2.IMREAD_GRAYSCALE)
            assert (mask == 0).mean() > 0.1
            assert not depth[mask == 0].any()
            assert not read_normal_map(workspace.normal_map_path(name, "geometric"))[mask == 0].any()
            assert (depth[mask > 0] > 0).mean() > 0.4
        scores = compare_depth_map(depth, truth, gsd=truth / camera.K[0, 0])
        assert scores.within[0] > 0.85, name
    # Its partners ignore the east: the image without a mask has nothing to compare its own with.
    x = read_points(dense / "fused.ply")[:, 0]
    assert len(x) == report.points > 5000
    assert np.mean(x > middle + 2 * gsd) < 1e-3
    assert np.percentile(x, 99.5) > middle - 20 * gsd


def test_a_black_mask_leaves_its_image_out(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep_images(project, NADIR)
    (project / "masks").mkdir()
    cv2.imwrite(str(project / "masks" / f"{NADIR[0]}.png"), np.zeros((240, 320), np.uint8))
    arguments = ["run", "--model", str(project / "sparse/0"), "--masks", str(project / "masks")]
    assert cli.main([*arguments, "--threads", "1"]) == PARTIAL_EXIT_CODE
    assert f"image skipped: {NADIR[0]}: " in capsys.readouterr().err
    workspace = Workspace(project / "dense")
    view = next(view for view in read_scene(workspace.sparse_dir).views if view.name == NADIR[0])
    assert not read_estimate(workspace.photometric_dir / f"{NADIR[0]}.sph", view).depth.any()


def test_masks_that_are_black_all_over(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """White may be what somebody wanted to be ignored: the message says which is which."""
    keep_images(project, NADIR)
    (project / "masks").mkdir()
    for name in NADIR:
        cv2.imwrite(str(project / "masks" / f"{name}.png"), np.zeros((240, 320), np.uint8))
    assert cli.main(["run", "--model", str(project / "sparse/0"), "--masks", str(project / "masks")]) == 4
    assert "is black in the masks what is to be ignored?" in " ".join(capsys.readouterr().err.split())


def spoil_nothing(folder: Path) -> None:
    shutil.rmtree(folder)


def spoil_names(folder: Path) -> None:
    for path in folder.iterdir():
        path.rename(path.with_name(path.name.replace(".jpg.png", "_mask.png")))


def spoil_size(folder: Path) -> None:
    cv2.imwrite(str(folder / f"{NADIR[1]}.png"), np.zeros((320, 240), np.uint8))


def spoil_content(folder: Path) -> None:
    (folder / f"{NADIR[1]}.png").write_bytes(b"\x89PNG\r\n\x1a\n no mask")


def spoil_kind(folder: Path) -> None:
    (folder / f"{NADIR[1]}.png").unlink()
    (folder / f"{NADIR[1]}.png").mkdir()


@pytest.mark.parametrize("from_workspace", [False, True], ids=["model", "workspace"])
@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (spoil_nothing, "does not exist; check --masks"),
        (spoil_names, f"that of {NADIR[0]} must be "),
        (spoil_size, "has 240 x 320 pixels, but its image 320 x 240"),
        (spoil_content, f"{NADIR[1]}.png is damaged or no image"),
        (spoil_kind, f"{NADIR[1]}.png is not a regular file"),
    ],
)
def test_masks_that_cannot_be_used(
    spoil, words: str, from_workspace: bool, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One sentence, before anything is written."""
    keep_images(project, NADIR)
    write_masks(project / "masks", NADIR, 240, 320)
    spoil(project / "masks")
    dense = project / "dense"
    arguments = ["--model", str(project / "sparse" / "0")]
    if from_workspace:
        pycolmap.undistort_images(dense, project / "sparse" / "0", project / "images")
        arguments = ["--workspace", str(dense)]
    before = sorted(project.rglob("*"))
    assert cli.main(["run", *arguments, "--masks", str(project / "masks")]) == 2
    output = capsys.readouterr().err
    assert words in output
    assert output.count("error: ") == 1
    assert "Traceback" not in output
    assert sorted(project.rglob("*")) == before
