"""Matching keyframes into the whole map: all positions in it and all headings.

Surfaces are mostly also there in similar places, but not all of them, and a beam that passes a known surface is seldom
an error. The free-space check therefore tests the beams of both sides on the walls of both sides.

Areas that certainly lie beside each other form one region. A region is searched once, and only where one of the
keyframes would be near one of the map.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import (
    NO_AREA,
    AreaPlace,
    GridCache,
    Neighborhood,
    areas_around,
    containing_area,
    keyframe_positions,
    keyframes_before,
    min_distance,
    stack_poses,
)
from hmt_slam_ros.registration.area_to_area import MatchMode, MatchSettings, find_cells, match_areas
from hmt_slam_ros.registration.consistency import Agreement, count_hits_and_violations
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.registration.position_constraint import constrain_around
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_mapping import LocalMapping

Pose = Float64

_MAX_SIGMA = 0.2
"""Largest deviation of the position of a certain candidate, m."""

_WALL_RADIUS = 12.0
"""Distance of keyframes within which they see each other's walls, m."""

_REGION_SIGMA = 1.0
"""Largest deviation of an area's position in a region, m: that of an arc traveled once."""

_FLAT = PoseGaussian(np.zeros(3), np.diag([100.0, 100.0, 20.0]) ** 2)
"""Prior that is flat over a region and all headings, m and rad."""

_NO_POINTS = np.zeros((0, 2))
"""No samples of the map, since known surface in free space of the keyframes does not count."""

_SAMPLE_STRIDE = 3
"""One of so many surface samples is matched, or fewer."""

_MAX_SAMPLES = 160
"""Most samples that are matched: more keyframes do not take longer."""

_SURFACE_LOG_RATIO = math.log(3.0)
"""Log-ratio of a sample amid a known surface, nats; beside its middle it is smaller."""

_MIN_LOG_RATIO = 0.5 * _SURFACE_LOG_RATIO
"""Smallest mean log-ratio of a match, nats. Surface in known free space does not count: furniture moves."""

_SHARE_MARGIN = 0.15
"""Matched share below that of the best match, at which matches in later regions do not matter.

They are dropped by their mean log-ratio, as if each matched sample were amid a surface. Most are beside its middle, and
those in free space count against a match: so also matches are dropped whose share is a little nearer to the best.
"""

_MAX_MATCHES = 40
"""Most matches per region."""

_REGION_WORK = 2_000_000
"""Work to find the areas and the keyframes of a region."""

_MODE_WORK = 400_000
"""Work of a mode of a match: about half a millisecond."""

_BEAM_WORK = 700
"""Work of a beam that is tested on walls: it is drawn in a map, and followed through another one."""


class PoseCandidate(NamedTuple):
    """A pose of keyframes in the map.

    :ivar area: in whose place they lie.
    :ivar mode: their pose there.
    :ivar agreement: of their surfaces with the map of the place.
    :ivar walls: on which beams of either side end, and which they pass; None before they were checked.
    """

    area: int
    mode: MatchMode
    agreement: Agreement
    walls: Agreement | None = None


def is_certain(candidate: PoseCandidate) -> bool:
    """Whether the surfaces alone determine the position in all directions."""
    variance = float(np.linalg.eigvalsh(candidate.mode.measured.covariance[:2, :2]).max())
    return variance <= _MAX_SIGMA**2


def query_bounds(positions: Float64, query: AreaGrid, poses: Mapping[int, Float64], radius: float) -> Float64:
    """Smallest and largest (x, y) of the query's centroid with a query keyframe near a position, shape (2, 2).

    :param positions: shape (n, 2), m.
    :param poses: {keyframe: ``reference_T_base``} of the query.
    :param radius: how near, m.
    """
    centroid = query.points.mean(axis=0) if len(query.points) else np.zeros(2)
    lever = float(np.hypot(*(stack_poses(poses)[:, :2] - centroid).T).max())
    reach = radius + lever
    return np.array([positions.min(axis=0) - reach, positions.max(axis=0) + reach])


