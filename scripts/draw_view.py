#!/usr/bin/env python3
"""Draw the live page on a desk and on a phone, amid a run of the nodes: docs/images/view.png."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from hmt_slam_ros.process_table import node_command, process_names
from hmt_slam_ros.ros.node_processes import own_domain

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test"))

from browser import Browser  # type: ignore[import-not-found]  # noqa: E402  it lies beside the tests

PICTURE = ROOT / "docs" / "images" / "view.png"
LOG, RATE, PORT = "sim:nested,seed=1", 3.0, 8899
DESK, PHONE = (1280, 844), (390, 844)
# The moment that is shown: after so many scans, the first at which so many hypotheses live.
SCANS, HYPOTHESES = 600, 3
PATIENCE = 600.0  # s
GAP = 24  # px between the two


def main() -> None:
    """Start the nodes, wait for the moment, take the pictures."""
    with own_domain() as domain, tempfile.TemporaryDirectory() as scratch:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}

        def start(name: str, **parameters: object) -> subprocess.Popen[bytes]:
            named = [f"{key.replace('__', '.')}:={value}" for key, value in parameters.items()]
            settings = [word for setting in named for word in ("-p", setting)]
            return subprocess.Popen([sys.executable, *node_command(name), "--ros-args", *settings], env=environment)

        nodes = [start(name) for name in process_names()] + [start("view", port=PORT)]
        nodes.append(start("robot", log=LOG, robot__rate=RATE, robot__odometry_listeners=2))
        browser = Browser(Path(scratch) / "profile")
        try:
            browser.size(*DESK)
            _await(lambda: socket.socket().connect_ex(("127.0.0.1", PORT)) == 0)
            browser.open(f"http://127.0.0.1:{PORT}/")
            _await(lambda: _moment(browser))
            desk, phone = Path(scratch) / "desk.png", Path(scratch) / "phone.png"
            browser.screenshot(desk)
            browser.size(*PHONE, mobile=True)
            time.sleep(0.5)
            browser.screenshot(phone)
            _save(desk, phone)
        finally:
            browser.close()
            for node in nodes:
                node.terminate()
            for node in nodes:
                node.wait()


def _moment(browser: Browser) -> bool:
    """Whether the page shows what the picture is to show."""
    drawn = json.loads(browser.evaluate("document.getElementById('plan').dataset.drawn ?? '{}'"))
    done = browser.evaluate("document.querySelector('#replay span').textContent").partition(": ")[2].partition(" ")[0]
    return bool(done) and int(done) >= SCANS and drawn["map"] and drawn["bars"] >= HYPOTHESES


def _await(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            sys.exit(f"{LOG} had no {HYPOTHESES} live hypotheses within {PATIENCE:g} s: choose another log")
        time.sleep(0.2)


def _save(desk: Path, phone: Path) -> None:
    left, right = (np.asarray(Image.open(path).convert("RGB")) for path in (desk, phone))
    gap = np.full((left.shape[0], GAP, 3), 255, dtype=np.uint8)
    Image.fromarray(np.concatenate([left, gap, right], axis=1)).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
