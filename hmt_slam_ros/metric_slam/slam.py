"""Metric SLAM: localisation and mapping within the current area, for every live hypothesis.

Section V of Blanco et al. 2008; the second step of Eq. (6). Scans wait in a queue while the topological processes
answer a keyframe event.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.patch_pool import PatchState
from hmt_slam_ros.hybrid_map.shortest_path import reachable
from hmt_slam_ros.hybrid_map.surroundings import Nearness, areas_around
from hmt_slam_ros.lifelong.change_detection import AROUND, CERTAIN, Look, News, news_of, outdated
from hmt_slam_ros.messages.map_changes import Place
from hmt_slam_ros.messages.messages import (
    Accepted,
    Arriving,
    Carried,
    EndOfLog,
    Finished,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
    Notice,
)
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica, ReplicaState
from hmt_slam_ros.metric_slam.live_hypothesis import LiveHypothesis, LiveState
from hmt_slam_ros.metric_slam.odometry_monitor import OdometryWatch, OdometryWatchState
from hmt_slam_ros.metric_slam.scan_queue import ScanQueue, ScanQueueState
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.deskew import deskewed
from hmt_slam_ros.sensors.motion_model import MotionModel, MotionState, Prediction
from hmt_slam_ros.submap.local_filter import FilterFactory, PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, Sighting
from hmt_slam_ros.submap.particle_filter import ParticleFilters


@dataclass(frozen=True, eq=False)
class SlamState:
    """Metric SLAM between two messages, at first before the first scan.

    :ivar replica: the maps of the live hypotheses.
    :ivar motion: what is known of the motion between scans.
    :ivar watch: what was heard of odometry and scans.
    :ivar queue: scans that wait for odometry, or for the answer to a keyframe event.
    :ivar patches: of the grids of all particles, None where there is none.
    :ivar live: {hypothesis: its filter and what is remembered beside it}.
    :ivar events: keyframe events.
    :ivar waiting: whether the answer to the last one is due.
    :ivar travelled: path length since the start, m.
    :ivar scans: scans that were given a pose.
    :ivar dropped: scans that were not.
    :ivar first_of_trail: number of the first scan that no trail was told of.
    :ivar arriving: whether nothing tells how the robot comes to where the next scan is from.
    :ivar lost: whether the robot may be anywhere in the map, under all hypotheses.
    :ivar place: where it is at the next scan as somebody says, None where nobody did.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    motion: MotionState = field(default_factory=MotionState)
    watch: OdometryWatchState = field(default_factory=OdometryWatchState)
    queue: ScanQueueState = field(default_factory=ScanQueueState)
    patches: PatchState | None = None
    live: Mapping[int, LiveState] = field(default_factory=dict)
    events: int = 0
    waiting: bool = False
    travelled: float = 0.0
    scans: int = 0
    dropped: int = 0
    first_of_trail: int = 0
    arriving: bool = True
    lost: bool = False
    place: Place | None = None


