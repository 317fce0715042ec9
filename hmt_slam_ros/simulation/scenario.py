"""Scenario of a simulated drive: building, path, odometry and scans."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.building import Building, furniture_walls
from hmt_slam_ros.simulation.drive import (
    Drive,
    draw_slips,
    drive_along,
    noisy_increments,
    odometry_readings,
    path_through,
)
from hmt_slam_ros.simulation.furniture import change_since_first_visit, schedule_furniture
from hmt_slam_ros.simulation.laser import Laser, WallIndex, clearance, wall_index
from hmt_slam_ros.simulation.marks import CeilingMarks
from hmt_slam_ros.simulation.people import draw_people
from hmt_slam_ros.simulation.settings import Settings


@dataclass(frozen=True)
class KidnappedDrive:
    """A drive with a kidnapping: a jump from one time of a drive to another, after which the robot turns to its path.

    :ivar drive: without the kidnapping.
    :ivar kidnap_time: of the jump, s.
    :ivar resume_time: time of the drive at which it goes on, s.
    :ivar heading_offset: rotation of the robot to the left by the kidnapping, rad.
    :ivar turn_duration: of the turn back, s.
    """

    drive: Drive
    kidnap_time: float
    resume_time: float
    heading_offset: float
    turn_duration: float

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return self.kidnap_time + self.turn_duration + self.drive.duration - self.resume_time

    def poses(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """``world_T_base`` (k, 3), m and rad, at times (k,), s."""
        since = seconds - self.kidnap_time
        poses = self.drive.poses(
            np.where(since < 0.0, seconds, self.resume_time + np.maximum(0.0, since - self.turn_duration))
        )
        left = 1.0 - np.clip(since / max(self.turn_duration, 1e-9), 0.0, 1.0)
        poses[:, 2] = se2.wrap(poses[:, 2] + np.where(since < 0.0, 0.0, left * self.heading_offset))
        return poses

    def wheel_poses(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (k, 3) by exact wheels, which do not measure the kidnapping."""
        poses = self.poses(seconds)
        before = self.drive.poses(np.array([self.kidnap_time]))[0]
        jump = se2.compose(before, se2.inverse(self.poses(np.array([self.kidnap_time]))[0]))
        late = seconds >= self.kidnap_time
        poses[late] = se2.compose(jump, poses[late])
        return poses


def kidnapped_drive(drive: Drive, settings: Settings) -> KidnappedDrive | None:
    """The drive with the kidnapping of the settings; None for none."""
    if settings.carried == 0.0:
        return None
    turned = math.radians(settings.turned)
    turning = abs(settings.turned) / settings.turn_rate
    return KidnappedDrive(drive, settings.carried * drive.duration, settings.to * drive.duration, turned, turning)


START = 1_000_000_000_000
"""Stamp of the first scan, ns."""

_SECOND = 1e9
"""ns in a second."""

_CLOSED = 1e-6
"""Largest distance between both ends of a closed route, m."""

_MAX_WAYPOINTS, _MAX_READINGS, _MAX_COMPARISONS = 10_000, 5e6, 2e9
"""Way-points of all laps, odometry readings, and points of the path times walls."""

_STEP = 0.1
"""Time between two points of the path whose clearance is checked, s."""


