"""A node's part of a map that slam asks for, as it is after one and the same keyframe event in all nodes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.chain_order import CHAIN
from hmt_slam_ros.nodes.topics import SAVE, SAVED
from hmt_slam_ros.persistence.folder import File, FolderWriter
from hmt_slam_ros.processes.documents import SavedPart, SaveRequest, decode, encode
from hmt_slam_ros.processes.messages import Message
from hmt_slam_ros.processes.routing import HEARD_BY

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.process_node import ProcessNode

PARTS = ("aam", "tsbi", "tlca", "rtl")
"""The nodes that slam asks."""


class PartSaver:
    """Writes the state of a node's process when it has heard as many keyframe events as slam says."""

    def __init__(self, node: ProcessNode, name: str) -> None:
        """Listen to slam.

        :param name: of the process.
        """
        self._node, self._name = node, name
        # The last message of an event that the process hears.
        self._last = [kind for kind in CHAIN if kind in HEARD_BY[name]][-1]
        self._events = node.beginning.events
        self._request: SaveRequest | None = None
        self._gave_last: float | None = None
        self._answers = node.create_publisher(String, SAVED, qos.CHAIN)
        node.create_subscription(String, SAVE, self._hear, qos.CHAIN_FROM_NOW)

    def delivered(self, message: Message) -> None:
        """Count an event that the process has worked off; write what waits for it."""
        if isinstance(message, self._last):
            self._events += 1
            self._answer_if_due()

    def gave_last(self, linger: float) -> bool:
        """Whether the part of the last map was written, at least some seconds ago, or there is nothing to be saved."""
        return not self._events or (self._gave_last is not None and time.monotonic() - self._gave_last >= linger)

    def _hear(self, message: String) -> None:
        try:
            self._request = decode(message.data, SaveRequest)
        except HmtSlamError as error:
            self._node.figures.fail(f"{SAVE}: {error}")
            return
        self._answer_if_due()

    def _answer_if_due(self) -> None:
        request = self._request
        if request is None or self._events < request.events:
            return
        self._request = None
        files, fault = self._written(request)
        self._answers.publish(String(data=encode(SavedPart(request.number, self._name, files, fault))))
        if request.last:
            self._gave_last = time.monotonic()

    def _written(self, request: SaveRequest) -> tuple[tuple[File, ...], str]:
        """What was written, or what went wrong."""
        if self._events > request.events:
            return (), f"it is at keyframe event {self._events}, not {request.events}: restart all nodes"
        folder = Path(request.folder)
        if not folder.is_dir():
            return (), f"it does not see the folder {folder}: run all nodes where that is, or set save_to of slam"
        try:
            writer = FolderWriter(folder)
            writer.write(self._name, self._node.process.state)
        except OSError as error:
            return (), f"{folder} cannot be written ({error.strerror})"
        return writer.files, ""
