"""The messages of explorer and pilot, which drive the robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import is_short_text, shorten

TaskKind = Literal["explore", "go", "navigate", "backtrack", "disambiguate", "localize", "stop"]

EXPLORER_TASKS: tuple[TaskKind, ...] = ("explore", "backtrack", "disambiguate", "stop", "go")
"""Tasks of the explorer that a text gives."""

PILOT_TASKS: tuple[TaskKind, ...] = ("localize", "stop", "go")
"""Tasks of the pilot that a text gives."""


class TaskError(IntEnum):
    """Why a task failed, as the error codes of nav2's planner and controller, which its navigator hands on."""

    NONE = 0
    TRANSFORM_ERROR = 202
    GOAL_OUTSIDE_MAP = 204
    GOAL_OCCUPIED = 206
    TIMEOUT = 207
    NO_VALID_PATH = 208
    FAILED_TO_MAKE_PROGRESS = 105
    UNKNOWN = 200


class GoalError(HmtSlamError):
    """A goal pose that is refused.

    :ivar error: the reason, for the result of an action.
    """

    def __init__(self, sentence: str, error: TaskError) -> None:
        super().__init__(sentence)
        self.error = error


@dataclass(frozen=True, eq=False, slots=True)
class AnchoredPose:
    """A pose to drive to, in the frame of a keyframe beside it: it moves with that keyframe, and so with its area.

    :ivar keyframe: number of the keyframe.
    :ivar pose: shape (3,), ``keyframe_T_goal``, m and rad.
    """

    keyframe: int
    pose: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Task:
    """To explorer or pilot: what to do from now on.

    :ivar kind: "explore" until the building is known, "go" to a place, "navigate" to a pose, "backtrack" along the
        robot's own path until the next task, "disambiguate": to where a look decides between topological hypotheses,
        until one is left, "localize" the robot, "stop".
    :ivar place: name of the place to go to, such as "room 3" or "area 12"; coordinates of a pose, as they were given.
    :ivar goal: the pose to navigate to; None for other kinds.
    """

    kind: TaskKind
    place: str = ""
    goal: AnchoredPose | None = None

    @property
    def text(self) -> str:
        """The task as it is given in words."""
        return f"{self.kind} {self.place}".strip()


def parse_task(text: str, kinds: Sequence[TaskKind]) -> Task:
    """The task of a text: its kind, and for "go" the name of a place.

    :param kinds: tasks that are allowed.
    :raises HmtSlamError: where the text is no allowed task.
    """
    word, _, place = text.strip().partition(" ")
    for kind in kinds:
        if kind == word and bool(place) == (kind == "go") and is_short_text(place):
            return Task(kind, place)
    alone = ", ".join(kind for kind in kinds if kind != "go")
    raise HmtSlamError(f"'{shorten(text)}' is no task: give one of {alone}, or go and the name of a place")


@dataclass(frozen=True, slots=True)
class TaskResult:
    """Explorer or pilot -> sender of the task: how the task ended.

    :ivar task: the task.
    :ivar succeeded: whether the task is complete.
    :ivar reason: the reason of its end, in a few words.
    :ivar error: why it failed; without a meaning where it succeeded.
    """

    task: Task
    succeeded: bool
    reason: str
    error: TaskError = TaskError.UNKNOWN

    @property
    def text(self) -> str:
        """The result as one sentence."""
        return f"{self.task.text}: {self.reason}"


class TaskProgress(NamedTuple):
    """How far a task is.

    :ivar remaining: length of the path to the current goal, m; None without a path.
    :ivar retries: new paths of the task because something was in the way.
    """

    remaining: float | None = None
    retries: int = 0


@dataclass(frozen=True, slots=True)
class TaskFeedback:
    """Explorer or pilot -> other programs: how far its task is, twice a second.

    :ivar stamp: stamp of the newest scan, ns.
    :ivar task: the task, as in its result.
    :ivar elapsed: time since its begin, s.
    :ivar distance_remaining: length of the path to the current goal, m; None without a path.
    :ivar retries: new paths of the task because something was in the way.
    """

    stamp: int
    task: str
    elapsed: float
    distance_remaining: float | None
    retries: int


@dataclass(frozen=True, eq=False, slots=True)
class GoalPose:
    """Explorer or pilot -> navigation, or displays: the current goal; one message for every new goal.

    :ivar stamp: stamp of the newest scan when the goal was chosen, ns.
    :ivar area: area of the goal.
    :ivar pose: shape (3,), ``area_T_goal``, m and rad.
    """

    stamp: int
    area: int
    pose: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """Explorer or pilot -> robot: the velocities until the next scan; one for every scan, of the pilot during a task.

    :ivar stamp: stamp of the scan, ns.
    :ivar speed: forward velocity, m/s.
    :ivar turn_rate: angular velocity, counterclockwise, rad/s.
    """

    stamp: int
    speed: float
    turn_rate: float


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """Pilot -> other programs: the belief over places, Eq. (1) of Tomatis et al. (2003); one for every scan.

    :ivar stamp: stamp of the scan, ns.
    :ivar place: name of the most probable place, the last that the robot passed; None for unmapped ground.
    :ivar heading: direction of travel, "north", "east", "south" or "west"; None for unmapped ground.
    :ivar distance_past_node: distance of the robot beyond the place, m.
    :ivar probability: probability of the place with that direction, or of unmapped ground.
    :ivar entropy: entropy of the belief, Eq. (3), nats.
    :ivar confident: whether the entropy is below `places.max_entropy`.
    :ivar room: name of the room behind the place that holds the metric pose; None where the pose is in no room.
    """

    stamp: int
    place: str | None
    heading: str | None
    distance_past_node: float
    probability: float
    entropy: float
    confident: bool
    room: str | None
