"""The nodes as OS processes in a separate domain, a node that listens to them, and their start times."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from rcl_interfaces.srv import ListParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from benchmark.logs import BUNDLED, ROOT, open_logs
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.process_table import node_command, process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.node_processes import own_domain
from hmt_slam_ros.ros.topics import DOCUMENTS

Parameters = Mapping[str, str | float | list[float]]
_TIMEOUT = 120.0  # s
_SPIN = 0.005  # s
_LOST = 0.5  # s, after which a request is sent again: DDS may lose that of a client which a new node does not know
NODES = (*process_names(), "robot")


class Listener:
    """A node in a separate domain, which starts processes and waits for them.

    :ivar node: the node.
    """

    node: Node

    def __enter__(self) -> Listener:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        with ExitStack() as stack:
            self._domain = stack.enter_context(own_domain())
            context = Context()
            context.init(domain_id=self._domain)
            stack.callback(context.try_shutdown)
            self.node = Node("stopwatch", context=context)
            stack.callback(self.node.destroy_node)
            self._executor = SingleThreadedExecutor(context=context)
            stack.callback(self._executor.shutdown)
            self._executor.add_node(self.node)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_fault: object) -> None:
        self._stack.close()

    def wait_until(self, condition: Callable[[], bool], timeout: float = _TIMEOUT) -> None:
        """Spin until a condition holds.

        :param timeout: s.
        :raises HmtSlamError: where it does not hold in time.
        """
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise HmtSlamError(f"a node did not answer within {timeout:g} s: see whether scripts/demo.sh runs")
            self.spin_once()

    def spin_once(self) -> None:
        """Take what has come."""
        self._executor.spin_once(timeout_sec=_SPIN)

    @contextmanager
    def running(
        self, name: str, parameters: Parameters, command: Sequence[str] = ()
    ) -> Iterator[subprocess.Popen[bytes]]:
        """A node as an OS process, which ends with the context.

        :param command: arguments of the Python interpreter; by default those that run the node.
        """
        words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
        process = subprocess.Popen(
            [sys.executable, *(command or node_command(name)), "--ros-args", *words],
            cwd=ROOT,
            env=os.environ | {"ROS_DOMAIN_ID": str(self._domain)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(_TIMEOUT)


class StartTime(NamedTuple):
    """The duration of a start: wall time and CPU time, s."""

    wall: float
    cpu: float


def time_until_answer(name: str) -> StartTime:
    """Time from the start of a node's process until it answers a service call."""
    with Listener() as listener, open_logs([BUNDLED]) as (log,):
        client = listener.node.create_client(ListParameters, f"{name}/list_parameters")
        begin = time.monotonic()
        with listener.running(name, _waiting_robot(log.path) if name == "robot" else {}) as process:
            listener.wait_until(client.service_is_ready)
            requests, again = [client.call_async(ListParameters.Request())], time.monotonic() + _LOST
            while not any(request.done() for request in requests):
                listener.spin_once()
                if time.monotonic() > again:
                    requests, again = [*requests, client.call_async(ListParameters.Request())], again + _LOST
            return StartTime(time.monotonic() - begin, cpu_seconds(process))


def time_until_first_pose() -> StartTime:
    """Time from the start of metric SLAM to the pose of the first scan, with waiting scans."""
    with Listener() as listener, open_logs([BUNDLED]) as (log,):
        estimates: list[String] = []
        listener.node.create_subscription(String, DOCUMENTS[LocalEstimate], estimates.append, topics.CHAIN)
        robot = listener.node.create_client(ListParameters, "robot/list_parameters")
        with listener.running("robot", _waiting_robot(log.path)):
            listener.wait_until(robot.service_is_ready)
            begin = time.monotonic()
            with listener.running("slam", {"laser_pose": log.scans[0].laser_pose.tolist()}) as process:
                listener.wait_until(lambda: bool(estimates))
                return StartTime(time.monotonic() - begin, cpu_seconds(process))


def _waiting_robot(log: Path) -> Parameters:
    """Parameters of a robot that waits for its subscribers."""
    return {"log": str(log), "robot.discovery_timeout": 3600.0, "robot.rate": 0.0}


def cpu_seconds(process: subprocess.Popen[bytes]) -> float:
    """User and system time up to now."""
    line = Path(f"/proc/{process.pid}/stat").read_text(encoding="utf-8")
    # Fields 14 and 15; the second, in parentheses, may hold spaces.
    return sum(map(int, line.rpartition(")")[2].split()[11:13])) / os.sysconf("SC_CLK_TCK")
