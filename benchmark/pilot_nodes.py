"""Slam, the pilot and a simulated robot as nodes, and errands that are given to the pilot one after the other."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from std_msgs.msg import String

from benchmark.live import PROCESSES
from benchmark.running_nodes import Listener, Parameters
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import planar_pose, stamp_of
from hmt_slam_ros.ros.topics import DIAGNOSTICS, ERRANDS, GROUND_TRUTH, INITIAL_POSE, OUTCOMES

RATE = 2.0
"""Times real time at most; the robot waits for slam."""

_PATIENCE = 900.0  # s, for an errand, and a node that compiles


class Start(NamedTuple):
    """With what the nodes begin.

    :ivar world: ``sim:WORLD,...``.
    :ivar seconds: from the beginning of its scripted drive until the robot wakes up.
    :ivar folder: of the map.
    """

    world: str
    seconds: float
    folder: Path


class Ran(NamedTuple):
    """What came of an errand.

    :ivar text: how the pilot says that it ended.
    :ivar path: shape (n, 2), where the robot truly was, m.
    :ivar seconds: of the simulation.
    :ivar contacts: how often the robot came upon something.
    :ivar starts: what slam was told, ``map_T_base``, and ``world_T_base`` then, each (3,).
    """

    text: str
    path: Float64
    seconds: float
    contacts: int
    starts: list[tuple[Float64, Float64]]

    @property
    def metres(self) -> float:
        """Way of the robot."""
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())


class Errands:
    """The nodes, and what they say."""

    def __init__(self, stack: ExitStack, listener: Listener, start: Start) -> None:
        """Start them; they end with the stack."""
        self._listener = listener
        self._outcomes: list[str] = []
        self._truths: dict[int, Float64] = {}
        self._starts: list[tuple[int, Float64]] = []
        self._contacts, self._reports = 0, 0
        node = listener.node
        node.create_subscription(
            String, OUTCOMES["pilot"], lambda message: self._outcomes.append(message.data), topics.LATCHED
        )
        node.create_subscription(PoseStamped, GROUND_TRUTH, self._hear_truth, topics.STREAM)
        node.create_subscription(PoseWithCovarianceStamped, INITIAL_POSE, self._hear_start, topics.STREAM)
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._hear_diagnostics, topics.STREAM)
        self._errands = node.create_publisher(String, ERRANDS["pilot"], topics.STREAM)
        shared: Parameters = {"start_from": str(start.folder), "mode": "localization"}
        for name in (*PROCESSES, "pilot"):
            stack.enter_context(listener.running(name, shared))
        listener.until(lambda: self._errands.get_subscription_count() == 1, _PATIENCE)
        robot: Parameters = {
            "log": start.world,
            "robot.start": start.seconds,
            "robot.drive": "commands",
            "robot.rate": RATE,
            "robot.scan_listeners": 2,
            "robot.odometry_listeners": 3,
            "robot.patience": _PATIENCE,
        }
        stack.enter_context(listener.running("robot", robot))
        listener.until(lambda: bool(self._truths), _PATIENCE)

    def run(self, room: str) -> Ran:
        """Go to a room.

        :raises HmtSlamError: where the pilot does not say how that ended.
        """
        ended, begin, starts, contacts = len(self._outcomes), len(self._truths), len(self._starts), self._contacts
        self._errands.publish(String(data=f"go {room}"))
        self._listener.until(lambda: len(self._outcomes) > ended, _PATIENCE)
        reports = self._reports
        # What it counted up to the end is in the second report from now on.
        self._listener.until(lambda: self._reports >= reports + 2)
        stamps = list(self._truths)[begin:]
        path = np.array([self._truths[stamp][:2] for stamp in stamps])
        seconds = (stamps[-1] - stamps[0]) / NANOSECONDS
        told = [(pose, self._truths[stamp]) for stamp, pose in self._starts[starts:] if stamp in self._truths]
        return Ran(self._outcomes[-1], path, seconds, self._contacts - contacts, told)

    def _hear_truth(self, message: PoseStamped) -> None:
        self._truths[stamp_of(message.header.stamp)] = planar_pose(message.pose)

    def _hear_start(self, message: PoseWithCovarianceStamped) -> None:
        self._starts.append((stamp_of(message.header.stamp), planar_pose(message.pose.pose)))

    def _hear_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "/robot":
                self._reports += 1
                # There are none before it drives.
                self._contacts = next((int(value.value) for value in status.values if value.key == "contacts"), 0)
