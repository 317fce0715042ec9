"""Requests to the live page: files, the picture of the map, a stream of changes, and commands if allowed."""

from __future__ import annotations

import io
import json
import socket
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from urllib.parse import parse_qs

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import shorten
from hmt_slam_ros.view.board import Board, ClientState
from hmt_slam_ros.view.commands import MAX_COMMAND, Commands, PageCommand, parse_command
from hmt_slam_ros.view.connections import IDLE_TIME, BoundedServer, Streams
from hmt_slam_ros.view.host_check import HostCheck

PAGE = Path(__file__).parent / "page"
"""Folder of the page's files."""

_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".txt": "text/plain"}
"""{suffix of a file: its content type}."""

_FILES = {f"/{path.name}": path for path in sorted(PAGE.iterdir()) if path.suffix in _KINDS}
_FILES["/"] = _FILES.pop("/index.html")
"""{path of a request: file}."""

_MAX_DIGITS = 16
"""Digits of a number in a request, and one more."""

_PERIOD = 0.2
"""Least time between two events of a stream, s."""

_HEARTBEAT = 5.0
"""Longest time without a line on a stream, s: a closed connection shows only when something is written to it."""

_LOOK = 0.5
"""Longest time until a stream notices that it was closed to make room, s."""

_STREAM_BUFFER = 131_072
"""Bytes that the operating system keeps of a stream that is not read."""

_MAX_HEADER = 16_384
"""Bytes of a request; browsers send about 1000."""

_SECURITY_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
"""Of every answer: the page loads nothing from elsewhere, and no page of another site shows it or a part of it."""


class _RequestReader:
    """The lines of requests, of a bounded number of bytes for each request."""

    def __init__(self, file: io.BufferedIOBase) -> None:
        self._file, self._left = file, _MAX_HEADER

    def begin_request(self) -> None:
        """Allow the bytes of one more request."""
        self._left = _MAX_HEADER

    def readline(self, _limit: int = -1) -> bytes:
        """The next line.

        :raises OSError: where the request is too long.
        """
        line = self._file.readline(self._left)
        self._left -= len(line)
        if not self._left:
            raise OSError(f"a request of more than {_MAX_HEADER} bytes")
        return line

    def read(self, length: int) -> bytes:
        """So many bytes behind the lines, or fewer where the request is too long or ends."""
        content = self._file.read(min(length, self._left))
        self._left -= len(content)
        return content

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _number(query: dict[str, list[str]], name: str) -> int:
    """A whole number of a request, 0 where there is none.

    :raises HmtSlamError: where it is no whole number.
    """
    text = "".join(query.get(name, ["0"]))
    if not (text.isascii() and text.isdigit() and len(text) < _MAX_DIGITS):
        raise HmtSlamError(f"{name} = {shorten(text)} is no whole number: give one such as {name}=0")
    return int(text)


