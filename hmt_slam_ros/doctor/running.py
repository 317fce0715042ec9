"""A running system: who publishes what and is heard by whom, which of our nodes run, and what they say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from hmt_slam_ros.doctor.finding import Finding, Severity, times_text
from hmt_slam_ros.process_table import COORDINATOR, process_names, topic_of

OUR_NODES = process_names()
SCAN, ODOM, TF, TF_STATIC, CLOCK = "scan", "odom", "tf", "tf_static", "/clock"
ESTIMATES = topic_of("LocalEstimate")
SINGLE_PUBLISHER_TOPICS = (SCAN, ODOM, "map", "pose", CLOCK)
"""Topics that have one publisher."""

# By the state of a node that takes no part, what makes it do so.
_STATE_REMEDIES = {
    "unconfigured": "ros2 lifecycle set {first} configure and then activate{others}, or start with autostart:=true",
    "inactive": "ros2 lifecycle set {first} activate{others}, or start with autostart:=true",
    "finalized": "end {first} and start it again{others}, since no transition leads out of that",
}

# Stamps that differ by this from the computer's clock, s: doubtful, and wrong.
_CLOCK_OFFSETS = (0.5, 10.0)


class Mismatch(NamedTuple):
    """A publisher that a subscriber does not hear.

    :ivar publisher: node.
    :ivar subscriber: node.
    :ivar reason: in DDS's words.
    """

    publisher: str
    subscriber: str
    reason: str


@dataclass(frozen=True)
class Topic:
    """A topic as the graph of the system shows it.

    :ivar message_count: messages that came while the doctor listened, None where it did not.
    :ivar publishers: nodes, once for each publisher.
    :ivar mismatches: pairs that do not hear each other.
    """

    message_count: int | None
    publishers: tuple[str, ...]
    mismatches: tuple[Mismatch, ...] = ()


class NodeStatus(NamedTuple):
    """What a node said on /diagnostics last.

    :ivar name: of the node, with its namespace.
    :ivar level: 0 all is well, 1 warning, 2 and more error.
    :ivar message: a sentence.
    :ivar state: of a managed node, such as inactive; else empty.
    """

    name: str
    level: int
    message: str
    state: str = ""


@dataclass(frozen=True)
class RunningSystem:
    """What was seen of a running system.

    :ivar seconds: how long it was listened to.
    :ivar topics: by name, without namespace; /clock has none.
    :ivar nodes: names of all nodes but the doctor's.
    :ivar sim_time_nodes: nodes with use_sim_time.
    :ivar diagnostics: by node.
    :ivar clock_offsets: by topic, by how much its stamps are before the computer's clock as they arrive, s (median);
        empty where a /clock runs.
    :ivar conflicting_transforms: transforms that two sources tell in turn, with how often.
    :ivar missing_laser_transform: what of the laser's transform is missing, empty where nothing is.
    """

    seconds: float
    topics: Mapping[str, Topic]
    nodes: tuple[str, ...]
    sim_time_nodes: tuple[str, ...]
    diagnostics: tuple[NodeStatus, ...]
    clock_offsets: Mapping[str, float]
    conflicting_transforms: Mapping[str, int]
    missing_laser_transform: str


def findings(running: RunningSystem) -> list[Finding]:
    """All of it."""
    return [
        *_check_nodes(running),
        *_check_states(running),
        *_check_silence(running),
        *_check_qos(running),
        *_check_publishers(running),
        *_check_clock(running),
        *_check_diagnostics(running),
    ]


def _check_nodes(running: RunningSystem) -> list[Finding]:
    there = [name for name in OUR_NODES if name in running.nodes]
    if not there:
        text = "None of the nodes of hmt_slam_ros runs, so that sensors alone were looked at."
        return [Finding("fine", "nodes", text)]
    missing = [name for name in OUR_NODES if name not in there]
    if missing:
        verb = "is" if len(missing) == 1 else "are"
        text = f"Of the nodes, {_join_names(missing)} {verb} missing: start all of them, such "
        return [Finding("wrong", "nodes", text + "as by mapping.launch.py; the others wait for them.")]
    return [] if _check_states(running) else [Finding("fine", "nodes", f"All nodes run: {_join_names(there)}.")]


def _check_states(running: RunningSystem) -> list[Finding]:
    """Nodes that run and take no part, by their states."""
    found = []
    for state, remedy in _STATE_REMEDIES.items():
        names = _nodes_in_state(running, state)
        if names:
            others = f", and likewise {_join_names(names[1:])}" if len(names) > 1 else ""
            verbs = f"is {state} and takes" if len(names) == 1 else f"are {state} and take"
            text = f"{_join_names(names)} {verbs} no part: {remedy.format(first=names[0], others=others)}."
            found.append(Finding("wrong", "states", text))
    return found


def _nodes_in_state(running: RunningSystem, state: str) -> list[str]:
    """Our nodes that said that they are in it, with their namespaces."""
    return sorted(
        told.name for told in running.diagnostics if told.state == state and told.name.rpartition("/")[2] in OUR_NODES
    )


def _check_silence(running: RunningSystem) -> list[Finding]:
    found = []
    for name in (SCAN, ODOM):
        topic = running.topics[name]
        by_transform = name == ODOM and running.topics[TF].message_count
        if not topic.message_count and not by_transform:
            found.append(Finding("wrong", f"{name} silent", _silence_text(name, topic, running.seconds)))
    if running.missing_laser_transform:
        found.append(Finding("wrong", "laser transform", running.missing_laser_transform))
    estimates = running.topics[ESTIMATES]
    if (
        COORDINATOR in running.nodes
        and running.topics[SCAN].message_count
        and not estimates.message_count
        and not _check_states(running)
    ):
        text = (
            f"Scans come, and slam said nothing about one for {running.seconds:g} s: it is paused, or "
            "waits for odometry, a transform or the other nodes; its own log and /diagnostics say for which."
        )
        found.append(Finding("doubtful", "slam silent", text))
    return found


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


def _check_qos(running: RunningSystem) -> list[Finding]:
    return [
        Finding(
            "wrong",
            "QoS mismatch",
            f"{pair.subscriber} does not hear {name} of {pair.publisher}: {pair.reason}; let both be reliable, or the "
            "subscriber best effort, and alike for durability.",
        )
        for name, topic in running.topics.items()
        for pair in topic.mismatches
    ]


def _check_publishers(running: RunningSystem) -> list[Finding]:
    found = [
        Finding(
            "wrong",
            "two publishers",
            f"{name} has {len(topic.publishers)} publishers, {_join_names(topic.publishers)}: stop all but one of "
            "them, or remap the others.",
        )
        for name in SINGLE_PUBLISHER_TOPICS
        if (topic := running.topics.get(name)) is not None and len(topic.publishers) > 1
    ]
    return found + [
        Finding(
            "wrong",
            "two transforms",
            f"The transform {joint} was told differently for one stamp {times_text(count)}: two nodes publish it, of "
            f"{_join_names(running.topics[TF].publishers)}; stop one of them (or its publish_tf).",
        )
        for joint, count in running.conflicting_transforms.items()
    ]


def _check_clock(running: RunningSystem) -> list[Finding]:
    clock = running.topics[CLOCK].publishers
    found = []
    if running.sim_time_nodes and not clock:
        text = (
            f"{_join_names(running.sim_time_nodes)} {'has' if len(running.sim_time_nodes) == 1 else 'have'} "
            "use_sim_time, and nobody publishes /clock, so that time stands still: start the simulation or ros2 bag "
            "play --clock, or set use_sim_time to false."
        )
        found.append(Finding("wrong", "use_sim_time", text))
    for name, away in running.clock_offsets.items():
        severity: Severity = "wrong" if abs(away) >= _CLOCK_OFFSETS[1] else "doubtful"
        if abs(away) >= _CLOCK_OFFSETS[0]:
            text = (
                f"The stamps of {name} are {abs(away):.2f} s {'before' if away > 0.0 else 'after'} the clock of this "
                "computer when they arrive: synchronize the clocks of both computers (chrony), or, where a bag is "
                "played, use ros2 bag play --clock and use_sim_time."
            )
            found.append(Finding(severity, "stamps against clock", text))
    return found


def _check_diagnostics(running: RunningSystem) -> list[Finding]:
    return [
        Finding("wrong" if told.level > 1 else "doubtful", "diagnostics", f"{told.name} says: {told.message}")
        for told in running.diagnostics
        if told.level
    ]


def _join_names(names: tuple[str, ...] | list[str]) -> str:
    different = sorted(set(names))
    return different[0] if len(different) == 1 else f"{', '.join(different[:-1])} and {different[-1]}"
