"""Checks on a running system: its nodes, publishers, subscriptions and clocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from hmt_slam_ros.doctor.finding import Finding, Severity, times_text
from hmt_slam_ros.kernel_loading import COMPILING
from hmt_slam_ros.messages.system_name import REMEDY
from hmt_slam_ros.process_table import COORDINATOR, process_names, topic_of

OUR_NODES = process_names()
"""Nodes without which there is no mapping."""

_ROBOT = "robot"
"""Node that replays a log or simulates a robot, and waits for the others."""

SCAN, ODOM, TF, TF_STATIC, CLOCK = "scan", "odom", "tf", "tf_static", "/clock"
ESTIMATES = topic_of("LocalEstimate")
SINGLE_PUBLISHER_TOPICS = (ODOM, "map", "pose", CLOCK)
"""Topics that have one publisher, as those of scans."""

_STATE_REMEDIES = {
    "unconfigured": "ros2 lifecycle set {first} configure and then activate{others}, or start with autostart:=true",
    "inactive": "ros2 lifecycle set {first} activate{others}, or start with autostart:=true",
    "finalized": "end {first} and start it again{others}, since no transition leads out of that",
}

"""{lifecycle state: how to activate the nodes in it}."""

_CLOCK_OFFSETS = (0.5, 10.0)
"""Offset of stamps from the computer's clock: doubtful, and wrong, s."""


class Mismatch(NamedTuple):
    """A publisher and a subscription with incompatible QoS.

    :ivar publisher: name of the node.
    :ivar subscriber: name of the node.
    :ivar reason: the sentence of DDS.
    """

    publisher: str
    subscriber: str
    reason: str


@dataclass(frozen=True)
class Topic:
    """A topic in the ROS graph.

    :ivar message_count: number of messages received, None without a subscription.
    :ivar publishers: names of nodes, one for each publisher.
    :ivar mismatches: pairs with incompatible QoS.
    """

    message_count: int | None
    publishers: tuple[str, ...]
    mismatches: tuple[Mismatch, ...] = ()


class NodeStatus(NamedTuple):
    """The last diagnostics of a node.

    :ivar name: name of the node, with its namespace.
    :ivar level: 0 OK, 1 warning, 2 and more error.
    :ivar message: a sentence.
    :ivar state: lifecycle state of a managed node, else empty.
    :ivar waits_for: the earlier system for whose end it waits, empty without.
    """

    name: str
    level: int
    message: str
    state: str = ""
    waits_for: str = ""


class FrameContradiction(NamedTuple):
    """A parameter that names another frame than the messages of the odometry.

    :ivar node: name of the node.
    :ivar parameter: name of the parameter.
    :ivar frame: its value.
    :ivar odometry_frame: the frame in the messages.
    """

    node: str
    parameter: str
    frame: str
    odometry_frame: str


@dataclass(frozen=True)
class RunningSystem:
    """Observations of a running system.

    :ivar seconds: duration of the observation, s.
    :ivar topics: {name without namespace: topic}.
    :ivar nodes: names of all nodes in the doctor's namespace, but its own.
    :ivar sim_time_nodes: names of the nodes with use_sim_time.
    :ivar diagnostics: last diagnostics of each node of each system.
    :ivar clock_offsets: {topic: median by which its stamps precede the computer's clock on arrival, s}; empty where
        /clock is published.
    :ivar conflicting_transforms: {transform: number of stamps for which two sources published different values}.
    :ivar missing_laser_transforms: a sentence about each missing transform of a laser.
    :ivar other_namespaces: other namespaces with nodes of ours.
    :ivar frame_contradictions: parameters of nodes that name other frames than the odometry.
    :ivar systems: names of the systems of our nodes in the doctor's namespace.
    :ivar scan_topics: topics of the scans.
    """

    seconds: float
    topics: Mapping[str, Topic]
    nodes: tuple[str, ...]
    sim_time_nodes: tuple[str, ...]
    diagnostics: tuple[NodeStatus, ...]
    clock_offsets: Mapping[str, float]
    conflicting_transforms: Mapping[str, int]
    missing_laser_transforms: tuple[str, ...] = ()
    other_namespaces: tuple[str, ...] = ()
    frame_contradictions: tuple[FrameContradiction, ...] = ()
    systems: tuple[str, ...] = ()
    scan_topics: tuple[str, ...] = (SCAN,)

    @property
    def has_scans(self) -> bool:
        """Whether scans came on any topic."""
        return any(self.topics[name].message_count for name in self.scan_topics)