class PageHandler(BaseHTTPRequestHandler):
    """Answers the requests of one connection; a server makes a class of it with its board and the checks."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "hmt_slam_view", ""
    timeout = IDLE_TIME
    board: Board
    hosts: HostCheck
    streams: Streams
    commands: Commands

    def setup(self) -> None:
        """Bound what is read."""
        super().setup()
        self._reader = _RequestReader(self.rfile)
        self.rfile = self._reader  # type: ignore[assignment]

    def handle_one_request(self) -> None:
        """Wait for a request, and answer it."""
        self._reader.begin_request()
        self._mark(is_idle=True)
        super().handle_one_request()

    def _mark(self, *, is_idle: bool) -> None:
        assert isinstance(self.server, BoundedServer)
        self.server.connections.mark(self.connection, is_idle=is_idle)

    def do_GET(self) -> None:
        """Answer a browser."""
        self._mark(is_idle=False)
        path, _, query = self.path.partition("?")
        objection = self.hosts.objection(self.headers, self.connection.getsockname()[0])
        if objection:
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", objection.encode())
        elif path in _FILES:
            kind = f"{_KINDS[_FILES[path].suffix]}; charset=utf-8"
            self._answer(HTTPStatus.OK, kind, _FILES[path].read_bytes())
        elif path == "/map.png":
            self._send_map_image("".join(parse_qs(query).get("robot", [])))
        elif path == "/news":
            self._stream()
        else:
            try:
                self._send_json(path, parse_qs(query))
            except HmtSlamError as fault:
                self._answer(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(fault).encode())

    def do_POST(self) -> None:
        """Take a command, where the node allows it; answers with a sentence where it is refused."""
        self._mark(is_idle=False)
        self.close_connection = True
        refusal = self.hosts.objection(self.headers, self.connection.getsockname()[0])
        refusal = refusal or self.commands.objection(self.headers)
        if refusal:
            self._answer(HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", refusal.encode())
            return
        try:
            self.commands.put(self._read_command())
        except HmtSlamError as fault:
            self._answer(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(fault).encode())
        else:
            self._answer(HTTPStatus.ACCEPTED, "application/json", b"{}")

    def _read_command(self) -> PageCommand:
        """The command of the request.

        :raises HmtSlamError: where it is none.
        """
        length = self.headers.get("Content-Length", "")
        if self.path != "/command" or self.headers.get_content_type() != "application/json":
            raise HmtSlamError("a command is JSON that is posted to /command")
        if not (length.isascii() and length.isdigit() and len(length) < 5 and 0 < int(length) <= MAX_COMMAND):
            raise HmtSlamError(f"a command has 1 to {MAX_COMMAND} bytes: give its Content-Length")
        return parse_command(self._reader.read(int(length)).decode(errors="replace"))

    def _send_json(self, path: str, query: dict[str, list[str]]) -> None:
        """Answer with the whole board, with walls after some, or with the past at an event."""
        if path == "/snapshot.json":
            content = json.dumps(self.board.wait_for_changes(ClientState()), allow_nan=False).encode()
        elif path == "/walls.json":
            content = self.board.walls.answer(_number(query, "after"))
        elif path == "/past.json":
            content = self.board.past.content(_number(query, "event"))
        else:
            content = b""
        if content:
            self._answer(HTTPStatus.OK, "application/json", content)
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is no such page, or nothing on it yet")

    def _send_map_image(self, robot: str) -> None:
        picture, tag = self.board.map_image(robot)
        if not picture:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is no map yet")
        elif self.headers.get("If-None-Match") == f'"{tag}"':
            self._answer(HTTPStatus.NOT_MODIFIED, "image/png", b"", tag)
        else:
            self._answer(HTTPStatus.OK, "image/png", picture, tag)

    def _stream(self) -> None:
        """Send server-sent events: JSON objects of the sections that changed, at most five a second.

        A browser that does not read what was written within :data:`IDLE_TIME` is dropped.
        """
        self.close_connection = True
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _STREAM_BUFFER)
        self.streams.add(self.connection)
        try:
            self._send_header(HTTPStatus.OK, "text/event-stream")
            self.send_header("Connection", "close")
            self.end_headers()
            client = ClientState()
            with self.board.count_watcher():
                self._send_events(client)
        finally:
            self.streams.remove(self.connection)

    def _send_events(self, client: ClientState) -> None:
        """Send events until the stream is closed to make room, or by the browser.

        :raises OSError: where the browser closed it, or does not read.
        """
        last = time.monotonic()
        while self.connection in self.streams:
            changes = self.board.wait_for_changes(client, _LOOK)
            if changes:
                text = f"data: {json.dumps(changes, allow_nan=False, separators=(',', ':'))}"
            elif time.monotonic() - last >= _HEARTBEAT:
                text = ":"
            else:
                continue
            last = time.monotonic()
            self.wfile.write(f"{text}\n\n".encode())
            time.sleep(_PERIOD)

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

    def end_headers(self) -> None:
        """Add the headers of every answer, that of an error too."""
        for name, value in _SECURITY_HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, *_: object) -> None:
        """Log no requests."""
