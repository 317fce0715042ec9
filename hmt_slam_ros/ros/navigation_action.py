"""The action ``navigate_to_pose`` of nav2, where its package nav2_msgs is installed.

As in nav2's navigator, a new goal replaces the one before, and a goal that cannot be reached is aborted with a code and
a sentence. The field ``behavior_tree`` is ignored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.tasks import GoalError, Task, TaskError, TaskFeedback, TaskResult
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.topics import NAVIGATE_TO_POSE

try:
    from nav2_msgs.action import NavigateToPose as NavigateToPose  # noqa: PLC0414  re-exported
except ImportError:  # PyPI does not have it
    NavigateToPose = None

_MIN_SPEED, _MIN_DISTANCE = 0.01, 0.1
"""Speed, m/s, and distance, m, from which on nav2 estimates the remaining time."""


class NavigationAction:
    """The action server of a node with tasks."""

    def __init__(
        self,
        node: GuardedNode,
        make_task: Callable[[PoseStamped], Task],
        start_task: Callable[[Task], None],
        is_active: Callable[[], bool],
    ) -> None:
        """Make the server.

        :param make_task: makes the task of a goal, or raises GoalError.
        :param start_task: starts a task, which replaces the one before.
        :param is_active: whether goals are taken.
        """
        self._node, self._make_task, self._start_task, self._is_active = node, make_task, start_task, is_active
        self._goals: list[tuple[Task, ServerGoalHandle]] = []
        self._server = _DeferringServer(
            node,
            NavigateToPose,
            NAVIGATE_TO_POSE,
            execute_callback=lambda _: NavigateToPose.Result(),
            goal_callback=node.guard(NAVIGATE_TO_POSE, self._check_request),
            handle_accepted_callback=node.guard(NAVIGATE_TO_POSE, self._begin),
            cancel_callback=node.guard(NAVIGATE_TO_POSE, self._accept_cancel),
        )

    def destroy(self) -> None:
        """Destroy the server."""
        self._server.destroy()

    def publish_feedback(self, feedback: TaskFeedback, pose: PoseStamped, speed: float) -> None:
        """Publish feedback on the goal, if the task is that of one.

        :param pose: of the robot, in the map.
        :param speed: of the last command, m/s.
        """
        remaining = feedback.distance_remaining or 0.0
        is_estimated = speed > _MIN_SPEED and remaining > _MIN_DISTANCE
        for _, handle in self._goals:
            handle.publish_feedback(
                NavigateToPose.Feedback(
                    current_pose=pose,
                    navigation_time=_duration(feedback.elapsed),
                    estimated_time_remaining=_duration(remaining / speed if is_estimated else 0.0),
                    number_of_recoveries=feedback.retries,
                    distance_remaining=remaining,
                )
            )

    def on_result(self, result: TaskResult) -> None:
        """End the goal of a task that ended."""
        for entry in [entry for entry in self._goals if entry[0] is result.task]:
            self._goals.remove(entry)
            self._end(entry[1], result.succeeded, result.error, result.reason)

    def _check_request(self, _goal: object) -> GoalResponse:
        """Reject goals while the node is inactive, as nav2 does."""
        if self._is_active():
            return GoalResponse.ACCEPT
        fault = HmtSlamError(f"{self._node.get_name()} is not active: activate it, then give the goal again")
        self._node.diagnostics.refuse(NAVIGATE_TO_POSE, fault)
        return GoalResponse.REJECT

    def _begin(self, handle: ServerGoalHandle) -> None:
        """Start the task of an accepted goal; a bad goal is aborted, since a rejection has no sentence."""
        handle.execute()
        try:
            task = self._make_task(handle.request.pose)
        except GoalError as fault:
            self._node.diagnostics.refuse(NAVIGATE_TO_POSE, fault)
            self._end(handle, succeeded=False, error=fault.error, reason=str(fault))
            return
        self._goals.append((task, handle))
        self._start_task(task)

    def _accept_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        """Accept to cancel the goal; rclpy changes its state only after this, so the task ends later."""
        if not any(other == handle for _, other in self._goals):
            return CancelResponse.REJECT
        self._node.executor.create_task(self._node.guard(NAVIGATE_TO_POSE, self._cancel), handle)
        return CancelResponse.ACCEPT

    def _cancel(self, handle: ServerGoalHandle) -> None:
        """Stop the robot, unless the goal ended meanwhile."""
        if any(other == handle for _, other in self._goals):
            self._start_task(Task("stop"))

    def _end(self, handle: ServerGoalHandle, succeeded: bool, error: TaskError, reason: str) -> None:
        """Set the state and the result of a goal."""
        result = NavigateToPose.Result()
        if succeeded:
            handle.succeed()
        else:
            result.error_code, result.error_msg = int(error), reason
            if handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
        self._server.send_result(handle, result)


class _DeferringServer(ActionServer):
    """An action server whose goals are executed until their result is sent.

    rclpy awaits a coroutine for each goal, which its executor polls without a pause: a core for one goal.
    """

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:  # noqa: ANN401  rclpy's
        """Leave a goal in execution."""

    def send_result(self, goal_handle: ServerGoalHandle, result: Any) -> None:  # noqa: ANN401  a generated message
        """Send the result of a goal that ended."""
        super().notify_execute(goal_handle, lambda _: result)


def _duration(seconds: float) -> Duration:
    fraction, whole = math.modf(seconds)
    return Duration(sec=int(whole), nanosec=int(1e9 * fraction))
