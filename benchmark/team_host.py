"""A robot of a team on a host of its own: the node ``team``, and the rest of its chain, which is recorded before.

    python -m benchmark.team_host NAME WORLD LAP FOLDER

Reads commands, one a line: ``start``, ``kill``, ``play SHARE``, ``end``. Prints what it sees once a second, as JSON.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from benchmark.recorded_chain import ChainPublisher, record_chain
from benchmark.runs import PARAMETERS
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.messages.documents import decode
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.team import TeamPlacement, TeamStatus
from hmt_slam_ros.process_table import TEAM, node_command
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS

_DOMAIN = 7
_SPIN = 0.01  # s
_PERIOD = 1.0  # s
_INTERVAL = 0.02
"""Time between two messages of the chain, s."""


class _Host:
    """The node ``team``, and the node that plays the chain to it."""

    def __init__(self, name: str, messages: Sequence[Message], folder: Path) -> None:
        """:param folder: of the state of a node that was killed."""
        self._name, self._messages, self._folder = name, messages, folder
        self._played, self._until, self._share, self._next_at = 0, 0, 0.0, 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._status: TeamStatus | None = None
        self._placements: dict[str, TeamPlacement] = {}
        self._values: dict[str, str] = {}
        context = Context()
        context.init(domain_id=_DOMAIN)
        self._node = Node("chain", context=context, namespace=name)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._chain = ChainPublisher(self._node, name)
        self._node.create_subscription(String, DOCUMENTS[TeamStatus], self._on_status, topics.TEAM_HISTORY)
        self._node.create_subscription(String, DOCUMENTS[TeamPlacement], self._on_placement, topics.TEAM_HISTORY)
        self._node.create_subscription(DiagnosticArray, DIAGNOSTICS, self._on_diagnostics, topics.STREAM)

    def _on_status(self, message: String) -> None:
        status = decode(message.data, TeamStatus)
        if status.robot == self._name:
            self._status = status

    def _on_placement(self, message: String) -> None:
        placement = decode(message.data, TeamPlacement)
        if placement.robot == self._name:
            (other,) = {placement.first, placement.second} - {self._name}
            self._placements[other] = placement

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._values |= {entry.key: entry.value for entry in status.values}

    def start(self) -> None:
        """Start the node ``team``, which goes on where it was."""
        words = ["-r", f"__ns:=/{self._name}", "-p", f"system:={self._name}", "-p", f"recovery:={self._folder}"]
        command = [sys.executable, *node_command(TEAM.name), "--ros-args", *words]
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=sys.stderr, env=os.environ | {"ROS_DOMAIN_ID": f"{_DOMAIN}"}
        )

    def end(self, number: int) -> None:
        """End the node by a signal."""
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait()
            self._process = None

    def serve(self) -> None:
        """Follow the commands until ``end``."""
        commands, reported = queue.SimpleQueue[list[str]](), 0.0
        threading.Thread(target=_read_commands, args=(commands,), daemon=True).start()
        while True:
            self._executor.spin_once(timeout_sec=_SPIN)
            self._play_on()
            if not commands.empty() and not self._follow(commands.get()):
                return
            if time.monotonic() - reported > _PERIOD:
                reported = time.monotonic()
                print(json.dumps(self._report()), flush=True)

    def _follow(self, words: Sequence[str]) -> bool:
        """Follow a command; False for the last one, or where nobody gives any more."""
        match words:
            case ["start"]:
                self.start()
            case ["kill"]:
                self.end(signal.SIGKILL)
            case ["play", share]:
                self._share = float(share)
                self._until = int(self._share * len(self._messages))
            case _:
                self.end(signal.SIGINT)
                return False
        return True

    def _play_on(self) -> None:
        if self._played == self._until or time.monotonic() < self._next_at:
            return
        self._next_at = time.monotonic() + _INTERVAL
        self._chain.publish(self._messages[self._played])
        self._played += 1

    def _report(self) -> dict[str, object]:
        return {
            "share": self._share if self._played == self._until else None,
            "played": self._played,
            "version": 0 if self._status is None else self._status.map_version,
            "maps": {key: value for key, value in self._values.items() if key.startswith("map of ")},
            "placements": {
                other: [each.verdict.value, each.probability, *each.pose.tolist()]
                for other, each in self._placements.items()
            },
            "sent": self._values.get("sent of the map", "0 kB"),
        }


def _read_commands(commands: queue.SimpleQueue[list[str]]) -> None:
    """Read commands until there are no more, and then ``end``."""
    for line in sys.stdin:
        commands.put(line.split())
    commands.put(["end"])


def main() -> None:
    """Run a robot until its commands end."""
    name, world, lap, folder = sys.argv[1:]
    messages = record_chain(load_configuration(PARAMETERS, []), world, int(lap))
    _Host(name, messages, Path(folder)).serve()


if __name__ == "__main__":
    main()
