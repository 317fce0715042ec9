"""Who hears what: the same for the lock-step run and for the nodes."""

from __future__ import annotations

from typing import Protocol

from hmt_slam_ros.messages.messages import (
    Accepted,
    AreaEvents,
    Arriving,
    Carried,
    EndOfLog,
    Finished,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
    Notice,
    RealTimePose,
    Trail,
)
from hmt_slam_ros.messages.tasks import Errand, Outcome, Steering
from hmt_slam_ros.sensors import Odometry, Scan


class Process(Protocol):
    """A value machine: no thread, clock, file or global random state inside."""

    def handle(self, message: Message) -> list[Message]:
        """Take in one message and return what there is to say."""


class Remembering(Process, Protocol):
    """A process whose memory is a value, from which another one can go on."""

    @property
    def state(self) -> object:
        """All that it knows between two messages, or between two keyframe events."""


HEARD_BY: dict[str, tuple[type, ...]] = {
    "slam": (Scan, Odometry, Carried, Hypotheses, Accepted, EndOfLog),
    "aam": (Keyframe, Hypotheses, Accepted),
    "tsbi": (Arriving, Keyframe, AreaEvents, Accepted),
    "tlca": (Keyframe, Hypotheses),
    "rtl": (Odometry, Arriving, LocalEstimate, Hypotheses, Accepted),
    "explorer": (Errand, Scan, RealTimePose, Keyframe, Hypotheses, Accepted),
    "pilot": (Errand, Odometry, Scan, RealTimePose, Keyframe, Hypotheses, Accepted),
    "robot": (Steering, Outcome),
    "recorder": (Keyframe, Hypotheses, Accepted, Trail, LocalEstimate, Finished, Notice),
}
