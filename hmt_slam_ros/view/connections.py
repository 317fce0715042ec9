"""An HTTP server of bounded connections and threads: a client that connects and sends nothing makes room for others."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

MAX_CONNECTIONS = 64
"""Connections, and threads that serve them, at once."""

IDLE_TIME = 10.0
"""Time after which a connection without a request is closed, and longest time for writing an answer, s."""

_MAKING_ROOM = 1.0
"""Longest wait for the thread of a connection that was closed to make room, s."""

_BUSY = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\nConnection: close\r\nContent-Length: 42\r\n\r\n"
    b"too many connections are open: close some\n"
)


class Connections:
    """The open connections of a server, the longest idle first. Thread-safe."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        # {connection: whether it waits for a request}, in the order in which they became idle.
        self._open: dict[socket.socket, bool] = {}

    def admit(self, connection: socket.socket) -> bool:
        """Add a connection; where there are as many as may be, the longest idle one is closed for it.

        :return: whether there is room.
        """
        with self._condition:
            if len(self._open) >= MAX_CONNECTIONS:
                idle = next((other for other, is_idle in self._open.items() if is_idle), None)
                if idle is None:
                    return False
                shut_down(idle)
                self._condition.wait_for(lambda: len(self._open) < MAX_CONNECTIONS, _MAKING_ROOM)
            if len(self._open) >= MAX_CONNECTIONS:
                return False
            self._open[connection] = True
            return True

    def mark(self, connection: socket.socket, *, is_idle: bool) -> None:
        """Record that a connection waits for a request, or is answered."""
        with self._condition:
            if self._open.pop(connection, None) is not None:
                self._open[connection] = is_idle

    def remove(self, connection: socket.socket) -> None:
        """Remove a connection whose thread ends."""
        with self._condition:
            self._open.pop(connection, None)
            self._condition.notify_all()

    def close_all(self) -> None:
        """Close all connections; their threads end by themselves."""
        with self._condition:
            for connection in self._open:
                shut_down(connection)

    def __len__(self) -> int:
        with self._condition:
            return len(self._open)


def shut_down(connection: socket.socket) -> None:
    """End both directions of a connection, so that the thread that waits for it goes on."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class BoundedServer(HTTPServer):
    """Serves each connection in a thread of its own, at most :data:`MAX_CONNECTIONS` at once.

    :ivar connections: the open ones.
    """

    # After a restart, several pages connect at once.
    request_queue_size = 128

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        """Bind.

        :raises OSError: where the port is taken or the address is none of this computer.
        """
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self.connections = Connections()
        super().__init__(address, handler)

    def server_bind(self) -> None:
        """Bind without asking the name service for the name of this computer, which may take long."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401  as socketserver has them
        """Serve a connection in a thread, or refuse it where there is no room."""
        if not self.connections.admit(request):
            request.setblocking(False)
            with suppress(OSError):
                request.send(_BUSY)
            self.shutdown_request(request)
            return
        try:
            threading.Thread(target=self._serve, args=(request, client_address), name="browser", daemon=True).start()
        except RuntimeError:  # the computer has no thread left
            self.connections.remove(request)
            self.shutdown_request(request)

    def _serve(self, request: socket.socket, client_address: object) -> None:
        try:
            self.finish_request(request, client_address)
        except (OSError, ValueError):
            # A browser that closed its connection during an answer, was too slow, or sent what is no request.
            pass
        finally:
            self.shutdown_request(request)
            self.connections.remove(request)

    def handle_error(self, _request: object, _client_address: object) -> None:
        """Ignore a connection that ended while it was accepted."""


class Streams:
    """The connections that stream, at most a number of them at once. Thread-safe."""

    def __init__(self, limit: int) -> None:
        self._lock, self._limit = threading.Lock(), limit
        self._open: list[socket.socket] = []

    def add(self, connection: socket.socket) -> None:
        """Add a stream; where there are as many as may be, the oldest is closed. A browser that reads reconnects."""
        with self._lock:
            self._open.append(connection)
            while len(self._open) > self._limit:
                shut_down(self._open.pop(0))

    def remove(self, connection: socket.socket) -> None:
        """Remove a stream that ended."""
        with self._lock:
            if connection in self._open:
                self._open.remove(connection)

    def __contains__(self, connection: socket.socket) -> bool:
        with self._lock:
            return connection in self._open
