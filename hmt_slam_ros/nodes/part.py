"""A node's part of what slam asks of all: its share of a map, or to begin anew, after one and the same event."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from rclpy.qos import QoSProfile
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.chain_order import CHAIN
from hmt_slam_ros.nodes.topics import BEGIN, BEGUN, SAVE, SAVED
from hmt_slam_ros.persistence.folder import File, FolderWriter
from hmt_slam_ros.processes.documents import BeginRequest, BegunPart, SavedPart, SaveRequest, decode, encode
from hmt_slam_ros.processes.messages import Message
from hmt_slam_ros.processes.routing import HEARD_BY

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.process_node import ProcessNode

PARTS = ("aam", "tsbi", "tlca", "rtl")
"""The nodes that slam asks."""


class Part:
    """Answers slam when the node's process has heard as many keyframe events as slam says."""

    def __init__(self, node: ProcessNode, name: str) -> None:
        """Listen to slam.

        :param name: of the process.
        """
        self._node, self._name = node, name
        # The last message of an event that the process hears.
        self._last = [kind for kind in CHAIN if kind in HEARD_BY[name]][-1]
        self._events = node.beginning.events
        self._requests: deque[SaveRequest | BeginRequest] = deque()
        self._gave_last: float | None = None
        self._saved = node.create_publisher(String, SAVED, qos.CHAIN)
        self._begun = node.create_publisher(String, BEGUN, qos.CHAIN)
        self._listen(SAVE, SaveRequest, qos.CHAIN_FROM_NOW)
        # Who was not there hears of it all the same.
        self._listen(BEGIN, BeginRequest, qos.CHAIN)

    def _listen(self, topic: str, kind: type[SaveRequest | BeginRequest], profile: QoSProfile) -> None:
        def hear(message: String) -> None:
            try:
                request = decode(message.data, kind)
            except HmtSlamError as error:
                self._node.figures.fail(f"{topic}: {error}")
            else:
                self._hear(request)

        self._node.create_subscription(String, topic, hear, profile)

    def _hear(self, request: SaveRequest | BeginRequest) -> None:
        """Take note of a request, unless it was answered before."""
        if isinstance(request, SaveRequest) or request.number > self._node.answered:
            self._requests.append(request)
            self.look()

    def delivered(self, message: Message) -> None:
        """Count an event that the process has worked off; do what waits for it."""
        if isinstance(message, self._last):
            self._events += 1
            self.look()

    def gave_last(self, linger: float) -> bool:
        """Whether the part of the last map was written, at least some seconds ago, or there is nothing to be saved."""
        return not self._events or (self._gave_last is not None and time.monotonic() - self._gave_last >= linger)

    def look(self) -> None:
        """Answer what is due, and what would never be as nothing is heard."""
        while self._requests and (self._events >= self._requests[0].events or self._node.inbox.waits):
            self._answer(self._requests.popleft())

    def _answer(self, request: SaveRequest | BeginRequest) -> None:
        fault = self._apart(request)
        if isinstance(request, BeginRequest):
            fault = fault or self._begin(request)
            self._begun.publish(String(data=encode(BegunPart(request.number, self._name, fault))))
            self._node.inbox.catch_up()
            return
        files: tuple[File, ...] = ()
        if not fault:
            files, fault = self._written(request)
        self._saved.publish(String(data=encode(SavedPart(request.number, self._name, files, fault))))
        if request.last:
            self._gave_last = time.monotonic()

    def _apart(self, request: SaveRequest | BeginRequest) -> str:
        """What is wrong where the process heard more keyframe events than slam, or less; who forgets may lack some."""
        if self._events > request.events:
            return f"it is at keyframe event {self._events}, not {request.events}: restart all nodes"
        if self._events < request.events and isinstance(request, SaveRequest):
            return f"it is inactive, at keyframe event {self._events} of {request.events}: activate it"
        return ""

    def _begin(self, request: BeginRequest) -> str:
        """Begin anew; what went wrong."""
        try:
            self._node.begin_anew(request.folder, request.number)
        except HmtSlamError as fault:
            return f"{fault}; restart all nodes"
        self._events = self._node.beginning.events
        return ""

    def _written(self, request: SaveRequest) -> tuple[tuple[File, ...], str]:
        """What was written, or what went wrong."""
        folder = Path(request.folder)
        if not folder.is_dir():
            return (), f"it does not see the folder {folder}: run all nodes where that is, or set save_to of slam"
        try:
            writer = FolderWriter(folder)
            writer.write(self._name, self._node.process.state)
        except OSError as error:
            return (), f"{folder} cannot be written ({error.strerror})"
        return writer.files, ""
