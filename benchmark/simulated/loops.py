"""Which loops a drive offers to close, by the truth alone, and when the map closed each.

The robot *enters again* where, after some metres on ground that it had not driven on, it comes to the place of a
keyframe of long before. Such a loop can be closed where the robot stays on known ground for some metres, sees there
what it saw before, and where the definite map did not know yet that the two places meet. It is closed when the definite
map has a keyframe from there on in the same area as one of the old ones of its place, or in an area beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmark.simulated.truth import Truth
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap

OLD = 10.0
"""Path between two keyframes from which on the second enters again, m."""

AWAY, STAY = 5.0, 5.0
"""Path on new ground before, and on known ground after, a place is entered again, m."""

VIEW = 0.5
"""Share of what a keyframe sees that was seen before where the scans can show that it is the same place."""

GRACE = 10.0
"""Path beyond the known ground within which a loop still counts as closed in time, m."""

_LOOKED_AT = 10.0  # m of the known ground, on half of whose keyframes the view must be shared
_PARTNERS = 3


@dataclass
class Loop:
    """A place that was entered again.

    :ivar event: the first keyframe event there.
    :ivar begin: path length since the start at that event, m; ``end``, at the last on known ground.
    :ivar length: path since the robot was there before, m.
    :ivar partners: {keyframe event: old keyframes of its place, the nearest first}.
    :ivar linked: whether the map had joined the two places already.
    :ivar closed_at: path length at which the definite map joined them, m; None before.
    :ivar closed_by_event: the keyframe event of that.
    :ivar view: share of the first keyframes there that see what was seen before.
    """

    event: int
    begin: float
    end: float
    length: float
    partners: dict[int, tuple[int, ...]] = field(default_factory=dict)
    linked: bool = False
    closed_at: float | None = None
    closed_by_event: int | None = None
    view: float = 0.0

    @property
    def can_be_closed(self) -> bool:
        """Whether there was something to close and the scans could show it."""
        return not self.linked and self.end - self.begin >= STAY and self.view >= 0.5

    @property
    def in_time(self) -> bool:
        """Whether it was closed before the robot was off again."""
        return self.closed_at is not None and self.closed_at <= self.end + GRACE


class Loops:
    """Finds loops while the robot drives.

    :ivar found: in the order of time.
    """

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._travelled: dict[int, float] = {}
        self.found: list[Loop] = []
        self._new_ground = 0.0
        self._before = 0.0

    def note(self, event: int, travelled: float, known: HybridMap, area: int) -> None:
        """Learn of a keyframe event.

        :param known: the map of the most probable hypothesis before it.
        :param area: the robot's area there.
        """
        old = [k for k, at in self._travelled.items() if at <= travelled - OLD]
        partners = self._partners(event, old)
        self._travelled[event] = travelled
        step, self._before = travelled - self._before, travelled
        if not partners:
            self._new_ground += step
            return
        if not self.found or self._new_ground >= AWAY:
            length = travelled - max(self._travelled[k] for k in partners)
            linked = _linked(known, _areas(known), area, partners)
            self.found.append(Loop(event, travelled, travelled, length, linked=linked))
        self._new_ground = 0.0
        self.found[-1].partners[event] = partners
        self.found[-1].end = travelled

    def definite(self, event: int, known: HybridMap, area: int) -> None:
        """Learn of the definite map at a keyframe event, and of the robot's area in it."""
        unclosed = [loop for loop in self.found if loop.closed_at is None]
        areas = _areas(known) if unclosed else {}
        for loop in unclosed:
            where = {k: areas[k] for k in loop.partners if k in areas}
            if event in loop.partners:
                # Keyframes that tell nothing new are in no area.
                where[event] = area
            if any(_linked(known, areas, own, loop.partners[k]) for k, own in where.items()):
                loop.closed_at, loop.closed_by_event = self._travelled[event], event

    def finish(self) -> None:
        """Work out what of each loop could be seen."""
        for loop in self.found:
            if not loop.linked and loop.end - loop.begin >= STAY:
                first = [k for k in loop.partners if self._travelled[k] <= loop.begin + _LOOKED_AT]
                seen = [self._truth.shared_view(k, loop.partners[k]).max() >= VIEW for k in first]
                loop.view = float(np.mean(seen))

    def _partners(self, event: int, old: list[int]) -> tuple[int, ...]:
        """The old keyframes in whose place the robot is, the nearest of them."""
        if not old:
            return ()
        inside = self._truth.same_place([event], old)[0]
        here = self._truth.poses[event]
        near = [k for k, same in zip(old, inside, strict=True) if same]
        return tuple(sorted(near, key=lambda k: float(np.hypot(*(self._truth.poses[k] - here)[:2])))[:_PARTNERS])


def _areas(hybrid_map: HybridMap) -> dict[int, int]:
    """{keyframe: its area}."""
    return {k: area for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area)}


def _linked(hybrid_map: HybridMap, areas: Mapping[int, int], area: int, keyframes: tuple[int, ...]) -> bool:
    """Whether one of the keyframes is in an area or in one beside it."""
    near = {area, *hybrid_map.neighbours(area)}
    return any(areas.get(keyframe) in near for keyframe in keyframes)
