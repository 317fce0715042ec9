"""Sharing a map: items with versions, of which an update has those after a version.

The definite areas of a robot, with their arcs and scans, are items. A change gives an item the next version. Who has
all items up to a version lacks only what comes after it. So nobody remembers who has what: a robot that joins late, or
was away, requests what is after its version, and lost, repeated and late updates do no harm.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain
from operator import attrgetter, xor
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, HybridMap, KeyframePoses, has_foreign_keyframes
from hmt_slam_ros.hybrid_map.pose_graph import consistent_poses
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces, shortest_path_beliefs
from hmt_slam_ros.messages.map_changes import Arc, Pose
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import NO_REPETITION, Repetition, SharedArea, SharedItem, SharedScan, TeamUpdate
from hmt_slam_ros.plain_data import to_plain
from hmt_slam_ros.registration.consistency import NO_CLUTTER, Clutter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.components import Component
from hmt_slam_ros.team.own_ground import own_ground

NEW_KEYFRAMES = 5
"""New keyframes of the robot's own area after which that is shared: they move while the robot maps it."""

UPDATE_BYTES = 64_000
"""Size of an update above which the rest has to wait for the next one."""

_SCAN_BYTES, _BEAM_BYTES, _KEYFRAME_BYTES, _ARC_BYTES = 400, 6, 80, 400
"""About what a scan and a beam, and a keyframe and an arc of an area take."""

_DIGEST_BYTES = 8


class _Content(NamedTuple):
    """An area as it was shared: the very objects, which are replaced by every change.

    :ivar keyframes: the mapping itself where the map is definite, a copy where the map changes it in place.
    """

    keyframes: KeyframePoses
    scans: Mapping[int, Scan]
    arcs: tuple[ArcValue, ...]


@dataclass(frozen=True, eq=False)
class SharedMapState:
    """The map that a robot shares, as a value.

    :ivar version: of the newest item, 0 before the first.
    :ivar scans: items, by growing version; ``areas`` likewise.
    :ivar clutter: usual rate of contradictions of the map.
    """

    version: int = 0
    scans: tuple[SharedScan, ...] = ()
    areas: tuple[SharedArea, ...] = ()
    clutter: Clutter = NO_CLUTTER


class SharedMap:
    """The map that a robot shares.

    :ivar version: of the newest item, 0 before the first.
    :ivar clutter: usual rate of contradictions of the map.
    """

    def __init__(self, robot: str, session: str, state: SharedMapState | None = None) -> None:
        """:param robot: its name.

        :param session: of the map.
        :param state: to go on from.
        """
        state = state or SharedMapState()
        self.robot, self.session, self.version = robot, session, state.version
        self.clutter = state.clutter
        # By growing version; a scan comes before its area.
        self._items: OrderedDict[tuple[str, int], SharedItem] = OrderedDict()
        self._contents: dict[int, _Content] = {}
        self._digests: dict[tuple[str, int], int] = {}
        items: list[SharedItem] = [*state.scans, *state.areas]
        for item in sorted(items, key=attrgetter("version")):
            self._put(item, _digest(item))

    @property
    def state(self) -> SharedMapState:
        """The shared map as a value."""
        scans = tuple(item for item in self._items.values() if isinstance(item, SharedScan))
        return SharedMapState(self.version, scans, self._areas(), self.clutter)

    def _areas(self) -> tuple[SharedArea, ...]:
        return tuple(item for item in self._items.values() if isinstance(item, SharedArea))

    @property
    def digest(self) -> str:
        """Of all items, hexadecimal."""
        return _combine_digests(self._digests.values())

    def take_over(self, replica: Replica, *, is_standing: bool = False) -> bool:
        """Share what is definite in the maps of all hypotheses, and the robot's own; whether something is new.

        :param is_standing: whether the robot's own area is shared whatever is new in it, as no more may come.
        """
        before = self.version
        hybrid_map, undecided = _agreed_map(replica)
        areas = hybrid_map.area_ids()
        if any(has_foreign_keyframes(hybrid_map.keyframes(area)) for area in areas):
            hybrid_map = own_ground(hybrid_map)
            areas = hybrid_map.area_ids()
        arcs_of = _arcs_by_larger_area(hybrid_map)
        occupied = set[int]() if is_standing else set(replica.robot_areas.values())
        for item in self._areas():
            if item.area not in undecided and not hybrid_map.has_area(item.area):
                self._contents.pop(item.area, None)
                self._add_area(item.area, {}, {})
        for area in areas:
            keyframes, arcs = hybrid_map.keyframes(area), arcs_of.get(area, {})
            known = self._contents.get(area)
            if area in undecided or (known is not None and _is_as_before(known, keyframes, arcs)):
                continue
            # Keyframes that were pruned leave the definite map with the next decision.
            scans = {keyframe: replica.scans[keyframe] for keyframe in keyframes if keyframe in replica.scans}
            is_definite = area not in hybrid_map.changed_areas
            content = _Content(keyframes if is_definite else dict(keyframes), scans, tuple(arcs.values()))
            if not _is_due(known, content, area in occupied):
                continue
            self._contents[area] = content
            for keyframe, scan in scans.items():
                self._add_scan(keyframe, scan)
            self._add_area(area, {keyframe: keyframes[keyframe] for keyframe in scans}, arcs)
        self._forget_scans()
        return self.version > before

    def _add_scan(self, keyframe: int, scan: Scan) -> None:
        known = self._items.get(("scan", keyframe))
        if not isinstance(known, SharedScan) or known.scan is not scan:
            self._add(SharedScan(self.version + 1, keyframe, scan))

    def _add_area(self, area: int, keyframes: KeyframePoses, arcs: Mapping[int, ArcValue]) -> None:
        shared = tuple(Arc(other, area, arc.pose, arc.closure) for other, arc in arcs.items())
        self._add(SharedArea(self.version + 1, area, tuple(keyframes), tuple(keyframes.values()), shared))

    def _add(self, item: SharedItem) -> None:
        """Add an item of the next version, unless it is there with the same content."""
        digest = _digest(item)
        if self._digests.get(_key(item), 0) != digest:
            self.version = item.version
            self._put(item, digest)

    def _put(self, item: SharedItem, digest: int) -> None:
        key = _key(item)
        self._items[key], self._digests[key] = item, digest
        self._items.move_to_end(key)

    def _forget_scans(self) -> None:
        """Drop scans of no area: keyframes are pruned."""
        kept = {keyframe for area in self._areas() for keyframe in area.keyframes}
        for key in [key for key in self._items if key[0] == "scan" and key[1] not in kept]:
            del self._items[key], self._digests[key]

    def update_after(self, version: int) -> TeamUpdate:
        """The items after a version, the oldest first, as many as fit into one update."""
        newer = []
        for item in reversed(self._items.values()):
            if item.version <= version:
                break
            newer.append(item)
        chosen: list[SharedItem] = []
        size = 0
        while newer and (not chosen or size + _size(newer[-1]) <= UPDATE_BYTES):
            chosen.append(newer.pop())
            size += _size(chosen[-1])
        last, is_complete = (chosen[-1].version, False) if newer else (self.version, True)
        scans = tuple(item for item in chosen if isinstance(item, SharedScan))
        areas = tuple(item for item in chosen if isinstance(item, SharedArea))
        return TeamUpdate(self.robot, self.session, version, last, scans, areas, is_complete, self.clutter)


