"""Subscriptions of the live page to the map as data, keyframes, scan, particles, goals, rooms and landmarks."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import PoseArray, PoseStamped
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.alternatives import Alternatives
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.gate import decode_checked
from hmt_slam_ros.messages.tasks import PlaceEstimate
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import keyframe_from_frame, ranges_from_message
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.message_io import document_callback
from hmt_slam_ros.ros.team_view import Subscribe
from hmt_slam_ros.ros.topics import (
    AMBIGUITY_GOAL,
    DOCUMENTS,
    GOAL_POSE,
    KEYFRAME_SCANS,
    LANDMARKS,
    PARTICLES,
    ROOMS,
    SCAN,
)
from hmt_slam_ros.ros.view_conversions import finite, landmarks_section, planar_pose, rooms_section
from hmt_slam_ros.untrusted_input import shorten
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.map_sections import LaserBeams, MapSections

_MAX_SHARE = 0.02
"""Share of a core that the documents of a topic take at most: the larger a map, the less often it is shown."""

_PERIOD = 0.9
"""Least time between two documents of the map that are shown, s."""

_UNWATCHED_PERIOD = 5.0
"""The same while no browser shows the page, for the time slider."""

_MAX_BEAMS = 20_000
"""Beams of a scan that is shown."""

_MAX_PARTICLES = 2000
"""Particles that are shown; there are some dozen."""


class _Layer(NamedTuple):
    """A subscription that lasts while a browser shows the page."""

    kind: type
    topic: str
    callback: Callable[[Any], None]
    profile: Any


class MapDocuments:
    """The documents of one topic of the map, of which the newest is shown within a share of a core."""

    def __init__(self, kind: type[Any], show: Callable[[Any], None], diagnostics: NodeDiagnostics) -> None:
        self._kind, self._show, self._diagnostics = kind, show, diagnostics
        self._newest: String | None = None
        self._next_at = 0.0

    def keep(self, message: String) -> None:
        """Keep a message until it is shown, or a newer one comes."""
        self._newest = message

    def show_if_due(self, now: float, *, is_watched: bool) -> None:
        """Show the newest message, where it is time; one that cannot be shown is refused.

        :param now: time on the clock of the node, s.
        :param is_watched: whether a browser shows the page.
        """
        if self._newest is None or now < self._next_at:
            return
        message, self._newest = self._newest, None
        begin = time.thread_time()
        try:
            document, _ = decode_checked(message.data, self._kind, self._diagnostics.system)
            self._show(document)
        except HmtSlamError as fault:
            self._diagnostics.refuse(DOCUMENTS[self._kind], fault)
        period = _PERIOD if is_watched else _UNWATCHED_PERIOD
        self._next_at = now + max(period, (time.thread_time() - begin) / _MAX_SHARE)

    def hurry(self) -> None:
        """Show the next message at once, since a page was opened."""
        self._next_at = 0.0


class MapLayers:
    """Shows the map of every hypothesis and the layers above it.

    :ivar sections: puts them on the board.
    """

    def __init__(
        self,
        board: Board,
        subscribe: Subscribe,
        unsubscribe: Callable[[Any], None],
        diagnostics: NodeDiagnostics,
    ) -> None:
        self.sections = MapSections(board)
        self._board, self._subscribe, self._unsubscribe, self._diagnostics = board, subscribe, unsubscribe, diagnostics
        self._topologies = MapDocuments(Topology, self.sections.add_topology, diagnostics)
        self._alternatives = MapDocuments(Alternatives, self.sections.add_alternatives, diagnostics)
        self._watched: list[Any] = []
        self._rooms: dict[str, list[list[Any]]] = {name: [] for name in ROOMS}
        subscribe(String, DOCUMENTS[Topology], self._topologies.keep, topics.LATCHED)
        on_evidence = document_callback(diagnostics, Evidence, self.sections.add_evidence)
        subscribe(String, DOCUMENTS[Evidence], on_evidence, topics.LATCHED)
        subscribe(LaserScan, KEYFRAME_SCANS, self._on_keyframe_scan, topics.CHAIN_HISTORY)
        on_place = document_callback(diagnostics, PlaceEstimate, self._on_place)
        self._layers = (
            _Layer(String, DOCUMENTS[Alternatives], self._alternatives.keep, topics.LATCHED),
            _Layer(LaserScan, SCAN, self._on_scan, topics.NEWEST),
            _Layer(PoseArray, PARTICLES, self._on_particles, topics.NEWEST),
            _Layer(PoseStamped, GOAL_POSE, lambda m: board.put("goal", planar_pose(m.pose)), topics.NEWEST),
            _Layer(PoseStamped, AMBIGUITY_GOAL, lambda m: board.put("look", planar_pose(m.pose)), topics.NEWEST),
            _Layer(String, DOCUMENTS[PlaceEstimate], on_place, topics.LATCHED),
            _Layer(MarkerArray, LANDMARKS, lambda m: board.put("landmarks", landmarks_section(m)), topics.LATCHED),
            *(_Layer(MarkerArray, ROOMS[name], partial(self._on_rooms, name), topics.LATCHED) for name in ROOMS),
        )

    def update(self, now: float) -> None:
        """Show the newest map, where it is time; subscribe to the layers while a browser shows the page.

        :param now: time on the clock of the node, which a recording has too, s.
        """
        watched = self._board.is_watched
        if watched and not self._watched:
            self._watched = [self._subscribe(*layer) for layer in self._layers]
            self._topologies.hurry()
        elif not watched and self._watched:
            for subscription in self._watched:
                self._unsubscribe(subscription)
            self._watched = []
        for documents in (self._topologies, self._alternatives):
            documents.show_if_due(now, is_watched=watched)

    def _on_keyframe_scan(self, message: LaserScan) -> None:
        keyframe, _, system = keyframe_from_frame(message.header.frame_id)
        self._diagnostics.system.admit(system)
        self.sections.add_keyframe_scan(keyframe, beams_of(message))

    def _on_scan(self, message: LaserScan) -> None:
        self.sections.show_scan(beams_of(message))

    def _on_particles(self, message: PoseArray) -> None:
        if len(message.poses) > _MAX_PARTICLES:
            raise HmtSlamError(f"{len(message.poses)} particles are too many to be shown: look who publishes it")
        self._board.put("particles", [planar_pose(pose) for pose in message.poses])

    def _on_rooms(self, node: str, message: MarkerArray) -> None:
        """Show the rooms of all nodes; those of one name, which are one room, where the first node has it."""
        self._rooms[node] = rooms_section(message)
        named = {name: place for each in reversed(ROOMS) for name, *place in self._rooms[each]}
        self._board.put("rooms", [[name, *place] for name, place in named.items()])

    def _on_place(self, place: PlaceEstimate) -> None:
        name = place.room or place.place
        content = None if name is None else {"name": shorten(name), "probability": round(place.probability, 3)}
        self._board.put("place", content)


def beams_of(message: LaserScan) -> LaserBeams:
    """The beams of a scan.

    :raises HmtSlamError: where there are too many, or an angle or a limit is not finite.
    """
    if len(message.ranges) > _MAX_BEAMS:
        raise HmtSlamError(f"a scan of {len(message.ranges)} beams is too large to be shown: look who publishes it")
    angles = finite(message.angle_min, "angle_min", 100.0), finite(message.angle_increment, "angle_increment", 100.0)
    if np.isnan(message.range_min) or np.isnan(message.range_max):
        raise HmtSlamError("range_min or range_max of a scan is NaN: look who publishes it")
    return LaserBeams(ranges_from_message(message), *angles, float(message.range_min), float(message.range_max))
