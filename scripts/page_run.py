"""The live page in a browser, amid a run of the nodes in a ROS domain of their own; for pictures of it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from hmt_slam_ros.process_table import node_command, process_names
from hmt_slam_ros.ros.node_processes import own_domain

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from browser import Browser  # type: ignore[import-not-found]  # noqa: E402  it lies beside the tests

IMAGES = ROOT / "docs" / "images"
PORT = 8899
PATIENCE = 900.0  # s


class PageOfRun:
    """The page in a browser.

    :ivar browser: the browser.
    """

    def __init__(self, browser: Browser) -> None:
        self.browser = browser

    @property
    def drawing(self) -> dict[str, Any]:
        """What the plan shows."""
        text = self.browser.evaluate("document.getElementById('plan').dataset.drawn ?? '{}'")
        return dict(json.loads(text))

    @property
    def scans(self) -> int:
        """Number of scans so far."""
        text = self.browser.evaluate("document.querySelector('#replay span').textContent")
        done = text.partition(": ")[2].partition(" ")[0]
        return int(done) if done else 0

    def events(self) -> list[dict[str, Any]]:
        """Events of the run so far: closures and incidents."""
        with urlopen(f"http://127.0.0.1:{PORT}/snapshot.json", timeout=20) as answer:
            return list(json.load(answer).get("events", []))


@contextmanager
def page_of_run(log: str, rate: float, size: tuple[int, int]) -> Iterator[PageOfRun]:
    """Start the nodes on a log, and open the page.

    :param rate: times real time.
    :param size: of the window, px.
    """
    with own_domain() as domain, tempfile.TemporaryDirectory() as scratch:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}

        def start(name: str, **parameters: object) -> subprocess.Popen[bytes]:
            named = [f"{key.replace('__', '.')}:={value}" for key, value in parameters.items()]
            settings = [word for setting in named for word in ("-p", setting)]
            return subprocess.Popen([sys.executable, *node_command(name), "--ros-args", *settings], env=environment)

        nodes = [start(name) for name in process_names()] + [start("view", port=PORT)]
        nodes.append(start("robot", log=log, robot__rate=rate, robot__odometry_listeners=2))
        browser = Browser(Path(scratch) / "profile")
        try:
            browser.size(*size)
            wait_until(lambda: socket.socket().connect_ex(("127.0.0.1", PORT)) == 0, "the page did not come")
            browser.open(f"http://127.0.0.1:{PORT}/")
            yield PageOfRun(browser)
        finally:
            browser.close()
            for node in nodes:
                node.terminate()
            for node in nodes:
                node.wait()


def wait_until(condition: Callable[[], bool], fault: str) -> None:
    """Wait for a condition, or end the program with a sentence."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"{fault} within {PATIENCE:g} s")
        time.sleep(0.2)
