"""The server of the live page: its files, the picture of the map and a stream of changes; it is read-only."""

from __future__ import annotations

import io
import ipaddress
import json
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.view.board import Board, ClientState

_UNKNOWN, _FREE, _OCCUPIED = 0, 85, 255
"""Gray levels of the map's picture, which the page replaces by its colors."""

_OCCUPIED_FROM = 50
"""Least occupancy of an occupied cell, of 100, as in nav_msgs/OccupancyGrid viewers."""

LOCAL, PORT = "127.0.0.1", 8800
"""Default address and port of the page."""

PAGE = Path(__file__).parent / "page"
"""Folder of the page's files."""

_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/view.css": ("view.css", "text/css; charset=utf-8"),
    "/view.js": ("view.js", "text/javascript; charset=utf-8"),
    "/draw.js": ("draw.js", "text/javascript; charset=utf-8"),
}
"""{path of a request: (file, content type)}."""

_LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Host names under which a page that listens on the loopback interface is served."""

_PERIOD = 0.2
"""Least time between two events of a stream, s."""

_HEARTBEAT = 5.0
"""Longest time without a line on a stream, s: a closed connection shows only when something is written to it."""

_MAX_STREAMS = 20
"""Streams that are served at once."""

_SECURITY = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'"
"""Content security policy: the page loads nothing from elsewhere."""


def grid_png(cells: NDArray[np.int8]) -> bytes:
    """An occupancy grid as a PNG of three gray levels: black unknown, dark gray free, white occupied.

    :param cells: shape (height, width), -1 unknown, else 0 to 100; row 0 is the smallest y, and the picture's lowest.
    """
    levels = np.select([cells >= _OCCUPIED_FROM, cells >= 0], [_OCCUPIED, _FREE], _UNKNOWN).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(levels[::-1]).save(file, "PNG")
    return file.getvalue()


class PageServer:
    """Serves a board to browsers, in threads of its own.

    :ivar url: of the page.
    """

    def __init__(self, board: Board, address: str, port: int) -> None:
        """Start to listen.

        :param address: IP address of the interface to listen on.
        :param port: TCP port, 0 for any free one.
        :raises HmtSlamError: where the address is invalid or the port is taken.
        """
        try:
            local = ipaddress.ip_address(address).is_loopback
        except ValueError:
            raise HmtSlamError(f"address = {address} is no IP address: give 127.0.0.1, or 0.0.0.0 for all") from None
        attributes = {"board": board, "local": local, "streams": threading.Semaphore(_MAX_STREAMS)}
        handler = type("_BoardHandler", (_Handler,), attributes)
        self._server = _bind_server(address, port, handler)
        self.url = f"http://{address}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, name="page", daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()


def check_port(port: int) -> None:
    """Check that a page can be served on a port of this computer.

    :raises HmtSlamError: where the port is taken.
    """
    _bind_server(LOCAL, port, _Handler).server_close()


def _bind_server(address: str, port: int, handler: type[BaseHTTPRequestHandler]) -> _Server:
    try:
        return _Server((address, port), handler)
    except (OSError, OverflowError) as fault:
        raise HmtSlamError(
            f"the page cannot listen on {address}, port {port} ({fault}): end the program that does, or give another "
            "port: -p port:=8801 of the node, --view 8801 of a replay"
        ) from fault


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # After a restart, several pages connect at once.
    request_queue_size = 64
    block_on_close = False

    def handle_error(self, _request: object, _client_address: object) -> None:
        """Ignore a browser that closed its connection during an answer."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    board: Board
    local: bool
    streams: threading.Semaphore

    def do_GET(self) -> None:
        """Answer a browser."""
        path = urlsplit(self.path).path
        if self.local and urlsplit(f"//{self.headers.get('Host', '')}").hostname not in _LOOPBACK:
            # DNS rebinding: a page of another site whose name resolves to this computer.
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"ask for 127.0.0.1 or localhost")
        elif path in _FILES:
            name, kind = _FILES[path]
            self._answer(HTTPStatus.OK, kind, (PAGE / name).read_bytes())
        elif path == "/map.png":
            self._send_map_image()
        elif path == "/snapshot.json":
            content = json.dumps(self.board.wait_for_changes(ClientState()), allow_nan=False).encode()
            self._answer(HTTPStatus.OK, "application/json", content)
        elif path == "/news":
            self._stream()
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such page")

    def _send_map_image(self) -> None:
        picture, tag = self.board.map_image()
        if not picture:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is no map yet")
        elif self.headers.get("If-None-Match") == f'"{tag}"':
            self._answer(HTTPStatus.NOT_MODIFIED, "image/png", b"", tag)
        else:
            self._answer(HTTPStatus.OK, "image/png", picture, tag)

    def _stream(self) -> None:
        """Send server-sent events: JSON objects of the sections that changed, at most five a second."""
        if not self.streams.acquire(blocking=False):
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"too many pages look on: close some")
            return
        try:
            self._send_header(HTTPStatus.OK, "text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            client = ClientState()
            with self.board.count_watcher():
                while True:
                    changes = self.board.wait_for_changes(client, _HEARTBEAT)
                    text = f"data: {json.dumps(changes, allow_nan=False, separators=(',', ':'))}" if changes else ":"
                    self.wfile.write(f"{text}\n\n".encode())
                    self.wfile.flush()
                    time.sleep(_PERIOD)
        except OSError:
            self.close_connection = True
        finally:
            self.streams.release()

    def _answer(self, status: HTTPStatus, kind: str, content: bytes, tag: str = "") -> None:
        self._send_header(status, kind)
        if tag:
            self.send_header("ETag", f'"{tag}"')
        if status is not HTTPStatus.NOT_MODIFIED:
            self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def _send_header(self, status: HTTPStatus, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-cache")
        self.send_header("Content-Security-Policy", _SECURITY)
        self.send_header("X-Content-Type-Options", "nosniff")

    def log_message(self, *_: object) -> None:
        """Log no requests."""