class Scenario:
    """A robot's drive through a building.

    :ivar settings: of the drive.
    :ivar building: at the start of this visit.
    :ivar drive: of the robot, without a kidnapping.
    :ivar laser: of the robot, the first one.
    :ivar rear_laser: the second one, None where there is one.
    :ivar people: in the building.
    :ivar marks: on its ceiling.
    :ivar walls: of the building with its closed doors, without furniture.
    :ivar stamps: shape (n,), of the odometry readings, ns; every ``settings.readings``-th is a scan's as well.
    :ivar poses: shape (n, 3), ``world_T_base`` at these stamps, m and rad.
    :ivar odometry: shape (n, 3), ``odom_T_base`` by the wheels, m and rad.
    :ivar slips: shape (k - 1, 3), errors by slips between the k scans, m, m, rad.

    :raises HmtSlamError: for a route closer to a wall or furniture than the robot's radius.
    """

    def __init__(self, building: Building, settings: Settings) -> None:
        building = change_since_first_visit(building, settings)
        self.settings, self.building = settings, building
        if len(building.route) * settings.laps > _MAX_WAYPOINTS:
            raise HmtSlamError(
                f"{settings.laps} laps of {len(building.route)} way-points are more than {_MAX_WAYPOINTS}: drive fewer."
            )
        route = driven_route(building.route, settings.laps)
        path = path_through(route, settings.rounding)
        self.drive: Drive = drive_along(path, settings.speed, math.radians(settings.turn_rate))
        _check_effort(self.drive, building, settings)
        self.laser = Laser(settings)
        self.rear_laser = Laser(settings, faces_back=True) if settings.lasers > 1 else None
        self.walls: WallIndex = wall_index(building.walls)
        self._furniture_schedule = schedule_furniture(building, self.walls, self.drive, settings)
        self._check_clearance()
        self._wall_indices = [
            wall_index(np.concatenate((building.walls, furniture_walls(pieces))))
            for pieces in self._furniture_schedule.pieces
        ]
        self.people = draw_people(self.drive, settings.people, settings.run_seed)
        self._kidnapped_drive = kidnapped_drive(self.drive, settings)
        self._executed_drive = self._kidnapped_drive or self.drive
        scans = 1 + math.floor(self._executed_drive.duration * settings.rate)
        ticks = np.arange((scans - 1) * settings.readings + 1)
        period = 1.0 / (settings.rate * settings.readings)
        self.stamps: NDArray[np.int64] = START + np.round(_SECOND * period * ticks).astype(np.int64)
        self.poses = self.true_poses(self.stamps)
        self._wheel_poses = self.poses
        if self._kidnapped_drive is not None:
            self._wheel_poses = self._kidnapped_drive.wheel_poses(self._seconds(self.stamps))
        lap = np.linspace(0.0, self.drive.duration / settings.laps, settings.marks, endpoint=False)
        self.marks = CeilingMarks(self.drive.poses(lap), self.poses[:: settings.readings], self.walls, settings)
        self.slips = self._draw_slips()
        self.odometry = self._odometry()

    @property
    def scan_stamps(self) -> NDArray[np.int64]:
        """Stamps of the scans, shape (k,), ns."""
        return self.stamps[:: self.settings.readings]

    @property
    def surfaces(self) -> WallIndex:
        """Walls, closed doors and furniture at the start."""
        return self._wall_indices[0]

    def true_poses(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """``world_T_base`` (n, 3), m and rad, at any stamps (n,), ns."""
        return self._executed_drive.poses(self._seconds(stamps))

    def scan(self, number: int) -> Scan:
        """A scan by its number, from 0."""
        return self.laser.scan(number, int(self.scan_stamps[number]), self.distances(number))

    def distances(self, number: int) -> NDArray[np.float64]:
        """True distances along the beams of a scan, shape (n,), m; inf for nothing within reach."""
        return self._distances_of(self.laser, int(self.scan_stamps[number]))

    def rear_scan(self, number: int, stamp: int) -> Scan:
        """A scan of the rear laser.

        :param stamp: ns.
        """
        assert self.rear_laser is not None
        return self.rear_laser.scan(number, stamp, self._distances_of(self.rear_laser, stamp))

    def _distances_of(self, laser: Laser, stamp: int) -> NDArray[np.float64]:
        """True distances along the beams of a laser, shape (n,), m; inf for nothing within reach."""
        seconds = float(self._seconds(np.array([stamp]))[0])
        poses = self._executed_drive.poses(seconds + laser.times)
        epoch = int(np.searchsorted(self._furniture_schedule.times, seconds, side="right")) - 1
        return laser.distances(poses, self._wall_indices[epoch], self.people.discs_at(seconds, poses[0]))

    def furniture(self, stamp: int) -> NDArray[np.float64]:
        """The furniture at a stamp, ns, (m, 5) as in `Building`."""
        seconds = self._seconds(np.array([stamp]))[0]
        epoch = int(np.searchsorted(self._furniture_schedule.times, seconds, side="right")) - 1
        return self._furniture_schedule.pieces[epoch]

    def _seconds(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        return (stamps - START) / _SECOND

    def _draw_slips(self) -> NDArray[np.float64]:
        settings = self.settings
        steps = np.diff(self._wheel_poses[:: settings.readings, :2], axis=0)
        random = random_stream(settings.run_seed, Purpose.WHEELS, 1)
        return draw_slips(np.hypot(steps[:, 0], steps[:, 1]), 1.0 / settings.rate, settings.slips, random)

    def _odometry(self) -> NDArray[np.float64]:
        settings = self.settings
        at_scans = self._wheel_poses[:: settings.readings]
        true = se2.between(at_scans[:-1], at_scans[1:])
        random = random_stream(settings.run_seed, Purpose.WHEELS, 0)
        measured = noisy_increments(true, settings.odometry, random) if settings.odometry > 0.0 else true
        return odometry_readings(self._wheel_poses, settings.readings, se2.compose(measured, se2.exp(self.slips)))

    def _check_clearance(self) -> None:
        points = self.drive.poses(np.arange(0.0, self.drive.duration + _STEP, _STEP))[:, :2].copy()
        pieces = self._furniture_schedule.pieces.reshape(-1, 5)
        for name, walls in (("a wall", self.building.walls), ("furniture", furniture_walls(np.unique(pieces, axis=0)))):
            free = clearance(walls, points)
            nearest = int(np.argmin(free))
            if free[nearest] < self.settings.radius:
                x, y = points[nearest]
                raise HmtSlamError(
                    f"the route passes {free[nearest]:.2f} m from {name} at ({x:.1f}, {y:.1f}), and the robot's radius "
                    f"is {self.settings.radius:g} m: move a way-point, or choose a smaller radius or rounding."
                )


def _check_effort(drive: Drive, building: Building, settings: Settings) -> None:
    """Check that a drive can be computed in seconds.

    :raises HmtSlamError: where it is too long.
    """
    readings = drive.duration * settings.rate * settings.readings
    comparisons = drive.duration / _STEP * (len(building.walls) + 4 * len(building.furniture))
    if not (readings <= _MAX_READINGS and comparisons <= _MAX_COMPARISONS):
        raise HmtSlamError(
            f"the drive takes {drive.duration:.0f} s among {len(building.walls)} walls: choose a shorter route, fewer "
            "laps, a larger speed or fewer walls."
        )


def driven_route(route: NDArray[np.float64], laps: int) -> NDArray[np.float64]:
    """The way-points of some laps, shape (n, 2), m; an open route is driven there and back in turn."""
    closed = bool(np.hypot(*(route[-1] - route[0])) < _CLOSED)
    ways = [route if closed or lap % 2 == 0 else route[::-1] for lap in range(laps)]
    return np.concatenate([ways[0], *(way[1:] for way in ways[1:])])
