"""How programs give tasks to a node, follow and cancel them: the same by standard types and by nav2's action."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import (
    GoalError,
    Task,
    TaskFeedback,
    TaskKind,
    TaskProgress,
    TaskResult,
    parse_task,
)
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.ros.navigation_action import NavigateToPose, NavigationAction
from hmt_slam_ros.ros.topics import TASK_FEEDBACK, TASK_GOALS, TASK_POSES, TASK_RESULTS

if TYPE_CHECKING:
    from hmt_slam_ros.exploration.exploration_map import ExplorationMap

_FEEDBACK_PERIOD = 0.5
"""Time between two messages of feedback, s."""


class TaskProcess(Process, Protocol):
    """A process that carries out tasks.

    :ivar exploration_map: the map in which it drives.
    :ivar task: what it does; None without a task.
    """

    exploration_map: ExplorationMap
    task: Task | None

    @property
    def progress(self) -> TaskProgress:
        """How far the task is."""

    def named_rooms(self) -> dict[str, int]:
        """{name: keyframe in it} of the rooms to which tasks lead."""


class TaskHost(ManagedNode):
    """A node to which tasks are given.

    :cvar task_kinds: kinds of tasks that a text gives.
    """

    task_kinds: Sequence[TaskKind]

    @property
    def is_driver(self) -> bool:
        """Whether it publishes velocity commands."""
        raise NotImplementedError

    def process_message(self, message: Message) -> None:
        """Let the process handle a message, such as a task, and publish its outputs."""
        raise NotImplementedError

    def make_pose_task(self, message: PoseStamped) -> Task:
        """The task to drive to a pose.

        :raises GoalError: for one that is no goal.
        """
        raise NotImplementedError

    def pose_in_map(self, stamp: int) -> PoseStamped:
        """The last pose of the robot in the map; before the first, the map's origin at a stamp, ns."""
        raise NotImplementedError

    def stop_robot(self) -> None:
        """Publish a velocity of 0."""
        raise NotImplementedError


class TaskInterface:
    """Subscriptions, publishers, service and action of a node with tasks.

    :ivar stamp: of the newest scan, ns, 0 before the first.
    :ivar speed: of the last command, m/s.
    """

    def __init__(self, node: TaskHost, name: str, process: TaskProcess) -> None:
        """:param name: of the node in the process table."""
        self._node, self._name, self._process = node, name, process
        self.stamp, self.speed = 0, 0.0
        self._task, self._task_start = process.task, 0
        node.create_subscription(String, TASK_GOALS[name], self._on_task, topics.STREAM)
        node.create_subscription(PoseStamped, TASK_POSES[name], self._on_goal, topics.STREAM)
        node.create_service(Trigger, "~/cancel", self._cancel)
        self._results = node.create_publisher(String, TASK_RESULTS[name], topics.LATCHED)
        self._feedback = node.create_publisher(String, TASK_FEEDBACK, topics.STREAM)
        node.create_timer(_FEEDBACK_PERIOD, self._publish_feedback, clock=node.diagnostics.steady_clock)
        self._action: NavigationAction | None = None
        # Else nav2 drives, and serves the action.
        if node.is_driver and NavigateToPose is not None:
            self._action = NavigationAction(
                node, node.make_pose_task, node.process_message, is_active=lambda: node.is_active
            )

    def destroy(self) -> None:
        """Destroy the action server, which rclpy does not count to the node."""
        if self._action is not None:
            self._action.destroy()
            self._action = None

    def follow(self, process: TaskProcess) -> None:
        """Note the task of the process, and report the end of one that was canceled or replaced by another."""
        self._process = process
        if process.task == self._task:
            self._task = process.task
            return
        if self._task is not None:
            self.publish_result(
                TaskResult(self._task, False, "canceled" if process.task is None else "replaced by another task")
            )
        self._task, self._task_start = process.task, self.stamp

    def publish_result(self, result: TaskResult) -> None:
        """Publish how a task ended."""
        if result.task is self._task:
            self._task = None
        self._results.publish(String(data=result.text))
        self._node.get_logger().info(result.text)
        if self._action is not None:
            self._action.on_result(result)

    def end_navigation(self) -> None:
        """End the drive to a pose, if that is the task."""
        if self._task is not None and self._task.kind == "navigate":
            self._node.process_message(Task("stop"))

    def _on_task(self, message: String) -> None:
        try:
            task = parse_task(message.data, self._node.task_kinds)
        except HmtSlamError as fault:
            self._node.diagnostics.refuse(TASK_GOALS[self._name], fault)
        else:
            self._node.process_message(task)

    def _on_goal(self, message: PoseStamped) -> None:
        """Start the drive to a pose; a refusal is a result, too."""
        try:
            task = self._node.make_pose_task(message)
        except GoalError as fault:
            self._node.diagnostics.refuse(TASK_POSES[self._name], fault)
            self.publish_result(TaskResult(Task("navigate"), False, str(fault), fault.error))
        else:
            self._node.process_message(task)

    def _cancel(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End the task, and stop the robot."""
        task = self._task
        response.success = task is not None
        response.message = "there is no task to cancel" if task is None else f"canceled: {task.text}"
        self._node.process_message(Task("stop"))
        self._node.stop_robot()
        return response

    def _publish_feedback(self) -> None:
        """Publish how far the task is."""
        if self._task is None or not self.stamp:
            return
        self._task_start = self._task_start or self.stamp
        elapsed = max(0, self.stamp - self._task_start) / NANOSECONDS
        progress = self._process.progress
        feedback = TaskFeedback(self.stamp, self._task.text, elapsed, progress.remaining, progress.retries)
        self._feedback.publish(String(data=encode(feedback, system=self._node.system.name)))
        if self._action is not None:
            self._action.publish_feedback(feedback, self._node.pose_in_map(self.stamp), self.speed)
