"""The health of the system: the diagnostics of the nodes, and which nodes and poses are missing."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Literal

from hmt_slam_ros.kernel_loading import COMPILING
from hmt_slam_ros.messages.system_name import REMEDY

Level = Literal["good", "waiting", "attention", "fault"]

NODE_TIMEOUT = 10.0
"""Time without diagnostics after which a node is silent, s; each has as long to start. They come once a second."""

_POSE_TIMEOUT = 3.0
"""Time without a pose that is a fault, s."""

_MAX_NODES = 100
"""Nodes that the page shows; diagnostics of further ones are left out."""

_MAX_VALUES = 100
"""Values of a node that the page shows."""

_MAX_TEXT = 1000
"""Characters of a message or value that the page shows."""

_WARN = 1
"""Level of a warning in diagnostic_msgs/DiagnosticStatus."""

_SECOND_SYSTEM = "second system"
"""Name of the value by which a node reports another system on its topics."""

_WAITS_FOR = "waits for"
"""Name of the value by which a node says that it waits for the end of an earlier system."""

_KERNELS = "kernels"
"""Name of the value that describes the kernels of a node."""

_ACTIVE = "active"
"""Lifecycle state of a node that processes messages."""

_NEXT_TRANSITION = {"unconfigured": "configure", "inactive": "activate"}
"""{lifecycle state: transition towards the active state}."""


@dataclass
class NodeHealth:
    """The last diagnostics of a node.

    :ivar level: 0 all is well, 1 a warning, 2 an error, as in diagnostic_msgs/DiagnosticStatus.
    :ivar message: "running", or the last warning or error.
    :ivar values: {name: value}.
    :ivar heard_at: time of arrival, s.
    :ivar load: share of the time that the node computed between the last two diagnostics, None before the second.
    """

    level: int
    message: str
    values: Mapping[str, str]
    heard_at: float
    load: float | None = None


@dataclass
class SystemHealth:
    """The health of all nodes.

    :ivar expected_nodes: nodes without which there is no mapping.
    :ivar nodes: {node: its last diagnostics}.
    :ivar last_pose_at: time of the last pose, s, None before the first.
    :ivar is_localized: whether the robot is localized, None before the first status.
    :ivar robot_state: state of the node that replays a log, None where there is none.
    :ivar second_system: name of another system that speaks on the same topics, empty without.
    """

    expected_nodes: Sequence[str]
    nodes: dict[str, NodeHealth] = field(default_factory=dict)
    last_pose_at: float | None = None
    is_localized: bool | None = None
    robot_state: str | None = None
    second_system: str = ""

    def update(self, node: str, level: int, message: str, values: Mapping[str, str], now: float) -> None:
        """Store the diagnostics of a node, as far as the page shows them.

        :param now: time on a monotonic clock, s.
        """
        name, message = node[:_MAX_TEXT], message[:_MAX_TEXT]
        if name not in self.nodes and name not in self.expected_nodes and len(self.nodes) >= _MAX_NODES:
            return
        values = {key[:_MAX_TEXT]: value[:_MAX_TEXT] for key, value in islice(values.items(), _MAX_VALUES)}
        previous, load = self.nodes.get(name), None
        if previous is not None and now > previous.heard_at:
            load = max(0.0, busy_seconds(values) - busy_seconds(previous.values)) / (now - previous.heard_at)
        self.nodes[name] = NodeHealth(level, message, values, now, load)

    def rows(self, now: float) -> list[dict[str, Any]]:
        """A row of the page for every node, the expected ones first."""
        names = [*self.expected_nodes, *sorted(self.nodes.keys() - set(self.expected_nodes))]
        return [self._row(name, now) for name in names]

    def _row(self, name: str, now: float) -> dict[str, Any]:
        node = self.nodes.get(name)
        if node is None:
            return {"name": name, "level": "waiting", "message": "not heard yet", "values": {}}
        age = now - node.heard_at
        if age > NODE_TIMEOUT:
            return {"name": name, "level": "fault", "message": f"silent for {age:.0f} s", "values": dict(node.values)}
        level = _level(node)
        row = {"name": name, "level": level, "message": node.message, "values": dict(node.values)}
        return row if node.load is None else {**row, "load": round(min(node.load, 1.0), 2)}

    def verdict(self, now: float) -> dict[str, str]:
        """The most serious condition: its level, a sentence and advice."""
        diagnostics = self._diagnostics_verdicts()
        for verdict in (
            self._no_nodes_verdict(),
            self._silent_nodes_verdict(now),
            diagnostics.get("fault"),
            self._compiling_nodes_verdict(),
            self._waiting_nodes_verdict(),
            self._inactive_nodes_verdict(),
            self._second_system_verdict(),
            self._pose_verdict(now),
            diagnostics.get("attention"),
        ):
            if verdict is not None:
                return verdict
        if self.is_localized is False:
            return _verdict("attention", "The robot's place is not known yet: it may be anywhere in the map.")
        if self.robot_state == "ended":
            return _verdict("good", "The log has ended; the nodes are well.")
        return _verdict("good", "All is well.")

    def _no_nodes_verdict(self) -> dict[str, str] | None:
        if any(name in self.nodes for name in self.expected_nodes):
            return None
        return _verdict(
            "waiting",
            "No node is heard.",
            "Start them: ros2 launch hmt_slam_ros mapping.launch.py. If they run: are ROS_DOMAIN_ID and the namespace "
            "the same as here?",
        )

    def _silent_nodes_verdict(self, now: float) -> dict[str, str] | None:
        never = [name for name in self.expected_nodes if name not in self.nodes]
        if never:
            level: Level = "fault" if now > NODE_TIMEOUT else "waiting"
            verb = "is" if len(never) == 1 else "are"
            return _verdict(level, f"{_join_names(never)} {verb} not running.", f"ros2 run hmt_slam_ros {never[0]}")
        silent = [name for name in self.expected_nodes if now - self.nodes[name].heard_at > NODE_TIMEOUT]
        if not silent:
            return None
        age = now - min(self.nodes[name].heard_at for name in silent)
        verb, advice = "says", "Did it end? Its log tells."
        if len(silent) > 1:
            verb, advice = "say", "Did they end? Their logs tell."
        return _verdict("fault", f"{_join_names(silent)} {verb} nothing, for {age:.0f} s.", advice)

    def _compiling_nodes_verdict(self) -> dict[str, str] | None:
        """The verdict on the nodes that compile their kernels, with the longest time left."""
        left = {name: _seconds_left(node) for name, node in self.nodes.items() if _is_compiling(node)}
        if not left:
            return None
        text = self.nodes[max(left, key=lambda name: left[name])].values[_KERNELS]
        advice = "That is so once on a computer. At the installation hmt_slam compile does it."
        return _verdict("waiting", f"{_join_names(sorted(left))}: {text}.", advice)

    def _waiting_nodes_verdict(self) -> dict[str, str] | None:
        """The verdict on nodes that wait for the end of an earlier system."""
        waiting = next((node for node in self.nodes.values() if _WAITS_FOR in node.values), None)
        if waiting is None:
            return None
        return _verdict("attention", "This system waits for the end of an earlier one.", waiting.message)

    def _inactive_nodes_verdict(self) -> dict[str, str] | None:
        for name in self.nodes:
            if (state := _state(self.nodes[name])) != _ACTIVE:
                transition = _NEXT_TRANSITION.get(state, "")
                advice = f"ros2 lifecycle set /{name} {transition}" if transition else "Start it anew."
                return _verdict("waiting", f"{name} is {state}.", advice)
        return None

    def _diagnostics_verdicts(self) -> dict[Level, dict[str, str]]:
        """{level: verdict on the first node of that level}."""
        levels = {name: _level(node) for name, node in self.nodes.items()}
        verbs: dict[Level, str] = {"fault": "has a fault", "attention": "warns"}
        return {
            level: _verdict(level, f"{name} {verbs[level]}.", self.nodes[name].message)
            for name, level in reversed(levels.items())
            if level in verbs
        }

    def _second_system_verdict(self) -> dict[str, str] | None:
        reports = (node.values[_SECOND_SYSTEM] for node in self.nodes.values() if _SECOND_SYSTEM in node.values)
        other = self.second_system or next(reports, "")
        if not other:
            return None
        return _verdict("attention", f"A second system runs here: {other}.", f"{REMEDY[0].upper()}{REMEDY[1:]}.")

    def _pose_verdict(self, now: float) -> dict[str, str] | None:
        if self.robot_state in ("ended", "paused"):
            return None
        advice = "Do scans and odometry arrive? ros2 topic hz scan, ros2 topic hz odom"
        if self.last_pose_at is None:
            return _verdict("waiting", "The nodes run; no pose came yet.", advice)
        if now - self.last_pose_at > _POSE_TIMEOUT:
            return _verdict("fault", f"No pose for {now - self.last_pose_at:.0f} s.", advice)
        return None


def _verdict(level: Level, text: str, advice: str = "") -> dict[str, str]:
    return {"level": level, "text": text, "advice": advice}


def _level(node: NodeHealth) -> Level:
    if node.level > _WARN:
        return "fault"
    if _state(node) != _ACTIVE:
        return "waiting"
    return "attention" if node.level == _WARN else "good"


def _state(node: NodeHealth) -> str:
    """Lifecycle state; nodes without one are active."""
    return node.values.get("state", _ACTIVE)


def _is_compiling(node: NodeHealth) -> bool:
    return node.values.get(_KERNELS, "").startswith(COMPILING)


def _seconds_left(node: NodeHealth) -> int:
    """Time that the compilation of the kernels takes yet, s; 0 where it is unknown."""
    found = re.search(r"[0-9]{1,6}", node.values[_KERNELS])
    return int(found[0]) if found else 0


def _join_names(names: Sequence[str]) -> str:
    return " and ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else names[0]


def busy_seconds(values: Mapping[str, str]) -> float:
    """Computing time since the start, s."""
    try:
        seconds = float(values.get("busy", "0").removesuffix(" s"))
    except ValueError:
        return 0.0
    return seconds if math.isfinite(seconds) else 0.0
