"""What is said to explorer and pilot, who drive the robot, and what they say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError

TaskKind = Literal["explore", "go", "backtrack", "localize", "stop"]

EXPLORER_TASKS: tuple[TaskKind, ...] = ("explore", "backtrack", "stop", "go")
"""Tasks of the explorer."""

PILOT_TASKS: tuple[TaskKind, ...] = ("localize", "stop", "go")
"""Tasks of the pilot."""


@dataclass(frozen=True, slots=True)
class Task:
    """to explorer or pilot: what to do from now on.

    :ivar kind: "explore" until the building is known, "go" to a place, "backtrack" along the robot's own path until
        told otherwise, "localize" the robot, "stop".
    :ivar place: name of the place to go to, such as "room 3" or "area 12".
    """

    kind: TaskKind
    place: str = ""


def parse_task(text: str, kinds: Sequence[TaskKind]) -> Task:
    """The task that is written as its kind and, where it has one, the name of the place.

    :param kinds: those that there are.
    :raises HmtSlamError: for anything else.
    """
    word, _, place = text.strip().partition(" ")
    for kind in kinds:
        if kind == word and bool(place) == (kind == "go"):
            return Task(kind, place)
    alone = ", ".join(kind for kind in kinds if kind != "go")
    raise HmtSlamError(f"'{text}' is no task: give one of {alone}, or go and the name of a place")


@dataclass(frozen=True, slots=True)
class TaskResult:
    """explorer or pilot -> who gave the task: how it ended.

    :ivar task: which.
    :ivar succeeded: whether all was done that was to be done.
    :ivar reason: in a few words.
    """

    task: Task
    succeeded: bool
    reason: str

    @property
    def text(self) -> str:
        """One sentence."""
        return f"{self.task.kind} {self.task.place}".strip() + f": {self.reason}"


@dataclass(frozen=True, eq=False, slots=True)
class GoalPose:
    """explorer or pilot -> who drives in its stead, or looks on: where the robot is to go now; one for every new goal.

    :ivar stamp: of the newest scan when it was chosen, ns.
    :ivar area: area of the goal.
    :ivar pose: shape (3,), ``area_T_goal``, m and rad.
    """

    stamp: int
    area: int
    pose: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class VelocityCommand:
    """explorer or pilot -> robot: the velocities until the next scan; one for every scan, of the pilot amid a task.

    :ivar stamp: of the scan, ns.
    :ivar speed: m/s.
    :ivar turn_rate: rad/s, to the left.
    """

    stamp: int
    speed: float
    turn_rate: float


@dataclass(frozen=True, slots=True)
class PlaceEstimate:
    """pilot -> people and other programs: the belief over places, Eq. (1) of Tomatis et al. (2003); one for every scan.

    :ivar stamp: of the scan, ns.
    :ivar place: name of the most probable place, at which the robot was last, None for unknown ground.
    :ivar heading: the direction in which it looks, "north", "east", "south" or "west", None likewise.
    :ivar distance_past_node: how far it is beyond the place, m.
    :ivar probability: of the place with the direction of travel, or of unknown ground.
    :ivar entropy: of the belief, Eq. (3), nats.
    :ivar confident: whether that is below `places.max_entropy`.
    :ivar room: name of the room behind the place in which the metric filter has it, None where that is not asked.
    """

    stamp: int
    place: str | None
    heading: str | None
    distance_past_node: float
    probability: float
    entropy: float
    confident: bool
    room: str | None
