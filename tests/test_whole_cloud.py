"""The whole cloud: a tree of fair samples of a file, served to one browser on this machine."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import tracemalloc
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
from small_workspaces import ground_workspace, write_cloud

from colmap_sph.app import cli
from colmap_sph.errors import InputError
from colmap_sph.pages.whole_cloud import CloudServer, blocks
from colmap_sph.pages.whole_cloud.blocks import FAN, LEAVES, CloudBlocks, CloudFrame
from colmap_sph.project.cloud_reader import read_some_points
from colmap_sph.project.workspace import Workspace

NAMES = ["a.png", "b.png"]
WORLD = CloudFrame(np.eye(3), np.zeros(3), 1.0)


@contextmanager
def tree_of(path: Path, frame: CloudFrame = WORLD) -> Iterator[CloudBlocks]:
    tree = CloudBlocks(path, frame)
    for number in range(tree.num_blocks):
        tree.index_block(number)
    try:
        yield tree
    finally:
        tree.close()


def nodes_of(tree: CloudBlocks) -> list[tuple[int, int]]:
    leaves = tree.num_blocks * LEAVES
    return [(height, k) for height in range(tree.height + 1) for k in range(-(-leaves // FAN**height))]


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """High trees of small clouds."""
    monkeypatch.setattr(blocks, "_BLOCK", 512)
    monkeypatch.setattr(blocks, "_NODE", 64)
    monkeypatch.setattr(blocks, "_QUARTERS", 128)
    monkeypatch.setattr(blocks, "_TELLING", 128)
    monkeypatch.setattr(blocks, "_KEPT_BLOCKS", 2)


def line_cloud(path: Path, count: int) -> np.ndarray:
    """Points along a line, as those of an image lie near each other, each of a colour of its own."""
    points = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)]).astype(float)
    colours = np.column_stack([np.arange(count) >> shift & 255 for shift in (0, 8, 16)]).astype(np.uint8)
    write_cloud(path, points, colours)
    return points


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(("count", "height"), [(1, 2), (511, 2), (512, 2), (513, 3), (5000, 4), (40_000, 6)])
def test_the_nodes_together_are_the_cloud(count: int, height: int, tmp_path: Path) -> None:
    """Each point once, with its colour."""
    line_cloud(tmp_path / "a.ply", count)
    with tree_of(tmp_path / "a.ply") as tree:
        assert tree.height == height
        found = [tree.node(*node) for node in nodes_of(tree)]
    places = np.concatenate([places for places, _ in found])
    colours = np.concatenate([colours for _, colours in found]).astype(int)
    assert sorted(places[:, 0].tolist()) == list(range(count))
    assert (colours @ [1, 256, 65536] == places[:, 0]).all()


@pytest.mark.usefixtures("small_blocks")
def test_every_level_is_a_fair_sample(tmp_path: Path) -> None:
    """Of every part of the cloud the root has its share, and so have all nodes of a height together."""
    line_cloud(tmp_path / "a.ply", 512 * 60)
    with tree_of(tmp_path / "a.ply") as tree:
        assert tree.height == 5
        nodes = {node: tree.node(*node)[0][:, 0] for node in nodes_of(tree)}
    for height, number in ((1, 128), (2, 64), (3, 16), (4, 4), (5, 1)):
        places = np.concatenate([each for node, each in nodes.items() if node[0] == height])
        assert (np.bincount((places // 512).astype(int), minlength=60) == number).all()
    # Within a block they are not its first points, but anywhere.
    upper = np.concatenate([each for node, each in nodes.items() if node[0] > 0]) % 512
    assert upper.min() < 20 and upper.max() > 492 and 200 < upper.mean() < 312


@pytest.mark.usefixtures("small_blocks")
def test_nodes_lie_where_their_boxes_are(tmp_path: Path) -> None:
    line_cloud(tmp_path / "a.ply", 512 * 20)
    with tree_of(tmp_path / "a.ply", CloudFrame(np.eye(3)[[1, 0, 2]], np.array([100.0, 0, 0]), 10.0)) as tree:
        leaves = [tree.node(0, number)[0] for number in range(20 * LEAVES)]
        quarters = [tree.node(1, number)[0] for number in range(20 * LEAVES // FAN)]
    for number, (box, places) in enumerate(zip(tree.boxes, leaves, strict=True)):
        assert box is not None
        block = number // LEAVES
        assert places[:, 1].min() >= (512 * block - 100) / 10 - 1e-4
        assert places[:, 1].max() <= (512 * (block + 1) - 100) / 10 + 1e-4
        # A sixteenth of a block each, in their order along the line.
        assert np.ptp(places[:, 1]) < 2 * 51.2 / LEAVES
        assert abs(np.median(places[:, 1]) - box[[1, 4]].mean()) < 2
        assert number % LEAVES == 0 or places[:, 1].min() > leaves[number - 1][:, 1].max()
        quarter = quarters[number // FAN][:, 1]
        assert quarter.min() < places[:, 1].max() and quarter.max() > places[:, 1].min()


@pytest.mark.usefixtures("small_blocks")
def test_points_that_are_nowhere_are_left_out(tmp_path: Path) -> None:
    points = line_cloud(tmp_path / "a.ply", 3000)
    points[::3] = np.nan
    points[1::3, 2] = 1e30
    points[512:1024] = np.inf
    write_cloud(tmp_path / "a.ply", points)
    with tree_of(tmp_path / "a.ply") as tree:
        assert tree.boxes[LEAVES : 2 * LEAVES] == [None] * LEAVES
        assert all(box is not None for box in tree.boxes[:LEAVES])
        found = np.concatenate([tree.node(*node)[0] for node in nodes_of(tree)])
    expected = points[2::3, 0][~np.isinf(points[2::3, 0])]
    assert sorted(found[:, 0].tolist()) == expected.tolist()


def test_a_large_cloud_takes_little_memory(tmp_path: Path) -> None:
    """Twenty million points, most of them in a hole of the file."""
    path = tmp_path / "large.ply"
    write_cloud(path, np.ones((1000, 3)))
    header = path.read_bytes().partition(b"end_header\n")[0].replace(b"vertex 1000", b"vertex 20000000")
    path.write_bytes(header + b"end_header\n")
    os.truncate(path, len(header) + 11 + 20_000_000 * 27)
    before = psutil.Process().memory_info().rss
    with tree_of(path) as tree:
        root, _ = tree.node(tree.height, 0)
        assert 5000 < len(root) < 40_000
        assert psutil.Process().memory_info().rss - before < 60e6


def test_some_points_of_a_large_cloud_take_the_memory_of_some(tmp_path: Path) -> None:
    """Not that of all that is read: 160 MB here, and up to a GiB."""
    path = tmp_path / "large.ply"
    write_cloud(path, np.ones((1000, 3)))
    header = path.read_bytes().partition(b"end_header\n")[0].replace(b"vertex 1000", b"vertex 6000000")
    path.write_bytes(header + b"end_header\n")
    os.truncate(path, len(header) + 11 + 6_000_000 * 27)
    tracemalloc.start()
    try:
        xyz, _, count = read_some_points(path, 10_000)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert count == 6_000_000
    assert 9_000 < len(xyz) <= 10_000 + 618  # at most one more of each piece
    assert peak < 5e6


@pytest.mark.parametrize(
    "header",
    [
        b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999999\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex -1\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
        b"ply" + b"\ncomment x" * 10_000,
        b"\0" * 100,
    ],
)
def test_what_is_no_cloud_is_refused(header: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(header)
    with pytest.raises(InputError, match=r"a\.ply"):
        CloudBlocks(tmp_path / "a.ply", WORLD)


def test_no_link_and_no_pipe_is_read(tmp_path: Path) -> None:
    line_cloud(tmp_path / "a.ply", 10)
    (tmp_path / "link.ply").symlink_to(tmp_path / "a.ply")
    os.mkfifo(tmp_path / "pipe.ply")
    for name in ("link.ply", "pipe.ply", "none.ply"):
        with pytest.raises(InputError, match=name):
            CloudBlocks(tmp_path / name, WORLD)


def test_a_file_that_is_cut_off_meanwhile(tmp_path: Path) -> None:
    line_cloud(tmp_path / "a.ply", 1000)
    with tree_of(tmp_path / "a.ply") as tree:
        os.truncate(tmp_path / "a.ply", 2000)
        with pytest.raises(InputError, match="was cut off"):
            tree.node(0, 0)
        for node in ((0, 16), (3, 0), (99, 0), (0, 999_999)):
            with pytest.raises(InputError, match="no such part"):
                tree.node(*node)


# ---- the server ----------------------------------------------------------------------------------------------


def coloured_ground(root: Path) -> Workspace:
    """Ground of 300,000 points, red in the west and green in the east, row by row."""
    made = ground_workspace(root, NAMES)
    x, y = np.meshgrid(np.linspace(-40, 60, 600), np.linspace(-30, 30, 500))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    colours = np.where(points[:, :1] < 10, np.array([200, 30, 30]), np.array([40, 160, 60])).astype(np.uint8)
    write_cloud(made.fused_path, points, colours)
    return made


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return coloured_ground(tmp_path_factory.mktemp("whole") / "<b>dense</b>")


@pytest.fixture(scope="module")
def server(workspace: Workspace) -> Iterator[CloudServer]:
    started = CloudServer(workspace)
    threading.Thread(target=started.run, daemon=True).start()
    yield started
    started.stop()
    started.close()


def get(address: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=10) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read(), dict(error.headers)


def test_the_page_and_its_parts_are_served(server: CloudServer) -> None:
    status, page, headers = get(server.address)
    assert status == 200 and b"&lt;b&gt;dense&lt;/b&gt;" in page and b"<b>" not in page
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    index = json.loads(get(f"{server.address}index.json")[1])
    assert index["count"] == 300_000 and len(index["leaves"]) == 32 and index["height"] == 3
    total = 0
    for height in range(4):
        for number in range(-(-32 // FAN**height)):
            status, content, _ = get(f"{server.address}node/{height}/{number}")
            assert status == 200 and len(content) % 15 == 0
            total += len(content) // 15
    assert total == 300_000


def test_nothing_else_is_served(server: CloudServer, workspace: Workspace) -> None:
    here = f"http://127.0.0.1:{server.port}/"
    for path in (
        "", "index.json", "node/0/0", "x/index.json", f"{server.address[len(here):-2]}/index.json",
    ):  # fmt: skip
        assert get(here + path)[0] == 404, path
    for rest in ("../", "node/0/99", "node/9/0", "node/-1/0", "node/0/0/", "fused.ply", "%2e%2e/fused.ply", "?a"):
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        connection.request("GET", f"/{server.address.split('/')[-2]}/{rest}")
        answer = connection.getresponse()
        assert answer.status == 404 and b"ply" not in answer.read(), rest
        connection.close()
    # By another name, as a page of strangers would call it; and to change anything.
    assert get(server.address, Host="stranger.example")[0] == 404
    request = urllib.request.Request(server.address, data=b"x", method="POST")
    with pytest.raises(urllib.error.HTTPError, match="501"):
        urllib.request.urlopen(request, timeout=10)


def test_only_this_machine_is_served(server: CloudServer) -> None:
    (listening,) = [
        each.laddr.ip
        for each in psutil.Process().net_connections("inet")
        if each.status == psutil.CONN_LISTEN and each.laddr.port == server.port
    ]
    assert listening == "127.0.0.1"


def test_a_port_that_is_taken(workspace: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        for words, code in ((["--full", "--port", str(port)], 2), (["--full", "--port", "99999"], 2)):
            assert cli.main(["view", str(workspace.root), *words]) == code
            assert "--port" in capsys.readouterr().err
    assert cli.main(["view", str(workspace.root), "--port", "7"]) == 2
    assert "--port is for --full" in capsys.readouterr().err


def test_without_a_cloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = ground_workspace(tmp_path / "dense", NAMES)
    made.fused_path.unlink()
    assert cli.main(["view", "--full", str(made.root)]) == 2
    assert "There is no cloud" in capsys.readouterr().err
    write_cloud(made.fused_path, np.zeros((0, 3)))
    assert cli.main(["view", "--full", str(made.root)]) == 2
    assert "has no points" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_command_serves_until_it_is_ended(number: int, code: int, workspace: Workspace) -> None:
    command = [sys.executable, "-P", "-m", "colmap_sph", "view", "--full", str(workspace.root)]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert get(f"{address}index.json")[0] == 200
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    assert process.returncode == code
    assert "served to this machine alone" in said and "Traceback" not in said
