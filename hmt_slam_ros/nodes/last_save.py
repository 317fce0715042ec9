"""Nodes that are told to end and save their map first, all together, where the parameter ``save_at_end`` is set.

rclpy's own handler of signals takes the context away at once, and with it all talk among the nodes. So these nodes do
without it: the one that is told goes on until the map is saved, or some seconds are over.
"""

from __future__ import annotations

import signal
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import uninstall_signal_handlers

from hmt_slam_ros.nodes.departure import end_within
from hmt_slam_ros.nodes.process_node import SAVING_PATIENCE, ProcessNode

_POLL = 0.05  # s


def spin(node: ProcessNode) -> None:
    """Begin and spin a node until it is told to end and its part of the last map is saved, if one is to be.

    :raises HmtSlamError: where it cannot begin.
    """
    node.begin()
    ended = False
    try:
        _spin(node)
        ended = True
    finally:
        if ended or not rclpy.ok():
            node.depart()


def _spin(node: ProcessNode) -> None:
    """By an executor of its own: ``rclpy.spin`` shares one, and fails where the signal comes before it has it."""
    if not rclpy.ok():
        return
    executor = SingleThreadedExecutor()
    told = _Told() if node.saves_at_end else None
    try:
        executor.add_node(node)
        while rclpy.ok() and not (told and (told.over or (told.at and node.saved_last()))):
            executor.spin_once(timeout_sec=_POLL if told else None)
    finally:
        executor.shutdown()


class _Told:
    """Takes note of the first signal in place of rclpy's handler; more of them change nothing.

    :ivar at: when that was, by the monotonic clock, None before.
    """

    def __init__(self) -> None:
        self.at: float | None = None
        uninstall_signal_handlers()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self)

    @property
    def over(self) -> bool:
        """Whether there is no time left."""
        return self.at is not None and time.monotonic() - self.at > SAVING_PATIENCE

    def __call__(self, _number: int, _frame: object) -> None:
        if self.at is None:
            self.at = time.monotonic()
            end_within(SAVING_PATIENCE + 1.0, 0)
