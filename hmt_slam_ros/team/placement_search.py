"""The search of one component in another, while both grow: a bounded step at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.components import ComponentPair
from hmt_slam_ros.team.contradictions import PlaceComparison
from hmt_slam_ros.team.placement import (
    PlacementDistribution,
    PlacementGeometry,
    PlacementPrior,
    WindowCandidate,
    placement_distribution,
    window_candidates,
)
from hmt_slam_ros.team.rendezvous import Rendezvous, RendezvousWindow, rendezvous_window
from hmt_slam_ros.team.windows import GROUND_RADIUS, Window, find_windows
from hmt_slam_ros.topological_inference.event_work import EventWork
from hmt_slam_ros.topological_inference.global_localization import GlobalSearch
from hmt_slam_ros.topological_inference.map_search import MapSearch

Keyframes = tuple[int, ...]

Exclusion = Callable[[ComponentPair], Callable[[Window], frozenset[int]]]
"""Of a pair: the areas of the first component in which each window is not searched."""

_FIRST_REGIONS, _REGIONS = 64, 16
"""Most areas in which a window is searched: at first, and each time the first component has grown.

They are those that look most like it. The others count as not searched.
"""

_STEP_WORK = 1_000_000
"""Least work of a step: that of finding that nothing is left to search for a window, about 1.5 ms."""


@dataclass(frozen=True, eq=False)
class _WindowSearch:
    """The search of a window.

    :ivar search: of its keyframes in the first component, None before it began.
    :ivar known: {area: its keyframes} when it began or went on.
    :ivar excluded: areas that are not searched.
    :ivar left: number of areas that are not to be searched.
    :ivar is_checked: whether the walls of the candidates were checked.
    """

    search: GlobalSearch | None = None
    known: Mapping[int, Keyframes] = field(default_factory=dict)
    excluded: frozenset[int] = frozenset()
    left: int = 0
    is_checked: bool = False


class PlacementSearch:
    """Searches every window of the second component in every area of the first, each once while it stays as it is.

    :ivar comparison_work: of all distributions until now.
    """

    def __init__(self, configuration: Configuration, exclusion: Exclusion | None = None) -> None:
        """:param exclusion: of a pair: the areas in which each window is not searched."""
        self._configuration, self._exclusion = configuration, exclusion
        self._scans: dict[int, Scan] = {}
        self._work = EventWork()
        self._map_search = MapSearch(configuration, self._scans, self._work, GROUND_RADIUS)
        self._pair: ComponentPair | None = None
        self._windows: list[Window] = []
        self._in_order: list[Window | RendezvousWindow] = []
        self._searches: dict[Keyframes, _WindowSearch] = {}
        self._outdated: dict[Keyframes, Window] = {}
        self._known: dict[int, Keyframes] = {}
        self.comparison_work = 0

    @property
    def pair(self) -> ComponentPair:
        """The two components, as of the last update."""
        assert self._pair is not None
        return self._pair

    @property
    def windows(self) -> tuple[Window, ...]:
        """The windows of the second component, and those of rendezvous, in the order of its path."""
        return tuple(each.window if isinstance(each, RendezvousWindow) else each for each in self._in_order)

    def update(self, pair: ComponentPair, rendezvous: Sequence[Rendezvous] = ()) -> None:
        """Go on with components that grew or changed, with the same numbers."""
        if any(self._scans[k] is not pair.scans.get(k) for k in self._scans):
            self._map_search.forget_scans()
            self._scans.clear()
        self._scans |= pair.scans
        self._pair = pair
        self._windows = find_windows(pair.hybrid_map, pair.other, self._windows)
        met = [window for each in rendezvous if (window := rendezvous_window(pair, each)) is not None]
        self._in_order = sorted([*self._windows, *met], key=_first_keyframe)
        known = {area: tuple(pair.hybrid_map.keyframes(area)) for area in pair.known}
        # The same object where nothing has changed.
        self._known = self._known if known == self._known else known
        earlier, windows = self._searches, {tuple(window.poses): window for window in self._windows}
        self._searches = {key: earlier.get(key, _WindowSearch()) for key in windows}
        exclude = self._exclusion(pair) if self._exclusion else _exclude_nothing
        self._excluded = {key: exclude(window) for key, window in windows.items()}
        self._outdated = {key: w for key, w in windows.items() if self._is_outdated(key)}

    def _is_outdated(self, window: Keyframes) -> bool:
        earlier = self._searches[window]
        return earlier.known is not self._known or earlier.excluded != self._excluded[window]

    def _continue_search(self, window: Window, earlier: _WindowSearch) -> _WindowSearch:
        """The search of a window with the areas that are new or have other keyframes still to be searched."""
        pair, known, excluded = self.pair, self._known, self._excluded[tuple(window.poses)]
        search = self._map_search.begin(pair.hybrid_map, window.poses, pair.first_keyframe)
        search = _without_areas(search, excluded)
        if earlier.search is None:
            return _WindowSearch(search, known, excluded, max(0, len(search.unexamined) - _FIRST_REGIONS))
        left = {*earlier.search.unexamined, *earlier.excluded, *excluded}
        examined = {a for a, keyframes in known.items() if earlier.known.get(a) == keyframes and a not in left}
        unexamined = {area: p for area, p in search.unexamined.items() if area not in examined}
        candidates = tuple(candidate for candidate in earlier.search.candidates if candidate.area in examined)
        search = replace(search, unexamined=unexamined, candidates=candidates)
        return _WindowSearch(search, known, excluded, max(0, len(unexamined) - _REGIONS))

    @property
    def searched_count(self) -> int:
        """Number of areas in which windows were searched, those of all windows together."""
        searches = [own.search for own in self._searches.values() if own.search is not None]
        return sum(search.areas - len(search.unexamined) for search in searches)

    def step(self) -> int | None:
        """Take the next step: its work, at most about that of an event; None where nothing is left."""
        hybrid_map = self.pair.hybrid_map
        for key, earlier in self._searches.items():
            window = self._outdated.pop(key, None)
            own = earlier if window is None else self._continue_search(window, earlier)
            if own.is_checked:
                continue
            assert own.search is not None
            self._work.begin_event()
            if len(own.search.unexamined) > own.left:
                self._searches[key] = replace(own, search=self._map_search.continue_search(hybrid_map, own.search))
            else:
                search, is_checked = self._map_search.check_candidates(hybrid_map, own.search, self.pair.clutter)
                self._searches[key] = replace(own, search=search, is_checked=is_checked)
            return max(_STEP_WORK, self._work.done)
        return None

    def distribution(self, left_out: int = 0) -> PlacementDistribution:
        """The PMF over placements, as far as it was searched.

        :param left_out: number of the newest windows that do not count.
        """
        pair, windows = self.pair, self.windows[: len(self._in_order) - left_out]
        candidates = [self._candidates(number, each) for number, each in enumerate(self._in_order[: len(windows)])]
        prior = PlacementPrior.of_pair(len(pair.known), len(pair.other), pair.repetitions)
        geometry = PlacementGeometry(pair.hybrid_map, windows)
        comparison = PlaceComparison(pair, windows, geometry, self._configuration, self._map_search.grid_cache)
        found = placement_distribution(geometry, candidates, pair.joint, prior, comparison.log_ratio)
        self.comparison_work += comparison.work
        in_maps = [replace(each, pose=pair.between_maps(each.pose)) for each in found.placements]
        return replace(found, placements=tuple(in_maps))

    def _candidates(self, number: int, window: Window | RendezvousWindow) -> list[WindowCandidate]:
        if isinstance(window, RendezvousWindow):
            return [window.candidate(number)]
        pair, search = self.pair, self._searches[tuple(window.poses)].search
        if search is None:
            return []
        found = self._map_search.localize(pair.hybrid_map, search, pair.clutter)
        return window_candidates(number, found, max(1, search.areas))


def _exclude_nothing(_: Window) -> frozenset[int]:
    return frozenset()


def _without_areas(search: GlobalSearch, excluded: frozenset[int]) -> GlobalSearch:
    """A search before its first region, without some areas."""
    unexamined = {area: p for area, p in search.unexamined.items() if area not in excluded}
    return replace(search, areas=len(unexamined), unexamined=unexamined)


def _first_keyframe(window: Window | RendezvousWindow) -> int:
    own = window.window if isinstance(window, RendezvousWindow) else window
    return next(iter(own.poses))
