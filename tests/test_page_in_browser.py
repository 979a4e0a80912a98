"""The page in a browser: it draws, obeys keys and narrow windows, complains of nothing, and names do nothing."""

import shutil
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from small_workspaces import HOSTILE_NAMES, ground_workspace
from test_whole_cloud import coloured_ground

from colmap_sph.pages import write_page
from colmap_sph.pages.whole_cloud import CloudServer
from colmap_sph.project.workspace import Workspace

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
NAMES = [f"{letter}.png" for letter in "dabce"]
COVERAGE = dict(zip(NAMES, (0.5, 0.25, 0.125, 1.0, 0.75), strict=True))
REPORT = {
    "coverage": COVERAGE,
    "matched_pairs": [["a.png", "b.png", 0.25], ["b.png", "c.png", None]],
    "seconds": {"match pairs": 3.0, "fuse": 1.0},
}
# WebGL without a graphics card.
ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)
        yield started
        started.close()


class Window:
    """A window with a page in it; what its console said, and what it asked for."""

    def __init__(self, browser: "Browser", workspace: Workspace, width: int = 800, **options: Any) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": 500}, **options)
        self.page = self.context.new_page()
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(workspace.page_path.as_uri())
        self.wait_for_drawing()

    def wait_for_drawing(self) -> None:
        """Until the cloud has been drawn at all, and again after what was done last."""
        limit = time.monotonic() + 20
        while self.page.evaluate("document.querySelector('#view:not([data-drawn])') !== null"):
            assert time.monotonic() < limit
            self.page.wait_for_timeout(20)
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def picture_of(self, selector: str) -> np.ndarray:
        """(H, W, 3) blue, green and red."""
        data = np.frombuffer(self.page.locator(selector).screenshot(), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert picture is not None
        return picture

    def names(self) -> list[str]:
        return self.page.locator("#image-table tbody th").all_inner_texts()

    def close(self) -> None:
        self.context.close()


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    made = ground_workspace(tmp_path_factory.mktemp("browser") / "dense", NAMES, report=REPORT)
    write_page(made)
    return made


@pytest.fixture
def window(browser: "Browser", workspace: Workspace) -> Iterator[Window]:
    opened = Window(browser, workspace)
    yield opened
    assert opened.said == []
    opened.close()


def green_pixels(picture: np.ndarray) -> int:
    """Pixels of the colour that all points of the cloud have."""
    return int((np.abs(picture.astype(int) - [60, 160, 40]).max(axis=2) < 12).sum())


def test_the_cloud_is_drawn_and_turned_by_keys(window: Window) -> None:
    first = window.picture_of("#view")
    assert green_pixels(first) > 2000
    window.page.locator("#view").focus()
    outlined = window.picture_of("#view")
    pictures = []
    for key in ("ArrowLeft", "ArrowUp", "+", "Shift+ArrowRight", "t"):
        window.page.keyboard.press(key)
        window.wait_for_drawing()
        pictures.append(window.picture_of("#view"))
    for before, after in pairwise([outlined, *pictures]):
        assert (before != after).mean() > 0.005
    assert green_pixels(pictures[2]) > 1.1 * green_pixels(pictures[1])
    window.page.keyboard.press("0")
    window.wait_for_drawing()
    assert np.array_equal(window.picture_of("#view"), outlined)


def test_the_cloud_from_above_is_the_block(window: Window) -> None:
    """Five images, 80 units apart in all, whose maps are 80 units wide and 40 high: four times as wide as high."""
    window.page.locator("#view").focus()
    window.page.keyboard.press("t")
    window.wait_for_drawing()
    picture = window.picture_of("#view").astype(int)
    rows, columns = np.nonzero(np.abs(picture - [60, 160, 40]).max(axis=2) < 12)
    width, height = np.ptp(columns), np.ptp(rows)
    assert width / height == pytest.approx(160 / 40, rel=0.15)


def test_the_mouse_turns_and_the_wheel_zooms(window: Window) -> None:
    first = window.picture_of("#view")  # which scrolls there
    box = window.page.locator("#view").bounding_box()
    assert box is not None
    mouse = window.page.mouse
    mouse.move(box["x"] + 200, box["y"] + 200)
    mouse.down()
    mouse.move(box["x"] + 320, box["y"] + 210, steps=4)
    mouse.up()
    window.wait_for_drawing()
    turned = window.picture_of("#view")
    assert (turned != first).mean() > 0.01
    mouse.wheel(0, -600)
    window.wait_for_drawing()
    assert green_pixels(window.picture_of("#view")) > 1.1 * green_pixels(turned)


def test_images_are_sorted_by_mouse_and_keys(window: Window) -> None:
    assert window.names() == sorted(NAMES)
    heading = window.page.locator("#image-table th", has_text="coverage")
    heading.locator("button").click()
    assert window.names() == sorted(NAMES, key=lambda name: COVERAGE[name])
    assert heading.get_attribute("aria-sort") == "ascending"
    window.page.keyboard.press("Enter")
    assert window.names() == sorted(NAMES, key=lambda name: -COVERAGE[name])
    assert heading.get_attribute("aria-sort") == "descending"
    assert window.page.locator("#image-table [aria-sort]").count() == 1


def test_layers_of_the_map_are_changed_by_keys(window: Window) -> None:
    first = window.picture_of("svg.block")
    window.page.locator("#layers input").first.focus()
    shown = []
    for _ in range(4):
        window.page.keyboard.press("ArrowRight")
        shown.append(window.picture_of("svg.block"))
    assert all((one != other).mean() > 0.02 for one, other in pairwise([first, *shown]))
    assert window.page.locator(".layer-text:visible").inner_text().startswith("Places of which")
    window.page.locator("#with-cameras").uncheck()
    assert not window.page.locator("#cameras").is_visible()


def test_a_camera_leads_to_its_pictures(window: Window) -> None:
    window.page.locator("#cameras a").nth(2).hover()
    assert window.page.locator("#footprints .chosen").count() == 1
    window.page.locator("#cameras a").nth(2).click()
    assert window.page.url.endswith("#image-2")
    assert window.page.locator("#image-2 h3").inner_text() == "c.png"


def test_pairs_are_listed_when_asked_for(window: Window) -> None:
    rows = window.page.locator("#pair-table tbody tr")
    assert rows.count() == 0
    window.page.locator("#pair-list summary").click()
    assert [text.split("\t") for text in rows.all_inner_texts()] == [
        ["a.png", "b.png", rows.nth(0).locator("td").nth(2).inner_text(), "0.25"],
        ["b.png", "c.png", rows.nth(1).locator("td").nth(2).inner_text(), ""],
    ]
    window.page.locator("#pair-filter").fill("A.p")
    assert rows.count() == 1


def test_pictures_are_shown(window: Window) -> None:
    window.page.locator("#image-1").scroll_into_view_if_needed()
    window.page.evaluate(
        "Promise.all([...document.querySelectorAll('#image-1 img')].map((each) => each.decode()))"
    )
    # The upper sixth is lost, the next found by its own pairs alone.
    picture = window.picture_of("#image-1 figure:nth-child(4) img")
    assert picture[len(picture) // 2, -30].tolist() == [184, 163, 148]
    assert picture[5, -30].tolist() != picture[len(picture) // 2, -30].tolist()


def test_nothing_is_loaded(window: Window, workspace: Workspace) -> None:
    window.page.evaluate("document.querySelectorAll('img').forEach((each) => { each.loading = 'eager'; })")
    window.page.wait_for_load_state("networkidle")
    assert {address for address in window.asked if not address.startswith("data:")} == {
        workspace.page_path.as_uri()
    }


@pytest.mark.parametrize("width", [320, 360, 700])
def test_a_narrow_window_needs_no_scrolling_sideways(width: int, browser: "Browser", workspace: Workspace) -> None:
    window = Window(browser, workspace, width)
    assert window.page.evaluate("document.documentElement.scrollWidth") == width
    assert green_pixels(window.picture_of("#view")) > 200
    window.close()


def test_by_night_it_is_dark(browser: "Browser", workspace: Workspace) -> None:
    for scheme, is_dark in (("light", False), ("dark", True)):
        window = Window(browser, workspace, color_scheme=scheme)
        paper = window.picture_of("h1").reshape(-1, 3)
        assert (np.median(paper) < 60) == is_dark
        window.close()


def test_hostile_names_do_nothing(browser: "Browser", tmp_path: Path) -> None:
    pairs = [[one, other, 0.5] for one, other in pairwise(HOSTILE_NAMES)]
    report = {"matched_pairs": pairs, "skipped_images": {name: name for name in HOSTILE_NAMES}}
    workspace = ground_workspace(tmp_path / "dense", HOSTILE_NAMES, report=report)
    write_page(workspace)
    window = Window(browser, workspace)
    window.page.locator("#pair-list summary").click()
    for locator in (window.page.locator("#cameras a").first, window.page.locator("#pair-table td").first):
        locator.hover()
    assert window.page.locator("#pair-table tbody tr").count() == len(pairs)
    assert window.page.title().endswith("dense reconstruction")
    assert window.page.locator("script").count() == 2
    assert window.said == []
    window.close()


# ---- the whole cloud ---------------------------------------------------------------------------------------


def test_the_whole_cloud_comes_as_one_looks(browser: "Browser", tmp_path: Path) -> None:
    """From afar a part of it, near by all that is in view; the west is red, the east green."""
    server = CloudServer(coloured_ground(tmp_path / "dense"))
    threading.Thread(target=server.run, daemon=True).start()
    page = browser.new_page(viewport={"width": 500, "height": 400})
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(server.address)
    wait_until_complete(page)
    drawn = int(page.evaluate("document.getElementById('view').dataset.drawn"))
    assert 20_000 < drawn <= 300_000
    page.locator("#view").focus()
    page.keyboard.press("t")
    wait_until_complete(page)
    picture = picture_of(page)
    red = np.abs(picture - [30, 30, 200]).max(axis=2) < 12
    green = np.abs(picture - [60, 160, 40]).max(axis=2) < 12
    assert red.sum() > 3000 and green.sum() > 3000
    assert abs(np.nonzero(red)[1].mean() - np.nonzero(green)[1].mean()) > 60
    # Next to it, the ground has no gaps, and there is nothing more to come.
    for _ in range(12):
        page.keyboard.press("+")
    wait_until_complete(page)
    picture = picture_of(page)
    middle = picture[60:-60, 60:-60]
    is_ground = (np.abs(middle - [30, 30, 200]).max(axis=2) < 12) | (
        np.abs(middle - [60, 160, 40]).max(axis=2) < 12
    )
    assert is_ground.mean() > 0.99
    asked_for = {address.removeprefix(server.address) for address in asked}
    assert asked_for >= {"", "index.json", "node/3/0"} and all(
        address.startswith(server.address) for address in asked
    )
    assert "points drawn" in page.locator("#status").inner_text()
    assert said == []
    page.close()
    server.stop()
    server.close()


def wait_until_complete(page: "Page") -> None:
    limit = time.monotonic() + 20
    page.wait_for_timeout(200)  # for the keys to act
    while page.evaluate("document.getElementById('view').dataset.missing") != "0":
        assert time.monotonic() < limit
        page.wait_for_timeout(50)


def picture_of(page: "Page") -> np.ndarray:
    """(H, W, 3) blue, green and red, of the cloud."""
    picture = cv2.imdecode(np.frombuffer(page.locator("#view").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture.astype(int)
