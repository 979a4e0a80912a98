"""The page of a workspace: what is on it, what it does not load, and what it says of what is missing."""

import base64
import hashlib
import json
import os
import re
import shlex
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import FinishedRun
from small_workspaces import HOSTILE_NAMES, ground_workspace, write_cloud

import colmap_sph
from colmap_sph.app import cli
from colmap_sph.app.run_command import RunCommand
from colmap_sph.errors import OutputError, printable
from colmap_sph.pages import write_page
from colmap_sph.pages.image_facts import small_pictures
from colmap_sph.pages.samples import read_normals, read_samples, samples_per_side
from colmap_sph.pages.words import duration
from colmap_sph.pipeline.options import RunOptions
from colmap_sph.pipeline.report_files import command_of
from colmap_sph.pipeline.stages.facts import Facts
from colmap_sph.pipeline.stages.maps import MapFiles
from colmap_sph.pipeline.stages.pair_files import write_estimate
from colmap_sph.project.map_files import read_depth_map, write_depth_map, write_normal_map
from colmap_sph.project.project import Project
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.state.ownership import map_place
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.depth import DepthEstimate
from colmap_sph.stereo.fusion import FusionOptions
from colmap_sph.stereo.partners.pairs import PairOptions

VOID = {"meta", "img", "input", "br", "link", "rect", "path", "image", "polygon"}
NAMES = ["a.png", "b.png", "c.png"]


class Page(HTMLParser):
    """A page taken apart: its elements with their attributes, and the text of each kind of element."""

    def __init__(self, workspace: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.source = Workspace(workspace).page_path.read_text(encoding="utf-8")
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self._open: list[str] = []
        self.feed(self.source)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self._open[-1] if self._open else "", data))

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def text(self, tag: str = "") -> str:
        return " ".join(text for name, text in self.texts if not tag or name == tag)

    @property
    def data(self) -> dict[str, Any]:
        found = re.search(r'<script type="application/json" id="data">(.*?)</script>', self.source, re.DOTALL)
        assert found is not None
        content: dict[str, Any] = json.loads(found[1])
        return content


def made(workspace: Workspace) -> Page:
    write_page(workspace)
    return Page(workspace.root)


# ---- after a run -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page(finished: FinishedRun) -> Page:
    return Page(finished.dense)


def test_a_run_ends_with_its_page(finished: FinishedRun, page: Page) -> None:
    report = finished.report
    assert f"{report.points:,}" in page.text("dd")
    assert f"{report.images} of {report.images} images with depth maps" in page.text("p")
    assert page.text("h3").split()[: report.images] == sorted(report.coverage)
    assert shlex.split(page.text("code"))[:2] == ["colmap_sph", "run"]
    for stage, seconds in report.seconds.items():
        assert stage in page.text("th")
        assert f"{seconds:,.1f}" in page.text("td")
    assert report.total_seconds > sum(report.seconds.values())
    assert f", in {duration(report.total_seconds)}." in page.text("p")