def _agreed_map(replica: Replica) -> tuple[HybridMap, set[int]]:
    """A map of what the hypotheses agree on, and the areas that are not the same in all of them."""
    first, *others = replica.maps.values()
    if not others:
        return first, set()
    changed = [{*each.changed_areas, *chain.from_iterable(each.changed_arcs)} for each in replica.maps.values()]
    return HybridMap(first.common), set().union(*changed)


def _arcs_by_larger_area(hybrid_map: HybridMap) -> dict[int, dict[int, ArcValue]]:
    """{larger area: {smaller area: arc}}."""
    arcs: dict[int, dict[int, ArcValue]] = {}
    for a, b, arc in hybrid_map.all_arcs():
        arcs.setdefault(b, {})[a] = arc
    return arcs


def _is_as_before(known: _Content, keyframes: KeyframePoses, arcs: Mapping[int, ArcValue]) -> bool:
    """Whether an area has the very mapping of keyframes, and the very arcs, as when it was shared."""
    return known.keyframes is keyframes and _are_same(known.arcs, arcs.values())


def _is_due(known: _Content | None, content: _Content, is_occupied: bool) -> bool:
    """Whether an area is to be shared: it changed, and the robot has left it or mapped more of it."""
    if known is None:
        return len(content.keyframes) >= (NEW_KEYFRAMES if is_occupied else 1)
    if is_occupied and known.keyframes.keys() <= content.keyframes.keys():
        return len(content.keyframes) >= len(known.keyframes) + NEW_KEYFRAMES
    return not (
        content.keyframes.keys() == known.keyframes.keys()
        and _are_same(content.keyframes.values(), known.keyframes.values())
        and _are_same(content.scans.values(), known.scans.values())
        and _are_same(content.arcs, known.arcs)
    )


def _are_same(some: Collection[object], others: Collection[object]) -> bool:
    """Whether both have the very same objects, in the same order."""
    return len(some) == len(others) and all(one is other for one, other in zip(some, others, strict=True))


def _size(item: SharedItem) -> int:
    if isinstance(item, SharedScan):
        return _SCAN_BYTES + _BEAM_BYTES * int(item.scan.ranges.size)
    return _KEYFRAME_BYTES * (1 + len(item.keyframes)) + _ARC_BYTES * len(item.arcs)


def _key(item: SharedItem) -> tuple[str, int]:
    return ("scan", item.keyframe) if isinstance(item, SharedScan) else ("area", item.area)


def _digest(item: SharedItem) -> int:
    """Digest of an item without its version; 0 for an area that was removed."""
    if isinstance(item, SharedArea) and not item.keyframes:
        return 0
    content = to_plain(replace(item, version=0), {np.ndarray: lambda array: array.tobytes().hex()})
    text = json.dumps([type(item).__name__, content], separators=(",", ":"))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=_DIGEST_BYTES).digest(), "little")


