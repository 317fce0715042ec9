"""A robot in a simulated building that goes where it is told to, and stops at what is in its way."""

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
"""So long a command holds, s; after that the robot stops."""

_STEP = 0.02  # s, at most
_SCRIPTED_ONLY = ("slips", "sweep", "moved", "carried")
_OFF = 0.05  # m, from what it touched, where a contact is over
_ROW = 5  # numbers that are kept of a step


class DrivenRobot:
    """A disc that is driven by velocities through the building of a scenario.

    It moves on arcs of constant velocity, each a step long, and its velocity follows the command as fast as
    accelerations allow. A step that would bring it nearer to a wall, to furniture or to a person than its radius is not
    gone, and it stands; it may turn on the spot wherever it is. Odometry and laser are those of the scripted drives,
    with the same noise. One that drives where a scripted drive goes, with nobody about, measures the same at the scans.

    :ivar scenario: the building, its people and the laser; the drive itself is not driven.
    :ivar pose: shape (3,), ``world_T_base`` now, m and rad.
    :ivar velocity: m/s and rad/s, now.
    :ivar stamp: now, ns.
    :ivar contacts: how often it came upon something; before the next time it has to be 0.05 m away from everything.
    :ivar distance_traveled: m.
    """

    def __init__(self, scenario: Scenario, start: NDArray[np.float64] | None = None) -> None:
        """Put it down.

        :param start: ``world_T_base`` (3,), where the scripted drive begins unless given.
        :raises HmtSlamError: for settings that only scripted drives know.
        """
        settings = scenario.settings
        for name in _SCRIPTED_ONLY:
            if getattr(settings, name):
                raise HmtSlamError(f"a robot that is driven by commands knows no {name}: set {name}=0")
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
        """Time of the last odometry reading, ns."""
        settings = self.scenario.settings
        return START + round(NANOSECONDS / (settings.rate * settings.readings) * self._reading)

    @property
    def people_discs(self) -> NDArray[np.float64]:
        """Where people are now, shape (k, 3), x, y and radius, m."""
        return self._walkers.discs

    def set_velocity(self, speed: float, turn_rate: float) -> None:
        """Drive like this from now on, for `COMMAND_TIMEOUT` seconds unless told again; within the limits of the
        settings.

        :param speed: m/s, backwards below 0.
        :param turn_rate: rad/s, to the left.
        """
        settings = self.scenario.settings
        fastest = math.radians(settings.turn_rate)
        self._command = (_clip(speed, settings.speed), _clip(turn_rate, fastest))
        self._command_end = self._step + round(COMMAND_TIMEOUT / self._seconds)

    def kidnap(self, pose: NDArray[np.float64]) -> None:
        """Put it elsewhere, standing; its wheels do not notice.

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
        """What wheels and laser say now; the laser not at every reading."""
        settings, stamp = self.scenario.settings, self.stamp
        number, between = divmod(self._reading, settings.readings)
        reading = Odometry(stamp, self._odometry)
        if between:
            return reading, None
        laser = self.scenario.laser
        distances = laser.distances(self.pose[None], self.scenario.surfaces, self.people_discs)
        return reading, laser.scan(number, stamp, distances)

    def true_poses(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """``world_T_base`` (n, 3), m and rad, at any stamps (n,) from the start until now, ns."""
        past = np.append(np.array(self._history), (*self.pose, 0.0, 0.0)).reshape(-1, _ROW)
        steps = (stamps - START) / NANOSECONDS / self._seconds
        # A stamp is a whole number of ns: one of a reading may be rounded to just before its step.
        whole = np.clip(np.floor(steps + 1e-6), 0, len(past) - 1).astype(np.int64)
        since = self._seconds * np.clip(steps - whole, 0.0, 1.0)
        twists = np.stack((since * past[whole, 3], 0.0 * since, since * past[whole, 4]), axis=1)
        return se2.compose(past[whole, :3], se2.exp(twists))

    def _advance_step(self) -> None:
        """One step."""
        told = self._command if self._step < self._command_end else (0.0, 0.0)
        seconds = self._seconds
        speed = self.velocity[0] + _clip(told[0] - self.velocity[0], ACCELERATION * seconds)
        turn_rate = self.velocity[1] + _clip(told[1] - self.velocity[1], TURN_ACCELERATION * seconds)
        moved = self._pose_after_step(speed, turn_rate)
        free = self._clearances(moved)
        radius, here = self.scenario.settings.radius, float(free[1])
        if free[0] < min(radius, here):
            speed, moved = 0.0, self._pose_after_step(0.0, turn_rate)
            self.contacts += not self._is_in_contact
            self._is_in_contact = True
        elif here > radius + _OFF:
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
        """How far the nearest surface is from its middle there and here, shape (2,), m."""
        places = np.array([pose[:2], self.pose[:2]])
        walls = clearance(self.scenario.surfaces.walls, places)
        people = (
            np.hypot(*(self.people_discs[None, :, :2] - places[:, None]).transpose(2, 0, 1)) - self.people_discs[:, 2]
        )
        return np.minimum(walls, people.min(axis=1, initial=math.inf))

    def _update_odometry(self) -> None:
        """Odometry at a reading: what is true since the last scan, and of the error of this draw the share until now.

        As in the scripted drives the error grows evenly from scan to scan; until the next one is there, the motion is
        taken to go on as since the last.
        """
        settings = self.scenario.settings
        passed = (self._reading - 1) % settings.readings + 1
        true, share = se2.between(self._pose_at_scan, self.pose), passed / settings.readings
        whole = true if share == 1.0 else se2.exp(se2.log(true) / share)
        measured = (
            add_odometry_noise(whole[None], settings.odometry, self._draw)[0] if settings.odometry > 0.0 else whole
        )
        if share < 1.0:
            error = se2.log(se2.between(whole, measured))
            measured = se2.compose(true, se2.exp(share * error))
        self._odometry = se2.compose(self._odometry_at_scan, measured)
        if share == 1.0:
            self._pose_at_scan, self._odometry_at_scan = self.pose, self._odometry
            self._draw = self._draws.standard_normal((1, 3))


class DrivenLog:
    """What a driven robot measures, as a log without an end: each record is made when it is asked for.

    :ivar name: of the world.
    :ivar scan_count: scans until its end, 0 where there is none.
    :ivar duration: seconds until its end, 0 where there is none.
    """

    def __init__(self, name: str, robot: DrivenRobot, duration: float = 0.0) -> None:
        """:param duration: s, 0 for no end."""
        self.name, self.duration = name, duration
        self.scan_count = 1 + math.floor(duration * robot.scenario.settings.rate) if duration > 0.0 else 0
        self._robot = robot

    def records(self) -> Iterator[LogRecord]:
        """All measurements from now on, each scan behind the odometry of the same stamp, with the truth."""
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
