"""The robot on one host, the five processes on another, over a link that delays, reorders and loses packets."""

import os
import subprocess
import sys

import pytest
from conftest import Listener
from logs_for_nodes import corridor_bag
from lossy_link import LossyLink, inside, reason_against

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.topics import DOCUMENTS
from hmt_slam_ros.processes.messages import LocalEstimate

PROCESSES = ("slam", "aam", "tsbi", "tlca", "rtl")
SCANS = 60
DECIDED = ("scans.bin", "chain.bin", "tlca.bin")
"""Files of a map with what all processes said and decided."""


@pytest.fixture
def link(domain, monkeypatch):
    if not os.environ.get("HMT_SLAM_TWO_HOSTS"):
        pytest.skip("beside other tests the link stands still for minutes at times: set HMT_SLAM_TWO_HOSTS=1 to run it")
    if reason := reason_against():
        pytest.skip(reason)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    with LossyLink(delay=0.02, jitter=0.02, loss=0.03) as link:
        yield link


@pytest.fixture
def listener(link, domain):
    """Beside the five processes."""
    with inside(link.hosts[1]):
        listener = Listener(domain)
    yield listener
    listener.close()


def test_the_map_is_that_of_one_host(link, listener, start, tmp_path):
    log, out, saved = corridor_bag(tmp_path, scans=SCANS), tmp_path / "out", tmp_path / "saved"
    alone = [sys.executable, "-m", "hmt_slam_ros.cli.main", "map", str(log), "--out", str(out)]
    subprocess.run(alone, check=True, timeout=120)
    estimates = listener.hear(String, DOCUMENTS[LocalEstimate], qos.CHAIN)
    nodes = [start(name, before=link.on(1), save_to=saved) for name in PROCESSES]
    patient = {"robot__odometry_listeners": 2, "robot__patience": 60.0}
    nodes.append(start("robot", before=link.on(0), log=log, robot__rate=0.0, **patient))
    # What is lost may be asked for again after three seconds only, by Fast DDS's heartbeat.
    listener.until(lambda: len(estimates) == SCANS, seconds=240.0, alive=nodes)
    answer = listener.call(Trigger, "slam/save", Trigger.Request())
    assert answer.success, answer.message
    for file in DECIDED:
        assert (saved / file).read_bytes() == (out / "hmt_map" / file).read_bytes(), file
