"""A server for one browser on this machine: the page of a whole cloud, and the parts of it that the view wants."""

import json
import re
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np

from colmap_sph.errors import InputError, OptionError, counted, printable, reason_of
from colmap_sph.pages.markup import from_template, style_and_script
from colmap_sph.pages.whole_cloud.blocks import FAN, LEAVES, CloudBlocks, CloudFrame
from colmap_sph.platforms.surroundings import REUSES_PORTS
from colmap_sph.project.cloud_reader import read_some_points
from colmap_sph.project.cloud_tiles import index_of
from colmap_sph.project.files import real_path
from colmap_sph.project.scene_reader import read_scene
from colmap_sph.project.workspace import Workspace
from colmap_sph.stereo.region.map_axes import map_axes

_HERE = "127.0.0.1"
# Points that tell where to look from.
_FRAME_SAMPLE = 100_000
_NODE = re.compile(r"node/(\d{1,2})/(\d{1,6})")
# Depth that is seen behind the middle, times the size of the cloud.
_BEHIND = 4.0


class CloudServer:
    """Serves the cloud of a workspace; nobody else on this machine knows its address.

    Parameters
    ----------
    workspace : Workspace
    port : int
        Of this machine; 0: any that is free.
    looked_at : callable, optional
        Called with the number of blocks, and then after each that was looked at.

    Attributes
    ----------
    address : str
        Of the page.

    Raises
    ------
    InputError
        There is no cloud, or no model beside it.
    OptionError
        The port is taken.
    """

    def __init__(
        self, workspace: Workspace, *, port: int = 0, looked_at: Callable[[int], None] | None = None
    ) -> None:
        index = index_of(workspace)
        if index is not None:
            raise InputError(
                f"The cloud of {workspace.root} is in {counted(len(index.tiles), 'tile')}, and --full shows one "
                f"file: leave out --full, or open files of {workspace.tiles_dir} in CloudCompare, or run with "
                "--fusion.max-points-per-file 0, which makes one file of it."
            )
        if not workspace.fused_path.exists():
            raise InputError(
                f"There is no cloud in {workspace.root} yet; colmap_sph run makes one, and stereo_fusion fuses "
                "maps that are there."
            )
        self.blocks = CloudBlocks(workspace.fused_path, _frame_of(workspace))
        for number in range(self.blocks.num_blocks):
            self.blocks.index_block(number)
            if looked_at is not None:
                looked_at(self.blocks.num_blocks)
        self._secret = secrets.token_urlsafe(16)
        root = real_path(workspace.root)
        styled = style_and_script("whole_cloud/whole_cloud.css", "cloud.js", "whole_cloud/whole_cloud.js")
        values = {"title": "/".join(root.parts[-2:]), "count": f"{self.blocks.layout.count:,}", **styled}
        self.page = from_template("whole_cloud/whole_cloud.html", values).encode("utf-8", "backslashreplace")
        self.policy = (
            f"default-src 'none'; connect-src 'self'; style-src 'sha256-{styled['style_hash']}'; "
            f"script-src 'sha256-{styled['script_hash']}'; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )
        self.index = json.dumps(self._index()).encode()
        try:
            self._server = _Server((_HERE, port), _Handler)
        except (OSError, OverflowError) as error:
            self.blocks.close()
            raise OptionError(
                f"--port {port} cannot be used ({reason_of(error)}); choose another, or leave it out.", "port"
            ) from error
        self._server.cloud = self
        self.port: int = self._server.server_address[1]
        self.address = f"http://{_HERE}:{self.port}/{self._secret}/"

    def _index(self) -> dict[str, Any]:
        boxes = [None if box is None else box.round(6).tolist() for box in self.blocks.boxes]
        farthest = max((max(map(abs, box)) for box in boxes if box is not None), default=1.0)
        return {
            "count": self.blocks.layout.count,
            "fan": FAN,
            "height": self.blocks.height,
            "shares": [share / LEAVES for share in self.blocks.shares],
            "behind": _BEHIND * max(farthest, 1.0),
            "leaves": boxes,
        }

    def run(self) -> None:
        """Answer until `stop`, or until an exception such as an interruption comes."""
        self._server.serve_forever(poll_interval=0.2)

    def stop(self) -> None:
        """End `run` from another thread."""
        self._server.shutdown()

    def close(self) -> None:
        """Let go of the port and the file."""
        self._server.server_close()
        self.blocks.close()

    def knows(self, host: str | None, path: str) -> str | None:
        """What is asked for below the page's address; None for who does not know it, or calls it otherwise."""
        if host not in (f"{_HERE}:{self.port}", f"localhost:{self.port}"):
            return None  # a page of strangers, whose name leads here
        secret, _, rest = path.removeprefix("/").partition("/")
        return rest if secrets.compare_digest(secret.encode(), self._secret.encode()) else None


def _frame_of(workspace: Workspace) -> CloudFrame:
    """Look at a cloud as its map is drawn, from so far away that most of it is in view."""
    scene = read_scene(workspace.sparse_dir)
    points, _, _ = read_some_points(workspace.fused_path, _FRAME_SAMPLE)
    if not len(points):
        raise InputError(f"The cloud {workspace.fused_path} has no points; its page says why.")
    axes = map_axes(scene.views, points - scene.origin, origin=scene.origin)
    middle = np.median(points, axis=0)
    reach = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90))
    return CloudFrame(axes, middle, reach if reach > 0 else 1.0)


class _Server(ThreadingHTTPServer):
    allow_reuse_address = REUSES_PORTS
    daemon_threads = True
    cloud: CloudServer

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: whoever has gone away wants no answer."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "colmap_sph"
    sys_version = ""
    timeout = 60
    server: _Server

    def do_GET(self) -> None:
        """Answer for the page, the index, or a node."""
        cloud = self.server.cloud
        wanted = cloud.knows(self.headers.get("Host"), self.path)
        node = None if wanted is None else _NODE.fullmatch(wanted)
        if wanted == "":
            self._send(cloud.page, "text/html; charset=utf-8")
        elif wanted == "index.json":
            self._send(cloud.index, "application/json")
        elif node is not None:
            self._send_node(*map(int, node.groups()))
        else:
            self._send(b"There is nothing here.", "text/plain", HTTPStatus.NOT_FOUND)

    def _send_node(self, height: int, number: int) -> None:
        try:
            places, colours = self.server.cloud.blocks.node(height, number)
        except InputError as error:
            self._send(printable(error).encode(), "text/plain; charset=utf-8", HTTPStatus.NOT_FOUND)
        else:
            self._send(places.astype("<f4").tobytes() + colours.tobytes(), "application/octet-stream")

    def _send(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(content))),
            ("Content-Security-Policy", self.server.cloud.policy),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Nothing on the terminal."""
