"""What the node slam knows beside its process."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.processes.map_parts import AreaPose
from hmt_slam_ros.processes.messages import LocalEstimate


@dataclass(frozen=True, eq=False)
class SlamMemory:
    """As a value.

    :ivar areas: of the most probable hypothesis, in the map.
    :ivar estimate: the last one that was said.
    :ivar unchanged: whether the map is as it was loaded.
    :ivar dropped: scans that the node did not let the process hear.
    """

    areas: tuple[AreaPose, ...]
    estimate: LocalEstimate | None
    unchanged: bool
    dropped: int
