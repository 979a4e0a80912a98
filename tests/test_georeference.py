"""A model finds its place on the map by cameras or control points, and says what is left at them."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational
from scipy.spatial.transform import Rotation
from small_workspaces import ALTITUDE, FOCAL, HEIGHT, LOOKING_DOWN, SPACING, WIDTH, ground_workspace

from colmap_sph.errors import ColmapSphError, InputError, NoResultError, OptionError
from colmap_sph.products.georeference import Georeference, read_georeference, write_georeference
from colmap_sph.products.georeferencing import GeoreferenceOptions, georeferenced, report_lines
from colmap_sph.project.alignment.gps import read_gps
from colmap_sph.project.alignment.similarity import estimate_similarity
from colmap_sph.project.wide.cuts import Cut
from colmap_sph.project.wide.layout import Face
from colmap_sph.project.wide.projection import Lens
from colmap_sph.project.wide.table import write_cuts
from colmap_sph.project.workspace import Workspace

NAMES = [f"a/{number}.png" for number in range(6)]
SCALE = 2.5
ROTATION = Rotation.from_euler("zyx", [130, 20, -15], degrees=True).as_matrix()
SHIFT = np.array([691_234.5, 5_334_567.25, 512.0])


def on_map(places: np.ndarray) -> np.ndarray:
    return SCALE * places @ ROTATION.T + SHIFT


def centers() -> np.ndarray:
    """Of a model whose cameras do not stand in one line."""
    return np.array([[number * SPACING, 15.0 * (number % 2), ALTITUDE + 3 * (number % 3)] for number in range(6)])


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = ground_workspace(tmp_path / "dense", NAMES)
    _write_model(made.sparse_dir, "PINHOLE", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    return made


def _write_model(folder: Path, camera_model: str, parameters: list[float]) -> None:
    folder.mkdir(exist_ok=True)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=camera_model, width=WIDTH, height=HEIGHT, params=parameters)
    )
    for number, center in enumerate(centers()):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(LOOKING_DOWN), -LOOKING_DOWN @ center)
        model.add_image_with_trivial_frame(pycolmap.Image(NAMES[number], np.empty((0, 2)), 1, number + 1), pose)
    model.write_binary(folder)


def write_lines(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def position_lines(places: np.ndarray) -> list[str]:
    return [f"{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in zip(NAMES, places.tolist(), strict=True)]


def mark_lines(points: dict[str, np.ndarray], radial: float = 0.0) -> list[str]:
    """Marks of points of the model in its images, by the formula of COLMAP's SIMPLE_RADIAL camera."""
    lines = []
    for label, point in points.items():
        x, y, z = on_map(point).tolist()
        for name, center in zip(NAMES, centers(), strict=True):
            ray = LOOKING_DOWN @ (point - center)
            u, v = ray[:2] / ray[2] * (1 + radial * ((ray[:2] / ray[2]) ** 2).sum())
            column = float(FOCAL * u + WIDTH / 2)
            row = float(FOCAL * v + HEIGHT / 2)
            if 0 <= column <= WIDTH and 0 <= row <= HEIGHT:
                lines.append(f"{label},{x!r},{y!r},{z!r},{name},{column!r},{row!r}")
    return lines


POINTS = {
    "P1": np.array([10.0, 5.0, 2.0]),
    "P2": np.array([60.0, -8.0, 0.0]),
    "P3": np.array([35.0, 25.0, -3.0]),
    "P4": np.array([80.0, 20.0, 6.0]),
}


def align(
    workspace: Workspace, table: Path, crs: str | None = None, marked_in: Path | None = None
) -> Georeference:
    return georeferenced(workspace, GeoreferenceOptions(crs=crs, align=table, marked_in=marked_in))


def test_camera_positions_give_the_similarity(workspace: Workspace, tmp_path: Path) -> None:
    table = write_lines(tmp_path / "cameras.csv", "image,x,y,z", *position_lines(on_map(centers())))
    before = (workspace.sparse_dir / "images.bin").read_bytes()
    found = align(workspace, table, "EPSG:25832")
    places = np.random.default_rng(1).uniform(-100, 100, (50, 3))
    np.testing.assert_allclose(found.to_map(places), on_map(places), atol=1e-6)
    assert max(each.length for each in found.residuals) < 1e-6
    assert (workspace.sparse_dir / "images.bin").read_bytes() == before
    kept = read_georeference(workspace)
    np.testing.assert_array_equal(kept.to_map(places), found.to_map(places))
    assert kept.crs == "EPSG:25832" and kept.residuals == found.residuals


