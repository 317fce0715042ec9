"""Node that examines a running system for some time, for ``hmt_slam doctor --live``."""

from __future__ import annotations

import heapq
import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry as OdometryMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.subscription import Subscription
from rclpy.task import Future
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from hmt_slam_ros.configuration.metric_slam import split_topics
from hmt_slam_ros.doctor import running
from hmt_slam_ros.doctor.examination import gathered_findings
from hmt_slam_ros.doctor.finding import Finding, sorted_findings
from hmt_slam_ros.doctor.frames import MessageStatistics, ScanHeader, TransformCollector
from hmt_slam_ros.doctor.running import FrameContradiction, Mismatch, NodeStatus, RunningSystem, Topic
from hmt_slam_ros.doctor.statistics import Gatherer
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mounting import FrameTree, Mounting, frame_name, planar_mounting
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import running_stamps
from hmt_slam_ros.process_table import COORDINATOR, producer, topic_of
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.diagnostics import HARDWARE_ID, STATE, SYSTEM, WAITS_FOR, is_of_other_namespace
from hmt_slam_ros.ros.odometry_frames import BASE_FRAME, ODOM_FRAME
from hmt_slam_ros.ros.topics import DIAGNOSTICS, TFMessage
from hmt_slam_ros.sensors import Odometry, Scan

