"""The live page against clients that connect and send nothing, do not read, or ask under another site's name."""

import contextlib
import http.client
import json
import socket
import threading
import time

import numpy as np
import pytest

from hmt_slam_ros.view import server as server_module
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.connections import MAX_CONNECTIONS
from hmt_slam_ros.view.request_handler import PageHandler
from hmt_slam_ros.view.server import PageServer, grid_png


@pytest.fixture
def board():
    return Board()


@pytest.fixture
def serve(board):
    servers = []

    def serve(address="127.0.0.1", allowed_hosts=()):
        servers.append(PageServer(board, address, 0, allowed_hosts))
        return int(servers[-1].url.rsplit(":", 1)[1].strip("/"))

    serve.servers = servers
    yield serve
    for server in servers:
        server.close()


@pytest.fixture
def connect():
    """Opens connections that stay until the end, and sends a text on each."""
    opened = []

    def connect(port, text=b""):
        connection = socket.create_connection(("127.0.0.1", port), timeout=20)
        connection.sendall(text)
        opened.append(connection)
        return connection

    yield connect
    for connection in opened:
        connection.close()


def ask(port, path="/snapshot.json", address="127.0.0.1", **headers):
    """Status, headers and content of an answer."""
    connection = http.client.HTTPConnection(address, port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, answer.headers, content


def wait_until(condition, seconds=20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def has_ended(connection):
    """Whether the other side has closed a connection, of which all is read that has come."""
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except ConnectionResetError:
        pass
    return True


def browser_threads():
    return sum(thread.name == "browser" or "process_request" in thread.name for thread in threading.enumerate())


def test_a_thousand_idle_connections_lock_nobody_out_and_take_few_threads(serve, connect):
    port = serve()
    for number in range(1000):
        connect(port, b"GET /news HT" if number % 2 else b"")
    assert ask(port)[0] == 200
    assert browser_threads() <= MAX_CONNECTIONS
    assert serve.servers[0].connection_count <= MAX_CONNECTIONS


def test_a_connection_without_a_request_is_closed_after_a_while(serve, connect, monkeypatch):
    assert PageHandler.timeout == 10.0
    monkeypatch.setattr(PageHandler, "timeout", 0.2)
    connection = connect(serve(), b"GET /snapshot.json HTTP/1.1\r\n")
    assert connection.recv(100) == b""


def test_where_every_connection_is_busy_a_further_one_is_refused_in_a_sentence(serve, connect, monkeypatch):
    monkeypatch.setattr(server_module, "_MAX_STREAMS", 10 * MAX_CONNECTIONS)
    port = serve()
    for _ in range(MAX_CONNECTIONS):
        connect(port, b"GET /news HTTP/1.1\r\nHost: localhost\r\n\r\n").recv(1)
    answer = connect(port).recv(1000)
    assert answer.startswith(b"HTTP/1.1 503 ")
    assert answer.endswith(b"too many connections are open: close some\n")


def test_streams_that_nobody_reads_lock_nobody_out(serve, connect):
    port = serve()
    streams = [connect(port, b"GET /news HTTP/1.1\r\nHost: localhost\r\n\r\n") for _ in range(20)]
    for stream in streams:
        stream.recv(1)
    reader = connect(port, b"GET /news HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert reader.recv(1000).startswith(b"HTTP/1.1 200 ")
    assert ask(port)[0] == 200
    # One of them made room, the first that was served.
    wait_until(lambda: any(has_ended(stream) for stream in streams))


def test_a_stream_that_is_not_read_is_dropped(serve, connect, board, monkeypatch):
    monkeypatch.setattr(PageHandler, "timeout", 0.5)
    port = serve()
    connect(port, b"GET /news HTTP/1.1\r\nHost: localhost\r\n\r\n").recv(1)
    assert serve.servers[0].connection_count == 1
    for number in range(200):
        board.put("graph", f"{number}" * 200_000)
        if not serve.servers[0].connection_count:
            return
        time.sleep(0.1)
    pytest.fail("it holds its connection")


def test_a_request_of_endless_headers_is_ended(serve, connect):
    connection = connect(serve(), b"GET / HTTP/1.1\r\n" + b"A" * 16_400)
    with contextlib.suppress(ConnectionResetError):
        assert connection.recv(100) == b""


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0"])
def test_a_page_of_another_site_gets_nothing_at_any_address(serve, address):
    port = serve(address)
    for host in (
        "evil.example",
        f"evil.example:{port}",
        "127.0.0.1.evil.example",
        "[::1",
        "",
        "localhost@evil.example:80",
    ):
        status, _, content = ask(port, Host=host)
        assert status == 403, host
        assert content == (
            b"the page is not served under this host name: ask for its address, or start view with allowed_hosts"
        )
    for host in ("localhost", f"127.0.0.1:{port}", socket.gethostname()):
        assert ask(port, Host=host)[0] == 200
    own = f"127.0.0.1:{port}"
    assert ask(port, Host=own, Origin=f"http://{own}")[0] == 200
    for origin in ("http://evil.example", "null", f"http://localhost:{port + 1}", "http://[::1", ""):
        status, _, content = ask(port, Host=own, Origin=origin)
        assert status == 403, origin
        assert content == b"the page is not served to other sites: open it by its own address"


def test_two_hosts_in_a_request_are_refused(serve, connect):
    connection = connect(serve(), b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n")
    assert connection.recv(100).startswith(b"HTTP/1.1 403 ")


def test_hosts_that_the_parameter_names_are_served(serve):
    port = serve("0.0.0.0", (" Robot.example", ""))
    assert ask(port, Host=f"robot.example:{port}")[0] == 200
    assert ask(port, Host="other.example")[0] == 403


@pytest.mark.parametrize("path", ["/", "/snapshot.json", "/map.png", "/none"])
def test_no_answer_may_be_framed_or_taken_for_another_kind(serve, path):
    port = serve()
    for host in ("localhost", "evil.example"):
        headers = ask(port, path, Host=host)[1]
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert headers["X-Frame-Options"] == "DENY"
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"


def test_a_page_on_ipv6_has_an_address_that_a_browser_takes(board):
    try:
        server = PageServer(board, "::1", 0)
    except Exception as fault:
        pytest.skip(f"no IPv6 here: {fault}")
    assert server.url.startswith("http://[::1]:")
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    status, _, content = ask(port, address="::1")
    server.close()
    assert status == 200
    assert json.loads(content) == {"history": {"anew": True, "events": []}}


def test_every_byte_of_a_grid_has_its_level():
    from io import BytesIO  # noqa: PLC0415

    from PIL import Image  # noqa: PLC0415

    cells = np.arange(-128, 128).astype(np.int8).reshape(2, 128)
    levels = np.asarray(Image.open(BytesIO(grid_png(cells))))
    assert (levels == np.where(cells >= 50, 255, np.where(cells >= 0, 85, 0))[::-1]).all()
