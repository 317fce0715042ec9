"""The families of buildings by their names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from hmt_slam_ros.configuration.flat import Value
from hmt_slam_ros.simulation import corridors
from hmt_slam_ros.simulation.building import Building
from hmt_slam_ros.simulation.institute import institute
from hmt_slam_ros.simulation.settings import Settings


@dataclass(frozen=True)
class Family:
    """A kind of building.

    :ivar build: draws one.
    :ivar description: one sentence.
    :ivar default_settings: settings that differ from the defaults where nobody sets them.
    """

    build: Callable[[np.random.Generator, Settings], Building]
    description: str
    default_settings: Mapping[str, Value] = field(default_factory=dict)


FAMILIES: dict[str, Family] = {
    "office": Family(corridors.office, "Offices with furniture on both sides of a ring of corridors."),
    "busy": Family(
        corridors.office,
        "The same with people in the corridors, and furniture that is moved between visits.",
        {"people": 6, "moved": 0.5},
    ),
    "nested": Family(
        corridors.nested,
        "Loops inside loops, 0.5 km of corridors with niches; size=4 makes 2 km of them.",
        {"laps": 1},
    ),
    "grid": Family(corridors.grid, "Corridors that cross at equal distances and look all alike.", {"laps": 1}),
    "ring": Family(corridors.symmetric_ring, "A square ring of corridors whose four sides are alike."),
    "straight": Family(corridors.straight, "A ring with two long halls without any feature.", {"range": 10.0}),
    "hall": Family(
        corridors.hall, "An open hall in whose middle the laser reaches nothing.", {"range": 8.0, "laps": 1}
    ),
    "twins": Family(
        corridors.twins,
        "Two identical rooms; lost in a hall in between, the robot enters one of them again.",
        {"range": 4.0, "laps": 1},
    ),
    "institute": Family(
        institute,
        "Hallways of 50 m x 25 m with crossings, offices and meeting rooms, of which 9 are open, and people; a visit "
        "finds others open.",
        {"laps": 1, "people": 4, "field_of_view": 360.0, "beams": 720},
    ),
}
