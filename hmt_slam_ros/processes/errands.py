"""What is said to the explorer, and what it says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError

_WITHOUT_PLACE = ("explore", "backtrack", "stop")


@dataclass(frozen=True, slots=True)
class Errand:
    """to explorer: what to do from now on.

    :ivar kind: "explore" until the building is known, "go" to a place, "backtrack" along the robot's own path until
        told otherwise, "stop".
    :ivar place: name of the place to go to, such as "room 3" or "area 12".
    """

    kind: Literal["explore", "go", "backtrack", "stop"]
    place: str = ""


def errand_of(text: str) -> Errand:
    """The errand that is written as its kind and, where it has one, the name of the place.

    :raises HmtSlamError: for anything else.
    """
    kind, _, place = text.strip().partition(" ")
    if kind == "go" and place:
        return Errand("go", place)
    if kind in _WITHOUT_PLACE and not place:
        return Errand(kind)  # type: ignore[arg-type]
    raise HmtSlamError(f"'{text}' is no errand: give one of {', '.join(_WITHOUT_PLACE)}, or go and the name of a place")


@dataclass(frozen=True, slots=True)
class Outcome:
    """explorer -> who gave the errand: how it ended.

    :ivar errand: which.
    :ivar reached: whether all was done that was to be done.
    :ivar text: one sentence.
    """

    errand: Errand
    reached: bool
    text: str


@dataclass(frozen=True, eq=False, slots=True)
class Heading:
    """explorer -> who drives in its stead: where the robot is to go now; one for every new goal.

    :ivar stamp: of the scan with which it was chosen, ns.
    :ivar area: area of the goal.
    :ivar goal: shape (3,), ``area_T_goal``, m and rad.
    """

    stamp: int
    area: int
    goal: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Steering:
    """explorer -> robot: the velocities until the next scan; one for every scan.

    :ivar stamp: of the scan, ns.
    :ivar speed: m/s.
    :ivar turn_rate: rad/s, to the left.
    """

    stamp: int
    speed: float
    turn_rate: float
