"""Every comparison of keyframes with known areas that TSBI makes, handed to whoever watches."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

from hmt_slam_ros import composition
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import Views
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.likelihood_grid import AreaGrid
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.admission import Query
from hmt_slam_ros.topological_inference.branching import Branches, Branching, Parent
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch, Comparison, Pose
from hmt_slam_ros.topological_inference.place_recognition import Looks


@dataclass(frozen=True, eq=False)
class Examination:
    """One hypothesis's keyframes, compared with its known areas.

    :ivar kind: "cut" or "recheck".
    :ivar parent: the hypothesis before the event.
    :ivar query: its keyframes in question.
    :ivar compared: {known area: keyframes that had been compared with it before}.
    :ivar excluded: areas that were neither candidates nor part of a candidate's map.
    :ivar found: what came of it.
    :ivar views: grids of keyframes and areas, as the search builds them.
    :ivar looks: of keyframes.
    """

    kind: str
    parent: Parent
    query: Query
    compared: Mapping[int, Collection[int]]
    excluded: frozenset[int]
    found: Comparison
    views: Views
    looks: Looks

    @property
    def hybrid_map(self) -> HybridMap:
        """The map of the hypothesis."""
        return self.parent.hybrid_map

    @property
    def keyframes(self) -> list[int]:
        """The keyframes in question."""
        return list(self.query.poses)

    @property
    def known_areas(self) -> list[int]:
        """All areas in which the keyframes could have been found."""
        return [area for area in self.hybrid_map.area_ids() if area not in self.excluded]

    def fresh(self, area: int) -> dict[int, Pose]:
        """{keyframe: ``reference_T_base``} of those not compared with an area before."""
        return {k: pose for k, pose in self.query.poses.items() if k not in self.compared.get(area, ())}

    def grid_of(self, area: int) -> AreaGrid:
        """The map of a known area and its surroundings."""
        return self.views.place(self.hybrid_map, area, self.excluded).grid


Heard = Callable[[Examination], None]


class WatchedBranching(Branching):
    """Makes the children of hypotheses, as always, and tells what they were made from."""

    def __init__(self, configuration: Configuration, replica: Replica, heard: Heard) -> None:
        super().__init__(configuration, replica, composition.landmark_evidence)
        self.search = self._watched = _WatchedSearch(configuration, replica.scans)
        self._looks = Looks(replica.scans)
        self._heard = heard

    def cut(self, parent: Parent, keyframes: Sequence[int]) -> Branches:
        """As always."""
        return self._told("cut", parent, super().cut(parent, keyframes))

    def recheck(self, parent: Parent, only: Collection[int] = ()) -> Branches:
        """As always."""
        return self._told("recheck", parent, super().recheck(parent, only))

    def _told(self, kind: str, parent: Parent, branches: Branches) -> Branches:
        if (asked := self._watched.take()) is not None:
            query, compared, excluded, found = asked
            views = self._watched.views
            self._heard(Examination(kind, parent, query, compared, excluded, found, views, self._looks))
        return branches


_Asked = tuple[Query, Mapping[int, Collection[int]], frozenset[int], Comparison]


class _WatchedSearch(ClosureSearch):
    """Remembers its last comparison."""

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        super().__init__(configuration, scans)
        self._last: _Asked | None = None

    @property
    def views(self) -> Views:
        """Grids that were built and are kept."""
        return self._views

    def compare(
        self,
        hybrid_map: HybridMap,
        area: int,
        query: Query,
        compared: Mapping[int, Collection[int]],
        excluded: Collection[int],
        most: int,
        only: Collection[int] = (),
    ) -> Comparison:
        """As always."""
        found = super().compare(hybrid_map, area, query, compared, excluded, most, only)
        self._last = query, compared, frozenset(excluded), found
        return found

    def take(self) -> _Asked | None:
        """The last comparison since it was taken."""
        last, self._last = self._last, None
        return last
