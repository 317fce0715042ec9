"""Which kind of filter an area has: one with a grid, one with lines, or by what the area is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.area_classes import AreaClassifier
from hmt_slam_ros.landmarks.line_filter import LineFilter
from hmt_slam_ros.submap.local_filter import LineFilterState, LocalFilter, ParticleFilterState, PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.submap.particle_filter import ParticleFilter


class FilterSelector:
    """Chooses the kind of filter by ``local_map.kind``; by class, after Tomatis et al. (2003), section 3.1."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping = mapping
        self._kind = mapping.configuration.local_map.kind
        self._classifier = AreaClassifier(mapping)

    def new(self, hypothesis: int, area: int) -> LocalFilter:
        """A filter that knows nothing yet, of the kind that ``local_map.kind`` names; by class, one with a grid."""
        kind = LineFilter if self._kind == "lines" else ParticleFilter
        return kind(self._mapping, hypothesis, area)

    def restore(self, state: ParticleFilterState | LineFilterState) -> LocalFilter:
        """The filter of a state; the patches of grids are in the pool."""
        if isinstance(state, LineFilterState):
            return LineFilter.from_state(self._mapping, state)
        return ParticleFilter.from_state(self._mapping, state)

    def select(self, own: LocalFilter, area: int, content: Sequence[PlacedKeyframe]) -> LocalFilter:
        """The filter to go on with: ``own``, or one of another kind that has the robot where ``own`` has it.

        It knows nothing of what is around the robot until it changes to the area. ``own`` is given up if it is not it.

        :param area: the one that is entered.
        :param content: keyframes in its frame, of which those of the area tell what it is.
        """
        if self._kind != "by_class":
            return own
        kind = self._filter_type(area, content)
        if kind is None or isinstance(own, kind):
            return own
        other = kind(self._mapping, own.hypothesis, own.area)
        other.initialize(PoseGaussian.from_pose(own.pose))
        other.tracking_covariance, other.clutter_estimate = own.tracking_covariance, own.clutter_estimate
        own.release()
        return other

    def _filter_type(
        self, area: int, content: Sequence[PlacedKeyframe]
    ) -> type[ParticleFilter] | type[LineFilter] | None:
        """None where too little is known of the area."""
        within = [placed for placed in content if placed.area == area]
        poses = np.array([placed.pose for placed in within]).reshape(-1, 3)
        found = self._classifier.classify([placed.scan for placed in within], poses)
        if found is None:
            return None
        return ParticleFilter if found.is_hallway else LineFilter
