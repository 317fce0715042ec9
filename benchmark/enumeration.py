"""All topologies of a small world, weighed one by one: what a PMF of TSBI ought to be.

Plainly enumerated: at a cut every known area is a candidate, however far it lies by the arcs, with every way in which
the keyframes fit into it; no hypothesis is reduced away. Shared with TSBI are the model, which is the transition model
and the likelihoods, and what a choice does to the map.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmark.scripted import Robot
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import reachable
from hmt_slam_ros.hybrid_map.surroundings import Transition, areas_around
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.admission import Candidate, Query
from hmt_slam_ros.topological_inference.branching import Branching, Child, Parent
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch, Comparison
from hmt_slam_ros.topological_inference.hypothesis_tree import LeafNotes

Path = tuple[int, ...]
"""The area of every visit, named by the visit in which it was entered first."""

NEGLIGIBLE = 1e-9
"""Probability below which a topology is not followed any further."""

_EVERYWHERE = 1.0 - 1e-9  # share of the prior in which poses are searched for


class _EverywhereSearch(ClosureSearch):
    """Compares with all areas, by the same likelihoods."""

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        super().__init__(configuration, scans)
        self._settings = replace(self._settings, gate=gate(_EVERYWHERE), margin=25.0, max_modes=1000)

    def compare(
        self,
        hybrid_map: HybridMap,
        area: int,
        query: Query,
        compared: Mapping[int, Collection[int]],
        excluded: Collection[int],
        most: int,
        only: Collection[int] = (),
    ) -> Comparison:
        """As in the model, over all areas, however many they are."""
        del most, only
        options = self._options
        fresh = {
            known: {k: pose for k, pose in query.poses.items() if k not in compared.get(known, ())}
            for known in hybrid_map.area_ids()
            if known not in excluded
        }
        beliefs = reachable(hybrid_map, area)
        asked = [known for known, own in fresh.items() if 2 * len(own) >= len(query.poses)]
        priors = {known: self.admission.prior(beliefs[known], query) for known in asked}
        candidates = {known: Candidate(prior, fresh[known], 1.0) for known, prior in priors.items()}
        places = {known: self._views.place(hybrid_map, known, excluded) for known in candidates}
        entries = {known: self._entry(place, candidates[known]) for known, place in places.items()}
        shares = {known: found.share for known, found in entries.items() if found.share}
        modes = {known: self._modes(places[known], candidates[known]) for known in shares}
        total = sum(shares.values())
        new = max(1.0 - total, options.new_probability) if total else 1.0
        if shares:
            elsewhere = self.admission.divided(hybrid_map, area, query, excluded)[2]
            self._count_likeness(query, [self._elsewhere(hybrid_map, other, excluded) for other in elsewhere])
        fits = [
            fit
            for known, share in shares.items()
            for fit in self._fits(
                hybrid_map,
                places[known],
                candidates[known],
                modes[known] or (),
                entries[known],
                (1.0 - new) * share / total,
            )
        ]
        beside = tuple(known for known, found in modes.items() if found is None)
        examined = tuple(known for known in shares if known not in beside)
        return Comparison(Transition({}, new), tuple(fits), examined, beside, 0.0)


@dataclass(frozen=True, eq=False)
class _Topology:
    """One way in which it may have been.

    :ivar path: its areas by visits.
    :ivar named: {area: the visit in which it was entered first}.
    :ivar log_weight: log of its probability.
    """

    path: Path
    named: dict[int, int]
    hybrid_map: HybridMap
    notes: LeafNotes
    robot: Robot
    log_weight: float

    @property
    def parent(self) -> Parent:
        """The hypothesis that it is at the next event."""
        return Parent(FIRST_HYPOTHESIS, self.robot.area, self.hybrid_map, self.notes, self.log_weight)


class Enumeration:
    """All topologies of a drive.

    :ivar lost: probability of the topologies that were not followed any further, at most.
    :ivar asked: whether there was a known area so far that the robot could be in, by the arcs.
    """

    def __init__(self, configuration: Configuration, noise: float = 1.0) -> None:
        """:param noise: factor on the deviations of the odometry."""
        self._noise = noise
        self._replica = Replica()
        self._branching = Branching(configuration, self._replica)
        self._branching.search = _EverywhereSearch(configuration, self._replica.scans)
        self._topologies = [_Topology((0,), {0: 0}, HybridMap(), LeafNotes(), Robot(), 0.0)]
        self._sequence = -1
        self.lost = 0.0
        self.asked = False

    @property
    def followed(self) -> int:
        """How many topologies there are now."""
        return len(self._topologies)

    def keyframe(self, step: Float64, scan: Scan, cut: int = 0) -> dict[Path, float]:
        """One keyframe event, as of :meth:`benchmark.scripted.Script.keyframe`; the probability of every path."""
        self._sequence += 1
        self._replica.scans[self._sequence] = scan
        self._branching.begin_event()
        points = self._branching.search.surface_points(scan)
        noted = [self._recognized(self._noted(topology, step), points) for topology in self._topologies]
        if cut:
            newest = range(self._sequence + 1 - cut, self._sequence + 1)
            noted = [child for topology in noted for child in self._children(topology, newest)]
        self._topologies = self._normalised(noted)
        pmf: dict[Path, float] = defaultdict(float)
        for topology in self._topologies:
            pmf[topology.path] += math.exp(topology.log_weight)
        return dict(pmf)

    def _noted(self, topology: _Topology, step: Float64) -> _Topology:
        """After the robot stored the newest keyframe in its area."""
        robot = topology.robot.moved(step, self._noise)
        topology.hybrid_map.place(self._sequence, robot.area, robot.pose.mean)
        return replace(topology, robot=robot, notes=topology.notes.stored(self._sequence, robot.pose.covariance))

    def _recognized(self, topology: _Topology, points: Float64) -> _Topology:
        """Weighed by what the newest scan says for the known ground that the robot is in."""
        pose = topology.robot.pose.mean
        found = self._branching.recognized(topology.parent, pose, points, self._sequence)
        return replace(topology, log_weight=found.log_weight)

    def _children(self, topology: _Topology, newest: Sequence[int]) -> Iterator[_Topology]:
        branches = self._branching.cut(topology.parent, newest)
        self.asked |= any(child.notes.compared for child in branches.children)
        for child in branches.children:
            yield self._followed(topology, child)

    def _followed(self, topology: _Topology, child: Child) -> _Topology:
        hybrid_map = topology.hybrid_map.branch()
        self._replica.change(hybrid_map, child.relabelled, child.arcs)
        around = areas_around(hybrid_map, child.area, self._branching.search.nearness)
        local = {area: belief.mean for area, belief in around.items() if area != child.area}
        named = {child.area: len(topology.path), **topology.named}
        robot = topology.robot.entered(child.area, child.rebase, len(child.relabelled), self._noise)
        path = (*topology.path, named[child.area])
        return _Topology(path, named, hybrid_map, replace(child.notes, local=local), robot, child.log_weight)

    def _normalised(self, topologies: Sequence[_Topology]) -> list[_Topology]:
        total = float(np.logaddexp.reduce([topology.log_weight for topology in topologies]))
        kept = [topology for topology in topologies if topology.log_weight - total > math.log(NEGLIGIBLE)]
        self.lost += NEGLIGIBLE * (len(topologies) - len(kept))
        return [replace(topology, log_weight=topology.log_weight - total) for topology in kept]
