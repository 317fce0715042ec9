"""Settings of a simulated drive, written as in ``sim:office,seed=3,people=4``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hmt_slam_ros.configuration.flat import Value, apply_changes, parse_setting
from hmt_slam_ros.configuration.parameter import parameter
from hmt_slam_ros.logs.records import SIMULATION_PREFIX


@dataclass(frozen=True)
class Settings:
    """Settings of building, robot, laser and people of a simulated drive."""

    seed: int = parameter(0, "Seed of building, noise, people and furniture.", low=0, high=2**31 - 1)
    visit: int = parameter(
        0,
        "Number of the visit: from 1 on, furniture was moved and doors were closed since the first.",
        low=0,
        high=1000,
    )
    changed: float = parameter(
        0.5, "Probability that a piece of furniture was moved, a door closed, before a later visit.", low=0.0, high=1.0
    )
    size: float = parameter(1.0, "Factor on the building's lengths; corridors stay as wide.", low=0.7, high=20.0)
    count: int = parameter(3, "Rings of nested loops, blocks on a side of a grid of corridors.", low=1, high=20)
    laps: int = parameter(2, "Laps of the route.", low=1, high=1000)
    speed: float = parameter(0.6, "Largest speed of the robot.", unit="m/s", low=0.05, high=5.0)
    turn_rate: float = parameter(45.0, "Largest turn rate of the robot.", unit="deg/s", low=1.0, high=360.0)
    rounding: float = parameter(0.5, "Radius of the arc at a corner of the route.", unit="m", low=0.05, high=10.0)
    radius: float = parameter(
        0.25, "Radius of the robot, its smallest distance from walls and furniture.", unit="m", low=0.01, high=2.0
    )
    odometry: float = parameter(
        1.0, "Factor on the deviations of the motion model for odometry from scan to scan.", low=0.0, high=2.0
    )
    slips: float = parameter(
        0.0, "Expected slips of the wheels on 100 m, of 15 degrees and 0.3 m deviation.", low=0.0, high=100.0
    )
    readings: int = parameter(2, "Odometry readings per scan.", low=1, high=100)
    rate: float = parameter(5.0, "Scans per second.", unit="1/s", low=0.1, high=100.0)
    beams: int = parameter(361, "Beams of a scan.", low=2, high=20000)
    field_of_view: float = parameter(180.0, "Angle from the first beam to the last.", unit="deg", low=1.0, high=360.0)
    range: float = parameter(20.0, "Reach of the laser.", unit="m", low=0.5, high=200.0)
    range_noise: float = parameter(0.015, "Deviation of a range.", unit="m", low=0.0, high=1.0)
    dropout: float = parameter(0.01, "Share of beams that do not return.", low=0.0, high=1.0)
    sweep: float = parameter(
        0.0, "Time from the first beam to the last, during which the robot moves.", unit="s", low=0.0, high=1.0
    )
    forward: float = parameter(0.0, "Distance of the laser before the robot's middle.", unit="m", low=-2.0, high=2.0)
    lasers: int = parameter(
        1,
        "Lasers; the second is as far behind the robot's middle, faces back, and scans half a period later.",
        low=1,
        high=2,
    )
    people: int = parameter(0, "People who walk to and fro on the robot's route.", low=0, high=200)
    moved: float = parameter(
        0.0, "Probability that a piece of furniture is moved while the robot does not see it.", low=0.0, high=1.0
    )
    marks: int = parameter(0, "Marks with names on the ceiling, evenly along the first lap.", low=0, high=200)
    wrong_marks: float = parameter(
        0.0, "Share of the passes of a mark in which its name is read as that of another one.", low=0.0, high=1.0
    )
    carried: float = parameter(
        0.0,
        "Share of the drive after which the robot is kidnapped, without odometry; 0 for never.",
        low=0.0,
        high=1.0,
    )
    to: float = parameter(0.0, "Share of the drive at which it goes on afterwards.", low=0.0, high=1.0)
    turned: float = parameter(
        0.0, "Rotation of the robot to the left by the kidnapping.", unit="deg", low=-180.0, high=180.0
    )

    @property
    def run_seed(self) -> int:
        """Seed of everything that differs between visits: noise, people, moved furniture."""
        return self.seed + (self.visit << 32)


def parse_name(log: str | Path) -> tuple[str, dict[str, Value]]:
    """The world and the given settings of ``sim:WORLD,name=value,...``.

    :raises HmtSlamError: for a setting without ``=``; names and values are checked by `chosen_settings`.
    """
    world, *settings = str(log).removeprefix(SIMULATION_PREFIX).split(",")
    return world, dict(parse_setting(setting, Settings()) for setting in settings)


def chosen_settings(own: Mapping[str, Value], given: Mapping[str, Value]) -> Settings:
    """The defaults, changed by those of a world, changed by the given settings.

    :raises HmtSlamError: for an unknown name, a value of the wrong type or out of range.
    """
    return apply_changes(Settings(), {**own, **given}, "docs/guides/simulation_settings.md")
