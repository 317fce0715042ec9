"""Names of topics, quality-of-service profiles, and the publishers of /tf."""

from __future__ import annotations

from collections.abc import Callable

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from hmt_slam_ros import process_table
from hmt_slam_ros.process_table import COMPANIONS, topic_of

try:
    from tf2_msgs.msg import TFMessage as TFMessage  # noqa: PLC0414  re-exported
except ImportError:  # PyPI does not have it
    TFMessage = None

_KEEP_ALL, _KEEP_LAST = HistoryPolicy.KEEP_ALL, HistoryPolicy.KEEP_LAST
_RELIABLE, _BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
_TRANSIENT = DurabilityPolicy.TRANSIENT_LOCAL

SENSOR = QoSProfile(history=_KEEP_ALL, reliability=_RELIABLE)
"""Scans and odometry from the robot node: nothing is lost at any rate of the replay.

DDS makes the writer wait for slow readers, since the history of a reliable KEEP_ALL topic is bounded (5000).
"""
LATCHED_SENSOR = QoSProfile(history=_KEEP_ALL, reliability=_RELIABLE, durability=_TRANSIENT)
"""Scans and odometry that the writer keeps, for a slam that was killed and missed some."""
LIVE_SENSOR = QoSProfile(history=_KEEP_LAST, depth=50, reliability=_BEST_EFFORT)
"""Scans and odometry of live drivers, which a reliable reader never receives; one second of a fast laser.

Readers start with SENSOR, and change to this profile when DDS reports such a writer.
"""
CHAIN = QoSProfile(history=_KEEP_ALL, reliability=_RELIABLE, durability=_TRANSIENT)
"""A reader of a chain topic: messages of keyframe events, with those of the past that their writer still has."""
VOLATILE_CHAIN = QoSProfile(history=_KEEP_ALL, reliability=_RELIABLE)
"""A reader of a chain topic that does not need the past."""
CHAIN_HISTORY = QoSProfile(history=_KEEP_LAST, depth=1000, reliability=_RELIABLE, durability=_TRANSIENT)
"""The writer of a chain topic, and a reader that wants the past but may lose messages.

The depth bounds the memory of a long run, with any middleware. A reader that joins later misses the first messages.
"""
ESTIMATE_HISTORY = QoSProfile(history=_KEEP_LAST, depth=5000, reliability=_RELIABLE, durability=_TRANSIENT)
"""The writer of estimates, of which there are several for each keyframe."""
COST_HISTORY = QoSProfile(history=_KEEP_LAST, depth=100, reliability=_RELIABLE, durability=_TRANSIENT)
"""Computing times of a node, once a second, with a row for each message."""
LATCHED = QoSProfile(history=_KEEP_LAST, depth=1, reliability=_RELIABLE, durability=_TRANSIENT)
"""Maps, graphs and statuses: the newest message, also for late readers."""
INCIDENT_HISTORY = QoSProfile(history=_KEEP_LAST, depth=100, reliability=_RELIABLE, durability=_TRANSIENT)
"""What happened to the nodes; a late reader gets the newest."""
TEAM_HISTORY = QoSProfile(history=_KEEP_LAST, depth=64, reliability=_RELIABLE, durability=_TRANSIENT)
"""Statuses and placements of a team; a late reader gets the newest of each robot."""
TF_STATIC = QoSProfile(history=_KEEP_LAST, depth=100, reliability=_RELIABLE, durability=_TRANSIENT)
"""/tf_static, with one latched message from each publisher."""
STREAM = QoSProfile(history=_KEEP_LAST, depth=100, reliability=_RELIABLE)
"""Streams for people and other programs: /tf, /pose, /clock, /diagnostics."""
NEWEST = QoSProfile(history=_KEEP_LAST, depth=1, reliability=_BEST_EFFORT)
"""Only the newest message, for the live page and for commands to a robot."""

SCAN, ODOM, CLOCK = "scan", "odom", "/clock"
CMD_VEL, GROUND_TRUTH = "cmd_vel", "ground_truth"
_TASK_NODES = tuple(row.name for row in COMPANIONS if "Task" in row.consumes)
TASK_GOALS = {name: f"{name}/task" for name in _TASK_NODES}
TASK_POSES = {name: f"{name}/goal" for name in _TASK_NODES}
TASK_RESULTS = {name: f"{name}/task_result" for name in _TASK_NODES}
ROOMS = {name: f"{name}/rooms" for name in _TASK_NODES}
TASK_FEEDBACK = topic_of("TaskFeedback")
NAVIGATE_TO_POSE = "navigate_to_pose"
GOAL_POSE, PLACE = "goal_pose", topic_of("PlaceEstimate")
KEYFRAMES, KEYFRAME_SCANS = topic_of("KeyframeHeader"), "hmt/keyframe_scans"
SCAN_POSES = "hmt/scan_poses"
FINISHED = topic_of("FinalCounts")
ROBOT_STATUS = topic_of("RobotStatus")
SAVE_REQUEST, SAVE_RESPONSE = topic_of("SaveRequest"), topic_of("SaveResponse")
RESET_REQUEST, RESET_RESPONSE = topic_of("ResetRequest"), topic_of("ResetResponse")
COST = "hmt/cost"
HMT_POSE, POSE = "hmt/pose", "pose"
MAP, GRAPH, PATH, PARTICLES, PMF = "map", "hmt/graph", "hmt/path", "hmt/particles", "hmt/pmf"
LANDMARKS = "hmt/landmarks"
IS_LOCALIZED, ENTROPY = "hmt/is_localized", "hmt/entropy"
AMBIGUITY_GOAL = "hmt/ambiguity_goal"
INITIAL_POSE = "initialpose"
RENDEZVOUS = "rendezvous"
STATEMENT = "statement"
DIAGNOSTICS, AGGREGATED = "diagnostics", "/diagnostics"
INCIDENTS = "hmt/incidents"

DOCUMENTS: dict[type, str] = {row.message_class: row.topic for row in process_table.DOCUMENTS}
"""{class of a message that travels as a document: topic}."""

BETWEEN_NODES = frozenset({*DOCUMENTS.values(), KEYFRAME_SCANS, DIAGNOSTICS, COST})
"""Topics on which nodes of the package listen to one another, with profiles that match."""


def transform_publisher(node: Node, topic: str) -> Callable[[list[TransformStamped]], None]:
    """Function that publishes transforms on ``tf`` or ``tf_static``; without tf2_msgs it only logs a warning once."""
    if TFMessage is None:
        node.get_logger().warning(
            f"tf2_msgs is not installed, so nothing is published on {topic}; scripts/test.sh builds it, and every ROS "
            "installation has it"
        )
        return lambda _: None
    publisher = node.create_publisher(TFMessage, topic, LATCHED if topic == "tf_static" else STREAM)
    return lambda transforms: publisher.publish(TFMessage(transforms=transforms))
