"""The robot on one host, the five processes on another, over a link that delays, reorders and loses packets."""

import subprocess
import sys
from pathlib import Path

import pytest
from logs_for_nodes import corridor_bag
from lossy_link import LossyLink, reason_against
from preloaded import hmt_slam

from hmt_slam_ros.process_table import process_names

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

PROCESSES = process_names()
SCANS = 60
PATIENCE = 400.0  # s
DECIDED = ("scans.bin", "chain.bin", "tlca.bin")
"""Files of a map with what all processes sent and decided."""


@pytest.fixture
def link(domain, monkeypatch):
    if reason := reason_against():
        pytest.skip(reason)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    with LossyLink(delay=0.02, jitter=0.02, loss=0.03) as link:
        yield link


@pytest.mark.long
def test_the_map_is_that_of_one_host(link, domain, start, tmp_path):
    log, out, saved = corridor_bag(tmp_path, scans=SCANS), tmp_path / "out", tmp_path / "saved"
    hmt_slam("map", log, "--out", out, check=True)
    listen = [
        *link.host_command(1),
        sys.executable,
        str(Path(__file__).with_name("listen_on_host.py")),
        str(domain),
        str(SCANS),
    ]
    listener = subprocess.Popen(listen, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert listener.stdout.readline() == "listens\n"
        for name in PROCESSES:
            start(name, before=link.host_command(1), save_to=saved)
        start(
            "robot",
            before=link.host_command(0),
            log=log,
            robot__rate=0.0,
            robot__odometry_listeners=2,
            robot__discovery_timeout=60.0,
        )
        print(listener.communicate(timeout=PATIENCE)[0])  # shown where the test fails
    finally:
        listener.kill()
    assert listener.returncode == 0
    for file in DECIDED:
        assert (saved / file).read_bytes() == (out / "hmt_map" / file).read_bytes(), file
