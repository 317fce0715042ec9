"""The process team: shares the robot's map with the others, and finds where it lies in theirs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.messages.team import (
    MAX_ROBOTS,
    MAX_TEAM_AREAS,
    MAX_TEAM_KEYFRAMES,
    JoinedGround,
    TeamPlacement,
    TeamRendezvous,
    TeamRequest,
    TeamStatus,
    TeamUpdate,
    Verdict,
)
from hmt_slam_ros.team.components import Shift, combine
from hmt_slam_ros.team.join import Meeting, judge, was_sure
from hmt_slam_ros.team.join_state import JoinState, next_join
from hmt_slam_ros.team.placement_search import PlacementSearch
from hmt_slam_ros.team.rendezvous import KnownRendezvous
from hmt_slam_ros.team.repetition import RepetitionTest
from hmt_slam_ros.team.search_budget import SearchBudget
from hmt_slam_ros.team.shared_map import ForeignMap, ForeignMapState, SharedMap, SharedMapState
from hmt_slam_ros.team.standing import PERIOD
from hmt_slam_ros.team.team_frame import team_poses

_SHIFT = Shift(MAX_TEAM_AREAS, MAX_TEAM_KEYFRAMES)
"""Added to the numbers of the second component of a pair, beyond those of any robot's map."""

_MIN_GROWTH = 16
"""New keyframes of both robots after which their maps are compared again, unless the robots stand."""

_KEYFRAME_WORK = 20_000
"""Work of a comparison for each keyframe of both maps, beside that of the search: about 30 microseconds."""


@dataclass(frozen=True, eq=False)
class TeamState:
    """The process of a robot in a team; searches are made again.

    :ivar robot: its name in the team.
    :ivar session: of its map: another one for each map from scratch.
    :ivar replica: the robot's map.
    :ivar shared: what it shares of it.
    :ivar others: {other robot: its map}.
    :ivar joins: {other robot: how far the join with it is}.
    :ivar placements: what this robot and others found.
    :ivar rendezvous: of this robot with others.
    """

    robot: str
    session: str
    replica: ReplicaState = field(default_factory=ReplicaState)
    shared: SharedMapState = field(default_factory=SharedMapState)
    others: Mapping[str, ForeignMapState] = field(default_factory=dict)
    joins: Mapping[str, JoinState] = field(default_factory=dict)
    placements: tuple[TeamPlacement, ...] = ()
    rendezvous: tuple[TeamRendezvous, ...] = ()


class _PairState:
    """The robot's map and that of another one.

    :ivar is_outdated: whether one of them changed since the search began or went on.
    :ivar meeting: what the search found at its end, None before.
    :ivar keyframes: number of keyframes of both when it was compared last.
    :ivar turn: number of this comparison among those of all pairs, 0 before the first.
    :ivar join: how far the join is.
    """

    def __init__(self, configuration: Configuration, join: JoinState) -> None:
        self.search = PlacementSearch(configuration)
        self.is_outdated = True
        self.meeting: Meeting | None = None
        self.is_judged = True
        self.keyframes = self.turn = 0
        self.join = join


class _Other:
    """Another robot of the team.

    :ivar map: its map, as far as it is known.
    :ivar newest: the newest version of which it is known that there is one.
    :ivar arrived: version of the map when its last status came.
    :ivar requested: version after which more was requested last, -1 before the first request.
    :ivar expected: version of the own map that it has when all has arrived that was sent.
    :ivar passed_over: version of its last request that was not answered, since that was on its way, -1 without.
    """

    def __init__(self, state: ForeignMapState) -> None:
        self.map = ForeignMap(state)
        self.newest = self.arrived = state.version
        self.expected = 0
        self.requested = self.passed_over = -1


