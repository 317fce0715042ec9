"""How do some keyframes lie in the whole map, of which the arcs tell nothing? At all positions in it and all headings.

Areas that lie for certain beside each other are one region, and are searched together, so that no spot is searched
twice, and only where one of the keyframes would be near to one of the map.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.agreement import Agreement
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.area_grid import AreaGrid
from hmt_slam_ros.topology.area_ground import ground_around
from hmt_slam_ros.topology.area_matching import MatchSettings, Mode, match
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.located import Located, reach_of
from hmt_slam_ros.topology.surroundings import Nearness, Views, areas_around, gap, positions, stacked
from hmt_slam_ros.topology.transition import Place, owner_at
from hmt_slam_ros.topology.walls import Walls

Pose = NDArray[np.float64]

# Deviation of an area's position, m, up to which it is part of a region: keyframes lie across the border of two areas
# also where their arc was travelled over once.
_WIDE = 1.0
# Flat over a region and all headings, m, m, rad.
_FLAT = PoseGaussian(np.zeros(3), np.diag([100.0, 100.0, 20.0]) ** 2)
# Of the samples, one of so many is looked for.
_EVERY = 3
# Of the log-ratio of a sample on a surface, as much on average at least: what the robot sees is in the map, or it is
# not. That little of the map is where it sees free space is not asked, as what moved left its traces there.
_SURE = math.log(3.0)
_HALF = 0.5 * _SURE
# Where so much less of the surfaces is known than in the best place, a place does not matter; and the fits of a region
# that are worked out at most.
_WORSE, _FITS = 0.15, 40


class Region(NamedTuple):
    """Areas that are searched together.

    :ivar reference: one of them.
    :ivar poses: {area: ``reference_T_area``} of all that the region's map holds.
    :ivar own: the areas that are looked for here; the others are in the map, but belong to other regions.
    """

    reference: int
    poses: dict[int, Pose]
    own: frozenset[int]


class WholeMap:
    """Looks for keyframes in the whole map.

    :param radius: farthest distance to a keyframe of a place, m.
    :param reach: as far as that from an area's keyframes, m, others are part of what is seen there.
    """

    def __init__(self, views: Views, walls: Walls, settings: MatchSettings, radius: float, reach: float) -> None:
        self._views, self._walls, self._settings, self._radius, self._reach = views, walls, settings, radius, reach

    def fits(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: float, shares: Mapping[int, float]
    ) -> list[Located]:
        """How the keyframes lie in some areas: the ways that matter beside the best.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        :param shares: {area: probability by its look} of the areas; where it is most probable is looked first.
        """
        found: list[Located] = []
        query = replace(self._views.grid(poses), points=self._views.lasting(poses))
        known = [area for area in hybrid_map.area_ids() if min(hybrid_map.keyframes(area), default=before) < before]
        parts = [part for part in regions(hybrid_map, known, self._reach) if part.own & shares.keys()]
        for part in sorted(parts, key=lambda part: (-sum(shares.get(a, 0.0) for a in part.own), part.reference)):
            best = max((fit.found.share for fit in found), default=0.0)
            place = self._views.place_of(hybrid_map, part.reference, part.poses, before)
            own = part.own & shares.keys()
            here = self._fits(place, query, poses, own, max(_HALF, (best - _WORSE) * _SURE))
            found += [fit._replace(mode=_seen_from(fit.mode, part.poses[fit.area])) for fit in here]
        return found

    def walls(self, hybrid_map: HybridMap, located: Located, poses: Mapping[int, Pose], before: float) -> Agreement:
        """Walls of the map and of the keyframes that beams of the other end on or pass, if these lie there.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        """
        known = {
            keyframe: se2.compose(belief.mean, pose)
            for area, belief in areas_around(hybrid_map, located.area, Nearness(_WIDE, 2.0 * self._reach)).items()
            for keyframe, pose in hybrid_map.keyframes(area).items()
            if keyframe < before
        }
        return self._walls.between(known, {k: se2.compose(located.mode.pose.mean, pose) for k, pose in poses.items()})

    def forget(self) -> None:
        """Forget the maps of the regions, which take as much memory as a large building's local maps."""
        self._views.forget()

    def _fits(
        self, place: Place, query: AreaGrid, poses: Mapping[int, Pose], own: Collection[int], least: float
    ) -> Iterator[Located]:
        """How the keyframes lie in areas of a region, in the frame of its reference.

        :param query: what the keyframes saw.
        :param own: the areas.
        :param least: log-ratio of the samples on average, nats.
        """
        some, known = (replace(grid, points=grid.points[::_EVERY]) for grid in (query, place.grid))
        temper = _EVERY * self._settings.temper
        margin = max(self._settings.margin, _WORSE * _SURE * temper * len(some.points))
        settings = replace(self._settings, temper=temper, margin=margin, least=least, max_modes=_FITS, reverse=False)
        near = place.positions[np.isin(place.owners, list(own))]
        ground = ground_around(near, stacked(poses)[:, :2], self._radius, place.grid.cell)
        for mode in match(some, known, _FLAT, settings, reach_of(near, query, poses, self._radius), ground).modes:
            area = owner_at(place, se2.compose(mode.pose.mean, stacked(poses)), self._radius)
            if area is not None and area in own:
                yield Located(area, mode, place.grid.agreement(query.points, mode.pose.mean))


def regions(hybrid_map: HybridMap, areas: Collection[int], reach: float) -> list[Region]:
    """The regions of a map; every area is one's own.

    :param reach: between the nearest keyframes of two areas of a region, m; its map reaches as far beyond.
    """
    found, left = [], set(areas)
    for area in sorted(areas):
        if area not in left:
            continue
        around = areas_around(hybrid_map, area, Nearness(_WIDE, 2.0 * reach))
        poses = {other: belief.mean for other, belief in around.items() if other in areas}
        here = positions(hybrid_map, area, np.zeros(3))
        own = {other for other in left & poses.keys() if gap(here, positions(hybrid_map, other, poses[other])) <= reach}
        left -= own
        found.append(Region(area, poses, frozenset(own)))
    return found


def _seen_from(mode: Mode, pose: Pose) -> Mode:
    """A mode in the frame of an area that stands at ``pose``, shape (3,), of the frame that it is in."""
    back = PoseGaussian.exactly(se2.inverse(pose))
    return Mode(back.compose(mode.pose), back.compose(mode.measured), mode.log_mass)
