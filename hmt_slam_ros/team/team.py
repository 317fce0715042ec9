"""The process team: shares the robot's map with the others, and finds where it lies in theirs."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import TeamPlacement, TeamRequest, TeamStatus, TeamUpdate, Verdict
from hmt_slam_ros.team.components import Shift, combine
from hmt_slam_ros.team.join import Meeting, judge
from hmt_slam_ros.team.placement_search import PlacementSearch
from hmt_slam_ros.team.shared_map import ForeignMap, SharedMap

MAX_ROBOTS = 16
"""Other robots of a team: they bound the memory."""

_SHIFT = Shift(2**16, 2**32)
"""Added to the numbers of the second component of a pair, beyond those of any robot's map."""

_STEPS = 8
"""Steps of the search after a keyframe event, of 30 ms each: they bound its work."""


class _PairState:
    """The robot's map and that of another one.

    :ivar is_outdated: whether one of them changed since the search began or went on.
    :ivar meeting: what the search found at its end, None before.
    """

    def __init__(self, configuration: Configuration) -> None:
        self.search = PlacementSearch(configuration)
        self.is_outdated = True
        self.meeting: Meeting | None = None
        self.is_judged = True


class Team:
    """Keeps a PMF over placements for its robot's map and each other one.

    Of two maps, that of the robot whose name comes first is the one in which the other lies. So both robots get the
    same answer. Nothing waits for another robot: what is lost is requested with its next status.
    """

    def __init__(self, configuration: Configuration, robot: str, session: str) -> None:
        """:param robot: its name in the team.

        :param session: of its map: another one for each map from scratch.
        """
        self._configuration, self._robot = configuration, robot
        self._replica = Replica()
        self._shared = SharedMap(robot, session)
        # The own map as the others see it.
        self._own = ForeignMap(session)
        self._others: dict[str, ForeignMap] = {}
        self._pairs: dict[str, _PairState] = {}

    @property
    def status(self) -> TeamStatus:
        """What the others have to know of the map that is shared."""
        return TeamStatus(self._robot, self._shared.session, self._shared.version)

    @property
    def meetings(self) -> dict[str, Meeting]:
        """{other robot: how the maps lie, as far as they were searched}."""
        return {name: pair.meeting for name, pair in self._pairs.items() if pair.meeting is not None}

    def handle(self, message: Message) -> list[Message]:
        """Process a message of the robot's own chain, or of another robot."""
        match message:
            case Keyframe():
                self._replica.add_keyframe(message)
            case Hypotheses():
                self._replica.apply_hypotheses(message)
            case ClosureDecision():
                self._replica.apply_decision(message)
                return [*self._share(), *self.search(_STEPS)]
            case TeamStatus():
                return self._on_status(message)
            case TeamRequest() if (message.owner, message.session) == (self._robot, self._shared.session):
                return [self._shared.update_after(message.version)]
            case TeamUpdate():
                return self._on_update(message)
        return []

    def _share(self) -> list[Message]:
        if not self._shared.take_over(self._replica):
            return []
        while self._own.apply(self._shared.update_after(self._own.version)):
            pass
        for pair in self._pairs.values():
            pair.is_outdated = True
        return [self.status]

    def _on_status(self, status: TeamStatus) -> list[Message]:
        """Request what the robot's map has more than is known here."""
        name = status.robot
        if name == self._robot or (name not in self._others and len(self._others) == MAX_ROBOTS):
            return []
        if name not in self._others or self._others[name].session != status.session:
            self._others[name], self._pairs[name] = ForeignMap(status.session), _PairState(self._configuration)
        known = self._others[name]
        if status.version <= known.version:
            return []
        return [TeamRequest(self._robot, name, known.session, known.version)]

    def _on_update(self, update: TeamUpdate) -> list[Message]:
        known = self._others.get(update.robot)
        if known is None or not known.apply(update):
            return []
        self._pairs[update.robot].is_outdated = True
        if update.is_complete:
            return []
        return [TeamRequest(self._robot, update.robot, known.session, known.version)]

    def search(self, steps: int) -> list[Message]:
        """Go on with the search for some steps; placements where the answer changed."""
        answers: list[Message] = []
        for name, pair in sorted(self._pairs.items()):
            if pair.is_outdated:
                self._update(name, pair)
            while steps > 0 and not pair.is_judged:
                steps -= 1
                if not pair.search.step():
                    answers += self._judge(name, pair)
        return answers

    @property
    def is_searching(self) -> bool:
        """Whether there is something left to search."""
        return any(pair.is_outdated or not pair.is_judged for pair in self._pairs.values())

    def _update(self, name: str, pair: _PairState) -> None:
        """Let the search of a pair go on with the maps of now, if both have areas."""
        pair.is_outdated = False
        own, other = self._own.component(), self._others[name].component()
        if own.scans and other.scans:
            first, second = (own, other) if self._robot < name else (other, own)
            pair.search.update(combine(first, second, _SHIFT))
            pair.is_judged = False

    def _judge(self, name: str, pair: _PairState) -> list[Message]:
        """The answer at the end of a search, where it differs from the one before."""
        before, pair.meeting, pair.is_judged = pair.meeting, judge(pair.search, self._configuration), True
        first, second = sorted((self._robot, name))
        now = _placement(self._robot, first, second, pair.meeting)
        if before is not None and _is_same(now, _placement(self._robot, first, second, before)):
            return []
        return [now]


def _placement(robot: str, first: str, second: str, meeting: Meeting) -> TeamPlacement:
    best = meeting.distribution.best
    probability, pose = (0.0, np.zeros(3)) if best is None else (best.probability, best.pose)
    return TeamPlacement(robot, first, second, meeting.verdict, probability, meeting.distribution.apart, pose)


def _is_same(one: TeamPlacement, other: TeamPlacement) -> bool:
    """Whether nothing is new for people: a probability is one of three digits."""
    if one.verdict is not other.verdict or round(one.probability, 3) != round(other.probability, 3):
        return False
    return one.verdict is Verdict.APART or bool(np.array_equal(one.pose, other.pose))