def running_findings(running: RunningSystem) -> Iterator[Finding]:
    """Findings on nodes, topics, publishers and clocks."""
    states = list(_check_states(running))
    yield from _check_nodes(running, all_active=not states)
    yield from states
    yield from _check_systems(running)
    yield from _check_silence(running, all_active=not states)
    yield from _check_qos(running)
    yield from _check_publishers(running)
    yield from _check_frames(running)
    yield from _check_clock(running)
    yield from _check_diagnostics(running)


def _check_nodes(running: RunningSystem, *, all_active: bool) -> Iterator[Finding]:
    present = [name for name in OUR_NODES if name in running.nodes]
    missing = [name for name in OUR_NODES if name not in present]
    if not present and running.other_namespaces:
        first, *others = running.other_namespaces
        likewise = f", and likewise {_join_names(others)}" if others else ""
        text = (
            "None of the nodes of hmt_slam_ros runs in this namespace, but some do in "
            f"{_join_names(running.other_namespaces)}: hmt_slam doctor --live --ros-args -r __ns:={first} examines "
            f"those{likewise}."
        )
        yield Finding("wrong", "nodes", text)
    elif not present:
        text = "None of the nodes of hmt_slam_ros runs, so only the sensors were checked."
        yield Finding("fine", "nodes", text)
    elif missing:
        verb = "is" if len(missing) == 1 else "are"
        text = (
            f"Of the nodes, {_join_names(missing)} {verb} missing: start all of them, such as by mapping.launch.py; "
            "the others wait for them."
        )
        yield Finding("wrong", "nodes", text)
    elif all_active:
        yield Finding("fine", "nodes", f"All nodes run: {_join_names(present)}.")


def _check_systems(running: RunningSystem) -> Iterator[Finding]:
    """A finding on two systems that speak on the same topics."""
    doubled = sorted({name for name in OUR_NODES if running.nodes.count(name) > 1})
    if len(running.systems) > 1:
        text = f"{len(running.systems)} systems run in this namespace, {_join_names(running.systems)}"
    elif doubled:
        text = (
            f"{_join_names(doubled)} {'runs' if len(doubled) == 1 else 'run'} twice in this namespace (a killed node "
            "counts for 20 s)"
        )
    else:
        return
    yield Finding("wrong", "two systems", f"{text}: end all but one, or {REMEDY}.")


def _check_states(running: RunningSystem) -> Iterator[Finding]:
    """Findings on nodes that run but are not active."""
    for state, remedy in _STATE_REMEDIES.items():
        names = _nodes_in_state(running, state)
        if names:
            others = f", and likewise {_join_names(names[1:])}" if len(names) > 1 else ""
            verbs = f"is {state} and takes" if len(names) == 1 else f"are {state} and take"
            text = f"{_join_names(names)} {verbs} no part: {remedy.format(first=names[0], others=others)}."
            yield Finding("wrong", "states", text)
    texts = [f"{status.name}: {status.message}" for status in running.diagnostics if _is_compiling(status)]
    if texts:
        text = f"{'; '.join(texts)}. That is so once on a computer: wait, and run hmt_slam compile at the installation."
        yield Finding("fine", "kernels", text)


def _nodes_in_state(running: RunningSystem, state: str) -> list[str]:
    """Names of our nodes in a lifecycle state, with their namespaces, but those that compile or wait for a system."""
    return sorted(
        status.name
        for status in running.diagnostics
        if status.state == state and status.name.rpartition("/")[2] in OUR_NODES
        if not _is_compiling(status) and not status.waits_for
    )


def _is_compiling(status: NodeStatus) -> bool:
    return status.message.startswith(COMPILING)


