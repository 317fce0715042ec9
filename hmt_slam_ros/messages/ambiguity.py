"""The message about open hypotheses, and where a look would decide between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_OVERHEAD = 3.0
"""Distance added to each path in the rate of information, m: to turn and to be localized there takes its time, too."""

MIN_INFORMATION = 0.05
"""Share of the entropy below which a look tells nothing worth a drive."""

NOT_DRIVEN = -1
"""Stands for no earlier look on a path."""


@dataclass(frozen=True, eq=False, slots=True)
class Look:
    """A place at which scans would weigh the live hypotheses.

    :ivar area: area of the pose in the map of the most probable hypothesis.
    :ivar pose: shape (3,), ``area_T_base`` there, m and rad.
    :ivar information: expected decrease of the entropy by the scans of the path and of the place, nats.
    :ivar path_length: from the robot, along keyframes, m.
    :ivar previous: number of the look that the path passes last, ``NOT_DRIVEN`` for none; it is always smaller.
    """

    area: int
    pose: NDArray[np.float64]
    information: float
    path_length: float
    previous: int

    @property
    def rate(self) -> float:
        """Expected information per meter, nats / m."""
        return self.information / (self.path_length + _OVERHEAD)


@dataclass(frozen=True, eq=False, slots=True)
class Ambiguity:
    """tlca -> explorer, other programs: the live hypotheses, and where a look would decide between them.

    There is one where hypotheses or the robot's place have changed, while several are probable, and one after that.

    :ivar sequence: the keyframe event.
    :ivar entropy: of the probable hypotheses, nats; 0 where there is one.
    :ivar looks: along the paths around the robot, by growing path length; empty where there is one hypothesis.
    :ivar text: the same for people, in one sentence.
    """

    sequence: int
    entropy: float
    looks: tuple[Look, ...]
    text: str

    @property
    def is_open(self) -> bool:
        """Whether several hypotheses are probable."""
        return self.entropy > 0.0

    def best_look(self, excluded: Sequence[int] = ()) -> int | None:
        """The number of the look with the most information per meter, None where none tells more than a little.

        :param excluded: numbers of looks that are left out.
        """
        least = MIN_INFORMATION * self.entropy
        informative = [n for n, look in enumerate(self.looks) if look.information > least and n not in excluded]
        return max(informative, key=lambda n: (self.looks[n].rate, -n), default=None)

    def path(self, look: int) -> list[int]:
        """The numbers of the looks on the path to one, itself the last."""
        path = [look]
        while (previous := self.looks[path[-1]].previous) != NOT_DRIVEN:
            path.append(previous)
        return path[::-1]
