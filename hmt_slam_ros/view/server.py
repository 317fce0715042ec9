"""The server of the live page."""

from __future__ import annotations

import io
import ipaddress
import threading
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.commands import Commands
from hmt_slam_ros.view.connections import BoundedServer, Streams
from hmt_slam_ros.view.host_check import HostCheck
from hmt_slam_ros.view.request_handler import PageHandler

_UNKNOWN, _FREE, _OCCUPIED = 0, 85, 255
"""Gray levels of the map's picture, which the page replaces by its colors."""

_OCCUPIED_FROM = 50
"""Least occupancy of an occupied cell, of 100, as in nav_msgs/OccupancyGrid viewers."""

LOCAL, PORT = "127.0.0.1", 8800
"""Default address and port of the page."""

_MAX_STREAMS = 20
"""Streams that are served at once."""

_LEVELS = np.select(
    [np.arange(256).astype(np.int8) >= _OCCUPIED_FROM, np.arange(256).astype(np.int8) >= 0],
    [_OCCUPIED, _FREE],
    _UNKNOWN,
).astype(np.uint8)
"""Gray level of each byte of an occupancy grid."""


def grid_png(cells: NDArray[np.int8]) -> bytes:
    """An occupancy grid as a PNG of three gray levels: black unknown, dark gray free, white occupied.

    :param cells: shape (height, width), -1 unknown, else 0 to 100; row 0 is the smallest y, and the picture's lowest.
    """
    file = io.BytesIO()
    Image.fromarray(_LEVELS[cells[::-1].view(np.uint8)]).save(file, "PNG")
    return file.getvalue()


class PageServer:
    """Serves a board to browsers, in threads of its own.

    :ivar url: of the page.
    """

    def __init__(
        self,
        board: Board,
        address: str,
        port: int,
        allowed_hosts: Iterable[str] = (),
        commands: Commands | None = None,
    ) -> None:
        """Start to listen.

        :param address: IP address of the interface to listen on.
        :param port: TCP port, 0 for any free one.
        :param allowed_hosts: host names under which the page is served, beside those of this computer.
        :param commands: where commands of browsers wait; None where none are allowed.
        :raises HmtSlamError: where the address is invalid or the port is taken.
        """
        try:
            version = ipaddress.ip_address(address).version
        except ValueError:
            raise HmtSlamError(f"address = {address} is no IP address: give 127.0.0.1, or 0.0.0.0 for all") from None
        commands = Commands() if commands is None else commands
        attributes = {
            "board": board,
            "hosts": HostCheck(allowed_hosts),
            "streams": Streams(_MAX_STREAMS),
            "commands": commands,
        }
        handler = type("_BoardHandler", (PageHandler,), attributes)
        self._server = _bind_server(address, port, handler)
        self.url = f"http://{f'[{address}]' if version == 6 else address}:{self._server.server_port}/"
        threading.Thread(target=self._server.serve_forever, name="page", daemon=True).start()

    @property
    def connection_count(self) -> int:
        """Number of open connections."""
        return len(self._server.connections)

    def close(self) -> None:
        """Stop listening, and close all connections."""
        self._server.shutdown()
        self._server.server_close()
        self._server.connections.close_all()


def check_port(port: int) -> None:
    """Check that a page can be served on a port of this computer.

    :raises HmtSlamError: where the port is taken.
    """
    _bind_server(LOCAL, port, PageHandler).server_close()


def _bind_server(address: str, port: int, handler: type[PageHandler]) -> BoundedServer:
    try:
        return BoundedServer((address, port), handler)
    except (OSError, OverflowError) as fault:
        raise HmtSlamError(
            f"the page cannot listen on {address}, port {port} ({fault}): end the program that does, or give another "
            "port: -p port:=8801 of the node, --view 8801 of a replay"
        ) from fault
