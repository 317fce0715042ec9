"""Frames of the odometry and of the robot: those of the odometry's messages, unless parameters set others."""

from __future__ import annotations

from nav_msgs.msg import Odometry as OdometryMessage
from rclpy.node import Node

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mounting import frame_name
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.parameters import declare_frame
from hmt_slam_ros.ros.topics import ODOM
from hmt_slam_ros.untrusted_input import is_short_text

ODOM_FRAME, BASE_FRAME = "odom_frame", "base_frame"
"""Parameters that set the frames."""
_DEFAULTS = {ODOM_FRAME: "odom", BASE_FRAME: "base_link"}
"""Frames of odometry whose messages have none, as in REP 105."""
_MAX_REPORTS = 4
"""Contradictions that are reported."""
_FIELDS = {ODOM_FRAME: "frame_id", BASE_FRAME: "child_frame_id"}


def declare_odometry_frame(node: Node, parameter: str) -> str:
    """Declare ``odom_frame`` or ``base_frame``, and return the name of the frame; empty for that of the odometry."""
    return declare_frame(node, parameter.removesuffix("_frame"), "", "; empty for that of the odometry's messages")


class OdometryFrames:
    """Names of the frames of the odometry and of the robot.

    Other frames than those of the messages would split the tree of transforms. So such a parameter is a fault.
    """

    def __init__(self, diagnostics: NodeDiagnostics, **parameters: str) -> None:
        """:param parameters: values of ``odom_frame`` and ``base_frame``, of those that the node has."""
        self._diagnostics = diagnostics
        self._parameters = {name: frame_name(frame) for name, frame in parameters.items()}
        self._of_messages: dict[str, str] = {}
        self._reported: set[tuple[str, str]] = set()

    @property
    def odom(self) -> str:
        """Frame of the odometry, empty while it is unknown."""
        return self._frame(ODOM_FRAME)

    @property
    def base(self) -> str:
        """Frame of the robot, empty while it is unknown."""
        return self._frame(BASE_FRAME)

    def _frame(self, parameter: str) -> str:
        return self._parameters.get(parameter) or self._of_messages.get(parameter, "")

    def note(self, message: OdometryMessage) -> None:
        """Take note of the frames of a message, and report those that contradict others.

        :raises HmtSlamError: where one has no name.
        """
        for parameter, frame in ((ODOM_FRAME, message.header.frame_id), (BASE_FRAME, message.child_frame_id)):
            if not is_short_text(frame):
                raise HmtSlamError("the name of a frame is no short text: correct the driver")
            if parameter in self._parameters:
                self._note(parameter, frame_name(frame))

    def _note(self, parameter: str, frame: str) -> None:
        known = self._of_messages.setdefault(parameter, frame or _DEFAULTS[parameter])
        expected = self._parameters[parameter] or known
        if frame in ("", expected) or (parameter, frame) in self._reported or len(self._reported) == _MAX_REPORTS:
            return
        self._reported.add((parameter, frame))
        if self._parameters[parameter]:
            self._diagnostics.fail(
                f"{parameter} = {expected} contradicts {_FIELDS[parameter]} = {frame} of {ODOM}, so that the tree of "
                f"transforms is in two parts: leave {parameter} empty, or set it to {frame}"
            )
        else:
            self._diagnostics.warn(
                f"{ODOM} comes with {_FIELDS[parameter]} = {frame} and with {expected}, which came first: look for a "
                "second publisher"
            )