@pytest.mark.parametrize("is_exchanged", [False, True])
def test_a_model_on_its_head_is_told(
    workspace: Workspace, tmp_path: Path, caplog: pytest.LogCaptureFixture, is_exchanged: bool
) -> None:
    """Cameras at one height fit as well with x and y exchanged: with the ground above them."""
    places = centers()
    places[:, 2] = ALTITUDE
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    for image in model.images.values():
        assert image.frame is not None
        place = places[NAMES.index(image.name)]
        image.frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(LOOKING_DOWN), -LOOKING_DOWN @ place)
    model.write_binary(workspace.sparse_dir)
    told = places[:, [1, 0, 2]] if is_exchanged else places
    found = align(workspace, write_lines(tmp_path / "cameras.csv", "image,x,y,z", *position_lines(told)))
    assert max(each.length for each in found.residuals) < 1e-6
    assert ("cameras.csv the model stands on its head: its images look up." in caplog.text) == is_exchanged


def test_gross_errors_are_left_out_and_told(workspace: Workspace, tmp_path: Path) -> None:
    places = on_map(centers()) + np.random.default_rng(2).normal(0, 0.01, (6, 3))
    places[3] += [40.0, -10.0, 5.0]
    table = write_lines(tmp_path / "cameras.csv", "image,x,y,z", *position_lines(places))
    found = align(workspace, table)
    assert [each.name for each in found.residuals if each.is_check] == [NAMES[3]]
    assert found.residuals[3].length == pytest.approx(np.linalg.norm([40, -10, 5]), abs=0.2)
    np.testing.assert_allclose(found.to_map(centers()), on_map(centers()), atol=0.1)
    assert any(line.startswith("1 gross error, left out: root mean square") for line in report_lines(found))


@pytest.mark.parametrize("is_distorted", [False, True])
def test_control_points_give_the_similarity(workspace: Workspace, tmp_path: Path, is_distorted: bool) -> None:
    radial = 0.05 if is_distorted else 0.0
    _write_model(tmp_path / "photographs", "SIMPLE_RADIAL", [FOCAL, WIDTH / 2, HEIGHT / 2, radial])
    lines = mark_lines(POINTS, radial)
    table = write_lines(tmp_path / "gcp.csv", "point,x,y,z,image,column,row", *lines)
    found = align(workspace, table, "EPSG:25832", tmp_path / "photographs")
    np.testing.assert_allclose(found.to_map(centers()), on_map(centers()), atol=1e-4)
    assert {each.name for each in found.residuals} == set(POINTS)
    assert max(each.pixels or 0.0 for each in found.residuals) < 1e-5


def test_check_points_are_counted(workspace: Workspace, tmp_path: Path) -> None:
    _write_model(tmp_path / "photographs", "SIMPLE_RADIAL", [FOCAL, WIDTH / 2, HEIGHT / 2, 0.0])
    lines = [f"{line},{'check' if line.startswith('P1') else 'control'}" for line in mark_lines(POINTS, 0.0)]
    table = write_lines(tmp_path / "gcp.csv", "point,x,y,z,image,column,row,role", *lines)
    found = align(workspace, table, "EPSG:25832", tmp_path / "photographs")
    assert list(report_lines(found))[1].startswith("1 check point: root mean square")


