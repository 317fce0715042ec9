"""Who hears what: the same for the lock-step run and for the nodes."""

from __future__ import annotations

from typing import Protocol

from hmt_slam_ros.messages.messages import (
    AreaEvents,
    ClosureDecision,
    EndOfLog,
    EndOfRun,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
    Notice,
    PoseReset,
    RealTimePose,
    ScanPoses,
    TrackingReset,
)
from hmt_slam_ros.messages.tasks import Task, TaskResult, VelocityCommand
from hmt_slam_ros.sensors import Odometry, Scan


class Process(Protocol):
    """A value machine: no thread, clock, file or global random state inside."""

    def handle(self, message: Message) -> list[Message]:
        """Take in one message and return what there is to say."""


class Checkpointable(Process, Protocol):
    """A process whose memory is a value, from which another one can go on."""

    @property
    def state(self) -> object:
        """All that it knows between two messages, or between two keyframe events."""


SUBSCRIPTIONS: dict[str, tuple[type, ...]] = {
    "slam": (Scan, Odometry, PoseReset, Hypotheses, ClosureDecision, EndOfLog),
    "aam": (Keyframe, Hypotheses, ClosureDecision),
    "tsbi": (TrackingReset, Keyframe, AreaEvents, ClosureDecision),
    "tlca": (Keyframe, Hypotheses),
    "rtl": (Odometry, TrackingReset, LocalEstimate, Hypotheses, ClosureDecision),
    "explorer": (Task, Scan, RealTimePose, Keyframe, Hypotheses, ClosureDecision),
    "pilot": (Task, Odometry, Scan, RealTimePose, Keyframe, Hypotheses, ClosureDecision),
    "robot": (VelocityCommand, TaskResult),
    "recorder": (Keyframe, Hypotheses, ClosureDecision, ScanPoses, LocalEstimate, EndOfRun, Notice),
}
