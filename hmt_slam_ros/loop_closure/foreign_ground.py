"""Ground of other robots that becomes part of the map, with numbers of its own.

What the robot has of the ground of another one stays as it is; new keyframes, areas and arcs are added. Arcs follow the
other robot's, unless the robot has observed them itself.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, AreaPair, HybridMap, area_pair
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, ForeignGround, ForeignKeyframe
from hmt_slam_ros.messages.team import JoinedGround, SharedArea
from hmt_slam_ros.sensors import Scan


@dataclass(frozen=True, eq=False)
class ForeignNumbers:
    """The numbers that areas and keyframes of another robot have in the map.

    :ivar session: of its map.
    :ivar areas: {its number of an area: number in the map}.
    :ivar keyframes: {its number of a keyframe: number in the map}.
    :ivar joining_arcs: arcs between its ground and the robot's own.
    """

    session: str
    areas: Mapping[int, int] = field(default_factory=dict)
    keyframes: Mapping[int, int] = field(default_factory=dict)
    joining_arcs: frozenset[AreaPair] = frozenset()

    def numbers_of_session(self, ground: JoinedGround, scans: Mapping[int, Scan]) -> ForeignNumbers:
        """The numbers in another session of the map: those up to the last keyframe that is the same one in both.

        Nodes that start from a saved map number on from it, so that keyframes after it have the numbers of others.

        :param ground: first one of the session.
        :param scans: {number in the map: scan}.
        """
        stamps = {item.keyframe: item.scan.stamp for item in ground.scans}
        same = [
            theirs
            for theirs, number in self.keyframes.items()
            if theirs in stamps and number in scans and scans[number].stamp == stamps[theirs]
        ]
        if not same:
            return ForeignNumbers(ground.session)
        keyframes = {theirs: number for theirs, number in self.keyframes.items() if theirs <= max(same)}
        common = {area.area for area in ground.areas if not keyframes.keys().isdisjoint(area.keyframes)}
        areas = {theirs: number for theirs, number in self.areas.items() if theirs in common}
        return ForeignNumbers(ground.session, areas, keyframes, self.joining_arcs)


class GroundTaker:
    """Takes over the ground of one robot into the map of the only hypothesis.

    :ivar areas: {number of the other robot: number in the map}; ``keyframes`` likewise.
    """

    def __init__(
        self,
        hybrid_map: HybridMap,
        numbers: ForeignNumbers,
        observed: Collection[AreaPair],
        next_area: int,
        next_keyframe: int,
    ) -> None:
        """:param hybrid_map: it is not changed.

        :param numbers: given before.
        :param observed: arcs that the robot has observed, which stay as they are.
        :param next_area: first number that no area has.
        :param next_keyframe: largest number below ``NO_KEYFRAME`` that no keyframe has.
        """
        self._map, self._numbers, self._observed = hybrid_map, numbers, observed
        self._next_area, self._next_keyframe = next_area, next_keyframe
        self.areas, self.keyframes = dict(numbers.areas), dict(numbers.keyframes)

    def take_over(self, ground: JoinedGround) -> tuple[ForeignGround, ForeignNumbers]:
        """What changes in the map, and the numbers with those of the new areas and keyframes."""
        keyframes = tuple(self._new_keyframes(ground))
        arcs, removed = list[Arc](), list[AreaPair]()
        for area in ground.areas:
            self._follow_arcs(area, arcs, removed)
        joining = self._joining_arcs(ground)
        ends = frozenset(area_pair(arc.source, arc.target) for arc in joining)
        left = sorted(pair for pair in self._numbers.joining_arcs - ends if self._is_free(*pair))
        if left and not joining:
            # The ground stays in the map, where nobody knows where it lies.
            (a, b), *left = left
            known = self._map.arc(a, b)
            assert known is not None
            joining = [Arc(a, b, uninformative_belief(known.mean), closure=True)]
            ends = frozenset([(a, b)])
        ends_removed = tuple(ArcEnds(a, b) for a, b in sorted([*removed, *left]))
        numbers = ForeignNumbers(ground.session, self.areas, self.keyframes, ends)
        return ForeignGround(ground.robot, keyframes, (*arcs, *joining), ends_removed), numbers

    def _new_keyframes(self, ground: JoinedGround) -> Iterator[ForeignKeyframe]:
        scans = {item.keyframe: item.scan for item in ground.scans}
        for area in sorted(ground.areas, key=lambda area: area.area):
            for keyframe, pose in zip(area.keyframes, area.poses, strict=True):
                if keyframe in self.keyframes or keyframe not in scans:
                    continue
                if area.area not in self.areas:
                    self.areas[area.area] = self._next_area
                    self._next_area += 1
                number = self.areas[area.area]
                if area.area in self._numbers.areas and not self._map.has_area(number):
                    break
                self.keyframes[keyframe] = self._next_keyframe
                self._next_keyframe -= 1
                yield ForeignKeyframe(self.keyframes[keyframe], number, pose, scans[keyframe])

    def _follow_arcs(self, area: SharedArea, arcs: list[Arc], removed: list[AreaPair]) -> None:
        """Add the arcs of an area to areas with smaller numbers, and those that it had and has no more."""
        own = self.areas.get(area.area)
        if own is None:
            return
        now = {self.areas[arc.source]: arc for arc in area.arcs if arc.source in self.areas}
        arcs += [
            Arc(other, own, arc.pose, arc.closure) for other, arc in sorted(now.items()) if self._is_free(other, own)
        ]
        smaller = {number for other, number in self._numbers.areas.items() if other < area.area}
        had = smaller & set(self._map.neighbors(own)) if self._map.has_area(own) else set()
        removed += [area_pair(other, own) for other in sorted(had - now.keys()) if self._is_free(other, own)]

    def _joining_arcs(self, ground: JoinedGround) -> list[Arc]:
        joining = []
        for arc in ground.joining_arcs:
            foreign = self.areas.get(arc.foreign_area)
            if foreign is not None and self._map.has_area(arc.own_area) and self._is_free(arc.own_area, foreign):
                joining.append(Arc(arc.own_area, foreign, arc.pose, closure=True))
        return joining

    def _is_free(self, a: int, b: int) -> bool:
        """Whether the arc between two areas may be set: both are there, and the robot has not observed it."""
        return a != b and area_pair(a, b) not in self._observed and self._is_there(a) and self._is_there(b)

    def _is_there(self, area: int) -> bool:
        return self._map.has_area(area) or area not in self._numbers.areas.values()


def next_foreign_keyframe(numbers: Mapping[str, ForeignNumbers], keyframes: Iterable[int]) -> int:
    """The largest number below ``NO_KEYFRAME`` that no keyframe has.

    :param keyframes: of the map, which may have some of earlier sessions.
    """
    used = [keyframe for own in numbers.values() for keyframe in own.keyframes.values()]
    return min(NO_KEYFRAME, *used, *keyframes) - 1