def test_control_points_may_be_marked_in_panoramas(workspace: Workspace, tmp_path: Path) -> None:
    """Also behind their middle, though the workspace has a view to one side of each alone."""
    width, height = 800, 400
    turned = Rotation.from_euler("yx", [70, 20], degrees=True).as_matrix()
    model, originals = pycolmap.Reconstruction(), pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=90, height=90, params=[40, 40, 45, 45])
    )
    originals.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=width, height=height, params=[width, height])
    )
    lines, cuts = [], {}
    for number, center in enumerate(centers()):
        R = Rotation.from_euler("y", 60 * number, degrees=True).as_matrix() @ LOOKING_DOWN
        for each, name, turn in ((model, f"left/{number}.png", turned), (originals, NAMES[number], np.eye(3))):
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn @ R), -turn @ R @ center)
            each.add_image_with_trivial_frame(pycolmap.Image(name, np.empty((0, 2)), 1, number + 1), pose)
        face = Face("left", tuple(map(tuple, turned.tolist())), 90, 90, 40.0, 45.0, 45.0)
        cuts[f"left/{number}.png"] = Cut(
            NAMES[number], Lens("EQUIRECTANGULAR", (width, height), width, height), face
        )
        for label, point in POINTS.items():
            x, y, z = R @ (point - center)
            column = float((np.arctan2(x, z) / (2 * np.pi) + 0.5) * width)
            row = float((np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height)
            lines.append(f"{label},{','.join(map(repr, on_map(point).tolist()))},{NAMES[number]},{column},{row}")
    model.write_binary(workspace.sparse_dir)
    write_cuts(cuts, workspace.sparse_dir)
    (tmp_path / "originals").mkdir()
    originals.write_binary(tmp_path / "originals")
    table = write_lines(tmp_path / "gcp.csv", "point,x,y,z,image,column,row", *lines)
    found = align(workspace, table, marked_in=tmp_path / "originals")
    np.testing.assert_allclose(found.to_map(centers()), on_map(centers()), atol=1e-4)
    assert max(each.pixels or 0.0 for each in found.residuals) < 1e-5


def test_check_points_do_not_take_part(workspace: Workspace, tmp_path: Path) -> None:
    lines = [f"{line},{'check' if line.startswith('P4') else 'control'}" for line in mark_lines(POINTS)]
    lines = [line.replace(repr(on_map(POINTS["P4"])[2].item()), "1000") for line in lines]
    table = write_lines(tmp_path / "gcp.csv", "point,x,y,z,image,column,row,role", *lines)
    found = align(workspace, table, marked_in=workspace.sparse_dir)
    np.testing.assert_allclose(found.to_map(centers()), on_map(centers()), atol=1e-4)
    assert [each.name for each in found.residuals if each.is_check] == ["P4"]
    assert found.residuals[3].difference[2] == pytest.approx(on_map(POINTS["P4"])[2] - 1000, abs=1e-4)


def test_a_name_that_begins_as_a_comment_is_told(
    workspace: Workspace, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = [line.replace("P4", "#4") for line in mark_lines(POINTS)]
    number = sum(line.startswith("#4") for line in lines)
    head = ("# a table, of, the, town, in, 1987, spring", "point,x,y,z,image,column,row")
    align(workspace, write_lines(tmp_path / "gcp.csv", *head, *lines), marked_in=workspace.sparse_dir)
    assert f"gcp.csv: {number} lines like '#4' not read" in caplog.text
    caplog.clear()
    quoted = [line.replace("#4", '"#4"') for line in lines]
    table = write_lines(tmp_path / "quoted.csv", *head, *quoted)
    found = align(workspace, table, marked_in=workspace.sparse_dir)
    assert [each.name for each in found.residuals] == ["P1", "P2", "P3", "#4"]
    assert "not read" not in caplog.text


def test_tables_may_be_european(workspace: Workspace, tmp_path: Path) -> None:
    lines = [
        line.replace(",", ";").replace(".", ",").replace(",png", ".png")
        for line in position_lines(on_map(centers()))
    ]
    table = write_lines(tmp_path / "cameras.csv", "# of the flight", "Label;Easting;Northing;Z", *lines)
    np.testing.assert_allclose(align(workspace, table).to_map(centers()), on_map(centers()), atol=1e-6)


def write_photograph(path: Path, latitude: float, longitude: float, height: float) -> None:
    def degrees(value: float) -> tuple[IFDRational, ...]:
        whole = int(abs(value))
        minutes = int((abs(value) - whole) * 60)
        seconds = ((abs(value) - whole) * 60 - minutes) * 60
        return IFDRational(whole), IFDRational(minutes), IFDRational(round(seconds * 1_000_000), 1_000_000)

    picture = Image.new("RGB", (WIDTH, HEIGHT))
    exif = picture.getexif()
    exif[0x8825] = {
        1: "N" if latitude >= 0 else "S", 2: degrees(latitude), 3: "E" if longitude >= 0 else "W",
        4: degrees(longitude), 5: b"\1" if height < 0 else b"\0", 6: IFDRational(round(abs(height) * 1000), 1000),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, "JPEG", exif=exif)


def test_gps_of_photographs_is_read(tmp_path: Path) -> None:
    write_photograph(tmp_path / "p" / "a.jpg", -33.87009602, -151.20999, -12.5)
    assert read_gps(tmp_path / "p" / "a.jpg") == pytest.approx((-33.87009602, -151.20999, -12.5), abs=1e-7)
    Image.new("RGB", (4, 4)).save(tmp_path / "b.jpg")
    assert read_gps(tmp_path / "b.jpg") is None and read_gps(tmp_path / "none.jpg") is None


def test_photographs_with_gps_place_a_model_in_their_utm_zone(workspace: Workspace, tmp_path: Path) -> None:
    pyproj = pytest.importorskip("pyproj")
    places = on_map(centers())
    to_gps = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4979", always_xy=True)
    for name, place in zip(NAMES, places, strict=True):
        longitude, latitude, height = to_gps.transform(*place)
        write_photograph(tmp_path / "photographs" / name, latitude, longitude, height)
    found = align(workspace, tmp_path / "photographs")
    assert found.crs == "EPSG:32632"
    assert pyproj.CRS.from_wkt(found.wkt).to_epsg() == 32632
    np.testing.assert_allclose(found.to_map(centers()), places, atol=0.02)


def test_positions_on_both_sides_of_the_180th_meridian_are_in_a_zone_beside_it(
    workspace: Workspace, tmp_path: Path
) -> None:
    """Their plain median lies anywhere: half way around the earth, where as many are east of it as west."""
    pyproj = pytest.importorskip("pyproj")
    to_gps = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:4979", always_xy=True)
    longitudes, latitudes, heights = to_gps.transform(*on_map(centers()).T)
    longitudes = (longitudes - np.median(longitudes)) % 360 - 180  # turned around the earth's axis
    assert min(longitudes) < -179.99 and max(longitudes) > 179.99 and abs(np.median(longitudes)) < 1
    rows = zip(NAMES, latitudes, longitudes, heights, strict=True)
    lines = [f"{name},{latitude:.12f},{longitude:.12f},{height:.6f}" for name, latitude, longitude, height in rows]
    found = align(workspace, write_lines(tmp_path / "gps.csv", "image,latitude,longitude,height", *lines))
    assert found.crs in {"EPSG:32660", "EPSG:32601"}
    to_zone = pyproj.Transformer.from_crs("EPSG:4979", found.crs, always_xy=True)
    expected = np.column_stack(to_zone.transform(longitudes, latitudes, heights))
    np.testing.assert_allclose(found.to_map(centers()), expected, atol=0.05)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "no column"),
        (["image,x,y,z", "a/0.png,1,2"], "line 2, has 3 values"),
        (["image,x,y,z", f"# {'-' * 200_000}", f"{'a' * 200_000},1,2,3"], "bad.csv is no table (field larger"),
        (["image,x,y,z", "# here", "a/0.png,1,2,north"], "line 3: z is 'north'"),
        (["image,x,y,z", "a/0.png,1,2,nan"], "line 2: z is 'nan'"),
        (["image,x,y,z", "a/0.png,1,2,3", "a/0.png,1,2,3"], "line 3: the image 'a/0.png' is there already"),
        (["image,lat,lon,alt", "a/0.png,500000,48,3"], "no latitude and longitude"),
        (["image,x,y,z", *(f"other{k}.png,{k},{k * k},3" for k in range(6))], "names other0.png"),
        (["image,x,y,z", "a/0.png,1,2,3", "a/1.png,2,2,3"], "2 images"),
        (["image,x,y,z", *(f"a/{k}.png,{k},{2 * k},3" for k in range(6))], "one line"),
        (["image,x,y,z,easting", *(f"a/{k}.png,{k},{2 * k},3,4" for k in range(6))], "two columns of one meaning"),
        (["point,x,y,z,image,column,row", "P,1,2,3,a/0.png,1000,5"], "line 2: 1000, 5 lies outside"),
        (["point,x,y,z,image,column,row", "P,1,2,3,a/0.png,1,5", "P,1,2,4,a/1.png,1,5"], "line 3: the point 'P'"),
        (["point,x,y,z,image,column,row", "P,,,,a/0.png,1,5"], "line 2: the point 'P' has no x"),
        (["point,x,y,z,image,column,row", "P,1,2,3,b.png,1,5"], "0 control points"),
        (
            ["point,x,y,z,image,column,row", "P,1,2,3,a/0.png,1,5", "P,,,,a/1.png,1,5", "P,,,,0.png,9,5"],
            "line 4: the point 'P' is marked in 0.png before",
        ),
        (["image,x,y,z", *(f"a/{k}.png,{k},{k * k},3" for k in range(6)), "3.png,3,9,3"], "a/3.png under two"),
        (["point,x,y,z,image,column,row,role", "P,1,2,3,b.png,1,5,chief"], "line 2: the role 'chief'"),
    ],
)  # fmt: skip
def test_bad_tables_are_refused(workspace: Workspace, tmp_path: Path, lines: list[str], words: str) -> None:
    table = write_lines(tmp_path / "bad.csv", *lines)
    with pytest.raises(InputError) as told:
        align(workspace, table, marked_in=workspace.sparse_dir)
    assert words in str(told.value) and "bad.csv" in str(told.value)
    assert not workspace.georeference_path.exists()


