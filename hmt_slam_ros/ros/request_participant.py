"""A process's side of coordinated requests: it saves its part of a map, or resets, after a keyframe event."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path

from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import ResetRequest, ResetResponse, SaveRequest, SaveResponse, encode
from hmt_slam_ros.messages.gate import MAX_REACH, check_save_folder
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS, Checkpointable
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.chain_order import CHAIN
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.ros.message_io import Inbox, subscribe_document
from hmt_slam_ros.ros.topics import DOCUMENTS
from hmt_slam_ros.saved_map.folder import FileRecord, FolderWriter

_MAX_REQUESTS = 16
"""Requests of slam that wait for their keyframe event; slam makes one at a time."""


class ParticipantNode(ManagedNode):
    """A node of a process, as far as its requests need it.

    :ivar process: the process.
    :ivar inbox: its messages.
    :ivar initial_state: the state with which it started last.
    :ivar reset_number: number of the last reset request that was answered, 0 before the first.
    """

    process: Checkpointable
    inbox: Inbox
    initial_state: InitialState
    reset_number: int

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """Forget all, and start again with a map in which the robot may be anywhere, or with nothing.

        :param folder: of the map, empty for nothing.
        :param reset_number: number of the reset request.
        :raises HmtSlamError: for a map that is damaged or does not match.
        """
        raise NotImplementedError


class RequestParticipant:
    """Answers the coordinated requests of slam, each after the keyframe event that it names."""

    def __init__(self, node: ParticipantNode, name: str) -> None:
        """Subscribe to the requests; ``name`` is that of the process."""
        self._node, self._name = node, name
        self._last_event_type = [kind for kind in CHAIN if kind in SUBSCRIPTIONS[name]][-1]
        self._events = node.initial_state.events
        self._requests: deque[SaveRequest | ResetRequest] = deque(maxlen=_MAX_REQUESTS)
        self._final_part_saved_at: float | None = None
        self._responses = {
            kind: node.create_publisher(String, DOCUMENTS[kind], topics.CHAIN) for kind in (SaveResponse, ResetResponse)
        }
        # A late node has to follow a reset too.
        for kind, profile in ((SaveRequest, topics.VOLATILE_CHAIN), (ResetRequest, topics.CHAIN)):
            subscribe_document(node, kind, self._on_request, profile)

    def _on_request(self, request: SaveRequest | ResetRequest) -> None:
        """Take a request, unless it is a reset that was done before."""
        if isinstance(request, ResetRequest) and request.number <= self._node.reset_number:
            self._repeat_response(request)
        elif request.events > self._events + MAX_REACH:
            self._node.diagnostics.refuse(
                DOCUMENTS[type(request)],
                HmtSlamError(
                    f"events = {request.events} is far ahead of {self._events}, this node's: look for a second system "
                    "in this ROS domain"
                ),
            )
        else:
            self._requests.append(request)
            self.answer_due_requests()

    def _repeat_response(self, request: ResetRequest) -> None:
        """Answer the last reset again: the node may have been killed between that and its response."""
        if request.number == self._node.reset_number:
            self._respond(ResetResponse(request.number, self._name))

    def on_delivered(self, message: Message) -> None:
        """Count keyframe events, and answer the requests that wait for this one."""
        if isinstance(message, self._last_event_type):
            self._events += 1
            self.answer_due_requests()

    def has_saved_final_part(self, linger: float) -> bool:
        """Whether the part of the last map was saved ``linger`` s ago, or there is nothing to save."""
        return not self._events or (
            self._final_part_saved_at is not None and time.monotonic() - self._final_part_saved_at >= linger
        )

    def answer_due_requests(self) -> None:
        """Answer requests whose keyframe event has come; those of a holding inbox too, for which it never will."""
        for request in tuple(self._requests):
            if self._events >= request.events or self._node.inbox.is_holding:
                self._requests.remove(request)
                self._answer(request)

    def _answer(self, request: SaveRequest | ResetRequest) -> None:
        fault = self._event_mismatch(request)
        if isinstance(request, ResetRequest):
            self._respond(ResetResponse(request.number, self._name, fault or self._reset(request)))
            self._node.inbox.deliver_early()
            return
        files: tuple[FileRecord, ...] = ()
        if not fault:
            files, fault = self._write_part(request)
        self._respond(SaveResponse(request.number, self._name, files, fault))
        if request.shutdown:
            self._final_part_saved_at = time.monotonic()

    def _respond(self, response: SaveResponse | ResetResponse) -> None:
        self._responses[type(response)].publish(String(data=encode(response, system=self._node.system.name)))

    def _event_mismatch(self, request: SaveRequest | ResetRequest) -> str:
        """Fault where the process is at another keyframe event; a reset may come after fewer."""
        if self._events > request.events:
            return f"it is at keyframe event {self._events}, not {request.events}: restart all nodes"
        if self._events < request.events and isinstance(request, SaveRequest):
            return f"it is inactive, at keyframe event {self._events} of {request.events}: activate it"
        return ""

    def _reset(self, request: ResetRequest) -> str:
        """Reset the node; return the fault, if any."""
        try:
            self._node.reset(request.folder, request.number)
        except HmtSlamError as fault:
            return f"{fault}; restart all nodes"
        self._events = self._node.initial_state.events
        return ""

    def _write_part(self, request: SaveRequest) -> tuple[tuple[FileRecord, ...], str]:
        """Write the node's part of the map; return its files, or the fault."""
        folder = Path(request.folder)
        if not folder.is_dir():
            return (), f"it does not see the folder {folder}: run all nodes where that is, or set save_to of slam"
        try:
            check_save_folder(folder, self._name)
            writer = FolderWriter(folder)
            writer.write(self._name, self._node.process.state)
        except OSError as error:
            return (), f"{folder} cannot be written ({error.strerror})"
        except HmtSlamError as error:
            self._node.diagnostics.refuse(DOCUMENTS[SaveRequest], error)
            return (), str(error)
        return writer.files, ""
