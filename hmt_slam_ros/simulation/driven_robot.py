"""A simulated robot that is driven by velocity commands, and stops before collisions."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.simulation.drive import ACCELERATION, TURN_ACCELERATION, add_odometry_noise
from hmt_slam_ros.simulation.laser import clearance
from hmt_slam_ros.simulation.people import ReactivePeople
from hmt_slam_ros.simulation.scenario import START, Scenario

COMMAND_TIMEOUT = 0.5
"""Duration of a command, s; after that the robot stops."""

_STEP = 0.02
"""Longest step, s."""

_CONTACT_END = 0.05
"""Distance beyond the radius at which a contact ends, m."""

_SCRIPTED_ONLY = ("slips", "sweep", "moved", "carried")
"""Settings of scripted drives alone."""

_ROW = 5
"""Numbers of the history per step: x, y, heading, speed and turn rate."""


class DrivenRobot:
    """A disc that is driven by velocities through the building of a scenario.

    It moves on arcs of constant velocity, one per step, and follows the command with limited accelerations. A step that
    would bring a wall, furniture or a person within its radius is replaced by a stop; turns on the spot are always
    possible. Odometry and laser have the noise of scripted drives: on the path of a scripted drive without people, the
    measurements at the scans are the same.

    :ivar scenario: the building, its people and the laser; its drive is not used.
    :ivar pose: shape (3,), ``world_T_base`` now, m and rad.
    :ivar velocity: m/s and rad/s, now.
    :ivar stamp: now, ns.
    :ivar contacts: number of contacts; one ends 0.05 m away from everything.
    :ivar distance_traveled: m.
    """

    def __init__(self, scenario: Scenario, start: NDArray[np.float64] | None = None) -> None:
        """Place the robot.

        :param start: ``world_T_base`` (3,); None for the start of the scripted drive.
        :raises HmtSlamError: for settings of scripted drives alone.
        """
        settings = scenario.settings
        for name in _SCRIPTED_ONLY:
            if getattr(settings, name):
                raise HmtSlamError(f"a robot that is driven by commands has no setting {name}: set {name}=0")
        if settings.lasers > 1 and settings.readings == 1:
            raise HmtSlamError("a robot that is driven by commands has one laser with readings=1: set readings=2")
        self.scenario = scenario
        self.pose = np.array(scenario.poses[0] if start is None else start, dtype=np.float64)
        self.velocity = (0.0, 0.0)
        self.contacts, self.distance_traveled = 0, 0.0
        period = 1.0 / (settings.rate * settings.readings)
        self._per_reading = math.ceil(period / _STEP)
        self._seconds = period / self._per_reading
        self._walkers = ReactivePeople(scenario.people)
        self._command, self._command_end = (0.0, 0.0), 0
        self._is_in_contact = False
        self._step, self._reading = 0, 0
        self._history = array("d")
        self._draws = random_stream(settings.run_seed, Purpose.WHEELS, 0)
        self._draw = self._draws.standard_normal((1, 3))
        self._pose_at_scan, self._odometry_at_scan, self._odometry = self.pose, np.zeros(3), np.zeros(3)

    @property
    def stamp(self) -> int:
        """Stamp of the last odometry reading, ns."""
        settings = self.scenario.settings
        return START + round(NANOSECONDS / (settings.rate * settings.readings) * self._reading)

    @property
    def people_discs(self) -> NDArray[np.float64]:
        """People now, shape (k, 3), x, y and radius, m."""
        return self._walkers.discs

    def set_velocity(self, speed: float, turn_rate: float) -> None:
        """Command a velocity for `COMMAND_TIMEOUT` seconds, within the limits of the settings.

        :param speed: m/s, backwards below 0.
        :param turn_rate: rad/s, to the left.
        """
        settings = self.scenario.settings
        fastest = math.radians(settings.turn_rate)
        self._command = (_clip(speed, settings.speed), _clip(turn_rate, fastest))
        self._command_end = self._step + round(COMMAND_TIMEOUT / self._seconds)

    def kidnap(self, pose: NDArray[np.float64]) -> None:
        """Move the robot without odometry; it stands afterwards.

        :param pose: ``world_T_base`` (3,).
        """
        self._pose_at_scan = se2.compose(pose, se2.between(self.pose, self._pose_at_scan))
        self.pose, self.velocity, self._is_in_contact = np.array(pose, dtype=np.float64), (0.0, 0.0), False

    def advance(self) -> None:
        """Drive on to the next odometry reading."""
        for _ in range(self._per_reading):
            self._advance_step()
        self._reading += 1
        self._update_odometry()

    def measure(self) -> tuple[Odometry, Scan | None]:
        """Odometry now, with a scan at every ``settings.readings``-th reading; of a second laser halfway between."""
        scenario, stamp = self.scenario, self.stamp
        number, between = divmod(self._reading, scenario.settings.readings)
        reading = Odometry(stamp, self._odometry)
        is_rear = between == scenario.settings.readings // 2 and between > 0
        laser = scenario.rear_laser if is_rear else scenario.laser
        if laser is None or (between and not is_rear):
            return reading, None
        distances = laser.distances(self.pose[None], self.scenario.surfaces, self.people_discs)
        return reading, laser.scan(number, stamp, distances)

    def true_poses(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """``world_T_base`` (n, 3), m and rad, at stamps (n,) from the start until now, ns."""
        past = np.append(np.array(self._history), (*self.pose, 0.0, 0.0)).reshape(-1, _ROW)
        steps = (stamps - START) / NANOSECONDS / self._seconds
        # Stamps are whole ns: one of a reading may be rounded to just before its step.
        whole = np.clip(np.floor(steps + 1e-6), 0, len(past) - 1).astype(np.int64)
        since = self._seconds * np.clip(steps - whole, 0.0, 1.0)
        twists = np.stack((since * past[whole, 3], 0.0 * since, since * past[whole, 4]), axis=1)
        return se2.compose(past[whole, :3], se2.exp(twists))

    def _advance_step(self) -> None:
        """Simulate one step."""
        command = self._command if self._step < self._command_end else (0.0, 0.0)
        seconds = self._seconds
        speed = self.velocity[0] + _clip(command[0] - self.velocity[0], ACCELERATION * seconds)
        turn_rate = self.velocity[1] + _clip(command[1] - self.velocity[1], TURN_ACCELERATION * seconds)
        moved = self._pose_after_step(speed, turn_rate)
        after, before = self._clearances(moved).tolist()
        radius = self.scenario.settings.radius
        if after < min(radius, before):
            speed, moved = 0.0, self._pose_after_step(0.0, turn_rate)
            self.contacts += not self._is_in_contact
            self._is_in_contact = True
        elif before > radius + _CONTACT_END:
            self._is_in_contact = False
        self._history.extend((*self.pose.tolist(), speed, turn_rate))
        self.pose, self.velocity = moved, (speed, turn_rate)
        self.distance_traveled += abs(speed) * seconds
        self._step += 1
        self._walkers.walk(seconds, self.pose)

    def _pose_after_step(self, speed: float, turn_rate: float) -> NDArray[np.float64]:
        """The pose at the end of a step."""
        return se2.compose(self.pose, se2.exp(self._seconds * np.array([speed, 0.0, turn_rate])))

    def _clearances(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of the nearest surface from a pose and from the present one, shape (2,), m."""
        points, discs = np.array([pose[:2], self.pose[:2]]), self.people_discs
        walls = clearance(self.scenario.surfaces.walls, points)
        people = np.hypot(*(discs[None, :, :2] - points[:, None]).transpose(2, 0, 1)) - discs[:, 2]
        return np.minimum(walls, people.min(axis=1, initial=math.inf))

    def _update_odometry(self) -> None:
        """Update odometry at a reading by the true motion since the last scan, and a share of this scan's error.

        As in scripted drives, the error grows linearly from scan to scan. The motion to the next scan is extrapolated.
        """
        settings = self.scenario.settings
        passed = (self._reading - 1) % settings.readings + 1
        true, share = se2.between(self._pose_at_scan, self.pose), passed / settings.readings
        whole = true if share == 1.0 else se2.exp(se2.log(true) / share)
        measured = whole
        if settings.odometry > 0.0:
            measured = add_odometry_noise(whole[None], settings.odometry, self._draw)[0]
        if share < 1.0:
            error = se2.log(se2.between(whole, measured))
            measured = se2.compose(true, se2.exp(share * error))
        self._odometry = se2.compose(self._odometry_at_scan, measured)
        if share == 1.0:
            self._pose_at_scan, self._odometry_at_scan = self.pose, self._odometry
            self._draw = self._draws.standard_normal((1, 3))


class DrivenLog:
    """The measurements of a driven robot as a log; each record is made when it is read.

    :ivar name: of the world.
    :ivar scan_count: scans until its end, 0 for no end.
    :ivar duration: until its end, s, 0 for no end.
    """

    def __init__(self, name: str, robot: DrivenRobot, duration: float = 0.0) -> None:
        """:param duration: s, 0 for no end."""
        self.name, self.duration = name, duration
        self.scan_count = 1 + math.floor(duration * robot.scenario.settings.rate) if duration > 0.0 else 0
        self._robot = robot

    def records(self) -> Iterator[LogRecord]:
        """All measurements from now on with true poses, each scan after the odometry of the same stamp."""
        robot, scans = self._robot, 0
        while True:
            reading, scan = robot.measure()
            yield LogRecord(reading.stamp, reading, robot.pose)
            if scan is not None:
                scans += 1
                yield LogRecord(scan.stamp, scan, robot.pose)
                if scans == self.scan_count:
                    return
            robot.advance()


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