class Team:
    """Keeps a PMF over placements for its robot's map and each other one.

    Of two maps, that of the robot whose name comes first is the one in which the other lies. So both robots get the
    same answer. Nothing waits for another robot: what is lost is requested with its next status.

    :ivar map_poses: {robot: ``team_T_map``, shape (3,)} of the robots that are joined with this one, itself included.
    """

    def __init__(self, configuration: Configuration, state: TeamState) -> None:
        """:param state: to go on from."""
        self._configuration, self._robot = configuration, state.robot
        self._replica = Replica.from_state(state.replica)
        self._shared = SharedMap(state.robot, state.session, state.shared)
        # The own map as the others see it.
        self._own = ForeignMap(ForeignMapState(state.session))
        self._repetition, self._tested_keyframes, self._tested_version = RepetitionTest(configuration), 0, 0
        self._others = {name: _Other(own) for name, own in state.others.items()}
        self._pairs = {name: _PairState(configuration, state.joins.get(name, JoinState())) for name in state.others}
        self._placements = {(each.robot, each.first, each.second): each for each in state.placements}
        self._rendezvous = KnownRendezvous(state.robot, state.rendezvous)
        self._budget, self._turns = SearchBudget(), 0
        self.map_poses = team_poses(state.robot, state.placements)
        self._update_own()

    @property
    def state(self) -> TeamState:
        """The process as a value."""
        return TeamState(
            self._robot,
            self._shared.session,
            self._replica.state,
            self._shared.state,
            {name: other.map.state for name, other in self._others.items()},
            {name: pair.join for name, pair in self._pairs.items()},
            tuple(self._placements.values()),
            self._rendezvous.state,
        )

    @property
    def status(self) -> TeamStatus:
        """What the others have to know of the map that is shared."""
        shared = self._shared
        return TeamStatus(self._robot, shared.session, shared.version, shared.digest, self._own.repetition)

    @property
    def session(self) -> str:
        """Of the map that is shared."""
        return self._shared.session

    @property
    def meetings(self) -> dict[str, Meeting]:
        """{other robot: how the maps lie, as far as they were searched}."""
        return {name: pair.meeting for name, pair in self._pairs.items() if pair.meeting is not None}

    def describe_others(self) -> dict[str, str]:
        """{other robot: what is known of its map, and how it lies}."""
        texts = {}
        for name, known in sorted(self._others.items()):
            meeting = self._pairs[name].meeting
            verdict = "not compared" if meeting is None else meeting.verdict.value
            texts[name] = f"version {known.map.version} of {known.newest}, {verdict}"
        return texts

    def handle(self, message: Message) -> list[Message]:
        """Process a message of the robot's own chain, or of another robot.

        The own status comes while the robot stands: all of its area is shared, and the search goes on.
        """
        match message:
            case Keyframe() | Hypotheses() | ClosureDecision():
                return self._follow_chain(message)
            case TeamStatus():
                return self._on_status(message)
            case TeamRequest():
                return self._on_request(message)
            case TeamUpdate():
                return self._on_update(message)
            case TeamRendezvous():
                return self._on_rendezvous(message)
            case TeamPlacement():
                self._note_placement(message)
        return []

    def _follow_chain(self, message: Keyframe | Hypotheses | ClosureDecision) -> list[Message]:
        """Follow the robot's map; a decision is shared."""
        if isinstance(message, ClosureDecision):
            self._replica.apply_decision(message)
            self._budget.begin_event()
            return [*self._share(), *self._search(self._budget)]
        self._replica.apply_message(message)
        if isinstance(message, Keyframe):
            self._note_clutter(message)
            self._budget.note_stamp(message.scan.stamp)
        return []

    def _note_clutter(self, keyframe: Keyframe) -> None:
        """Remember the usual rate of contradictions of the map of the most probable hypothesis."""
        clutter = {each.hypothesis: each.clutter for each in keyframe.estimates}
        self._shared.clutter = clutter.get(self._replica.best_hypothesis, self._shared.clutter)

    def _share(self, *, is_standing: bool = False) -> list[Message]:
        if not self._shared.take_over(self._replica, is_standing=is_standing):
            return []
        self._update_own()
        for pair in self._pairs.values():
            pair.is_outdated = True
        return [self.status]

    def _update_own(self) -> None:
        while self._own.apply(self._shared.update_after(self._own.version)):
            pass

    def _on_status(self, status: TeamStatus) -> list[Message]:
        """Request what the robot's map has more than is known here.

        While a request is under way, a newer status waits for its answer. Where the very same status comes again, and
        nothing has arrived meanwhile, the answer was lost. The own status shows that the robot stands.
        """
        name = status.robot
        if name == self._robot:
            self._budget.add_time(PERIOD)
            self._budget.begin_event()
            return [*self._share(is_standing=True), *self._search(self._budget, may_wait=False)]
        if name not in self._others and len(self._others) == MAX_ROBOTS:
            return []
        known = self._others.get(name)
        if known is None or known.map.session != status.session or _is_damaged(known.map, status):
            known = self._others[name] = _Other(ForeignMapState(status.session))
            self._pairs[name] = _PairState(self._configuration, JoinState())
            self._forget_placements(name)
        is_again = known.map.repetition == status.repetition
        if not is_again:
            known.map.repetition, self._pairs[name].is_outdated = status.repetition, True
        is_stuck = is_again and (known.newest, known.arrived) == (status.map_version, known.map.version)
        known.newest, known.arrived = max(known.newest, status.map_version), known.map.version
        if known.requested == known.map.version and not is_stuck:
            return []
        return self._request(name, known)

    def _request(self, name: str, known: _Other) -> list[Message]:
        if known.newest <= known.map.version:
            return []
        known.requested = known.map.version
        return [TeamRequest(self._robot, name, known.map.session, known.map.version)]

    def _on_request(self, request: TeamRequest) -> list[Message]:
        """The update that another robot requests, sent to all; nothing where such a one is still on its way to it."""
        if (request.owner, request.session) != (self._robot, self._shared.session) or request.robot == self._robot:
            return []
        requester = self._others.get(request.robot)
        if requester is not None and requester.passed_over != request.after < requester.expected:
            requester.passed_over = request.after
            return []
        if requester is not None:
            requester.expected = request.after
        update = self._shared.update_after(request.after)
        for other in self._others.values():
            if update.after <= other.expected:
                other.expected = max(other.expected, update.until)
        return [update]

    def _on_update(self, update: TeamUpdate) -> list[Message]:
        known = self._others.get(update.robot)
        if known is None or not known.map.apply(update):
            return []
        known.newest = max(known.newest, update.until)
        self._pairs[update.robot].is_outdated = True
        requests = self._request(update.robot, known) if known.map.version < known.newest else []
        return [*requests, *self._new_ground(update.robot)]

    def _note_placement(self, placement: TeamPlacement) -> None:
        """Remember what a robot of the team found."""
        names = {placement.robot, placement.first, placement.second}
        if names <= {self._robot, *self._others}:
            self._placements[placement.robot, placement.first, placement.second] = placement
            self.map_poses = team_poses(self._robot, self._placements.values())

    def _on_rendezvous(self, rendezvous: TeamRendezvous) -> list[Message]:
        """Keep a rendezvous for the next comparison; the others get what this robot observed."""
        other = self._rendezvous.add(rendezvous)
        if other in self._pairs:
            self._pairs[other].is_outdated = True
        return [rendezvous] if other and rendezvous.robot == self._robot else []

    def _forget_placements(self, name: str) -> None:
        """Forget how a map lay that is no more."""
        self._placements = {key: each for key, each in self._placements.items() if name not in key}
        self.map_poses = team_poses(self._robot, self._placements.values())

    def search(self, work: int, *, may_wait: bool = True) -> list[Message]:
        """Go on with the search until so much work is done; placements where the answer changed.

        :param may_wait: whether a search may wait until the maps have grown some more.
        """
        return self._search(SearchBudget(work), may_wait=may_wait)

    def _search(self, budget: SearchBudget, *, may_wait: bool = True) -> list[Message]:
        """The same within a budget. The pair that was compared the longest ago comes first."""
        growth = _MIN_GROWTH if may_wait else 0
        answers = self._test_repetition(budget, growth)
        for name, pair in sorted(self._pairs.items(), key=lambda item: (item[1].turn, item[0])):
            # A search ends with the maps with which it began: maps that grow would put its end off again and again.
            if pair.is_outdated and pair.is_judged and budget.is_left:
                self._update(name, pair, growth, budget)
            while budget.is_left and not pair.is_judged:
                done = pair.search.step()
                if done is None:
                    before = pair.search.comparison_work
                    answers += self._judge(name, pair)
                    done = pair.search.comparison_work - before
                budget.spend(done)
        return answers

    def _test_repetition(self, budget: SearchBudget, growth: int) -> list[Message]:
        """Go on with the search of the own map in itself, if there is another robot, and it has grown enough.

        :returns: the status where the evidence is new.
        """
        own, test = self._own, self._repetition
        grown = own.scan_count - self._tested_keyframes
        if test.is_done and self._is_untested and not 0 <= grown < growth and budget.is_left:
            self._tested_version, self._tested_keyframes = own.version, own.scan_count
            if own.scan_count:
                test.update(own.component(), _SHIFT)
                budget.spend(_KEYFRAME_WORK * 2 * own.scan_count)
        while budget.is_left and not test.is_done:
            budget.spend(test.step())
        if not test.is_done or test.repetition == own.repetition:
            return []
        own.repetition = test.repetition
        for pair in self._pairs.values():
            pair.is_outdated = True
        return [self.status]

    @property
    def _is_untested(self) -> bool:
        return bool(self._others) and self._tested_version != self._own.version

    @property
    def is_searching(self) -> bool:
        """Whether there is something left to search."""
        if self._is_untested or not self._repetition.is_done:
            return True
        return any(pair.is_outdated or not pair.is_judged for pair in self._pairs.values())

    def _update(self, name: str, pair: _PairState, growth: int, budget: SearchBudget) -> None:
        """Let the search of a pair go on with the maps of now, if both have areas, and have grown enough."""
        keyframes = self._own.scan_count + self._others[name].map.scan_count
        # Keyframes are pruned, too.
        if 0 <= keyframes - pair.keyframes < growth:
            return
        pair.is_outdated, pair.keyframes = False, keyframes
        own, other = self._own.component(), self._others[name].map.component()
        if own.scans and other.scans:
            first, second = (own, other) if self._robot < name else (other, own)
            pair.search.update(combine(first, second, _SHIFT), self._rendezvous.with_robot(name))
            pair.is_judged = False
            budget.spend(_KEYFRAME_WORK * keyframes)

    def _judge(self, name: str, pair: _PairState) -> list[Message]:
        """The answer at the end of a search, where it differs from the one before."""
        meeting = pair.meeting = judge(pair.search, self._configuration)
        pair.is_judged = True
        self._turns += 1
        pair.turn = self._turns
        first, second = sorted((self._robot, name))
        before, holds = pair.join, pair.join.holds(meeting)
        has_lasted = holds or was_sure(pair.search, meeting, self._configuration)
        is_first = self._robot == first
        pair.join = next_join(before, meeting, self._configuration, is_first=is_first, has_lasted=has_lasted)
        withdrawn = self._withdraw_ground(name) if before.is_joined and not holds else []
        ground = [*withdrawn, *self._new_ground(name)]
        now = _placement(self._robot, first, second, meeting)
        if meeting.verdict in (Verdict.JOINED, Verdict.OPEN):
            now = replace(now, verdict=Verdict.JOINED if pair.join.is_joined else Verdict.OPEN)
        earlier = self._placements.get((self._robot, first, second))
        if earlier is not None and _is_same(now, earlier):
            return ground
        self._note_placement(now)
        return [now, *ground]

    def _new_ground(self, name: str) -> list[Message]:
        """What the map lacks of the ground of a robot that is joined with this one."""
        other, pair = self._others[name].map, self._pairs[name]
        if not (self._configuration.team.uses_ground and pair.join.is_joined):
            return []
        scans, areas = other.items_after(pair.join.sent_version)
        if not areas:
            return []
        pair.join = replace(pair.join, sent_version=other.version)
        return [JoinedGround(name, other.session, scans, areas, pair.join.joining_arcs)]

    def _withdraw_ground(self, name: str) -> list[Message]:
        """That a robot is no longer joined with this one."""
        ground = JoinedGround(name, self._others[name].map.session, (), (), ())
        return [ground] if self._configuration.team.uses_ground else []


def _is_damaged(known: ForeignMap, status: TeamStatus) -> bool:
    """Whether a map that is known up to a version differs from the robot's own at that version."""
    return known.version == status.map_version and known.digest != status.digest


def _placement(robot: str, first: str, second: str, meeting: Meeting) -> TeamPlacement:
    best = meeting.distribution.best
    probability, pose = (0.0, np.zeros(3)) if best is None else (best.probability, best.pose)
    return TeamPlacement(robot, first, second, meeting.verdict, probability, meeting.distribution.apart, pose)


def _is_same(one: TeamPlacement, other: TeamPlacement) -> bool:
    """Whether nothing is new for people: a probability is one of three digits."""
    if one.verdict is not other.verdict or round(one.probability, 3) != round(other.probability, 3):
        return False
    return one.verdict is Verdict.APART or bool(np.array_equal(one.pose, other.pose))
