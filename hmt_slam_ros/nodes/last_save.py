"""Nodes that are told to end and save their map first, all together, where the parameter ``save_at_end`` is set.

rclpy's own handler of signals takes the context away at once, and with it all talk among the nodes. So these nodes do
without it: the one that is told goes on until the map is saved, or some seconds are over.
"""

from __future__ import annotations

import signal
import time

import rclpy
from rclpy.signals import uninstall_signal_handlers

from hmt_slam_ros.nodes.departure import end_within
from hmt_slam_ros.nodes.process_node import SAVING_PATIENCE, ProcessNode
from hmt_slam_ros.nodes.running import spin_until


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
    if not node.saves_at_end or not rclpy.ok():
        spin_until(node)
        return
    told = _Told()
    spin_until(node, lambda: told.over or (told.at is not None and node.saved_last()))


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
