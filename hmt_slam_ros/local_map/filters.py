"""Which kind of filter an area has."""

from __future__ import annotations

from hmt_slam_ros.local_map.area_filter import AreaFilter
from hmt_slam_ros.local_map.filter_state import FilterState, LineFilterState
from hmt_slam_ros.local_map.line_filter import LineFilter
from hmt_slam_ros.local_map.local_filter import LocalFilter
from hmt_slam_ros.local_map.local_mapping import LocalMapping


def new_filter(mapping: LocalMapping, hypothesis: int, area: int) -> LocalFilter:
    """A filter that knows nothing yet, of the kind that ``local_map.kind`` names."""
    kind = LineFilter if mapping.configuration.local_map.kind == "lines" else AreaFilter
    return kind(mapping, hypothesis, area)


def filter_of(mapping: LocalMapping, state: FilterState | LineFilterState) -> LocalFilter:
    """The filter of a state; the patches of grids are in the pool."""
    if isinstance(state, LineFilterState):
        return LineFilter.of(mapping, state)
    return AreaFilter.of(mapping, state)
