"""The search of the whole map for a lost robot, with the maps of its regions and the parameters it goes by."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import GridCache, GridCacheState, Neighborhood
from hmt_slam_ros.registration.area_to_area import MatchSettings
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.registration.likelihood_grid import GridModel
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.event_work import CELL_WORK, EventWork
from hmt_slam_ros.topological_inference.global_localization import (
    GlobalSearch,
    begin_search,
    check_candidates,
    continue_search,
    is_conclusive,
    localize_globally,
    plausible_areas,
    search_region,
)
from hmt_slam_ros.topological_inference.global_scan_matching import FreeSpaceCheck, GlobalScanMatcher
from hmt_slam_ros.topological_inference.place_recognition import ScanDescriptors
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution
from hmt_slam_ros.topological_inference.search_prior import FLAT_PRIOR, SearchPrior

Pose = Float64


class MapSearch:
    """Searches the whole of a hybrid map for keyframes.

    :ivar work: of the event, which it shares with the comparison of areas.
    :ivar grid_cache: grids of the whole map.
    """

    def __init__(
        self,
        configuration: Configuration,
        scans: Mapping[int, Scan],
        work: EventWork,
        place_radius: float | None = None,
    ) -> None:
        """:param scans: {keyframe: scan}, which may grow.
        :param place_radius: largest distance to a keyframe of an area's place, m; ``tsbi.place_radius`` if None.
        """
        self._options = options = configuration.tsbi
        self._place_radius = options.place_radius if place_radius is None else place_radius
        self.work = work
        self._descriptors = ScanDescriptors(scans)
        radius = Neighborhood(options.local_sigma, options.local_reach)
        model = GridModel.from_configuration(configuration)
        self.grid_cache = GridCache(scans, model, radius, count_cells=self._count_cells)
        self._matcher = GlobalScanMatcher(
            self.grid_cache,
            FreeSpaceCheck(scans, configuration),
            MatchSettings.from_options(options),
            self._place_radius,
            options.local_reach,
        )

    @property
    def state(self) -> GridCacheState:
        """The maps that it holds."""
        return self.grid_cache.state

    def restore(self, state: GridCacheState) -> None:
        """Start from a saved state."""
        self.grid_cache.restore(state)

    def _count_cells(self, cells: int) -> None:
        self.work.add(CELL_WORK * cells)

    def forget_scans(self) -> None:
        """Drop what was computed from scans, of which some have changed."""
        self.grid_cache.clear()
        self._descriptors.clear()

    def begin(
        self,
        hybrid_map: HybridMap,
        poses: Mapping[int, Pose],
        before: int,
        prior: SearchPrior = FLAT_PRIOR,
        only: Collection[int] = (),
    ) -> GlobalSearch:
        """A search of the whole map, before its first region.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        :param prior: of the reference.
        :param only: the only areas to search, since fewer keyframes fitted nowhere else; all if empty.
        """
        known = {area: [k for k in hybrid_map.keyframes(area) if k < before] for area in hybrid_map.area_ids()}
        known = {area: keyframes for area, keyframes in known.items() if keyframes}
        probabilities = self._descriptors.area_probabilities(list(poses), known)
        return begin_search(hybrid_map, poses, before, probabilities, prior, self._place_radius, only)

    def continue_search(
        self, hybrid_map: HybridMap, search: GlobalSearch, first: int | None = None, prior: SearchPrior = FLAT_PRIOR
    ) -> GlobalSearch:
        """The search after one event.

        :param first: the area whose region comes first, if it was not searched yet.
        :param prior: of the reference.
        """
        return continue_search(search, self._matcher, hybrid_map, self.work, first, prior)

    def search_now(self, hybrid_map: HybridMap, search: GlobalSearch, area: int, clutter: Clutter) -> GlobalSearch:
        """The search after the region of an area and the walls there, whatever work they take, and others meanwhile.

        :param clutter: usual rate of contradictions of the robot's map.
        """
        search = search_region(search, self._matcher, hybrid_map, self.work, area)
        search, is_checked = self.continue_search(hybrid_map, search), False
        while not is_checked:
            own, aliasing = EventWork(), self._options.aliasing_prior
            search, is_checked = check_candidates(search, self._matcher, own, aliasing, hybrid_map, clutter)
            self.work.add(own.done)
        return search

    def check_candidates(
        self, hybrid_map: HybridMap, search: GlobalSearch, clutter: Clutter, prior: SearchPrior = FLAT_PRIOR
    ) -> tuple[GlobalSearch, bool]:
        """The search after the walls of its probable candidates were checked, and whether all were at this event.

        :param clutter: usual rate of contradictions of the robot's map.
        :param prior: of the reference.
        """
        aliasing = self._options.aliasing_prior
        return check_candidates(search, self._matcher, self.work, aliasing, hybrid_map, clutter, prior)

    def is_conclusive(
        self, hybrid_map: HybridMap, search: GlobalSearch, clutter: Clutter, prior: SearchPrior = FLAT_PRIOR
    ) -> bool:
        """Whether the search is over.

        :param clutter: usual rate of contradictions of the robot's map.
        :param prior: of the reference.
        """
        probability = self._options.relocalization_probability
        return is_conclusive(search, self._options.aliasing_prior, hybrid_map, clutter, probability, prior)

    def localize(
        self, hybrid_map: HybridMap, search: GlobalSearch, clutter: Clutter, prior: SearchPrior = FLAT_PRIOR
    ) -> PoseDistribution:
        """The distribution of the keyframes' pose in the whole map, as far as it was searched.

        :param clutter: usual rate of contradictions of the robot's map.
        :param prior: of the reference.
        """
        return localize_globally(search, self._options.aliasing_prior, hybrid_map, clutter, prior)

    def plausible_areas(self, hybrid_map: HybridMap, distribution: PoseDistribution) -> frozenset[int]:
        """The areas in which the keyframes of a search may be, and those around; none where they may be anywhere.

        More keyframes are searched there alone: they fit nowhere else, as fewer did not.
        """
        return plausible_areas(distribution, hybrid_map, self._options.local_reach)

    def end(self) -> None:
        """Free the grids of the whole map, which take as much memory as a large building's submaps."""
        self.grid_cache.clear()
