"""The process table: processes, their messages and nodes, for both runtimes, doctor, live page and packaging.

A new process is a new row in :data:`PROCESSES`. The module imports only the standard library, so that ``setup.py`` and
launch files can read it. Names are resolved when they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

_COMPOSITION = "hmt_slam_ros.composition"
_MESSAGES = "hmt_slam_ros.messages.messages"
_DOCUMENTS = "hmt_slam_ros.messages.documents"
_ROS = "hmt_slam_ros.ros"
_TEAM = "hmt_slam_ros.messages.team"
_TEAM_MESSAGES = ("TeamStatus", "TeamRequest", "TeamUpdate", "TeamPlacement", "TeamRendezvous")
_TOPOLOGY_NICENESS = 5  # a quarter of a core beside a program of niceness 0

RUN_NODE = f"{_ROS}.run_node"
"""Module that runs any node by its name."""

ALL = "all"
"""Program that runs all processes, each forked from it."""

COORDINATOR = "slam"
"""The process that starts coordinated requests; all others take part."""


@dataclass(frozen=True)
class NodeRow:
    """A node.

    :ivar name: name of the node and of its executable.
    :ivar title: its purpose in a few words.
    :ivar node_class: "module:Class" of the node, made with its name and run by ``spin``; empty without an executable.
    :ivar consumes: names of the message classes that it receives.
    :ivar libraries: parts of scipy that are imported at the first call of a function, or ahead with the kernels.
    """

    name: str
    title: str
    node_class: str = ""
    consumes: tuple[str, ...] = ()
    libraries: tuple[str, ...] = ()


@dataclass(frozen=True)
class ProcessRow(NodeRow):
    """A process of the SLAM system with its node.

    Its messages include at least one of the chain Keyframe, AreaEvents, Hypotheses, ClosureDecision.

    :ivar factory: "module:function" or "module:Class" that makes the process from a configuration and a state or None.
    :ivar state: "module:Class" of its state; without arguments the class is the state before the first message.
    :ivar produces: names of the message classes that it sends; ``Notice`` is implied.
    :ivar niceness: of its node, 0 to 19; on a busy processor those with less come first.
    """

    node_class: str = f"{_ROS}.process_node:ProcessNode"
    factory: str = ""
    state: str = ""
    produces: tuple[str, ...] = ()
    niceness: int = 0

    @property
    def state_class(self) -> type[Any]:
        """Class of the state."""
        return resolve_class(self.state)

    def make(self, configuration: Any, state: Any = None) -> Any:  # noqa: ANN401  the table knows no class
        """Make the process.

        :param configuration: all parameters.
        :param state: state from which it continues, None for the start.
        """
        return resolve(self.factory)(configuration, state)


@dataclass(frozen=True)
class DocumentRow:
    """A message that travels as a JSON document on a topic of its own.

    :ivar message: "module:Class" of the message.
    :ivar topic: name of the topic, relative to the namespace; absolute where all robots of a team share it.
    :ivar document: name of the document.
    :ivar version: version of the document; raise it with every change of the class.
    """

    message: str
    topic: str
    document: str
    version: int

    @property
    def message_class(self) -> type[Any]:
        """Class of the message."""
        return resolve_class(self.message)


PROCESSES: tuple[ProcessRow, ...] = (
    ProcessRow(
        name="slam",
        title="metric SLAM in the local area",
        node_class=f"{_ROS}.slam_node:SlamNode",
        consumes=("Scan", "Odometry", "MarkObservation", "PoseReset", "Hypotheses", "ClosureDecision", "EndOfLog"),
        factory=f"{_COMPOSITION}:metric_slam",
        state="hmt_slam_ros.metric_slam.slam:SlamState",
        produces=("TrackingReset", "Keyframe", "ScanPoses", "LocalEstimate", "EarlyEstimate", "EndOfRun"),
    ),
    ProcessRow(
        name="aam",
        title="area abstraction",
        consumes=("Keyframe", "Hypotheses", "ClosureDecision"),
        factory=f"{_COMPOSITION}:area_abstraction",
        state="hmt_slam_ros.area_abstraction.partition:AamState",
        libraries=("scipy.linalg", "scipy.sparse.csgraph"),
        produces=("AreaEvents",),
        niceness=_TOPOLOGY_NICENESS,
    ),
    ProcessRow(
        name="tsbi",
        title="Bayesian inference of the topology",
        node_class=f"{_ROS}.publishing_nodes:TsbiNode",
        consumes=("TrackingReset", "Keyframe", "AreaEvents", "ClosureDecision", "PlaceStatement"),
        factory=f"{_COMPOSITION}:topological_inference",
        state="hmt_slam_ros.topological_inference.tsbi:TsbiState",
        libraries=("scipy.special",),
        produces=("Hypotheses",),
        niceness=_TOPOLOGY_NICENESS,
    ),
    ProcessRow(
        name="tlca",
        title="loop closure acceptance and the global map",
        node_class=f"{_ROS}.publishing_nodes:TlcaNode",
        consumes=("Keyframe", "Hypotheses", "JoinedGround"),
        factory="hmt_slam_ros.loop_closure.tlca:Tlca",
        state="hmt_slam_ros.loop_closure.tlca:TlcaState",
        libraries=("scipy.sparse.csgraph", "scipy.sparse.linalg"),
        produces=("ClosureDecision", "Ambiguity"),
        niceness=_TOPOLOGY_NICENESS,
    ),
    ProcessRow(
        name="rtl",
        title="real-time localization",
        node_class=f"{_ROS}.publishing_nodes:RtlNode",
        consumes=("Odometry", "TrackingReset", "LocalEstimate", "EarlyEstimate", "Hypotheses", "ClosureDecision"),
        factory="hmt_slam_ros.real_time_localization.rtl:Rtl",
        state="hmt_slam_ros.real_time_localization.rtl:RtlState",
        produces=("RealTimePose",),
    ),
)
"""The processes of every robot, in the order in which messages are delivered."""

TEAM = ProcessRow(
    name="team",
    title="a team of robots",
    node_class=f"{_ROS}.team_node:TeamNode",
    consumes=("Keyframe", "Hypotheses", "ClosureDecision", *_TEAM_MESSAGES),
    factory="hmt_slam_ros.team.team:Team",
    state="hmt_slam_ros.team.team:TeamState",
    libraries=("scipy.special", "scipy.sparse.csgraph", "scipy.sparse.linalg"),
    produces=(*_TEAM_MESSAGES, "JoinedGround"),
    niceness=_TOPOLOGY_NICENESS,
)
"""The sixth process, of a robot in a team; it takes no part in saves, and a map has no state of it."""

COMPANIONS: tuple[NodeRow, ...] = (
    NodeRow(
        "robot", "replay of a log, or simulation", f"{_ROS}.robot_node:RobotNode", ("VelocityCommand", "TaskResult")
    ),
    NodeRow("view", "live page", f"{_ROS}.view_node:ViewNode"),
    NodeRow(
        "explorer",
        "exploration",
        f"{_ROS}.task_nodes:ExplorerNode",
        ("Task", "Scan", "RealTimePose", "Keyframe", "Hypotheses", "ClosureDecision", "Ambiguity", "TeamGoal"),
    ),
    NodeRow(
        "pilot",
        "localization and navigation among places",
        f"{_ROS}.task_nodes:PilotNode",
        ("Task", "Odometry", "Scan", "RealTimePose", "Keyframe", "Hypotheses", "ClosureDecision"),
    ),
)
"""Nodes beside the processes."""

RECORDER = NodeRow(
    "recorder",
    "recording for the output folder",
    consumes=("Keyframe", "Hypotheses", "ClosureDecision", "ScanPoses", "LocalEstimate", "EndOfRun", "Notice"),
)
"""The recorder of both runtimes. In a replay, its node runs in the OS process that started the others."""

DOCUMENTS: tuple[DocumentRow, ...] = (
    DocumentRow(f"{_DOCUMENTS}:KeyframeHeader", "hmt/keyframes", "keyframe", 13),
    DocumentRow(f"{_MESSAGES}:AreaEvents", "hmt/area_events", "area_events", 4),
    DocumentRow(f"{_MESSAGES}:Hypotheses", "hmt/hypotheses", "hypotheses", 10),
    DocumentRow(f"{_MESSAGES}:ClosureDecision", "hmt/closure_decisions", "closure_decision", 2),
    DocumentRow(f"{_MESSAGES}:LocalEstimate", "hmt/local_estimate", "local_estimate", 1),
    DocumentRow(f"{_MESSAGES}:TrackingReset", "hmt/tracking_reset", "tracking_reset", 1),
    DocumentRow(f"{_MESSAGES}:Notice", "hmt/notices", "notice", 1),
    DocumentRow(f"{_DOCUMENTS}:FinalCounts", "hmt/finished", "finished", 2),
    DocumentRow(f"{_DOCUMENTS}:RobotStatus", "hmt/robot_status", "robot_status", 2),
    DocumentRow(f"{_DOCUMENTS}:SaveRequest", "hmt/save_request", "save_request", 2),
    DocumentRow(f"{_DOCUMENTS}:SaveResponse", "hmt/save_response", "save_response", 1),
    DocumentRow(f"{_DOCUMENTS}:ResetRequest", "hmt/reset_request", "reset_request", 1),
    DocumentRow(f"{_DOCUMENTS}:ResetResponse", "hmt/reset_response", "reset_response", 1),
    DocumentRow("hmt_slam_ros.messages.tasks:PlaceEstimate", "pilot/place_estimate", "place_estimate", 2),
    DocumentRow("hmt_slam_ros.messages.tasks:TaskFeedback", "hmt/task_feedback", "task_feedback", 1),
    DocumentRow(f"{_MESSAGES}:EarlyEstimate", "hmt/early_estimate", "early_estimate", 1),
    DocumentRow("hmt_slam_ros.messages.ambiguity:Ambiguity", "hmt/ambiguity", "ambiguity", 1),
    DocumentRow("hmt_slam_ros.messages.topology:Topology", "hmt/topology", "topology", 2),
    DocumentRow("hmt_slam_ros.messages.alternatives:Alternatives", "hmt/alternatives", "alternatives", 1),
    DocumentRow("hmt_slam_ros.messages.evidence:Evidence", "hmt/evidence", "evidence", 1),
    DocumentRow(f"{_TEAM}:JoinedGround", "hmt/joined_ground", "joined_ground", 1),
    DocumentRow(f"{_TEAM}:TeamStatus", "/team/statuses", "team_status", 3),
    DocumentRow(f"{_TEAM}:TeamRequest", "/team/requests", "team_request", 1),
    DocumentRow(f"{_TEAM}:TeamUpdate", "/team/updates", "team_update", 2),
    DocumentRow(f"{_TEAM}:TeamPlacement", "/team/placements", "team_placement", 1),
    DocumentRow(f"{_TEAM}:TeamRendezvous", "/team/rendezvous", "team_rendezvous", 1),
    DocumentRow(f"{_TEAM}:TeamGoal", "/team/goals", "team_goal", 1),
)
"""Messages that travel as JSON documents."""


def resolve(reference: str) -> Any:  # noqa: ANN401  any object
    """The object that "module:name" refers to."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)


