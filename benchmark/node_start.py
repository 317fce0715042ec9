"""How long a node takes until it answers, and metric SLAM until its first pose."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from rcl_interfaces.srv import ListParameters
from std_msgs.msg import String

from benchmark.logs import BUNDLED, opened
from benchmark.running_nodes import Listener, Parameters
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DOCUMENTS

NODES = ("slam", "aam", "tsbi", "tlca", "rtl", "robot")


class Start(NamedTuple):
    """What a start takes: seconds on the wall, and of CPU time, which other programs of the machine do not change."""

    wall: float
    cpu: float


def until_answer(name: str) -> Start:
    """From the start of a node's process until it answers a service call, as it does once it spins."""
    with Listener() as listener, opened([BUNDLED]) as (log,):
        client = listener.node.create_client(ListParameters, f"{name}/list_parameters")
        begin = time.monotonic()
        with listener.running(name, _waiting(log.path) if name == "robot" else {}) as process:
            listener.until(client.service_is_ready)
            answer = client.call_async(ListParameters.Request())
            listener.until(answer.done)
            return Start(time.monotonic() - begin, _cpu_seconds(process))


def until_first_pose() -> Start:
    """From the start of metric SLAM until it has placed the first scan, with scans waiting for it."""
    with Listener() as listener, opened([BUNDLED]) as (log,):
        heard: list[String] = []
        listener.node.create_subscription(String, DOCUMENTS[LocalEstimate], heard.append, topics.CHAIN)
        robot = listener.node.create_client(ListParameters, "robot/list_parameters")
        with listener.running("robot", _waiting(log.path)):
            listener.until(robot.service_is_ready)
            begin = time.monotonic()
            with listener.running("slam", {"laser_pose": log.scans[0].laser_pose.tolist()}) as process:
                listener.until(lambda: bool(heard))
                return Start(time.monotonic() - begin, _cpu_seconds(process))


def _waiting(log: Path) -> Parameters:
    """Parameters of a robot that waits for whoever listens."""
    return {"log": str(log), "robot.patience": 3600.0, "robot.rate": 0.0}


def _cpu_seconds(process: subprocess.Popen[bytes]) -> float:
    """User and system time up to now."""
    line = Path(f"/proc/{process.pid}/stat").read_text(encoding="utf-8")
    # Fields 14 and 15; the second, in parentheses, may hold spaces.
    return sum(map(int, line.rpartition(")")[2].split()[11:13])) / os.sysconf("SC_CLK_TCK")