def _check_silence(running: RunningSystem, *, all_active: bool) -> Iterator[Finding]:
    for name in (*running.scan_topics, ODOM):
        topic = running.topics[name]
        by_transform = name == ODOM and running.topics[TF].message_count
        if topic.message_count or by_transform:
            continue
        if set(topic.publishers) == {_ROBOT} and any(map(_is_compiling, running.diagnostics)):
            yield Finding("fine", f"{name} silent", f"{_ROBOT} sends nothing on {name} until the kernels are compiled.")
        else:
            yield Finding("wrong", f"{name} silent", _silence_text(name, topic, running.seconds))
    for text in running.missing_laser_transforms:
        yield Finding("wrong", "laser transform", text)
    estimates = running.topics[ESTIMATES]
    if COORDINATOR in running.nodes and running.has_scans and not estimates.message_count and all_active:
        text = (
            f"Scans arrive, but slam sent no estimate for {running.seconds:g} s: it is paused, or waits for odometry, "
            "a transform or the other nodes; its own log and /diagnostics say for which."
        )
        yield Finding("doubtful", "slam silent", text)


def _silence_text(name: str, topic: Topic, seconds: float) -> str:
    if topic.publishers:
        return (
            f"Nothing came on {name} for {seconds:g} s, though {_join_names(topic.publishers)} publishes it: look "
            "whether the driver has its device and whether the network lets messages through."
        )
    return (
        f"Nobody publishes {name}: start the driver, or remap its topic, such as --ros-args -r {name}:=/base_{name}, "
        "and see that ROS_DOMAIN_ID is the same everywhere."
    )


def _check_qos(running: RunningSystem) -> Iterator[Finding]:
    for name, topic in running.topics.items():
        for pair in topic.mismatches:
            text = (
                f"{pair.subscriber} does not hear {name} of {pair.publisher}: {pair.reason}; let both be reliable, or "
                "the subscriber best effort, and alike for durability."
            )
            yield Finding("wrong", "QoS mismatch", text)


def _check_publishers(running: RunningSystem) -> Iterator[Finding]:
    for name in (*running.scan_topics, *SINGLE_PUBLISHER_TOPICS):
        topic = running.topics.get(name)
        if topic is not None and len(topic.publishers) > 1:
            text = (
                f"{name} has {len(topic.publishers)} publishers, {_join_names(topic.publishers)}: stop all but one of "
                "them, or remap the others."
            )
            yield Finding("wrong", "two publishers", text)
    for transform, count in running.conflicting_transforms.items():
        text = (
            f"The transform {transform} had different values at one stamp {times_text(count)}: two nodes publish it, "
            f"of {_join_names(running.topics[TF].publishers)}; stop one of them (or its publish_tf)."
        )
        yield Finding("wrong", "two transforms", text)


def _check_frames(running: RunningSystem) -> Iterator[Finding]:
    for node, parameter, frame, odometry_frame in running.frame_contradictions:
        text = (
            f"{node} has {parameter} = {frame}, and the odometry is that of {odometry_frame}, so that the tree of "
            f"transforms is in two parts: leave {parameter} empty, or set it to {odometry_frame}."
        )
        yield Finding("wrong", "frames contradict", text)


def _check_clock(running: RunningSystem) -> Iterator[Finding]:
    clock = running.topics[CLOCK].publishers
    if running.sim_time_nodes and not clock:
        text = (
            f"{_join_names(running.sim_time_nodes)} {'has' if len(running.sim_time_nodes) == 1 else 'have'} "
            "use_sim_time, and nobody publishes /clock, so that time stands still: start the simulation or ros2 bag "
            "play --clock, or set use_sim_time to false."
        )
        yield Finding("wrong", "use_sim_time", text)
    for name, offset in running.clock_offsets.items():
        severity: Severity = "wrong" if abs(offset) >= _CLOCK_OFFSETS[1] else "doubtful"
        if abs(offset) >= _CLOCK_OFFSETS[0]:
            text = (
                f"The stamps of {name} are {abs(offset):.2f} s {'before' if offset > 0.0 else 'after'} the clock of "
                "this computer when they arrive: synchronize the clocks of both computers (chrony), or, where a bag is "
                "played, use ros2 bag play --clock and use_sim_time."
            )
            yield Finding(severity, "stamps against clock", text)


def _check_diagnostics(running: RunningSystem) -> Iterator[Finding]:
    for status in running.diagnostics:
        if status.level:
            severity: Severity = "wrong" if status.level > 1 else "doubtful"
            yield Finding(severity, "diagnostics", f"{status.name} says: {status.message}")


def _join_names(names: tuple[str, ...] | list[str]) -> str:
    different = sorted(set(names))
    return different[0] if len(different) == 1 else f"{', '.join(different[:-1])} and {different[-1]}"
