"""The page's server: three files, the map's picture, and a stream of news; nothing can be changed through it."""

from __future__ import annotations

import ipaddress
import json
import struct
import threading
import time
import zlib
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.view.board import Board, ClientState

_UNKNOWN, _FREE, _OCCUPIED = 0, 1, 3
# Grayscale of two bits, without interlacing: see section 11.2.2 of the PNG specification, ISO/IEC 15948.
_BITS, _GRAY = 2, 0
_CELLS_IN_BYTE = 4
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_OCCUPIED_FROM = 50  # of 100


def grid_png(cells: NDArray[np.int8]) -> bytes:
    """Black where nothing is known, dark gray where free, white where occupied; the browser gives it its colors.

    :param cells: shape (height, width), -1 unknown, else 0 to 100; row 0 is the smallest y, and the picture's lowest.
    """
    height, width = cells.shape
    levels = np.full((height, -(-width // _CELLS_IN_BYTE) * _CELLS_IN_BYTE), _UNKNOWN, dtype=np.uint8)
    levels[:, :width][cells >= 0] = _FREE
    levels[:, :width][cells >= _OCCUPIED_FROM] = _OCCUPIED
    quads = levels[::-1].reshape(height, -1, _CELLS_IN_BYTE)
    packed = (quads << np.array([6, 4, 2, 0], dtype=np.uint8)).sum(axis=2, dtype=np.uint8)
    # Every row begins with the number of its filter, 0 for none.
    rows = np.concatenate([np.zeros((height, 1), dtype=np.uint8), packed], axis=1)
    header = struct.pack(">IIBBBBB", width, height, _BITS, _GRAY, 0, 0, 0)
    body = zlib.compress(rows.tobytes(), level=6)
    return _SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


LOCAL, PORT = "127.0.0.1", 8800
PAGE = Path(__file__).parent / "page"
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/view.css": ("view.css", "text/css; charset=utf-8"),
    "/view.js": ("view.js", "text/javascript; charset=utf-8"),
    "/draw.js": ("draw.js", "text/javascript; charset=utf-8"),
}
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_PERIOD = 0.2  # s between two pieces of news
# A browser that is gone is noticed when something is written to it.
_HEARTBEAT = 5.0  # s
_MOST_STREAMS = 20
_SECURITY = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'"


class PageServer:
    """Serves a board to browsers, in threads of its own.

    :ivar url: of the page.
    """

    def __init__(self, board: Board, address: str, port: int) -> None:
        """Listen.

        :param address: IP address of the interface to listen on.
        :param port: 0 for any that is free.
        :raises HmtSlamError: where that cannot be.
        """
        try:
            local = ipaddress.ip_address(address).is_loopback
        except ValueError:
            raise HmtSlamError(f"address = {address} is no IP address: give 127.0.0.1, or 0.0.0.0 for all") from None
        own = {"board": board, "local": local, "streams": threading.Semaphore(_MOST_STREAMS)}
        handler = type("_OwnHandler", (_Handler,), own)
        self._server = _bind_server(address, port, handler)
        self.url = f"http://{address}:{self._server.server_address[1]}/"
        threading.Thread(target=self._server.serve_forever, name="page", daemon=True).start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()


def check_port(port: int) -> None:
    """See whether a page could be served on a port of this computer.

    :raises HmtSlamError: where it cannot.
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
    # Several pages may come at once, as after a restart.
    request_queue_size = 64
    block_on_close = False

    def handle_error(self, _request: object, _client_address: object) -> None:
        """A browser that went away amid an answer is no fault."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    board: Board
    local: bool
    streams: threading.Semaphore

    def do_GET(self) -> None:
        """Answer a browser."""
        path = urlsplit(self.path).path
        if self.local and urlsplit(f"//{self.headers.get('Host', '')}").hostname not in _LOOPBACK:
            # A page of another site whose name was made to lead here.
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
        """Server-sent events: a JSON object of the sections that changed, at most five times a second."""
        if not self.streams.acquire(blocking=False):
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"too many pages look on: close some")
            return
        try:
            self._send_header(HTTPStatus.OK, "text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            seen = ClientState()
            with self.board.count_watcher():
                while True:
                    news = self.board.wait_for_changes(seen, _HEARTBEAT)
                    text = f"data: {json.dumps(news, allow_nan=False, separators=(',', ':'))}" if news else ":"
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
        """Requests are no news."""
