"""Observations of marks on their way to a keyframe (docs/decisions/0080-marks.md)."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.sensors import MarkObservation
from hmt_slam_ros.sensors.relative_motion import NO_MOTION

_MAX_WAITING = 256
"""Observations that wait for a scan; of more the oldest are dropped."""

_MAX_NAMES = 32
"""Marks of a keyframe; further ones are dropped."""

_MAX_STEPS = 64
"""Scans to whose times observations may refer: those of the last seconds."""

DELAY = 500_000_000
"""Time after its stamp at which an observation counts, ns: until then both runtimes have it, and a slow detector."""

_MAX_AGE = 1_000_000_000
"""Time before these scans from which an observation is too old, ns."""


@dataclass(frozen=True, eq=False, slots=True)
class ScanStep:
    """The tracked motion to a scan.

    :ivar stamp: of the scan, ns.
    :ivar increment: shape (3,), motion since the scan before.
    """

    stamp: int
    increment: Float64


@dataclass(frozen=True, eq=False)
class MarkQueue:
    """Observations of marks since the last keyframe event.

    An observation counts at the pose of the robot at its stamp, between the two scans around it. With the motion since
    then it follows the robot.

    :ivar waiting: those that do not count yet, in the order of arrival.
    :ivar followed: {name: the newest one}, at the pose of the last scan.
    :ivar steps: the last scans, from the first observation on.
    """

    waiting: tuple[MarkObservation, ...] = ()
    followed: Mapping[str, MarkObservation] = field(default_factory=dict)
    steps: tuple[ScanStep, ...] = ()

    def add(self, observation: MarkObservation) -> MarkQueue:
        """The queue with one more observation."""
        return replace(self, waiting=(*self.waiting, observation)[-_MAX_WAITING:])

    def after_scan(self, stamp: int, increment: Float64) -> MarkQueue:
        """The queue after a scan.

        :param increment: motion since the scan before, shape (3,).
        """
        if not (self.waiting or self.followed or self.steps):
            return self
        steps = (*self.steps, ScanStep(stamp, increment))[-_MAX_STEPS:]
        motion = PoseGaussian.from_pose(increment)
        followed = {name: _move(observation, motion) for name, observation in self.followed.items()}
        oldest = steps[0].stamp - _MAX_AGE
        due = [observation for observation in self.waiting if oldest <= observation.stamp <= stamp - DELAY]
        for observation in due:
            if observation.name in followed or len(followed) < _MAX_NAMES:
                moved = _move(observation, PoseGaussian.from_pose(_motion_since(observation.stamp, steps)))
                followed[observation.name] = _newer(moved, followed.get(observation.name))
        return MarkQueue(tuple(one for one in self.waiting if one.stamp > stamp - DELAY), followed, steps)

    def take(self) -> tuple[tuple[MarkObservation, ...], MarkQueue]:
        """The observations at the pose of the last scan, ordered by name, and the queue without them."""
        observations = sorted(self.followed.values(), key=attrgetter("name"))
        return tuple(observations), replace(self, followed={})


def _newer(observation: MarkObservation, other: MarkObservation | None) -> MarkObservation:
    return other if other is not None and other.stamp > observation.stamp else observation


def _move(observation: MarkObservation, motion: PoseGaussian) -> MarkObservation:
    return replace(observation, pose=observation.pose.compose(motion))


def _motion_since(stamp: int, steps: tuple[ScanStep, ...]) -> Float64:
    """The motion from a stamp, ns, to the last of some scans, shape (3,); before the first of them there is none."""
    following = bisect_left(steps, stamp, key=attrgetter("stamp"))
    motion = NO_MOTION.increment
    if following:
        last, step = steps[following - 1], steps[following]
        reached = (stamp - last.stamp) / (step.stamp - last.stamp)
        motion = se2.between(se2.interpolate(motion, step.increment, reached), step.increment)
    for step in steps[following + 1 :]:
        motion = se2.compose(motion, step.increment)
    return motion