class MetricSlam:
    """The metric SLAM process.

    Consumes Scan, Odometry, Carried, Hypotheses, Accepted, EndOfLog; produces Arriving, Keyframe, Trail, LocalEstimate,
    Notice, Finished.

    :ivar mode: what is done with known ground; but a robot that may be anywhere maps what is around it.
    """

    def __init__(
        self,
        configuration: Configuration,
        state: SlamState | None = None,
        filters: Callable[[LocalMapping], FilterFactory] = ParticleFilters,
    ) -> None:
        """:param state: to go on from.

        :param filters: what makes the filters of areas.
        """
        state = state or SlamState()
        self._configuration = configuration
        self.mode = configuration.mode
        self._mapping = LocalMapping(configuration)
        self._filters = filters(self._mapping)
        self._in_sight = Nearness(CERTAIN, AROUND)
        self._replica = Replica.of(state.replica)
        self._motion = MotionModel(configuration.motion, state.motion)
        self._watch = OdometryWatch(state.watch)
        self._queue = ScanQueue(configuration.filter.patience, self._motion.odometry, state.queue)
        self._live = self._live_in(state)
        self._events, self._arriving = state.events, state.arriving
        self._lost, self._place = state.lost, state.place
        self._waiting = state.waiting
        self._travelled = state.travelled
        self._scans, self._dropped = state.scans, state.dropped
        self._first_of_trail = state.first_of_trail
        self._ended = False

    def _live_in(self, state: SlamState) -> dict[int, LiveHypothesis]:
        if not state.live:
            first = self._filters.new(FIRST_HYPOTHESIS, FIRST_AREA)
            return {FIRST_HYPOTHESIS: LiveHypothesis(first, self._configuration.filter)}
        grids = [live.grid.tables for live in state.live.values() if live.grid is not None]
        if state.patches is not None and grids:
            self._mapping.pool.load(state.patches, np.concatenate(grids))
        settings = self._configuration.filter
        return {name: LiveHypothesis.of(self._filters, settings, live) for name, live in state.live.items()}

    @property
    def state(self) -> SlamState:
        """All that metric SLAM knows, as a value."""
        live, patches = self._without_pool()
        return SlamState(
            self._replica.state,
            self._motion.state,
            self._watch.state,
            self._queue.state,
            patches,
            live,
            self._events,
            self._waiting,
            self._travelled,
            self._scans,
            self._dropped,
            self._first_of_trail,
            self._arriving,
            self._lost,
            self._place,
        )

    def _without_pool(self) -> tuple[dict[int, LiveState], PatchState | None]:
        """The live hypotheses, with the patches of their grids, whose numbers are those in the tables."""
        states = {name: live.state() for name, live in self._live.items()}
        grids = {name: state.grid for name, state in states.items() if state.grid is not None}
        if not grids:
            return states, None
        patches, tables = self._mapping.pool.state(np.concatenate([grid.tables for grid in grids.values()]))
        for (name, grid), own in zip(grids.items(), np.split(tables, len(grids)), strict=True):
            states[name] = replace(states[name], grid=replace(grid, tables=own))
        return states, patches

    @property
    def mapping(self) -> bool:
        """Whether the map may change."""
        return self.mode != "localization"

    @property
    def replica(self) -> Replica:
        """The maps of the live hypotheses."""
        return self._replica

    @property
    def waiting(self) -> bool:
        """Whether the answer to a keyframe event is due."""
        return self._waiting

    @property
    def events(self) -> int:
        """Keyframe events so far."""
        return self._events

    @property
    def scans(self) -> int:
        """Scans that were given a pose."""
        return self._scans

    @property
    def lost(self) -> bool:
        """Whether the robot may be anywhere in the map."""
        return self._lost

    @property
    def waiting_scans(self) -> int:
        """Scans in the queue."""
        return len(self._queue)

    @property
    def map_bytes(self) -> int:
        """What the maps of all particles took at most, bytes."""
        return self._mapping.pool.peak_bytes

    @property
    def particles(self) -> tuple[int, NDArray[np.float64]]:
        """Area of the most probable hypothesis and the poses of its particles, ``area_T_base``, shape (M, 3)."""
        return self._best.filter.area, self._best.filter.poses

    @property
    def _best(self) -> LiveHypothesis:
        return self._live[self._replica.best]

    def handle(self, message: Message) -> list[Message]:
        """Take in one message, work off what can be worked off, return what there is to say."""
        if isinstance(message, Odometry):
            self._queue.hear(message)
        elif isinstance(message, Scan):
            return self._queue.receive(message) + self._work()
        elif isinstance(message, Hypotheses):
            self._change_hypotheses(message)
        elif isinstance(message, Accepted):
            self._accept(message)
        elif isinstance(message, Carried):
            self._place = message.place
            return [] if self._lost and self._place is not None else self._arrive()
        elif isinstance(message, EndOfLog):
            self._ended = True
        return self._work()

    def _work(self) -> list[Message]:
        said: list[Message] = []
        while not self._waiting and self._queue.ready(ended=self._ended):
            said += self._process(self._queue.take())
        if self._ended and not self._queue and not self._waiting:
            said += self._finish()
        return said

    def _arrive(self) -> list[Message]:
        """Forget how the robot came here; scans that still wait were taken before and are passed over."""
        self._motion, self._watch = MotionModel(self._configuration.motion), OdometryWatch()
        self._dropped += len(self._queue)
        self._queue = self._queue.emptied(self._motion.odometry)
        self._arriving = True
        return [Arriving(self._events, self._scans)]

    def _process(self, scan: Scan) -> list[Message]:
        prediction = self._motion.predict(scan.stamp)
        sighting = Sighting(self._mapping, deskewed(scan, self._motion.odometry, self._configuration.rtl))
        said: list[Message] = []
        if self._arriving:
            self._put_down(prediction)
        else:
            said += self._track(sighting, prediction)
        if self._arriving or self._place is not None or self._best.event_due(sighting):
            said += self._keyframe_event(sighting)
        for live in self._live.values():
            live.note_scan(scan.stamp)
        self._scans += 1
        return [*said, self._estimate(scan.stamp)]

    def _put_down(self, prediction: Prediction) -> None:
        """Draw every hypothesis where the motion since the last scan leads.

        Of a robot that was carried none is known; one that takes itself for lost may be wrong about that.
        """
        for live in self._live.values():
            at = se2.compose(live.filter.pose, prediction.together.increment)
            live.filter.stand(PoseGaussian.exactly(at))

    def _track(self, sighting: Sighting, prediction: Prediction) -> list[Message]:
        """Move every hypothesis on to the scan, and learn from what the best one found."""
        tracked = {hypothesis: live.filter.track(sighting, prediction) for hypothesis, live in self._live.items()}
        best = tracked[self._replica.best]
        self._motion.observe(best.moved, best.information, best.contradicted)
        self._travelled += math.hypot(best.moved[0], best.moved[1])
        return self._tell(self._watch.hear(sighting.scan.stamp, prediction.odometry, best))

    @staticmethod
    def _tell(text: str | None) -> list[Message]:
        return [] if text is None else [Notice("slam", text)]

    def _keyframe_event(self, sighting: Sighting) -> list[Message]:
        sequence, scan = self._events, sighting.scan
        trails: list[Message] = self._trails()
        storing = self.mapping or self._lost
        news: list[tuple[News, float]] = []
        leaves = tuple(
            live.event(
                sequence,
                sighting,
                arriving=self._arriving,
                storing=storing,
                wanted=partial(self._is_news, live, scan, news) if self._lifelong else None,
            )
            for live in self._live.values()
        )
        self._motion.keyframe(self._best.moved, self._best.information)
        carried, place = self._arriving and sequence > 0, self._place
        keyframe = Keyframe(sequence, scan, self._travelled, leaves, carried, place, self.mapping, outdated(news))
        self._replica.add(keyframe)
        self._events += 1
        # With the scan of its arrival the robot is put where somebody says, with the next one it is looked for there,
        # even if it stands still.
        self._waiting, self._arriving, self._place = True, False, place if self._arriving else None
        return [*trails, keyframe, *self._tell(self._watch.judge(self._motion.noise))]

    @property
    def _lifelong(self) -> bool:
        """Whether the map is changed only where the world is new or has changed."""
        return self.mode == "lifelong" and not self._lost

    def _is_news(self, live: LiveHypothesis, scan: Scan, found: list[tuple[News, float]]) -> bool:
        """Whether a scan shows what a hypothesis's map does not hold; what was found is added."""
        own, hybrid_map = live.filter, self._replica.maps[live.filter.hypothesis]
        placed = zip(own.keyframes, own.keyframe_areas, own.leading_keyframe_poses(), strict=True)
        known = [PlacedKeyframe(k, area, self._replica.scans[k], pose) for k, area, pose in placed]
        # A laser sees farther than the local map reaches.
        around = areas_around(hybrid_map, own.area, self._in_sight, own.keyframe_areas)
        beyond = self._content(own.hypothesis, {area: belief.mean for area, belief in around.items()})
        news = news_of(Look(scan, own.pose), live.looks, [*known, *beyond])
        live.note_look(scan)
        found.append((news, self._replica.probabilities[own.hypothesis]))
        return news.new or news.changed

    def _trails(self) -> list[Message]:
        """The trails since the last event, of every hypothesis."""
        said: list[Message] = [trail for live in self._live.values() for trail in live.take_trail(self._first_of_trail)]
        self._first_of_trail = self._scans
        return said

    def _estimate(self, stamp: int) -> LocalEstimate:
        best = self._best
        odometry = self._motion.odometry_pose
        return LocalEstimate(stamp, self._scans - 1, best.filter.area, best.belief(), odometry, self._dropped)

    def _change_hypotheses(self, hypotheses: Hypotheses) -> None:
        """Branch, re-base and drop filters as TSBI decided."""
        for live in self._live.values():
            live.forget({one.keyframe for one in hypotheses.forgotten})
        for leaf in hypotheses.leaves:
            if leaf.merged is not None:
                keyframes = self._replica.maps[leaf.parent].keyframes(leaf.merged.area)
                self._live[leaf.parent].merge(leaf.merged, keyframes)
        self._replica.apply(hypotheses)
        self._lost = all(leaf.lost for leaf in hypotheses.leaves)
        self._arriving |= all(leaf.arriving for leaf in hypotheses.leaves)
        children = {}
        for leaf in hypotheses.leaves:
            parent = self._live[leaf.parent]
            live = parent if leaf.hypothesis == leaf.parent else parent.branch(leaf.hypothesis)
            if leaf.local:
                areas = {local.area: local.pose for local in leaf.local}
                live.change_area(leaf, self._content(leaf.hypothesis, areas), self._filters)
            children[leaf.hypothesis] = live
        for live in children.values() if hypotheses.outdated else ():
            if live.filter.keyframes[-1:] == [hypotheses.sequence]:
                # What stands there now would have to be seen many times to outweigh what was seen before.
                live.reload(self._surroundings(live))
        self._replace_live(children)

    def _accept(self, accepted: Accepted) -> None:
        self._replica.accept(accepted)
        if accepted.hypothesis is not None:
            live = self._live[accepted.hypothesis]
            self._replace_live({accepted.hypothesis: live})
            if accepted.relabelled:
                live.reload(self._surroundings(live))
        self._waiting = False

    def _replace_live(self, live: dict[int, LiveHypothesis]) -> None:
        for hypothesis, old in self._live.items():
            if live.get(hypothesis) is not old:
                old.filter.release()
        self._live = live

    def _content(self, hypothesis: int, areas: Mapping[int, NDArray[np.float64]]) -> list[PlacedKeyframe]:
        """The keyframes of the areas that the local map has to hold, in the frame of the robot's area.

        :param areas: {area: ``robot_area_T_area``, shape (3,)}.
        """
        hybrid_map = self._replica.maps[hypothesis]
        return [
            PlacedKeyframe(keyframe, area, self._replica.scans[keyframe], se2.compose(frame, pose))
            for area, frame in areas.items()
            for keyframe, pose in hybrid_map.keyframes(area).items()
        ]

    def _surroundings(self, live: LiveHypothesis) -> list[PlacedKeyframe]:
        """The local map's areas as they are now known."""
        held = dict.fromkeys(live.filter.keyframe_areas)
        reached = reachable(self._replica.maps[live.filter.hypothesis], live.filter.area, until=held)
        return self._content(live.filter.hypothesis, {area: reached[area].mean for area in held if area in reached})

    def _finish(self) -> list[Message]:
        self._ended = False
        finished = Finished(self._scans + self._dropped, self._scans, self._dropped)
        return [*self._trails(), *self._tell(self._watch.close()), finished]
