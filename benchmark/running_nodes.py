"""The nodes as processes of their own, in a domain of their own, and a node that listens to them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager

from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from benchmark.logs import ROOT
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros.domain import own_domain

Parameters = Mapping[str, str | float | list[float]]

_PATIENCE = 120.0  # s
_SPIN = 0.005  # s


class Listener:
    """A node in a domain of its own, and the processes that it waits for.

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

    def until(self, condition: Callable[[], bool], patience: float = _PATIENCE) -> None:
        """Spin until a condition holds.

        :param patience: s.
        :raises HmtSlamError: where it does not for so long.
        """
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise HmtSlamError(f"a node did not answer within {patience:g} s: see whether scripts/demo.sh runs")
            self._executor.spin_once(timeout_sec=_SPIN)

    @contextmanager
    def running(self, name: str, parameters: Parameters) -> Iterator[subprocess.Popen[bytes]]:
        """A node as a process of its own, which ends with the context."""
        words = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
        process = subprocess.Popen(
            [sys.executable, "-m", f"hmt_slam_ros.ros.{name}_node", "--ros-args", *words],
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
            process.wait(_PATIENCE)