def resolve_class(reference: str) -> type[Any]:
    """The class that "module:Class" refers to."""
    found = resolve(reference)
    assert isinstance(found, type)
    return found


def process_names() -> tuple[str, ...]:
    """Names of the processes, in the order of delivery."""
    return tuple(row.name for row in PROCESSES)


def participant_names() -> tuple[str, ...]:
    """Names of the processes that answer coordinated requests."""
    return tuple(name for name in process_names() if name != COORDINATOR)


def node_rows() -> tuple[NodeRow, ...]:
    """Rows of all nodes that have an executable."""
    return (*PROCESSES, TEAM, *COMPANIONS)


def node_names() -> tuple[str, ...]:
    """Names of all nodes that have an executable."""
    return tuple(row.name for row in node_rows())


def program_names() -> tuple[str, ...]:
    """Names of all executables of nodes: one for each node, and one for all processes."""
    return (*node_names(), ALL)


def process_row(name: str) -> ProcessRow:
    """The row of a process."""
    return next(row for row in (*PROCESSES, TEAM) if row.name == name)


def node_row(name: str) -> NodeRow:
    """The row of a node that has an executable."""
    return next(row for row in node_rows() if row.name == name)


def producer(message: str) -> str:
    """Name of the process that sends a kind of message."""
    return next(row.name for row in PROCESSES if message in row.produces)


def consumer_count(message: str) -> int:
    """Number of processes that receive a kind of message."""
    return sum(message in row.consumes for row in PROCESSES)


def topic_of(message: str) -> str:
    """Topic of the documents of a message class, by its name."""
    return next(row.topic for row in DOCUMENTS if row.message.endswith(f":{message}"))


def node_command(name: str) -> list[str]:
    """Arguments of the Python interpreter that run a node; arguments for ROS may follow."""
    return ["-m", RUN_NODE, name]