def test_what_cannot_be_is_refused(workspace: Workspace, tmp_path: Path) -> None:
    table = write_lines(tmp_path / "gcp.csv", "point,x,y,z,image,column,row", *mark_lines(POINTS))
    refused: list[tuple[GeoreferenceOptions, type[ColmapSphError], str]] = [
        (GeoreferenceOptions(align=tmp_path / "none.csv"), InputError, "none.csv cannot be read"),
        (GeoreferenceOptions(align=workspace.images_dir), InputError, "GPS position"),
        (GeoreferenceOptions(align=table), OptionError, "marked_in"),
        (GeoreferenceOptions(marked_in=workspace.sparse_dir), OptionError, "align"),
        (GeoreferenceOptions(crs="EPSG:99999"), OptionError, "EPSG:99999"),
        (GeoreferenceOptions(crs="EPSG:4326"), OptionError, "degrees"),
        (GeoreferenceOptions(crs="EPSG:25832"), InputError, "--align"),
        # At whose origin, on the equator, is no zone of theirs.
        (GeoreferenceOptions(crs="EPSG:32633"), InputError, "--align"),
        (GeoreferenceOptions(crs="EPSG:32733"), InputError, "--align"),
        (GeoreferenceOptions(crs="EPSG:4978"), InputError, "--align"),
        (GeoreferenceOptions(crs="EPSG:2056+5728"), InputError, "--align"),
        # Feet in plan and metres in height; axes to the south and the west.
        (GeoreferenceOptions(crs="EPSG:2263+5703"), OptionError, "one unit"),
        (GeoreferenceOptions(crs="EPSG:5513"), OptionError, "EPSG:5514"),
    ]
    for options, kind, words in refused:
        with pytest.raises(kind, match=words):
            georeferenced(workspace, options)
        assert not workspace.georeference_path.exists()


