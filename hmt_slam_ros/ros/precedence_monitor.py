"""Whether a node may take part: it waits, and at last ends, where a system that was started earlier has its topics."""

from __future__ import annotations

import time
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from hmt_slam_ros.errors import EarlierSystemError
from hmt_slam_ros.messages.precedence import Announcement, Precedence
from hmt_slam_ros.messages.system_name import REMEDY
from hmt_slam_ros.process_table import COORDINATOR
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.diagnostics import (
    HARDWARE_ID,
    STARTED,
    STATE,
    SYSTEM,
    SYSTEM_STARTED,
    WAITS_FOR,
    NodeDiagnostics,
    is_of_other_namespace,
)
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.topics import DIAGNOSTICS
from hmt_slam_ros.untrusted_input import shorten

_PATIENCE = 15.0
"""Time for which a node waits for the end of an earlier system, s; launch kills its nodes 10 s after Ctrl-C."""
_FAREWELL = 2.5
"""Time from the error until the node ends, s, in which it is on /diagnostics."""
_DISCOVERY_TIME = 3.0
"""Time from the start in which diagnostics of a living node of the same name would have come, s."""
_LIFETIME = 2.0
"""Time for which the warning and the error hold after the last check, s."""
_IDLE = ("unconfigured", "finalized")
"""Lifecycle states in which a node has no part in the topics."""


class PrecedenceMonitor:
    """Finds systems that were started earlier, by diagnostics of living nodes and by doubled names in the ROS graph.

    DDS lists a killed node for 20 s, but it sends nothing; a played bag may speak for a node that is not in the graph.

    :ivar knows_coordinator: whether diagnostics of slam of the same system have come.
    """

    def __init__(self, node: GuardedNode, diagnostics: NodeDiagnostics) -> None:
        self._node, self._diagnostics = node, diagnostics
        self._order = Precedence(node.get_fully_qualified_name(), diagnostics.system, diagnostics.started)
        diagnostics.system_started = lambda: self._order.system_started
        self._began = time.monotonic()
        self._earlier: Announcement | None = None
        self._waiting_since = self._began
        self.knows_coordinator = self._has_given_up = self._shares_name = False
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)

    @property
    def is_unsure(self) -> bool:
        """Whether the graph has a second node of this name or of slam that had no time yet to speak."""
        return time.monotonic() - self._began < _DISCOVERY_TIME and self._has_double(self._node.get_name(), COORDINATOR)

    def check(self) -> bool:
        """Whether an earlier system runs, which is also reported."""
        now = time.monotonic()
        earlier = self._order.preceding(now)
        if earlier is None or not self._is_confirmed():
            if self._earlier is not None:
                self._note_end(self._earlier)
            return False
        if self._earlier is None:
            self._waiting_since = now
        self._earlier = earlier
        self._report(earlier, now - self._waiting_since)
        return True

    def check_patience(self) -> None:
        """Check whether the node may still wait.

        :raises EarlierSystemError: once, where it has waited in vain, and reported that.
        """
        waited = time.monotonic() - self._waiting_since
        if self._earlier is not None and waited > _PATIENCE + _FAREWELL and not self._has_given_up:
            self._has_given_up = True
            raise EarlierSystemError(self._refusal(self._earlier))

    def check_first(self) -> None:
        """Check that no earlier system runs.

        :raises EarlierSystemError: where one does.
        """
        if self.check() and self._earlier is not None:
            raise EarlierSystemError(self._refusal(self._earlier))

    def _report(self, earlier: Announcement, waited: float) -> None:
        self._diagnostics.values[WAITS_FOR] = self._describe(earlier)
        if waited > _PATIENCE:
            self._diagnostics.fail(self._refusal(earlier), _LIFETIME)
        else:
            self._diagnostics.warn(
                f"{self._describe(earlier)} was started earlier and runs here, so this node waits up to "
                f"{_PATIENCE:g} s for its end: end it, or {REMEDY}",
                _LIFETIME,
            )

    def _describe(self, earlier: Announcement) -> str:
        """The other system by its name, or else by the node that spoke."""
        if earlier.system not in ("", self._diagnostics.system.name):
            return f"the system '{shorten(earlier.system)}'"
        return f"another node '{shorten(earlier.node)}', of {earlier.started},"

    def _refusal(self, earlier: Announcement) -> str:
        return (
            f"{self._describe(earlier)} was started earlier and runs here, so this node does not run beside it: end "
            f"it, or {REMEDY}"
        )

    def _note_end(self, earlier: Announcement) -> None:
        self._earlier = None
        self._diagnostics.values.pop(WAITS_FOR, None)
        self._diagnostics.system.forget_other()
        self._diagnostics.note(f"{self._describe(earlier)} has ended, so this node goes on")

    def _is_confirmed(self) -> bool:
        """Whether the graph agrees that an earlier system runs.

        One without a node of this name shows as a second slam, but only as long as this system has one, too. So it runs
        until it is silent.
        """
        is_known = self._earlier is not None
        self._shares_name = (is_known and self._shares_name) or self._has_double(self._node.get_name())
        return (is_known and not self._shares_name) or self._has_double(self._node.get_name(), COORDINATOR)

    def _has_double(self, *names: str) -> bool:
        """Whether the graph has two nodes of a name in this namespace."""
        nodes, namespace = self._node.get_node_names_and_namespaces(), self._node.get_namespace()
        return any(nodes.count((name, namespace)) > 1 for name in names)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.hardware_id == HARDWARE_ID and not is_of_other_namespace(status, self._node):
                self._on_status(status)

    def _on_status(self, status: DiagnosticStatus) -> None:
        values = {entry.key: entry.value for entry in status.values}
        announcement = _announcement(status.name, values)
        if status.name.rpartition("/")[2] == COORDINATOR and announcement.system == self._diagnostics.system.name:
            self.knows_coordinator = True
        if values.get(STATE) in _IDLE or not self._order.note(announcement, time.monotonic()):
            return
        if announcement.node == self._node.get_fully_qualified_name() and self._has_double(self._node.get_name()):
            self._note_double(announcement.system)

    def _note_double(self, system: str) -> None:
        """Take note of a living node of this name; a later one is reported here, an earlier one by :meth:`check`."""
        self._diagnostics.system.note_other(system)
        if self._order.preceding(time.monotonic()) is None and self._diagnostics.is_new_cause(DIAGNOSTICS, system):
            self._diagnostics.warn(self._diagnostics.second_system_text)


def _announcement(node: str, values: Mapping[str, str]) -> Announcement:
    started = values.get(STARTED, "")
    return Announcement(node, values.get(SYSTEM, ""), started, values.get(SYSTEM_STARTED, started))