def test_threads_make_the_same_page(tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    write_page(workspace)
    alone = workspace.page_path.read_bytes()
    write_page(workspace, threads=3)
    assert workspace.page_path.read_bytes() == alone


def test_the_page_loads_nothing(page: Page) -> None:
    links = [value or "" for _, each in page.elements for name, value in each.items() if name in ("src", "href")]
    assert len(links) > 20
    assert all(link.startswith(("data:image/webp;base64,", "#")) for link in links)
    assert not {"link", "iframe", "object", "embed", "form", "base"} & {name for name, _ in page.elements}
    assert not [name for _, each in page.elements for name in each if name.startswith("on") or name == "style"]
    assert "@import" not in page.source
    assert "url(" not in page.source


def test_links_lead_to_their_places(page: Page) -> None:
    ids = [each["id"] for _, each in page.elements if "id" in each]
    assert len(ids) == len(set(ids))
    assert {(each["href"] or "")[1:] for each in page.all("a") if "href" in each} <= set(ids)


def test_only_the_pages_own_script_and_style_may_run(page: Page) -> None:
    policy = next(each["content"] for each in page.all("meta") if "http-equiv" in each)
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:;")
    for tag in ("style", "script"):
        (body,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page.source, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}';" in policy


def test_pairs_and_points_are_those_of_the_run(finished: FinishedRun, page: Page) -> None:
    report = finished.report
    names = sorted(report.coverage)
    assert page.data["names"] == names
    assert len(page.data["pairs"]) == report.pairs == len(report.matched_pairs)
    assert [
        (names[left], names[right], rows) for left, right, _, rows in page.data["pairs"]
    ] == report.matched_pairs
    assert sum(report.points_of.values()) == report.points
    assert set(report.points_of) <= set(names)


def test_a_rerun_still_knows_which_image_made_which_points(finished: FinishedRun) -> None:
    again = colmap_sph.run(workspace=finished.dense)
    assert again.made["fuse"] == 0
    assert again.points_of == finished.report.points_of


def test_angles_are_those_between_rays(finished: FinishedRun, page: Page) -> None:
    scene = read_scene(Workspace(finished.dense).sparse_dir)
    for left, right, angle, _ in page.data["pairs"][::7]:
        views = scene.views[left], scene.views[right]
        shared = sorted({*views[0].point_indices} & {*views[1].point_indices})
        rays = [scene.points[shared] - view.center for view in views]
        lengths = [np.linalg.norm(each, axis=1) for each in rays]
        angles = np.degrees(np.arccos((rays[0] * rays[1]).sum(axis=1) / (lengths[0] * lengths[1])))
        assert angle == pytest.approx(np.percentile(angles, 75), rel=0.02)


def test_the_cloud_on_the_page_is_whole(page: Page) -> None:
    data = page.data["cloud"]
    raw = base64.b64decode(data["text"])
    assert len(raw) == 9 * data["count"]
    places = np.frombuffer(raw, "<u2", 3 * data["count"]).reshape(-1, 3)
    assert places.min() < 1000
    assert places.max() > 64_000
    assert 1000 < data["count"] <= 60_000


def test_coverage_and_what_was_lost_add_up(finished: FinishedRun, page: Page) -> None:
    bars = [each["aria-label"] or "" for each in page.all("svg") if each.get("class") == "bar"]
    assert len(bars) == finished.report.images
    for name, words in zip(sorted(finished.report.coverage), bars, strict=True):
        shares = dict(re.findall(r"([a-z ]+?) ([\d.]+) %", words))
        assert sum(map(float, shares.values())) == pytest.approx(100, abs=0.5)
        # Of a sample of the pixels.
        assert float(shares["confirmed"]) == pytest.approx(100 * finished.report.coverage[name], abs=2)
    # Of all pixels, as the summary of the run says it.
    mean = 100 * np.mean(list(finished.report.coverage.values()))
    assert re.search(rf"\bcoverage\s+{mean:.1f} %", page.text())


def test_a_page_that_fails_does_not_fail_the_run(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    dense = tmp_path / "my dense"
    shutil.copytree(finished.dense, dense)

    def fail(*_: object, **__: object) -> str:
        raise RuntimeError("no ink")

    monkeypatch.setattr("colmap_sph.pages.write_page", fail)
    report = colmap_sph.run(workspace=dense)
    assert report.points == finished.report.points
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    command = re.search(r"report\.html could not be made \(no ink\);.* `(.*)` tries it again", warning)
    assert command and shlex.split(command[1]) == ["colmap_sph", "report", str(dense)]
    assert not Workspace(dense).page_path.exists(), "the page of the run before tells of other results"


# ---- what is missing ---------------------------------------------------------------------------------------


def run_cli(*arguments: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    code = cli.main(list(arguments))
    out, err = capsys.readouterr()
    return code, out, err


def test_an_unfinished_run_is_shown_and_said_to_be_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    workspace.fused_path.unlink()
    workspace.depth_map_path("b.png", "geometric").unlink()
    code, out, err = run_cli("report", str(workspace.root), capsys=capsys)
    assert code == 0
    assert out.strip() == str(workspace.page_path)
    sentence = (
        "1 of 3 images have no geometric depth map, there is no cloud and no run of this program has come to its "
        "end here, so that its numbers are not known."
    )
    assert f"not finished: {sentence}\n" in err
    page = Page(workspace.root)
    assert sentence in page.text("p")
    assert "There is no cloud yet: " in page.text("p")
    assert not page.all("canvas")


def test_a_workspace_of_colmap_alone_has_a_page(tmp_path: Path) -> None:
    """Without anything of ours in it; partners are those that overlap."""
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    shutil.rmtree(workspace.state_dir)
    page = made(workspace)
    assert "3 of 3 images with depth maps, 1,536 points." in page.text("p")
    assert page.data["cloud"]["count"] == 1536


def test_nothing_to_show_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    shutil.rmtree(workspace.stereo_dir)
    workspace.fused_path.unlink()
    code, out, err = run_cli("report", str(workspace.root), capsys=capsys)
    assert (code, out) == (2, "")
    assert "There is nothing to show of" in err.splitlines()[-1]
    assert not workspace.page_path.exists()


@pytest.mark.parametrize("command", ["report", "view"])
def test_what_is_no_workspace_is_refused(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "dense").mkdir()
    for part in ("dense", "images", "sparse/0"):
        (tmp_path / "project" / part).mkdir(parents=True)
    for folder, words in (
        (tmp_path, "did you mean .*dense"),
        (tmp_path / "project", r"did you mean .*project/dense\?"),
        (tmp_path / "no", "not exist"),
        (tmp_path / "file", "is a file"),
    ):
        code, out, err = run_cli(command, str(folder), capsys=capsys)
        assert (code, out) == (2, "")
        assert len(err.splitlines()) == 1
        assert re.search(words, err)


def test_a_link_out_of_the_workspace_is_not_written_through(tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    shutil.rmtree(workspace.state_dir)
    (tmp_path / "elsewhere").mkdir()
    workspace.state_dir.symlink_to(tmp_path / "elsewhere")
    assert cli.main(["report", str(workspace.root)]) == OutputError.exit_code
    assert not list((tmp_path / "elsewhere").iterdir())


def test_damaged_files_leave_holes(tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    workspace.image_path("a.png").write_bytes(b"no picture")
    workspace.depth_map_path("b.png", "geometric").write_bytes(b"160&120&1&")
    workspace.normal_map_path("c.png", "geometric").write_bytes(b"")
    workspace.fused_path.write_bytes(workspace.fused_path.read_bytes()[:-1])
    page = made(workspace)
    assert "is cut off" in page.text("p")
    pictures = [each["alt"] for each in page.all("img")]
    assert [pictures.count(name) for name in ("picture", "depth", "normals", "confirmed, and lost")] == [
        2,
        3,
        2,
        3,
    ]


@pytest.mark.parametrize(
    "report",
    [
        b"{",
        b'{"seconds": {"fuse": 1e308, "vote": 1e308}}',
        b'{"seconds": {"fuse": -1}, "points": -5}',
        b'{"coverage": {"../../../../etc/passwd": 0.5, "a.png": 0.25}, "points_of": {"\\u0000": 3}}',
        b'{"options": {"pairs": {"min_triangulation_angle": "1"}}, "matched_pairs": [["a.png", "nobody", 1.0]]}',
        b"[" * 100_000,
    ],
)
def test_a_report_that_is_not_ours_does_no_harm(report: bytes, tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    workspace.report_path.write_bytes(report)
    assert len(made(workspace).all("article")) == 3


def test_maps_made_after_the_report_are_said_to_be_newer(finished: FinishedRun, tmp_path: Path) -> None:
    dense = tmp_path / "dense"
    shutil.copytree(finished.dense, dense)
    workspace = Workspace(dense)
    assert "out of date" not in made(workspace).source
    content = json.loads(workspace.report_path.read_text())
    content["coverage"]["N_0_1.jpg"] /= 2
    workspace.report_path.write_text(json.dumps(content))
    assert re.search(r"out of date:</strong> .*ended: N_0_1\.jpg\.", made(workspace).source)


# ---- names of strangers ------------------------------------------------------------------------------------


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    told = {name: f"is {name}" for name in HOSTILE_NAMES}
    report = {
        "skipped_images": told,
        "skipped_pairs": told,
        "matched_pairs": [[*HOSTILE_NAMES[:2], 0.5]],
        "seconds": {HOSTILE_NAMES[0]: 1.0},
        "command": HOSTILE_NAMES[0],
        "versions": told,
        "doubts": HOSTILE_NAMES[2],
    }
    page = made(ground_workspace(tmp_path / "</title><script>", HOSTILE_NAMES, report=report))
    harmless = made(ground_workspace(tmp_path / "harmless", [f"{k}.png" for k in range(5)]))
    assert len(page.all("script")) == len(harmless.all("script")) == 2
    assert len(page.all("img")) == len(harmless.all("img"))
    assert not [name for _, each in page.elements for name in each if name.startswith("on")]
    names = [printable(name) for name in sorted(HOSTILE_NAMES)]
    assert [text for tag, text in page.texts if tag == "h3"][:5] == names
    assert page.data["names"] == names
    assert not re.search("[\u202e\u2028\x1b\x07]", page.source)


# ---- size --------------------------------------------------------------------------------------------------


def test_pictures_of_a_thousand_images_fit_the_page(tmp_path: Path) -> None:
    """The worst there is: noise, in pictures, depth, normals and reasons."""
    workspace = ground_workspace(tmp_path / "dense", NAMES[:1])
    (view,) = read_scene(workspace.sparse_dir).views
    samples = read_samples(workspace, view, samples_per_side(1000))
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 256, (384, 512, 3), dtype=np.uint8)
    reasons = rng.integers(0, 8, samples.geometric.shape, dtype=np.uint8)
    samples.geometric[:] = rng.uniform(1, 100, reasons.shape)
    pictures = small_pictures(workspace, view, samples, reasons, picture, 1000)
    assert len(pictures) == 4
    assert 1000 * sum(len(each.uri) for each in pictures) < 5.5e6
    few = small_pictures(workspace, view, samples, reasons, picture, 10)
    assert sum(len(each.uri) for each in few) < 1.4 * 60_000
    assert len(few[0].uri) > 2 * len(pictures[0].uri)


def test_text_of_a_thousand_images_fits_the_page(tmp_path: Path) -> None:
    """Beside pictures (5.5 MB), cloud (0.75 MB) and map (1 MB) there is room for 2.5 KB of each image."""
    lengths = []
    for number in (4, 24):
        names = [f"flight_{k:02d}/DJI_20261127_{k:05d}_W.JPG" for k in range(number)]
        pairs = [[one, other, 0.123] for k, one in enumerate(names) for other in names[k + 1 : k + 8]]
        report = {
            "matched_pairs": pairs,
            "coverage": dict.fromkeys(names, 0.5),
            "agreement": dict.fromkeys(names, 0.9),
        }
        page = made(ground_workspace(tmp_path / str(number), names, report=report))
        cloud = len(page.data["cloud"]["text"])
        lengths.append(len(re.sub(r"data:image/webp;base64,[\w+/=]*", "", page.source)) - cloud)
    assert (lengths[1] - lengths[0]) / 20 < 2500


def test_of_very_many_images_the_least_covered_and_some_others_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("colmap_sph.pages.page._MOST_SHOWN", 4)
    workspace = ground_workspace(tmp_path / "dense", [f"{k}.png" for k in range(9)])
    for name in ("3.png", "7.png"):
        write_depth_map(workspace.depth_map_path(name, "geometric"), np.zeros((120, 160), np.float32))
    page = made(workspace)
    shown = [text for tag, text in page.texts if tag == "h3"][:4]
    assert {"3.png", "7.png"} < set(shown)
    assert len(page.all("article")) == 4
    assert "Pictures of 4 images" in page.text("p")
    test_links_lead_to_their_places(page)


def test_samples_of_many_images_take_bounded_memory() -> None:
    for views in (1, 30, 1000, 10_000):
        assert 9 * views * samples_per_side(views) ** 2 < 1.3e8 or samples_per_side(views) == 24
    assert samples_per_side(30) == 192


def test_samples_are_pixels_of_the_maps(tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES[:1])
    (view,) = read_scene(workspace.sparse_dir).views
    samples = read_samples(workspace, view, 50)
    for kind, found in (("photometric", samples.photometric), ("geometric", samples.geometric)):
        whole = read_depth_map(workspace.depth_map_path("a.png", kind))  # type: ignore[arg-type]
        assert np.array_equal(found, whole[np.ix_(samples.rows, samples.columns)])
    assert 40 <= found.shape[1] <= 50


@pytest.mark.parametrize("corner", [(0, 0), (7, 5)])
def test_samples_of_what_was_voted_where_there_is_no_map_of_it(tmp_path: Path, corner: tuple[int, int]) -> None:
    """Of all of the image, or of the part of it that shows a region."""
    workspace = ground_workspace(tmp_path / "dense", NAMES[:1])
    (view,) = read_scene(workspace.sparse_dir).views
    left, top = corner
    voted = np.zeros((view.height, view.width), np.float32)
    voted[top:, left:] = 1 + np.random.default_rng(0).random((view.height - top, view.width - left), np.float32)
    part = np.ascontiguousarray(voted[top:, left:])
    estimate = DepthEstimate(part, part, np.ones(part.shape, np.uint8))
    path = workspace.photometric_dir / "a.png.sph"
    path.parent.mkdir(parents=True)
    workspace.depth_map_path("a.png", "photometric").unlink()
    assert not read_samples(workspace, view, 50).photometric.any()
    write_estimate(path, estimate, "key", Facts(), corner=corner)
    samples = read_samples(workspace, view, 50)
    assert np.array_equal(samples.photometric, voted[np.ix_(samples.rows, samples.columns)])
    assert not samples.has_photometric
    write_estimate(path, estimate, "key", Facts(), corner=(left + 1, top))  # it reaches beyond the image
    assert not read_samples(workspace, view, 50).photometric.any()


def test_what_was_voted_is_shown_and_not_maps_of_others(tmp_path: Path) -> None:
    """COLMAP's own, say, of a run on another machine; ours, which is fitted to what was voted, is."""
    workspace = ground_workspace(tmp_path / "dense", NAMES[:1])
    (view,) = read_scene(workspace.sparse_dir).views
    voted = np.full((view.height, view.width), 3, np.float32)
    path = workspace.photometric_dir / "a.png.sph"
    path.parent.mkdir(parents=True)
    write_estimate(path, DepthEstimate(voted, voted, np.ones(voted.shape, np.uint8)), "key", Facts())
    place = map_place(workspace, "a.png", "photometric")
    write_depth_map(place.files[0], np.full_like(voted, 5))
    assert (read_samples(workspace, view, 50).photometric == 3).all()
    MapFiles(place.files[0], place.files[1], place.record).write(
        np.zeros((*voted.shape, 3), np.float32), voted + 4, "key"
    )
    assert (read_samples(workspace, view, 50).photometric == 7).all()
    write_depth_map(place.files[0], np.full_like(voted, 5))  # over ours
    assert (read_samples(workspace, view, 50).photometric == 3).all()
    path.unlink()
    assert (read_samples(workspace, view, 50).photometric == 5).all()


def test_reduced_maps_are_shown(tmp_path: Path) -> None:
    """Maps of half as many rows and columns, as `max_image_size` of dense stereo makes them."""
    workspace = ground_workspace(tmp_path / "dense", NAMES[:1])
    (view,) = read_scene(workspace.sparse_dir).views
    half = 1 + np.arange(view.height * view.width / 4, dtype=np.float32).reshape(view.height // 2, -1)
    write_depth_map(workspace.depth_map_path("a.png", "geometric"), half)
    normals = np.dstack([half, -half, half])
    write_normal_map(workspace.normal_map_path("a.png", "geometric"), normals)
    samples = read_samples(workspace, view, 50)
    assert np.array_equal(samples.geometric, half[samples.rows // 2][:, samples.columns // 2])
    shown = read_normals(workspace, view, samples)
    assert shown is not None and np.array_equal(shown[1], -samples.geometric)
    assert "no geometric depth map" not in write_page(workspace)
    write_depth_map(workspace.depth_map_path("a.png", "geometric"), half[:, :-5])  # of another shape
    assert not read_samples(workspace, view, 50).has_geometric


# ---- the command, and the browser --------------------------------------------------------------------------


def test_the_command_repeats_the_run(tmp_path: Path) -> None:
    """Read as the command line reads it, it is the same project with the same options."""
    masks = tmp_path / "masks of 'mine'"
    masks.mkdir()
    project = Project(tmp_path / "sparse 0", images=tmp_path / "$(touch x)", output=tmp_path / "dense")
    options = RunOptions(
        threads=3,
        memory="2GiB",
        pairs=PairOptions(num_pairs=4),
        undistortion=colmap_sph.UndistortionOptions(max_image_size=800),
        fusion=FusionOptions(mask_path=masks, use_cache=True),
    )
    words = shlex.split(command_of(project, options))
    assert words[0] == "colmap_sph"
    command = cli._parsed(words[1:])
    assert isinstance(command, RunCommand)
    assert command.project == project
    assert command.options == options
    assert shlex.split(command_of(project, RunOptions()))[-2] == "--output"


def test_products_are_listed(tmp_path: Path) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    assert "Products" not in made(workspace).text("h2")
    names = ["surface/dsm.tif", "mesh/a & b.ply", "export/depth_exr/x.exr"]
    for name in names:
        (workspace.root / name).parent.mkdir(parents=True)
        (workspace.root / name).write_bytes(bytes(1500))
    (workspace.export_dir / "out.laz").symlink_to("/etc/hostname")
    picture = np.full((40, 60, 3), 200, np.uint8)
    cv2.imwrite(str(workspace.surface_dir / "preview_orthophoto.png"), picture)
    cv2.imwrite(str(workspace.surface_dir / "preview_large.png"), np.zeros((10, 5000, 3), np.uint8))
    (workspace.mesh_dir / "preview_mesh.png").write_bytes(b"no picture")
    os.mkfifo(workspace.mesh_dir / "preview_pipe.png")
    page = made(workspace)
    links = [each["href"] for each in page.all("a") if (each.get("href") or "").startswith("../")]
    assert links == ["../surface/dsm.tif", "../mesh/a%20%26%20b.ply", "../export/depth_exr"]
    assert "1.5 kB" in page.text("li")
    assert "1 file, 1.5 kB" in page.text("li")
    shown = [each for each in page.all("img") if each["alt"] == "orthophoto"]
    assert [(each["width"], each["height"]) for each in shown] == [("60", "40")]
    assert not {"large", "mesh", "pipe"} & {each["alt"] for each in page.all("img")}


def test_view_opens_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = ground_workspace(tmp_path / "a b#c", NAMES)
    opened: list[str] = []

    def open_browser(address: str) -> bool:
        opened.append(address)
        return True

    monkeypatch.setattr("webbrowser.open", open_browser)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    code, out, err = run_cli("view", str(workspace.root), capsys=capsys)
    assert (code, opened) == (2, [])
    assert "No browser can be opened here" in err
    assert out.strip() == str(workspace.page_path)
    monkeypatch.setenv("DISPLAY", ":0")
    code, _, _ = run_cli("view", str(workspace.root), capsys=capsys)
    assert code == 0
    assert opened == [workspace.page_path.as_uri()]
    assert opened[0].endswith("a%20b%23c/colmap_sph/report.html")


def test_view_makes_a_page_anew_that_is_older_than_the_cloud(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    workspace = ground_workspace(tmp_path / "dense", NAMES)
    monkeypatch.setattr("webbrowser.open", lambda _: True)
    monkeypatch.setenv("DISPLAY", ":0")
    write_page(workspace)
    made = workspace.page_path.stat().st_mtime_ns
    run_cli("view", str(workspace.root), capsys=capsys)
    assert workspace.page_path.stat().st_mtime_ns == made
    write_cloud(workspace.fused_path, np.zeros((7, 3)))
    os.utime(workspace.fused_path, ns=(made + 10**9, made + 10**9))
    code, _, _ = run_cli("view", str(workspace.root), capsys=capsys)
    assert code == 0
    assert "7 points" in workspace.page_path.read_text()