def test_places_far_from_their_system_are_refused(workspace: Workspace, tmp_path: Path) -> None:
    """What lies in New York has no place in the UTM zone of Sydney, nor a site grid at its own origin in any."""
    to_gps = pytest.importorskip("pyproj").Transformer.from_crs("EPSG:32618", "EPSG:4979")
    degrees = np.column_stack(to_gps.transform(*(centers() + np.array([500_000, 4_500_000, 0])).T))
    far = write_lines(tmp_path / "far.csv", "image,latitude,longitude,height", *position_lines(degrees))
    site = write_lines(tmp_path / "site.csv", "image,x,y,z", *position_lines(on_map(centers()) - SHIFT + 1000))
    for table, crs in ((far, "EPSG:32756"), (site, "EPSG:25832"), (site, "EPSG:25832+7837")):
        with pytest.raises(InputError, match=rf"{table.name} the cameras are at .* check --crs"):
            align(workspace, table, crs)
        assert not workspace.georeference_path.exists()
    assert align(workspace, site).crs == "" and align(workspace, far).crs == "EPSG:32618"


def test_upright_in_a_geocentric_system_is_not_along_its_axis(
    workspace: Workspace, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In the south images that look down look along the axis of the earth, to the north."""
    pyproj = pytest.importorskip("pyproj")
    to_earth = pyproj.Transformer.from_crs("EPSG:32734", "EPSG:4978", always_xy=True)
    x, y, z = to_earth.transform(*(centers() + np.array([400_000, 5_800_000, 0])).T)
    table = write_lines(tmp_path / "cape.csv", "image,x,y,z", *position_lines(np.column_stack([x, y, z])))
    found = align(workspace, table, "EPSG:4978")
    assert max(each.length for each in found.residuals) < 1e-3
    assert "head" not in caplog.text


def test_another_model_does_not_get_the_place_of_the_last(workspace: Workspace) -> None:
    write_georeference(workspace, Georeference(scale=2.0))
    assert read_georeference(workspace).scale == 2
    _write_model(workspace.sparse_dir, "SIMPLE_PINHOLE", [FOCAL, WIDTH / 2, HEIGHT / 2])
    assert read_georeference(workspace).scale == 2  # the same poses
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.zeros(3)))
    model.write_binary(workspace.sparse_dir)
    with pytest.raises(InputError, match="other poses"):
        read_georeference(workspace)
    workspace.georeference_path.write_text("{}")
    with pytest.raises(InputError, match="damaged"):
        read_georeference(workspace)


def test_what_was_said_is_kept_until_something_else_is_said(workspace: Workspace, tmp_path: Path) -> None:
    table = write_lines(tmp_path / "cameras.csv", "image,x,y,z", *position_lines(on_map(centers())))
    aligned = align(workspace, table, "EPSG:25832")
    assert georeferenced(workspace, GeoreferenceOptions()).scale == aligned.scale
    for name in ("EPSG:25832", "epsg:25832"):
        assert georeferenced(workspace, GeoreferenceOptions(crs=name)).scale == aligned.scale
    with pytest.raises(OptionError, match="align again"):
        georeferenced(workspace, GeoreferenceOptions(crs="EPSG:25833"))
    model = pycolmap.Reconstruction(workspace.sparse_dir)
    model.transform(pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(ROTATION), SHIFT))
    model.write_binary(workspace.sparse_dir)
    # The next zone goes on to the west, where many a map of two zones is drawn in one.
    assert georeferenced(workspace, GeoreferenceOptions(crs="EPSG:25833")).crs == "EPSG:25833"
    own = georeferenced(workspace, GeoreferenceOptions(crs="EPSG:25832"))
    assert own.is_identity and own.crs == "EPSG:25832" and not own.aligned_by


def test_similarity_of_a_third_gross_errors() -> None:
    rng = np.random.default_rng(3)
    source = rng.uniform(-1, 1, (30, 3))
    target = on_map(source) + rng.normal(0, 1e-3, source.shape)
    target[::3] += rng.uniform(-50, 50, (10, 3))
    found = estimate_similarity(source, target, robust=True)
    assert not found.used[::3].any() and found.used.sum() >= 15
    np.testing.assert_allclose(found(source), on_map(source), atol=0.01)


@pytest.mark.parametrize("number", [3, 4, 20])
def test_similarity_of_places_in_one_plane(number: int) -> None:
    """As of a flight at one height, wherever that is."""
    plane = np.random.default_rng(number).uniform(-100, 100, (number, 3)) * [1, 1, 0]
    for height in (0.0, 80.0):
        source = plane + np.array([0, 0, height])
        found = estimate_similarity(source, on_map(source))
        np.testing.assert_allclose(found(centers()), on_map(centers()), atol=1e-6)
        shift = np.array([5e5, 5.4e6, 300])
        level = estimate_similarity(source, source + shift)  # exactly in a plane in both frames
        np.testing.assert_allclose(level(centers()), centers() + shift, atol=1e-6)


def test_places_on_a_line_tell_no_similarity() -> None:
    rng = np.random.default_rng(4)
    line = np.outer(np.arange(8.0), [3.0, 4.0, 0.0]) * 10 + rng.normal(0, 0.1, (8, 3))
    with pytest.raises(NoResultError, match="one line"):
        estimate_similarity(line, on_map(line) + rng.normal(0, 0.5, (8, 3)))
    with pytest.raises(NoResultError, match="2 places"):
        estimate_similarity(line[:2], line[:2])
