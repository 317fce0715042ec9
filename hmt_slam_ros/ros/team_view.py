"""What the live page shows of the other robots of a team, by their topics."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.exceptions import InvalidTopicNameException
from rclpy.qos import QoSProfile
from rclpy.validate_full_topic_name import validate_full_topic_name
from std_msgs.msg import String

from hmt_slam_ros.messages.gate import decode_of_team
from hmt_slam_ros.messages.team import TeamPlacement
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DOCUMENTS, MAP, POSE
from hmt_slam_ros.ros.view_conversions import map_cells, map_section, robot_section
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.server import grid_png
from hmt_slam_ros.view.team_section import TeamSection

Subscribe = Callable[[type, str, Callable[[Any], None], QoSProfile], Any]
"""Subscribes the node: message class, topic, callback and profile."""


class TeamView:
    """Subscribes to the poses and maps of the robots that are joined with that of the page.

    The name of a robot in its team is its namespace, unless it has ``robot_name``: such a robot has a row alone.
    """

    def __init__(self, board: Board, subscribe: Subscribe, unsubscribe: Callable[[Any], None]) -> None:
        self._board, self._subscribe, self._unsubscribe = board, subscribe, unsubscribe
        self._section = TeamSection()
        self._poses: dict[str, Any] = {}
        self._maps: dict[str, Any] = {}
        subscribe(String, DOCUMENTS[TeamPlacement], self._on_placement, topics.TEAM_HISTORY)

    def note_name(self, robot: str) -> None:
        """Note the name of the page's robot in its team."""
        self._section.robot = robot

    def update(self) -> None:
        """Show what is new, and subscribe to the robots that are joined now; to maps while a browser shows the page."""
        if not self._section.robot:
            return
        joined = [name for name in self._section.map_poses if _has_topics(name)]
        self._follow(self._poses, joined, self._subscribe_to_pose)
        self._follow(self._maps, joined if self._board.is_watched else [], self._subscribe_to_map)
        self._board.put("team", self._section.content())

    def _follow(self, subscriptions: dict[str, Any], robots: list[str], subscribe: Callable[[str], Any]) -> None:
        """Have subscriptions for these robots, and for no others."""
        for name in subscriptions.keys() - set(robots):
            self._unsubscribe(subscriptions.pop(name))
        for name in robots:
            if name not in subscriptions:
                subscriptions[name] = subscribe(name)

    def _subscribe_to_pose(self, name: str) -> Any:  # noqa: ANN401  of rclpy
        return self._subscribe(
            PoseWithCovarianceStamped, _topic(name, POSE), partial(self._on_pose, name), topics.NEWEST
        )

    def _subscribe_to_map(self, name: str) -> Any:  # noqa: ANN401  of rclpy
        return self._subscribe(OccupancyGrid, _topic(name, MAP), partial(self._on_map, name), topics.LATCHED)

    def _on_placement(self, message: String) -> None:
        self._section.note_placement(decode_of_team(message.data, TeamPlacement))

    def _on_pose(self, name: str, message: PoseWithCovarianceStamped) -> None:
        self._section.robot_poses[name] = robot_section(message)["pose"]

    def _on_map(self, name: str, message: OccupancyGrid) -> None:
        section, cells = map_section(message), map_cells(message)
        self._section.maps[name] = {"tag": self._board.put_map_image(grid_png(cells), name), **section}


def _topic(robot: str, topic: str) -> str:
    return f"/{robot.replace('.', '/')}/{topic}"


def _has_topics(robot: str) -> bool:
    """Whether the name of a robot is a namespace."""
    try:
        validate_full_topic_name(_topic(robot, POSE))
    except InvalidTopicNameException:
        return False
    return True