class FreeSpaceCheck:
    """Tests the beams of two sets of keyframes on each other's walls.

    :param scans: {keyframe: scan}, which may grow.
    """

    def __init__(self, scans: Mapping[int, Scan], configuration: Configuration) -> None:
        self._scans, self._configuration = scans, configuration

    def compare(self, known: Mapping[int, Pose], query: Mapping[int, Pose]) -> tuple[Agreement, int]:
        """Samples of the walls of either that beams of the other hit (on) or pass (free), and the work.

        :param known: {keyframe: ``map_T_base`` (3,)}, of which those near the others count.
        :param query: the others, likewise.
        """
        if not known or not query:
            return Agreement(0, 0, 0), 0
        centroid = np.append(stack_poses(query)[:, :2].mean(axis=0), 0.0)
        query_poses = stack_poses(query) - centroid
        known_poses = stack_poses(known) - centroid
        distances = np.hypot(*(known_poses[:, None, :2] - query_poses[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
        is_near = distances <= _WALL_RADIUS
        known_scans = [self._scans[k] for k, near in zip(known, is_near, strict=True) if near]
        known_poses = known_poses[is_near]
        query_scans = [self._scans[k] for k in query]
        mapping = LocalMapping(self._configuration)
        counts = _count_in_map(mapping, known_scans, known_poses, query_scans, query_poses)
        counts = counts + _count_in_map(mapping, query_scans, query_poses, known_scans, known_poses)
        hits, violations = counts.tolist()
        beams = sum(len(scan.points) for scan in [*known_scans, *query_scans])
        return Agreement(hits + violations, hits, violations), _BEAM_WORK * beams


def _count_in_map(
    mapping: LocalMapping, map_scans: list[Scan], map_poses: Pose, scans: list[Scan], poses: Pose
) -> Int64:
    """Samples on which beams of scans end, and which they pass, in a map of other scans, shape (2,).

    :param map_poses: shape (len(map_scans), 3); ``poses`` is that of ``scans``.
    """
    table = mapping.pool.empty_table()
    for scan, pose in zip(map_scans, map_poses, strict=True):
        mapping.insert_scan(table[None], pose[None], scan)
    view = mapping.pool.view(table)
    counts = [
        count_hits_and_violations(mapping.matching_surfels(scan), scan.laser_pose[:2], pose, view, mapping.hit_distance)
        for scan, pose in zip(scans, poses, strict=True)
    ]
    mapping.pool.release(table)
    return np.array(counts, dtype=np.int64).reshape(-1, 2).sum(axis=0)


class Region(NamedTuple):
    """Areas that are searched together.

    :ivar reference: the area in whose frame they are.
    :ivar poses: {area: ``reference_T_area``} of all that the region's map holds.
    :ivar own_areas: the areas that are searched here; the others belong to other regions.
    """

    reference: int
    poses: dict[int, Pose]
    own_areas: frozenset[int]


class RegionMatch(NamedTuple):
    """The matches of keyframes into a region.

    :ivar candidates: each in the frame of its area; None where something fits, but the whole map is not held.
    :ivar work: the number of samples looked up.
    """

    candidates: tuple[PoseCandidate, ...] | None
    work: int


class GlobalScanMatcher:
    """Matches keyframes into the whole map, one region after the other.

    :param radius: largest distance to a keyframe of a place, m.
    :param reach: largest distance between keyframes of two areas of a region, m.
    """

    def __init__(
        self,
        grid_cache: GridCache,
        free_space_check: FreeSpaceCheck,
        settings: MatchSettings,
        radius: float,
        reach: float,
    ) -> None:
        self._grid_cache, self._free_space_check = grid_cache, free_space_check
        self._settings, self._radius, self._reach = settings, radius, reach

    def find_region(self, hybrid_map: HybridMap, before: float, unexamined: Mapping[int, float]) -> Region:
        """The region of the most probable area.

        :param before: the map is that of the keyframes before this one.
        :param unexamined: {area: probability} of the areas that were not searched yet, at least one.
        """
        older = [area for area in hybrid_map.area_ids() if min(hybrid_map.keyframes(area), default=before) < before]
        reference = min(unexamined, key=lambda area: (-unexamined[area], area))
        return region_around(hybrid_map, reference, older, unexamined.keys(), self._reach)

    def prepare_region(self, hybrid_map: HybridMap, region: Region, before: float, *, whole: bool = False) -> None:
        """Make the map for :meth:`match_region`, unless it is held.

        :param whole: for a region in which something fits; else its coarse log-ratios are enough.
        """
        known, _ = keyframes_before(hybrid_map, region.poses, before)
        if whole:
            self._grid_cache.grid(known)
        else:
            self._grid_cache.coarse_grid(known)

    def match_region(
        self, hybrid_map: HybridMap, region: Region, poses: Mapping[int, Pose], before: float, best_share: float
    ) -> RegionMatch:
        """The best match of the keyframes into a region, and those that matter beside it.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        :param best_share: largest matched share in the regions that were searched.
        """
        query = self._grid_cache.grid(poses)
        min_log_ratio = max(_MIN_LOG_RATIO, (best_share - _SHARE_MARGIN) * _SURFACE_LOG_RATIO)
        known, areas = keyframes_before(hybrid_map, region.poses, before)
        keyframe_areas = np.array(areas, dtype=np.int64)
        candidates, work = self._match_keyframes(known, keyframe_areas, query, poses, region.own_areas, min_log_ratio)
        work += _REGION_WORK
        if candidates is None:
            return RegionMatch(None, work)
        in_frames = [c._replace(mode=_mode_in_frame(c.mode, region.poses[c.area])) for c in candidates]
        return RegionMatch(tuple(in_frames), work)

    def check_walls(
        self, hybrid_map: HybridMap, candidate: PoseCandidate, poses: Mapping[int, Pose], before: float
    ) -> tuple[Agreement, int]:
        """Walls on which beams end, and which they pass, between the map and keyframes at a candidate; and the work.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        """
        known = {
            keyframe: se2.compose(belief.mean, pose)
            for area, belief in areas_around(hybrid_map, candidate.area, region_neighborhood(self._reach)).items()
            for keyframe, pose in hybrid_map.keyframes(area).items()
            if keyframe < before
        }
        return self._free_space_check.compare(
            known, {k: se2.compose(candidate.mode.pose.mean, pose) for k, pose in poses.items()}
        )

    def _match_keyframes(
        self,
        known: Mapping[int, Pose],
        keyframe_areas: Int64,
        query: AreaGrid,
        poses: Mapping[int, Pose],
        areas: Collection[int],
        min_log_ratio: float,
    ) -> tuple[list[PoseCandidate] | None, int]:
        """Matches of the keyframes into a region, in its frame, and the work.

        The whole map of the region is needed where something fits only: None where it is not held.

        :param known: {keyframe: ``region_T_base``} of the map.
        :param keyframe_areas: shape (len(known),), the area of each.
        :param query: grid of the keyframes.
        :param areas: those that are searched.
        :param min_log_ratio: smallest mean log-ratio of the samples, nats.
        """
        stride = max(_SAMPLE_STRIDE, math.ceil(len(query.points) / _MAX_SAMPLES))
        sparse = replace(query, points=query.points[::stride])
        surface, positions = self._grid_cache.coarse_grid(known), stack_poses(known)[:, :2]
        temper = stride * self._settings.temper
        settings = replace(
            self._settings,
            temper=temper,
            margin=max(self._settings.margin, _SHARE_MARGIN * _SURFACE_LOG_RATIO * temper * len(sparse.points)),
            min_log_ratio=min_log_ratio,
            max_modes=_MAX_MATCHES,
            check_reverse=False,
        )
        is_searched = np.isin(keyframe_areas, list(areas))
        constraint = constrain_around(positions, is_searched, stack_poses(poses)[:, :2], self._radius, surface.cell)
        bounds = query_bounds(positions[is_searched], query, poses, self._radius)
        cells = find_cells(sparse, surface, _NO_POINTS, _FLAT, settings, bounds, constraint)
        if not cells.score.size:
            return [], cells.work
        if not self._grid_cache.holds_grid(known):
            return None, cells.work
        place = AreaPlace(NO_AREA, keyframe_areas, positions, self._grid_cache.grid(known))
        match, candidates = match_areas(sparse, place.grid, _FLAT, settings, bounds, cells), []
        for mode in match.modes:
            area = containing_area(place, se2.compose(mode.pose.mean, stack_poses(poses)), self._radius)
            if area is not None and area in areas:
                candidates.append(PoseCandidate(area, mode, place.grid.compare(query.points, mode.pose.mean)))
        return candidates, match.work + _MODE_WORK * len(match.modes)


def region_around(
    hybrid_map: HybridMap, reference: int, known: Collection[int], unexamined: Collection[int], reach: float
) -> Region:
    """The region of an area.

    :param known: the areas that a region may hold.
    :param unexamined: those of them that no other region searched.
    :param reach: largest distance between keyframes of two areas of a region, m; its map reaches as far beyond.
    """
    around = areas_around(hybrid_map, reference, region_neighborhood(reach))
    poses = {other: belief.mean for other, belief in around.items() if other in known}
    positions = keyframe_positions(hybrid_map, reference)
    own_areas = {
        other
        for other in poses.keys() & set(unexamined)
        if min_distance(positions, keyframe_positions(hybrid_map, other, poses[other])) <= reach
    }
    return Region(reference, poses, frozenset(own_areas))


def region_neighborhood(reach: float) -> Neighborhood:
    """What a region's map holds around an area.

    :param reach: largest distance between keyframes of two areas of a region, m.
    """
    return Neighborhood(_REGION_SIGMA, 2.0 * reach)


def _mode_in_frame(mode: MatchMode, pose: Pose) -> MatchMode:
    """A mode in the frame of an area at ``pose``, shape (3,), in the mode's frame."""
    area_T_frame = PoseGaussian.from_pose(se2.inverse(pose))
    return MatchMode(area_T_frame.compose(mode.pose), area_T_frame.compose(mode.measured), mode.log_mass)
