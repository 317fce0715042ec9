"""Scans of all lasers on their way to a process that drives the robot."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from sensor_msgs.msg import LaserScan

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.laser_mountings import LaserMountings, check_scan_message
from hmt_slam_ros.ros.scan_merge import ScanMerge
from hmt_slam_ros.ros.task_interface import TaskHost
from hmt_slam_ros.sensors import Scan

_REPORTED_SCANS = 20
"""Scans without a transform, or beside a silent laser, after which that is reported."""


class TaskScans:
    """Passes the scans of all topics in the order of their stamps, each with the mounting of its laser.

    A robot that drives itself stands while a laser is silent, since it does not see there.
    """

    def __init__(self, node: TaskHost, mountings: LaserMountings, deliver: Callable[[Scan], None]) -> None:
        """Subscribe to the topics of the configuration.

        :param deliver: called with each scan while the node is active.
        """
        self._node, self._mountings, self._deliver = node, mountings, deliver
        names = node.configuration.sensors.topics
        self._merge = ScanMerge(names)
        self._scans_without_mounting = self._scans_beside_silence = 0
        for name in names:
            node.create_subscription(LaserScan, name, partial(self._on_scan, name), topics.NEWEST)

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        if not self._node.is_active:
            return
        try:
            scan = self._mountings.convert_scan(check_scan_message(message), topic)
        except HmtSlamError as fault:
            self._node.diagnostics.refuse(topic, fault)
            return
        self._node.diagnostics.received["Scan"] += 1
        if scan is None:
            self._scans_without_mounting += 1
            if self._scans_without_mounting == _REPORTED_SCANS:
                self._node.diagnostics.warn(self._mountings.missing_transform_text(message, _REPORTED_SCANS))
            return
        due = self._merge.push(topic, scan)
        if due is None:
            self._node.diagnostics.count_refused(topic)
        elif self._node.is_driver and self._merge.silent_topics:
            self._halt_robot(topic)
        else:
            self._scans_beside_silence = 0
            for each in due:
                self._deliver(each)

    def _halt_robot(self, topic: str) -> None:
        """Stop the robot beside a silent laser."""
        self._node.stop_robot()
        self._scans_beside_silence += 1
        if self._scans_beside_silence % _REPORTED_SCANS == 0:
            self._node.diagnostics.warn(
                f"scans come on {topic}, and none on {', '.join(self._merge.silent_topics)}, so that the robot stands: "
                "look at that laser, and at the name and the type of its topic"
            )