def _combine_digests(digests: Iterable[int]) -> str:
    """Digest of a set of items, whatever their order."""
    return f"{reduce(xor, digests, 0):0{2 * _DIGEST_BYTES}x}"


@dataclass(frozen=True, eq=False)
class ForeignMapState:
    """The map of another robot, as a value.

    :ivar session: of the map.
    :ivar version: up to which it is known, 0 for nothing.
    :ivar scans: of its keyframes, and those of areas that are still to come; ``areas`` likewise.
    :ivar clutter: usual rate of contradictions of the map.
    :ivar repetition: what the map shows in itself.
    """

    session: str
    version: int = 0
    scans: tuple[SharedScan, ...] = ()
    areas: tuple[SharedArea, ...] = ()
    clutter: Clutter = NO_CLUTTER
    repetition: Repetition = NO_REPETITION


class ForeignMap:
    """The map of another robot, as far as it is known here.

    :ivar session: of the map.
    :ivar version: up to which it is known, 0 for nothing.
    :ivar repetition: what the map shows in itself.
    """

    def __init__(self, state: ForeignMapState) -> None:
        """:param state: to go on from."""
        self.session, self.version, self._clutter = state.session, state.version, state.clutter
        self.repetition = state.repetition
        self._areas = {area.area: area for area in state.areas}
        self._scans = {scan.keyframe: scan for scan in state.scans}

    @property
    def state(self) -> ForeignMapState:
        """The map as a value."""
        scans, areas = tuple(self._scans.values()), tuple(self._areas.values())
        return ForeignMapState(self.session, self.version, scans, areas, self._clutter, self.repetition)

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return len(self._scans)

    @property
    def digest(self) -> str:
        """Of all items, hexadecimal."""
        items: list[SharedItem] = [*self._scans.values(), *self._areas.values()]
        return _combine_digests(map(_digest, items))

    def apply(self, update: TeamUpdate) -> bool:
        """Take in an update; whether it brought something. One that leaves a gap brings nothing."""
        if update.session != self.session or update.after > self.version or update.until <= self.version:
            return False
        self._scans |= {item.keyframe: item for item in update.scans if item.version > self.version}
        for area in update.areas:
            if area.version > self.version:
                self._areas.pop(area.area, None)
                if area.keyframes:
                    self._areas[area.area] = area
        self.version, self._clutter = update.until, update.clutter
        if update.is_complete:
            kept = {keyframe for area in self._areas.values() for keyframe in area.keyframes}
            self._scans = {keyframe: item for keyframe, item in self._scans.items() if keyframe in kept}
        return True

    def items_after(self, version: int) -> tuple[tuple[SharedScan, ...], tuple[SharedArea, ...]]:
        """The scans and areas that are newer than a version."""
        scans = tuple(item for item in self._scans.values() if item.version > version)
        return scans, tuple(item for item in self._areas.values() if item.version > version)

    def component(self) -> Component:
        """The largest piece of the map that informative arcs hold together, as a component.

        A robot that was kidnapped, or whose odometry failed, begins another piece.
        A keyframe that moved to another area may be in both until all has arrived: it is in the newer one.
        """
        hybrid_map, placed = HybridMap(), set[int]()
        for area in sorted(self._areas.values(), key=lambda area: -area.version):
            if all(keyframe in self._scans for keyframe in area.keyframes):
                poses = zip(area.keyframes, area.poses, strict=True)
                own = {keyframe: pose for keyframe, pose in poses if keyframe not in placed}
                placed |= own.keys()
                if own:
                    hybrid_map.changed_areas[area.area] = own
        for area in self._areas.values():
            for arc in area.arcs:
                if hybrid_map.has_area(arc.source) and hybrid_map.has_area(arc.target):
                    hybrid_map.changed_arcs[arc.source, arc.target] = ArcValue(arc.pose, arc.closure)
        hybrid_map.commit()
        scans = {keyframe: item.scan for keyframe, item in self._scans.items()}
        areas, pose = _largest_piece(hybrid_map)
        found = Component.of_map(hybrid_map.subgraph(areas), scans, self._clutter, self.repetition)
        return replace(found, pose=pose)


def _largest_piece(hybrid_map: HybridMap) -> tuple[Collection[int], Pose]:
    """The areas of the piece with the most keyframes, of equals the older one, and the pose of its first area.

    A piece without an arc to the first one has no pose and does not count: areas between them are still to come.
    """
    areas = hybrid_map.area_ids()
    if not areas:
        return areas, np.zeros(3)
    reached = shortest_path_beliefs(hybrid_map, areas[0])
    pieces = [piece for piece in map_pieces(hybrid_map) if piece[0] in reached]
    largest = max(pieces, key=lambda piece: sum(len(hybrid_map.keyframes(area)) for area in piece))
    if largest is pieces[0]:
        return largest, np.zeros(3)
    return largest, consistent_poses(hybrid_map)[largest[0]]
