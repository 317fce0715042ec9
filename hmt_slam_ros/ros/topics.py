"""The names of the topics, and every quality-of-service profile in use."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from hmt_slam_ros import process_table
from hmt_slam_ros.process_table import topic_of

# Scans and odometry between the robot node and the processes: nothing is lost, however fast the replay runs.
# A reader that falls behind makes the writer wait, since the history of a reliable KEEP_ALL topic is bounded (5000).
SENSOR = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)

# The same where what was sent is kept: of the robot node, and for slam that was killed and missed something.
LATCHED_SENSOR = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# Drivers of live lasers publish best effort, which a reliable reader never hears. The nodes begin with SENSOR and
# change over to this profile when DDS reports such a writer. The depth bridges a second of a fast laser.
LIVE_SENSOR = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)

# The chain Keyframe -> AreaEvents -> Hypotheses -> ClosureDecision and what belongs to it: who comes late catches up.
CHAIN = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# A reader of a chain topic that has no use for the past.
VOLATILE_CHAIN = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)

# Maps, graphs, statuses: the newest one, also for who comes late.
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# /tf_static has one latched message from each of several publishers.
TF_STATIC = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

# What passes by for people and other programs: /tf, /pose, /clock, /diagnostics.
STREAM = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE)

# For the page, which looks at what passes by a few times a second, and for commands to a robot: older ones are
# replaced inside of DDS.
NEWEST = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)

# A reader of a chain topic that wants to know its past, and for which nobody waits: what is too much is lost.
CHAIN_HISTORY = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


SCAN, ODOM, CLOCK = "scan", "odom", "/clock"
CMD_VEL, GROUND_TRUTH = "cmd_vel", "ground_truth"
TASK_GOALS = {"explorer": "explorer/task", "pilot": "pilot/task"}
TASK_RESULTS = {"explorer": "explorer/task_result", "pilot": "pilot/task_result"}
GOAL_POSE, PLACE = "goal_pose", topic_of("PlaceEstimate")
KEYFRAMES, KEYFRAME_SCANS = topic_of("KeyframeHeader"), "hmt/keyframe_scans"
SCAN_POSES = "hmt/scan_poses"
FINISHED = topic_of("FinalCounts")
ROBOT_STATUS = topic_of("RobotStatus")
SAVE_REQUEST, SAVE_RESPONSE = topic_of("SaveRequest"), topic_of("SaveResponse")
RESET_REQUEST, RESET_RESPONSE = topic_of("ResetRequest"), topic_of("ResetResponse")
COST = "hmt/cost"
HMT_POSE, POSE = "hmt/pose", "pose"
MAP, GRAPH, PARTICLES, PMF = "map", "hmt/graph", "hmt/particles", "hmt/pmf"
IS_LOCALIZED, ENTROPY = "hmt/is_localized", "hmt/entropy"
INITIAL_POSE = "initialpose"
DIAGNOSTICS = "diagnostics"

DOCUMENTS: dict[type, str] = {row.message_class: row.topic for row in process_table.DOCUMENTS}
"""{class of a message that travels as a document: topic}."""