_ARGUMENT_ERRORS = (rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError)
_BEST_EFFORT = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Profile of a reader that every publisher is compatible with."""
_DISCOVERY_TIMEOUT = 5.0
"""Time in which DDS finds the first other node, s."""
_SPIN = 0.05  # s
_USE_SIM_TIME, _LASER_POSE = "use_sim_time", "laser_pose"
_SCAN_TOPICS = "sensors.scan_topics"
_PARAMETERS = (_USE_SIM_TIME, _LASER_POSE, _SCAN_TOPICS, ODOM_FRAME, BASE_FRAME)
_GRAPH_ONLY_TOPICS = ("map", "pose", *map(topic_of, ("KeyframeHeader", "Hypotheses", "ClosureDecision")))
_ODOM_FRAME, _BASE_FRAME = "odom", "base_link"
_MAP_TO_ODOM_NODE = producer("RealTimePose")


def examine_running(seconds: float, ros_arguments: Sequence[str], scan_topics: Sequence[str] = ()) -> list[Finding]:
    """Findings about the running system, the most severe first.

    :param seconds: time to listen.
    :param scan_topics: topics of the scans; those of slam if empty, or ``scan`` without slam.
    :param ros_arguments: those after ``--ros-args``.
    :raises HmtSlamError: for an invalid time, or arguments that ROS refuses.
    """
    if not 0.0 < seconds < float("inf"):
        raise HmtSlamError(f"--seconds {seconds:g} is no time to listen: give more than 0")
    with _make_node(ros_arguments, scan_topics) as (node, executor):
        begin = time.monotonic()
        while not node.other_nodes and time.monotonic() < begin + _DISCOVERY_TIMEOUT:
            executor.spin_once(timeout_sec=_SPIN)
        begin = time.monotonic()
        while time.monotonic() < begin + seconds:
            executor.spin_once(timeout_sec=_SPIN)
            node.request_parameters()
            node.follow_scan_topics()
        return sorted_findings(node.findings(seconds))


@contextmanager
def _make_node(
    ros_arguments: Sequence[str], scan_topics: Sequence[str]
) -> Iterator[tuple[DoctorNode, SingleThreadedExecutor]]:
    context = Context()
    try:
        rclpy.init(args=["--ros-args", *ros_arguments], context=context)
        node = DoctorNode(context, scan_topics)
    except _ARGUMENT_ERRORS as fault:
        raise HmtSlamError(f"--ros-args {' '.join(ros_arguments)} cannot be ({fault}): see ros2 run --help") from fault
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    except ExternalShutdownException:
        raise KeyboardInterrupt from None
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


class DoctorNode(Node):
    """Collects sensor messages, transforms, diagnostics and the ROS graph."""

    def __init__(self, context: Context, scan_topics: Sequence[str] = ()) -> None:
        """:param scan_topics: topics of the scans; those of slam if empty."""
        super().__init__(f"doctor_{os.getpid()}", context=context, enable_rosout=False)
        self._given_topics = tuple(scan_topics)
        self._scans: dict[str, list[LaserScan]] = {}
        self._scan_subscriptions: dict[str, Subscription] = {}
        self._readings: list[Odometry] = []
        self._odometry_frames = ("", "")
        self._transform_odometry: dict[str, list[Odometry]] = defaultdict(list)
        self._counts: dict[str, int] = defaultdict(int)
        self._clock_offsets: dict[str, list[float]] = defaultdict(list)
        self._frame_tree, self._transforms = FrameTree(), TransformCollector()
        self._last_transforms: dict[tuple[str, str], tuple[int, bytes]] = {}
        self._conflicting_transforms: dict[str, int] = defaultdict(int)
        self._node_statuses: dict[tuple[str, str], NodeStatus] = {}
        self._systems: set[str] = set()
        self._parameter_clients: dict[str, Client] = {}
        self._parameter_futures: dict[str, dict[str, Future]] = {}
        self.follow_scan_topics()
        self.create_subscription(OdometryMessage, running.ODOM, self._on_odometry, _BEST_EFFORT)
        self.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, _BEST_EFFORT)
        self.create_subscription(String, running.ESTIMATES, self._on_estimate, _BEST_EFFORT)
        if TFMessage is not None:
            self.create_subscription(TFMessage, running.TF, self._on_transforms, _BEST_EFFORT)
            self.create_subscription(TFMessage, running.TF_STATIC, self._on_static_transforms, topics.TF_STATIC)

    @property
    def other_nodes(self) -> tuple[str, ...]:
        """Names of all other nodes."""
        return tuple(name for name in self.get_node_names() if name != self.get_name())

    def _nodes_by_namespace(self) -> dict[str, list[str]]:
        """{namespace: names of the nodes in it}, without this node."""
        found: dict[str, list[str]] = defaultdict(list)
        for name, namespace in self.get_node_names_and_namespaces():
            if name != self.get_name():
                found[namespace].append(name)
        return found

    def request_parameters(self) -> None:
        """Request the relevant parameters of every node that has not been requested before."""
        for name, namespace in self.get_node_names_and_namespaces():
            full = f"{namespace.rstrip('/')}/{name}"
            if full in self._parameter_futures or name == self.get_name():
                continue
            if full not in self._parameter_clients:
                self._parameter_clients[full] = self.create_client(GetParameters, f"{full}/get_parameters")
            client = self._parameter_clients[full]
            if client.service_is_ready():
                # One by one: a node that lacks one of several answers with none.
                self._parameter_futures[full] = {
                    name: client.call_async(GetParameters.Request(names=[name])) for name in _PARAMETERS
                }

    def follow_scan_topics(self) -> None:
        """Subscribe to the topics of the scans, which slam may name only now."""
        wanted = self._given_topics or split_topics(self._slam_parameter(_SCAN_TOPICS).string_value) or (running.SCAN,)
        if wanted == tuple(self._scan_subscriptions):
            return
        for topic in self._scan_subscriptions.keys() - set(wanted):
            self.destroy_subscription(self._scan_subscriptions.pop(topic))
        old = self._scan_subscriptions
        self._scan_subscriptions = {topic: old.get(topic) or self._subscribe_to_scans(topic) for topic in wanted}
        self._scans = {topic: self._scans.get(topic, []) for topic in wanted}

    def _subscribe_to_scans(self, topic: str) -> Subscription:
        return self.create_subscription(LaserScan, topic, partial(self._on_scan, topic), _BEST_EFFORT)

    def findings(self, seconds: float) -> list[Finding]:
        """Findings about the system, and about its measurements where there are scans."""
        system = self._running_system(seconds)
        found = list(running.running_findings(system))
        if not system.has_scans:
            return found
        return [*found, *gathered_findings(self._gather(), "the running system", self._message_statistics())]

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        self._count_message(topic, conversions.stamp_from_time(message.header.stamp))
        self._scans[topic].append(message)

    def _on_odometry(self, message: OdometryMessage) -> None:
        self._count_message(running.ODOM, conversions.stamp_from_time(message.header.stamp))
        self._odometry_frames = (frame_name(message.header.frame_id), frame_name(message.child_frame_id))
        try:
            self._readings.append(conversions.odometry_from_message(message))
        except HmtSlamError as fault:
            self.get_logger().warning(str(fault), once=True)

    def _count_message(self, topic: str, stamp: int) -> None:
        self._counts[topic] += 1
        self._clock_offsets[topic].append(1e-9 * (time.time_ns() - stamp))

    def _on_estimate(self, _: String) -> None:
        self._counts[running.ESTIMATES] += 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if is_of_other_namespace(status, self):
                continue
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            values = {entry.key: entry.value for entry in status.values}
            state, system = values.get(STATE, ""), values.get(SYSTEM, "")
            if status.hardware_id == HARDWARE_ID and system:
                self._systems.add(system)
            self._node_statuses[status.name, system] = NodeStatus(
                status.name, level, status.message, state, values.get(WAITS_FOR, "")
            )

    def _on_static_transforms(self, message: Any) -> None:  # noqa: ANN401  a TFMessage, where there is one
        self._counts[running.TF_STATIC] += 1
        self._frame_tree.add(message)
        self._transforms.add(running.TF_STATIC, message)

    def _on_transforms(self, message: Any) -> None:  # noqa: ANN401  a TFMessage, where there is one
        self._counts[running.TF] += 1
        self._transforms.add(running.TF, message)
        for joint in message.transforms:
            parent, child = frame_name(joint.header.frame_id), frame_name(joint.child_frame_id)
            stamp = conversions.stamp_from_time(joint.header.stamp)
            translation, rotation = joint.transform.translation, joint.transform.rotation
            value = np.array([translation.x, translation.y, rotation.z, rotation.w])
            last = self._last_transforms.get((parent, child))
            if last is not None and last[0] == stamp and last[1] != value.tobytes():
                self._conflicting_transforms[f"{parent} -> {child}"] += 1
            self._last_transforms[parent, child] = (stamp, value.tobytes())
            if parent == _ODOM_FRAME:
                heading = 2.0 * float(np.arctan2(rotation.z, rotation.w))
                pose = np.array([translation.x, translation.y, heading])
                self._transform_odometry[child].append(Odometry(stamp, pose))

    def _running_system(self, seconds: float) -> RunningSystem:
        names = (*self._scans, running.ODOM, running.TF, running.TF_STATIC, running.CLOCK, running.ESTIMATES)
        topics = {name: self._topic(name, self._counts[name]) for name in names}
        topics |= {name: self._topic(name, None) for name in _GRAPH_ONLY_TOPICS}
        has_clock = bool(topics[running.CLOCK].publishers)
        with_sim_time = sorted(
            full.lstrip("/")
            for full in self._parameter_futures
            if self._parameter_value(full, _USE_SIM_TIME).bool_value
        )
        nodes = self._nodes_by_namespace()
        here = tuple(nodes.pop(self.get_namespace(), ()))
        return RunningSystem(
            seconds,
            topics,
            here,
            tuple(with_sim_time),
            tuple(self._node_statuses.values()),
            {} if has_clock else {name: float(np.median(values)) for name, values in self._clock_offsets.items()},
            dict(self._conflicting_transforms),
            tuple(self._missing_laser_transforms()),
            tuple(sorted(namespace for namespace, names in nodes.items() if set(names) & set(running.OUR_NODES))),
            tuple(self._frame_contradictions()),
            tuple(sorted(self._systems)),
            tuple(self._scans),
        )

    def _frame_contradictions(self) -> Iterator[FrameContradiction]:
        """Parameters of our nodes in this namespace that name other frames than the odometry."""
        for node in running.OUR_NODES:
            full = f"{self.get_namespace().rstrip('/')}/{node}"
            for parameter, odometry_frame in zip((ODOM_FRAME, BASE_FRAME), self._odometry_frames, strict=True):
                known = full in self._parameter_futures
                frame = frame_name(self._parameter_value(full, parameter).string_value) if known else ""
                if frame and odometry_frame and frame != odometry_frame:
                    yield FrameContradiction(full, parameter, frame, odometry_frame)

    def _topic(self, name: str, message_count: int | None) -> Topic:
        full = self.resolve_topic_name(name)
        publishers = self.get_publishers_info_by_topic(full)
        subscribers = [end for end in self.get_subscriptions_info_by_topic(full) if end.node_name != self.get_name()]
        mismatches = []
        for publisher in publishers:
            for subscriber in subscribers:
                compatibility, reason = qos_check_compatible(publisher.qos_profile, subscriber.qos_profile)
                if compatibility == QoSCompatibility.ERROR:
                    mismatches.append(Mismatch(publisher.node_name, subscriber.node_name, reason.strip().rstrip(".;")))
        return Topic(message_count, tuple(end.node_name for end in publishers), tuple(mismatches))

    def _parameter_value(self, full: str, parameter: str) -> ParameterValue:
        """A node's value of a parameter, not set where it has none."""
        future = self._parameter_futures[full][parameter]
        response = future.result() if future.done() and future.exception() is None else None
        return response.values[0] if response is not None and response.values else ParameterValue()

    def _base_frame(self) -> str:
        return self._odometry_frames[1] or next(iter(self._transform_odometry), _BASE_FRAME)

    def _slam_parameter(self, parameter: str) -> ParameterValue:
        """The value of a parameter of slam in this namespace, not set where it has none."""
        full = f"{self.get_namespace().rstrip('/')}/{COORDINATOR}"
        return self._parameter_value(full, parameter) if full in self._parameter_futures else ParameterValue()

    def _configured_mounting(self, topic: str) -> Mounting | None:
        """The mounting of the laser of a topic from the parameter of slam, None where it is not set."""
        numbers = self._slam_parameter(_LASER_POSE).double_array_value
        first = 3 * list(self._scans).index(topic)
        return Mounting(np.array(numbers[first : first + 3]), 1.0) if len(numbers) >= first + 3 else None

    def _mounting(self, topic: str, frame: str) -> Mounting | None:
        configured, pose = (
            self._configured_mounting(topic),
            self._frame_tree.lookup_transform(self._base_frame(), frame),
        )
        return configured if configured is not None or pose is None else planar_mounting(pose, f"the laser {frame!r}")

    def _mountings(self) -> dict[tuple[str, str], Mounting | None]:
        """{(topic, frame of its scans): mounting of the laser, None where it is unknown}."""
        frames = {(topic, frame_name(each.header.frame_id)): None for topic, own in self._scans.items() for each in own}
        return {(topic, frame): self._mounting(topic, frame) for topic, frame in frames}

    def _missing_laser_transforms(self) -> Iterator[str]:
        missing = {frame for (_, frame), mounting in self._mountings().items() if mounting is None}
        for frame in sorted(missing):
            yield (
                f"No transform leads from {self._base_frame()!r} to the scans' frame {frame!r} on /tf_static: start "
                "robot_state_publisher or static_transform_publisher, or set the parameter laser_pose of slam."
            )

    def _gather(self) -> Gatherer:
        """All measurements in the order of their stamps, those of one kind in the order of arrival.

        Where mountings are unknown, the scans of one of these lasers are examined.
        """
        mountings = self._mountings()
        unknown = [key for key, mounting in mountings.items() if mounting is None]
        known = {key: mounting for key, mounting in mountings.items() if mounting is not None}
        known |= dict.fromkeys(unknown[:1], Mounting(np.zeros(3), 1.0))
        scans = [self._convert_scans(topic, known) for topic in self._scans]
        readings: list[Scan | Odometry] = [*(self._readings or self._transform_odometry[self._base_frame()])]
        ordered = list(heapq.merge(readings, *scans, key=lambda measurement: measurement.stamp))
        sources = [measurement.stamp for measurement in ordered]
        is_scan = [isinstance(measurement, Scan) for measurement in ordered]
        stamps = running_stamps(sources, is_scan, [False] * len(ordered))
        gatherer = Gatherer()
        for source, stamp, measurement in zip(sources, stamps.tolist(), ordered, strict=True):
            gatherer.add(LogRecord(source, _with_stamp(measurement, stamp)))
        return gatherer

    def _convert_scans(self, topic: str, mountings: Mapping[tuple[str, str], Mounting]) -> list[Scan | Odometry]:
        """The scans of a topic from lasers with a mounting."""
        frames = [(topic, frame_name(message.header.frame_id)) for message in self._scans[topic]]
        return [
            conversions.scan_from_message(message, *mountings[key])
            for message, key in zip(self._scans[topic], frames, strict=True)
            if key in mountings
        ]

    def _message_statistics(self) -> MessageStatistics:
        headers: dict[ScanHeader, int] = defaultdict(int)
        for scan in (message for own in self._scans.values() for message in own):
            frame = frame_name(scan.header.frame_id)
            headers[ScanHeader(frame, scan.angle_min, scan.angle_max, scan.angle_increment, len(scan.ranges))] += 1
        frames = self._odometry_frames if self._readings else (_ODOM_FRAME, self._base_frame())
        types = {name: kind[0] for name, kind in self.get_topic_names_and_types()}
        transforms = self._transforms.transforms
        if _MAP_TO_ODOM_NODE in self.other_nodes:
            transforms = tuple(transform for transform in transforms if transform.child != frames[0])
        return MessageStatistics(dict(self._counts), types, dict(headers), frames, transforms)


def _with_stamp(measurement: Scan | Odometry, stamp: int) -> Scan | Odometry:
    return measurement if measurement.stamp == stamp else replace(measurement, stamp=stamp)
