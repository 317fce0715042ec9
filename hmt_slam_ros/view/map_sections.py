"""Layers of the live page from messages: the map of every hypothesis, walls, marks, and the newest scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.alternatives import Alternatives
from hmt_slam_ros.messages.documents import KeyframeHeader, ScanGeometry
from hmt_slam_ros.messages.evidence import Evidence
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.view.board import Board
from hmt_slam_ros.view.topology_section import alternatives_section, evidence_section, topology_section
from hmt_slam_ros.view.wall_points import thin

_MAX_WAITING = 200
"""Keyframes whose header or scan is missing yet."""

_MAX_MARKS = 200
"""Marks that are shown, the last observed."""

_MAX_SCAN_POINTS = 180
"""Points of the newest scan."""

_REACH = 40.0
"""Longest beam that is shown, m."""


@dataclass(frozen=True, eq=False)
class LaserBeams:
    """A scan without its mounting.

    :ivar ranges: shape (n,), m.
    :ivar angle_min: angle of the first beam, rad.
    :ivar angle_increment: between two beams, rad.
    :ivar range_min: shortest valid range, m.
    :ivar range_max: longest valid range, m.
    """

    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float

    def points(self, geometry: ScanGeometry) -> Float64:
        """End points of the beams that returned, shape (n, 2), m, base frame.

        :param geometry: of a keyframe; a laser that is mounted upside down turns the other way there.
        """
        ranges = self.ranges.astype(np.float64)
        kept = np.flatnonzero(
            np.isfinite(ranges) & (ranges >= self.range_min) & (ranges < min(self.range_max, _REACH)) & (ranges > 0.0)
        )
        sign = -1.0 if self.angle_increment * geometry.angle_increment < 0.0 else 1.0
        angles = sign * (self.angle_min + self.angle_increment * kept)
        ends = ranges[kept, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
        x, y, theta = geometry.laser_pose
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        return np.asarray(ends @ turn.T + (x, y), dtype=np.float64)


class MapSections:
    """Puts the layers of the map on the board.

    :ivar frame: name of the map's frame.
    """

    def __init__(self, board: Board) -> None:
        self._board, self.frame = board, "map"
        self._geometries: dict[int, ScanGeometry] = {}
        self._beams: dict[int, LaserBeams] = {}
        self._geometry: ScanGeometry | None = None
        self._marks: dict[str, dict[str, object]] = {}

    def add_topology(self, topology: Topology) -> None:
        """Show the map, and keep it for the time slider.

        :raises HmtSlamError: where it cannot be shown.
        """
        section = topology_section(topology)
        self.frame = topology.frame
        self._board.put("graph", section)
        if topology.events:
            self._board.past.add(topology.events - 1, section["time"], section)
            self._board.put("past", self._board.past.index())

    def add_alternatives(self, alternatives: Alternatives) -> None:
        """Show the maps of the other hypotheses.

        :raises HmtSlamError: where they cannot be shown.
        """
        self._board.put("alternatives", alternatives_section(alternatives))

    def add_evidence(self, evidence: Evidence) -> None:
        """Show what speaks for and against the hypotheses."""
        self._board.put("evidence", evidence_section(evidence))

    def add_keyframe(self, header: KeyframeHeader) -> None:
        """Take in the geometry of a keyframe's scan, and its marks."""
        self._geometry = header.scan
        self._geometries[header.sequence] = header.scan
        self._join(header.sequence)
        for mark in header.marks:
            estimate = header.estimates[0]
            place = se2.compose(estimate.pose.mean, se2.inverse(mark.pose.mean))
            self._marks.pop(mark.name, None)
            self._marks[mark.name] = {"area": estimate.area, "at": np.round(place[:2], 3).tolist()}
        if header.marks:
            self._marks = dict(list(self._marks.items())[-_MAX_MARKS:])
            self._board.put("marks", self._marks)

    def add_keyframe_scan(self, keyframe: int, beams: LaserBeams) -> None:
        """Take in the ranges of a keyframe's scan."""
        self._beams[keyframe] = beams
        self._join(keyframe)

    def show_scan(self, beams: LaserBeams) -> None:
        """Show the newest scan, once the mounting of the laser is known from a keyframe."""
        if self._geometry is not None:
            points = thin(beams.points(self._geometry), _MAX_SCAN_POINTS)
            self._board.put("scan", np.round(points, 2).ravel().tolist())

    def clear(self) -> None:
        """Forget the marks, since a new run begins. New walls replace those of keyframes of the same number."""
        self._marks = {}
        self._board.put("marks", {})

    def _join(self, keyframe: int) -> None:
        if keyframe in self._geometries and keyframe in self._beams:
            geometry = self._geometries.pop(keyframe)
            self._board.walls.add(keyframe, self._beams.pop(keyframe).points(geometry))
        for waiting in (self._geometries, self._beams):
            while len(waiting) > _MAX_WAITING:
                del waiting[min(waiting)]
