"""Execution of the commands that people give through the live page: services, initial pose and goal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import header_message, pose_message, pose_with_covariance_message
from hmt_slam_ros.ros.topics import GOAL_POSE, INITIAL_POSE, STATEMENT, TASK_POSES
from hmt_slam_ros.untrusted_input import shorten
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.commands import Commands, PageCommand
from hmt_slam_ros.view.health import Level

_SPREAD = np.diag([0.5, 0.5, math.radians(15.0)]) ** 2
"""Covariance of an initial pose that a person points at, as RViz has it, m^2 and rad^2."""


class ViewControls:
    """Executes commands, and shows on the page what became of the last one."""

    def __init__(self, node: Node, board: Board, commands: Commands, map_frame: Callable[[], str]) -> None:
        """:param map_frame: returns the name of the map's frame."""
        self._node, self._board, self._commands, self._map_frame = node, board, commands, map_frame
        self._is_paused = False
        board.put("controls", commands.is_allowed)
        if not commands.is_allowed:
            return
        self._save = node.create_client(Trigger, "slam/save")
        self._pauses = [node.create_client(SetBool, f"{name}/pause") for name in ("robot", "slam")]
        self._initial_poses = node.create_publisher(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)
        self._goals = node.create_publisher(PoseStamped, GOAL_POSE, topics.STREAM)
        self._explorer_goals = node.create_publisher(PoseStamped, TASK_POSES["explorer"], topics.STREAM)
        self._statements = node.create_publisher(String, STATEMENT, topics.STREAM)

    def update(self) -> None:
        """Execute the commands that wait."""
        for command in self._commands.take():
            self._node.get_logger().info(f"the page: {command.kind}")
            if command.kind == "save":
                self._call([self._save], Trigger.Request(), "saving the map", "slam/save")
            elif command.kind in ("pause", "resume"):
                request = SetBool.Request(data=command.kind == "pause")
                self._call(self._pauses, request, command.kind, "slam/pause")
            elif command.kind == "statement":
                self._publish_statement(command.statement)
            elif command.pose is not None:
                self._publish_pose(command, np.array(command.pose))

    def _call(self, clients: list[Any], request: Any, doing: str, name: str) -> None:  # noqa: ANN401  of any service
        """Call the first service that is there."""
        client = next((client for client in clients if client.service_is_ready()), None)
        if client is None:
            self._tell("fault", f"{name} does not answer: is slam running?")
            return
        self._tell("waiting", f"{doing} …")
        client.call_async(request).add_done_callback(lambda future: self._on_answer(request, doing, future))

    def _on_answer(self, request: Any, doing: str, future: Any) -> None:  # noqa: ANN401  of rclpy
        answer = future.result()
        if answer is None:
            self._tell("fault", f"{doing}: no answer")
            return
        if answer.success and isinstance(request, SetBool.Request):
            self._is_paused = request.data
        self._tell("good" if answer.success else "fault", shorten(answer.message) or f"{doing}: done")

    def _publish_statement(self, statement: str) -> None:
        self._statements.publish(String(data=statement))
        if self._statements.get_subscription_count():
            self._tell("good", f"'{statement}' is weighed at the next keyframe")
        else:
            self._tell("fault", f"'{statement}': tsbi does not run")

    def _publish_pose(self, command: PageCommand, pose: Any) -> None:  # noqa: ANN401  an array (3,)
        stamp = self._node.get_clock().now().nanoseconds
        place = f"{pose[0]:.2f}, {pose[1]:.2f} m, {math.degrees(pose[2]):.0f}°"
        if command.kind == "initial_pose":
            belief = PoseGaussian(pose, _SPREAD)
            self._initial_poses.publish(pose_with_covariance_message(stamp, self._map_frame(), belief))
            self._tell("good", f"initial pose {place}: the robot is searched near it")
            return
        goal = PoseStamped(header=header_message(stamp, self._map_frame()), pose=pose_message(pose))
        if self._explorer_goals.get_subscription_count():
            self._explorer_goals.publish(goal)
            self._tell("good", f"goal {place}: the explorer drives there, or gives a reason")
        else:
            self._goals.publish(goal)
            listeners = self._goals.get_subscription_count()
            is_heard = listeners > 1  # the page itself shows goals
            text = f"goal {place}" if is_heard else f"goal {place}: no explorer and no nav2 listens"
            self._tell("good" if is_heard else "attention", text)

    def _tell(self, level: Level, text: str) -> None:
        self._board.put("command", {"level": level, "text": text, "paused": self._is_paused})
