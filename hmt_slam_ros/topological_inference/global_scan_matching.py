"""How keyframes lie in the whole map, of which the arcs tell nothing: all positions in it and all headings.

Doors are open in one corridor and closed in the next, a wall ends sooner, a shelf stands in front of nothing: surfaces
that are there are mostly in places that look alike, too, but not each of them, and a beam that passes where one should
be is seldom an error. The walls are those of either side, and so are the beams, as what one of them did not see of the
other may be what differs.

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

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import (
    AreaPlace,
    GridCache,
    Neighborhood,
    areas_around,
    containing_area,
    keyframe_positions,
    min_distance,
    stack_poses,
)
from hmt_slam_ros.registration.area_to_area import MatchMode, MatchSettings, match_areas
from hmt_slam_ros.registration.branch_and_bound import constrain_around
from hmt_slam_ros.registration.consistency import Agreement, count_hits_and_violations
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping

# Deviation of an answer's position at most, m.
_MAX_DEVIATION = 0.2


class PoseCandidate(NamedTuple):
    """Where keyframes are.

    :ivar area: in whose place.
    :ivar mode: how they lie there.
    :ivar agreement: their surfaces in the map of the place.
    """

    area: int
    mode: MatchMode
    agreement: Agreement


def is_certain(candidate: PoseCandidate) -> bool:
    """Whether the surfaces alone say where, also along corridors."""
    variance = float(np.linalg.eigvalsh(candidate.mode.measured.covariance[:2, :2])[-1])
    return variance <= _MAX_DEVIATION**2


def query_bounds(
    positions: NDArray[np.float64], query: AreaGrid, poses: Mapping[int, NDArray[np.float64]], radius: float
) -> NDArray[np.float64]:
    """The smallest and the largest (x, y) of the middle of the query's points where a keyframe of it is near one of
    some positions, shape (2, 2).

    :param positions: shape (n, 2), m.
    :param poses: {keyframe: ``reference_T_base``} of the query.
    :param radius: how near, m.
    """
    middle = query.points.mean(axis=0) if len(query.points) else np.zeros(2)
    lever = float(np.hypot(*(stack_poses(poses)[:, :2] - middle).T).max())
    reach = radius + lever
    return np.array([positions.min(axis=0) - reach, positions.max(axis=0) + reach])


Pose = NDArray[np.float64]

# Keyframes see each other's walls where they are this near, m.
_WALL_RADIUS = 12.0


class FreeSpaceCheck:
    """Lays keyframes into each other's maps.

    :param scans: {keyframe: scan}, which may grow.
    """

    def __init__(self, scans: Mapping[int, Scan], configuration: Configuration) -> None:
        self._scans, self._configuration = scans, configuration

    def compare(self, known: Mapping[int, Pose], seen: Mapping[int, Pose]) -> Agreement:
        """Samples of the walls of either on which beams of the other end (on), and which they pass (free).

        :param known: {keyframe: ``map_T_base`` (3,)}, of which those count that are near to the others.
        :param seen: the others, likewise.
        """
        if not known or not seen:
            return Agreement(0, 0, 0)
        middle = np.append(stack_poses(seen)[:, :2].mean(axis=0), 0.0)
        here = stack_poses(seen) - middle
        there = stack_poses(known) - middle
        apart = np.hypot(*(there[:, None, :2] - here[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
        near = apart <= _WALL_RADIUS
        scans = [self._scans[k] for k, is_near in zip(known, near, strict=True) if is_near]
        own = [self._scans[k] for k in seen]
        mapping = LocalMapping(self._configuration)
        there = there[near]
        found = _count_hits_and_violations(mapping, scans, there, own, here) + _count_hits_and_violations(
            mapping, own, here, scans, there
        )
        met, passed = found.tolist()
        return Agreement(met + passed, met, passed)


def _count_hits_and_violations(
    mapping: LocalMapping, scans: list[Scan], poses: Pose, seeing: list[Scan], at: Pose
) -> NDArray[np.int64]:
    """Samples that beams of some scans end on, and that they pass, in a map of others, shape (2,).

    :param poses: shape (len(scans), 3), where the map's were taken; ``at`` is where the others were.
    """
    table = mapping.pool.empty_table()
    for scan, pose in zip(scans, poses, strict=True):
        mapping.insert_scan(table[None], pose[None], scan)
    view = mapping.pool.view(table)
    found = [
        count_hits_and_violations(mapping.matching_surfels(scan), scan.laser_pose[:2], pose, view, mapping.hit_distance)
        for scan, pose in zip(seeing, at, strict=True)
    ]
    mapping.pool.release(table)
    return np.array(found, dtype=np.int64).reshape(-1, 2).sum(axis=0)


# Deviation of an area's position, m, up to which it is part of a region: keyframes lie across the border of two areas
# also where their arc was travelled over once.
_WIDE = 1.0
# Flat over a region and all headings, m, m, rad.
_FLAT = PoseGaussian(np.zeros(3), np.diag([100.0, 100.0, 20.0]) ** 2)
# Of the samples, one of so many is looked for.
_SAMPLE_STRIDE = 3
# Of the log-ratio of a sample on a surface, as much on average at least: what the robot sees is in the map, or it is
# not. That little of the map is where it sees free space is not asked, as what moved left its traces there.
_SURFACE_LOG_RATIO = math.log(3.0)
_MIN_LOG_RATIO = 0.5 * _SURFACE_LOG_RATIO
# Where so much less of the surfaces is known than in the best place, a place does not matter; and the fits of a region
# that are worked out at most.
_SHARE_MARGIN, _MAX_FITS = 0.15, 40


class Region(NamedTuple):
    """Areas that are searched together.

    :ivar reference: one of them.
    :ivar poses: {area: ``reference_T_area``} of all that the region's map holds.
    :ivar own_areas: the areas that are looked for here; the others are in the map, but belong to other regions.
    """

    reference: int
    poses: dict[int, Pose]
    own_areas: frozenset[int]


class GlobalScanMatcher:
    """Looks for keyframes in the whole map.

    :param radius: farthest distance to a keyframe of a place, m.
    :param reach: as far as that from an area's keyframes, m, others are part of what is seen there.
    """

    def __init__(
        self, views: GridCache, walls: FreeSpaceCheck, settings: MatchSettings, radius: float, reach: float
    ) -> None:
        self._grid_cache, self._free_space_check, self._settings, self._radius, self._reach = (
            views,
            walls,
            settings,
            radius,
            reach,
        )

    def match_regions(
        self, hybrid_map: HybridMap, poses: Mapping[int, Pose], before: float, shares: Mapping[int, float]
    ) -> list[PoseCandidate]:
        """How the keyframes lie in some areas: the ways that matter beside the best.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        :param shares: {area: probability by its look} of the areas; where it is most probable is looked first.
        """
        found: list[PoseCandidate] = []
        query = replace(self._grid_cache.grid(poses), points=self._grid_cache.static_points(poses))
        known = [area for area in hybrid_map.area_ids() if min(hybrid_map.keyframes(area), default=before) < before]
        parts = [part for part in regions(hybrid_map, known, self._reach) if part.own_areas & shares.keys()]
        for part in sorted(parts, key=lambda part: (-sum(shares.get(a, 0.0) for a in part.own_areas), part.reference)):
            best = max((fit.agreement.matched_share for fit in found), default=0.0)
            place = self._grid_cache.place_among(hybrid_map, part.reference, part.poses, before)
            own = part.own_areas & shares.keys()
            here = self._match_region(
                place, query, poses, own, max(_MIN_LOG_RATIO, (best - _SHARE_MARGIN) * _SURFACE_LOG_RATIO)
            )
            found += [fit._replace(mode=_mode_in_frame(fit.mode, part.poses[fit.area])) for fit in here]
        return found

    def check_walls(
        self, hybrid_map: HybridMap, candidate: PoseCandidate, poses: Mapping[int, Pose], before: float
    ) -> Agreement:
        """Walls of the map and of the keyframes that beams of the other end on or pass, if these lie there.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        """
        known = {
            keyframe: se2.compose(belief.mean, pose)
            for area, belief in areas_around(hybrid_map, candidate.area, Neighborhood(_WIDE, 2.0 * self._reach)).items()
            for keyframe, pose in hybrid_map.keyframes(area).items()
            if keyframe < before
        }
        return self._free_space_check.compare(
            known, {k: se2.compose(candidate.mode.pose.mean, pose) for k, pose in poses.items()}
        )

    def forget(self) -> None:
        """Forget the maps of the regions, which take as much memory as a large building's local maps."""
        self._grid_cache.forget()

    def _match_region(
        self, place: AreaPlace, query: AreaGrid, poses: Mapping[int, Pose], own: Collection[int], least: float
    ) -> Iterator[PoseCandidate]:
        """How the keyframes lie in areas of a region, in the frame of its reference.

        :param query: what the keyframes saw.
        :param own: the areas.
        :param least: log-ratio of the samples on average, nats.
        """
        some, known = (replace(grid, points=grid.points[::_SAMPLE_STRIDE]) for grid in (query, place.grid))
        temper = _SAMPLE_STRIDE * self._settings.temper
        margin = max(self._settings.margin, _SHARE_MARGIN * _SURFACE_LOG_RATIO * temper * len(some.points))
        settings = replace(
            self._settings, temper=temper, margin=margin, min_log_ratio=least, max_modes=_MAX_FITS, check_reverse=False
        )
        near = place.positions[np.isin(place.keyframe_areas, list(own))]
        ground = constrain_around(near, stack_poses(poses)[:, :2], self._radius, place.grid.cell)
        for mode in match_areas(
            some, known, _FLAT, settings, query_bounds(near, query, poses, self._radius), ground
        ).modes:
            area = containing_area(place, se2.compose(mode.pose.mean, stack_poses(poses)), self._radius)
            if area is not None and area in own:
                yield PoseCandidate(area, mode, place.grid.compare(query.points, mode.pose.mean))


def regions(hybrid_map: HybridMap, areas: Collection[int], reach: float) -> list[Region]:
    """The regions of a map; every area is one's own.

    :param reach: between the nearest keyframes of two areas of a region, m; its map reaches as far beyond.
    """
    found, left = [], set(areas)
    for area in sorted(areas):
        if area not in left:
            continue
        around = areas_around(hybrid_map, area, Neighborhood(_WIDE, 2.0 * reach))
        poses = {other: belief.mean for other, belief in around.items() if other in areas}
        here = keyframe_positions(hybrid_map, area, np.zeros(3))
        own = {
            other
            for other in left & poses.keys()
            if min_distance(here, keyframe_positions(hybrid_map, other, poses[other])) <= reach
        }
        left -= own
        found.append(Region(area, poses, frozenset(own)))
    return found


def _mode_in_frame(mode: MatchMode, pose: Pose) -> MatchMode:
    """A mode in the frame of an area that stands at ``pose``, shape (3,), of the frame that it is in."""
    back = PoseGaussian.from_pose(se2.inverse(pose))
    return MatchMode(back.compose(mode.pose), back.compose(mode.measured), mode.log_mass)
