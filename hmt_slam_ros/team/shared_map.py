"""Sharing a map: items with versions, of which an update has those after a version.

The definite areas of a robot, with their arcs and scans, are items. A change gives an item the next version. Who has
all items up to a version lacks only what comes after it. So nobody remembers what was sent to whom: a robot that joins
late, or was away, requests what is after its version, and lost, repeated and late updates do no harm.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, CommonMap, HybridMap, KeyframePoses
from hmt_slam_ros.hybrid_map.surroundings import stack_poses
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import SharedArea, SharedScan, TeamUpdate
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.components import Component

NEW_KEYFRAMES = 5
"""New keyframes of the robot's own area after which that is shared: they move while the robot maps it."""

UPDATE_BYTES = 64_000
"""Size of an update above which the rest has to wait for the next one."""

_SCAN_BYTES, _BEAM_BYTES, _KEYFRAME_BYTES, _ARC_BYTES = 300, 4, 40, 200
"""About what a scan and a beam, and a keyframe and an arc of an area take."""


class _Content(NamedTuple):
    """An area as it was shared: the very objects, which are replaced by every change."""

    keyframes: KeyframePoses
    arcs: tuple[ArcValue, ...]


class SharedMap:
    """The map that a robot shares.

    :ivar version: of the newest item, 0 before the first.
    """

    def __init__(self, robot: str, session: str) -> None:
        """:param robot: its name.

        :param session: of the map.
        """
        self.robot, self.session, self.version = robot, session, 0
        # By growing version; a scan comes before its area.
        self._items: OrderedDict[tuple[str, int], SharedScan | SharedArea] = OrderedDict()
        self._contents: dict[int, _Content] = {}

    def take_over(self, replica: Replica) -> bool:
        """Share what is definite in the maps of all hypotheses; whether something is new."""
        before = self.version
        common = next(iter(replica.maps.values())).common
        arcs = _arcs_by_larger_area(common)
        occupied = set(replica.robot_areas.values())
        for area in self._contents.keys() - common.areas.keys():
            del self._contents[area]
            self._add_area(area, {}, {})
        for area, keyframes in common.areas.items():
            content = _Content(keyframes, tuple(arcs.get(area, {}).values()))
            if not self._is_due(area, content, area in occupied):
                continue
            for keyframe in keyframes:
                self._add_scan(keyframe, replica.scans[keyframe])
            self._contents[area] = content
            self._add_area(area, keyframes, arcs.get(area, {}))
        self._forget_scans()
        return self.version > before

    def _is_due(self, area: int, content: _Content, is_occupied: bool) -> bool:
        """Whether an area is to be shared: it changed, and the robot has left it or mapped more of it."""
        known = self._contents.get(area)
        if not content.keyframes or (known is not None and _is_same(known, content)):
            return False
        count = 0 if known is None else len(known.keyframes)
        return not is_occupied or len(content.keyframes) >= count + NEW_KEYFRAMES

    def _add_scan(self, keyframe: int, scan: Scan) -> None:
        known = self._items.get(("scan", keyframe))
        if not isinstance(known, SharedScan) or known.scan is not scan:
            self.version += 1
            self._put(("scan", keyframe), SharedScan(self.version, keyframe, scan))

    def _add_area(self, area: int, keyframes: KeyframePoses, arcs: Mapping[int, ArcValue]) -> None:
        self.version += 1
        shared = tuple(Arc(other, area, arc.pose, arc.closure) for other, arc in arcs.items())
        self._put(("area", area), SharedArea(self.version, area, tuple(keyframes), stack_poses(keyframes), shared))

    def _put(self, key: tuple[str, int], item: SharedScan | SharedArea) -> None:
        self._items[key] = item
        self._items.move_to_end(key)

    def _forget_scans(self) -> None:
        """Drop scans of no area: keyframes are pruned."""
        kept = {keyframe for content in self._contents.values() for keyframe in content.keyframes}
        for key in [key for key in self._items if key[0] == "scan" and key[1] not in kept]:
            del self._items[key]

    def update_after(self, version: int) -> TeamUpdate:
        """The items after a version, the oldest first, as many as fit into one update."""
        newer = []
        for item in reversed(self._items.values()):
            if item.version <= version:
                break
            newer.append(item)
        chosen: list[SharedScan | SharedArea] = []
        size = 0
        while newer and (not chosen or size + _size(newer[-1]) <= UPDATE_BYTES):
            chosen.append(newer.pop())
            size += _size(chosen[-1])
        last, is_complete = (chosen[-1].version, False) if newer else (self.version, True)
        scans = tuple(item for item in chosen if isinstance(item, SharedScan))
        areas = tuple(item for item in chosen if isinstance(item, SharedArea))
        return TeamUpdate(self.robot, self.session, version, last, scans, areas, is_complete)


def _arcs_by_larger_area(common: CommonMap) -> dict[int, dict[int, ArcValue]]:
    """{larger area: {smaller area: arc}}."""
    arcs: dict[int, dict[int, ArcValue]] = {}
    for (a, b), arc in common.arcs.items():
        arcs.setdefault(b, {})[a] = arc
    return arcs


def _is_same(one: _Content, other: _Content) -> bool:
    if one.keyframes is not other.keyframes or len(one.arcs) != len(other.arcs):
        return False
    return all(a is b for a, b in zip(one.arcs, other.arcs, strict=True))


def _size(item: SharedScan | SharedArea) -> int:
    if isinstance(item, SharedScan):
        return _SCAN_BYTES + _BEAM_BYTES * int(item.scan.ranges.size)
    return _KEYFRAME_BYTES * (1 + len(item.keyframes)) + _ARC_BYTES * len(item.arcs)


class ForeignMap:
    """The map of another robot, as far as it is known here.

    :ivar session: of the map.
    :ivar version: up to which it is known, 0 for nothing.
    """

    def __init__(self, session: str) -> None:
        self.session, self.version = session, 0
        self._areas: dict[int, SharedArea] = {}
        self._scans: dict[int, Scan] = {}

    def apply(self, update: TeamUpdate) -> bool:
        """Take in an update; whether it brought something. One that leaves a gap brings nothing."""
        if update.session != self.session or update.after > self.version or update.version <= self.version:
            return False
        self._scans |= {item.keyframe: item.scan for item in update.scans if item.version > self.version}
        for area in update.areas:
            if area.version > self.version:
                self._areas.pop(area.area, None)
                if area.keyframes:
                    self._areas[area.area] = area
        self.version = update.version
        if update.is_complete:
            kept = {keyframe for area in self._areas.values() for keyframe in area.keyframes}
            self._scans = {keyframe: scan for keyframe, scan in self._scans.items() if keyframe in kept}
        return True

    def component(self) -> Component:
        """The map as a component."""
        hybrid_map = HybridMap()
        for number, area in sorted(self._areas.items()):
            if all(keyframe in self._scans for keyframe in area.keyframes):
                hybrid_map.changed_areas[number] = dict(zip(area.keyframes, _rows(area.poses), strict=True))
        for area in self._areas.values():
            for arc in area.arcs:
                if hybrid_map.has_area(arc.source) and hybrid_map.has_area(arc.target):
                    hybrid_map.changed_arcs[arc.source, arc.target] = ArcValue(arc.pose, arc.closure)
        hybrid_map.commit()
        return Component.of_map(hybrid_map, self._scans)


def _rows(poses: Float64) -> list[Float64]:
    return [np.asarray(pose) for pose in poses]
