"""The children of a hypothesis, where its newest keyframes may lie in known areas: Eq. (6), summed over gamma.

Every scan is counted once. Metric SLAM's evidence counts it against the local map. Here the surfaces of several
keyframes are compared with known areas of which the local map did not know: what that map holds is left out of the
candidates' grids, and no keyframe is compared with an area twice.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.messages import Arc, Relabelled
from hmt_slam_ros.processes.replica import FIRST_AREA, Replica
from hmt_slam_ros.topology.appearance import appearance_log_ratio, signature
from hmt_slam_ros.topology.area_grid import GridModel
from hmt_slam_ros.topology.area_matching import MatchSettings, Mode, match
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.hypothesis_tree import LeafNotes, relative_covariance
from hmt_slam_ros.topology.shortest_path import reachable
from hmt_slam_ros.topology.surroundings import Nearness, Views
from hmt_slam_ros.topology.transition import Place, Transition, entry_probability, owner_at, transition

# Bounds the search for candidates in maps with thousands of areas within the limit of certainty.
_MOST_AREAS = 500


@dataclass(frozen=True, eq=False)
class Parent:
    """A hypothesis before the event.

    :ivar log_weight: log of its probability, the newest scan's evidence included.
    """

    hypothesis: int
    area: int
    hybrid_map: HybridMap
    notes: LeafNotes
    log_weight: float


@dataclass(frozen=True, eq=False)
class Child:
    """One continuation of a hypothesis.

    :ivar parent: id of the hypothesis that it continues.
    :ivar log_weight: log of its weight, unnormalised.
    :ivar reload: whether the local map has to be loaded anew.
    """

    parent: int
    log_weight: float
    area: int
    notes: LeafNotes
    rebase: PoseGaussian | None = None
    relabelled: tuple[Relabelled, ...] = ()
    arcs: tuple[Arc, ...] = ()
    reload: bool = False


class Branches(NamedTuple):
    """All continuations of one hypothesis.

    :ivar looked: whether known areas were looked for.
    :ivar log_skipped: log of the weight of those that were not looked at.
    """

    children: list[Child]
    looked: bool = False
    log_skipped: float = -math.inf


@dataclass(frozen=True, eq=False)
class _Query:
    """Keyframes in question.

    :ivar belief: over ``area_T_reference``; the reference is the first keyframe.
    :ivar poses: {keyframe: ``reference_T_base``}.
    """

    belief: PoseGaussian
    poses: Mapping[int, NDArray[np.float64]]


class _Candidate(NamedTuple):
    """A known area, the belief over ``candidate_T_reference`` by the arcs, the keyframes not yet compared with it."""

    place: Place
    prior: PoseGaussian
    fresh: dict[int, NDArray[np.float64]]


class _Comparison(NamedTuple):
    """What came of comparing a query with the known areas."""

    transition: Transition
    modes: list[tuple[int, float, Mode]]
    compared: tuple[int, ...]
    skipped: float


class Branching:
    """Makes the children of hypotheses; numbers new areas."""

    def __init__(self, configuration: Configuration, replica: Replica) -> None:
        options = configuration.tsbi
        self._options = options
        self._gate = float(chi2.ppf(options.gate_probability, 3))
        self._settings = MatchSettings(temper=options.temper, gate=self._gate, max_modes=options.max_modes)
        self.nearness = Nearness(options.local_sigma, options.local_reach)
        model = GridModel(
            options.search_cell, options.surface_sigma, options.surface_ratio, options.free_ratio,
            configuration.local_map.max_range, options.sample_spacing,
        )  # fmt: skip
        self._replica = replica
        self._views = Views(replica.scans, model, self.nearness)
        sigma, angle = configuration.tlca.arc_sigma_floor, math.radians(configuration.tlca.arc_angle_floor)
        self._floor = np.diag([sigma**2, sigma**2, angle**2])
        self._areas = FIRST_AREA
        self._named: dict[tuple[int, ...], int] = {}

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance at the gate."""
        return self._gate

    def begin_event(self) -> None:
        """Forget which new areas were named; within one event hypotheses share the ids of the same new area."""
        self._named = {}

    def cut(self, parent: Parent, keyframes: Sequence[int]) -> Branches:
        """{new area} and every known area that the arcs admit, with one child a mode.

        Where the keyframes lie in the place of an area of the local map there is nothing to ask: the robot tracks its
        pose there, and "new" would be the same metric map under another name.
        """
        query = self._query(parent, keyframes)
        tracked = self._tracked_area(parent, query)
        if tracked is not None:
            return Branches([self._enter_tracked(parent, query, tracked)])
        found = self._compare(parent, query, {parent.area, *parent.notes.local})
        noted = replace(parent, notes=parent.notes.checked(found.compared, keyframes))
        children = [self._enter_new(noted, query, math.log(found.transition.new))]
        children += [self._enter_known(noted, query, *mode) for mode in found.modes]
        return Branches(children, True, _log(found.skipped) + parent.log_weight)

    def recheck(self, parent: Parent) -> Branches:
        """Stay as it is, or join the robot's area to a known one by a further arc; no keyframe changes its area."""
        keyframes = [k for k in parent.notes.unchecked if k in parent.hybrid_map.keyframes(parent.area)]
        query = self._query(parent, keyframes)
        excluded = {parent.area, *parent.notes.local, *parent.hybrid_map.neighbours(parent.area)}
        found = self._compare(parent, query, excluded)
        noted = replace(parent, notes=parent.notes.checked(found.compared, keyframes))
        stay = parent.log_weight + math.log(found.transition.new)
        children = [Child(parent.hypothesis, stay, parent.area, noted.notes)]
        children += [self._join(noted, query, *mode) for mode in found.modes]
        return Branches(children, True, _log(found.skipped) + parent.log_weight)

    def move(self, parent: Parent, area: int) -> Branches:
        """The robot went into a known area; the keyframes stay where they are."""
        belief = self._belief(parent, area)
        notes = parent.notes.entered({})
        child = Child(parent.hypothesis, parent.log_weight, area, notes, rebase=belief.inverse(), reload=True)
        return Branches([child])

    def _belief(self, parent: Parent, area: int) -> PoseGaussian:
        """The belief over ``area_T_other``, its mean as the local map has it, so that the robot does not jump."""
        found = parent.hybrid_map.arc(parent.area, area) or reachable(parent.hybrid_map, parent.area)[area]
        return PoseGaussian(parent.notes.local.get(area, found.mean), found.covariance)

    def _query(self, parent: Parent, keyframes: Sequence[int]) -> _Query:
        placed = parent.hybrid_map.keyframes(parent.area)
        reference = placed[keyframes[0]]
        covariance = parent.notes.covariances.get(keyframes[0], np.zeros((3, 3))) + self._floor
        poses = {keyframe: se2.between(reference, placed[keyframe]) for keyframe in keyframes}
        return _Query(PoseGaussian(reference, covariance), poses)

    def _tracked_area(self, parent: Parent, query: _Query) -> int | None:
        """The area of the local map in whose place the keyframes lie."""
        known = set(parent.hybrid_map.area_ids())
        local = {area: pose for area, pose in parent.notes.local.items() if area in known}
        if not local:
            return None
        place = self._views.place_of(parent.hybrid_map, parent.area, local)
        poses = se2.compose(query.belief.mean, _stacked(query.poses))
        return owner_at(place, poses, self._options.place_radius)

    def _compare(self, parent: Parent, query: _Query, excluded: Collection[int]) -> _Comparison:
        """Prior, appearance and evidence of all admitted areas."""
        candidates = {c.place.area: c for c in self._candidates(parent, query, excluded)}
        shares = {
            area: entry_probability(c.place, c.prior, _stacked(c.fresh), self._options.place_radius)
            for area, c in candidates.items()
        }
        shares = {area: share for area, share in shares.items() if share > 0.0}
        model = transition(shares, self._options.new_probability)
        ranked = sorted(shares, key=lambda area: (-shares[area], area))
        examined = ranked[: self._options.max_candidates]
        modes = [
            (area, math.log(model.known[area] / shares[area]) + look, mode)
            for area in examined
            for look, mode in self._fits(parent.hybrid_map, candidates[area])
        ]
        skipped = sum(model.known[area] for area in ranked[self._options.max_candidates :])
        return _Comparison(model, modes, tuple(examined), skipped)

    def _candidates(self, parent: Parent, query: _Query, excluded: Collection[int]) -> Iterator[_Candidate]:
        """The known areas whose keyframes the query can be near to under the arcs' belief."""
        limit = self._options.prior_limit**2
        for area, belief in reachable(parent.hybrid_map, parent.area, limit, _MOST_AREAS).items():
            fresh = {k: p for k, p in query.poses.items() if k not in parent.notes.compared.get(area, frozenset())}
            # An area with which most of the keyframes were compared has had its chance.
            if area in excluded or 2 * len(fresh) < len(query.poses):
                continue
            prior = self._prior(belief, query)
            if self._within_reach(parent.hybrid_map, area, prior, fresh):
                yield _Candidate(self._views.place(parent.hybrid_map, area, excluded), prior, fresh)

    def _prior(self, belief: PoseGaussian, query: _Query) -> PoseGaussian:
        """``candidate_T_reference`` from ``area_T_candidate`` and ``area_T_reference``, widened."""
        prior = belief.inverse().compose(query.belief)
        return PoseGaussian(prior.mean, self._options.prior_scale**2 * prior.covariance)

    def _within_reach(
        self, hybrid_map: HybridMap, area: int, prior: PoseGaussian, poses: Mapping[int, NDArray[np.float64]]
    ) -> bool:
        """Whether a keyframe of the area is near enough to one of the query's, somewhere within the gate."""
        positions = se2.compose(prior.mean, _stacked(poses))[:, :2]
        known = _stacked(hybrid_map.keyframes(area))[:, :2]
        if not known.size:
            return False
        lever = np.hypot(*(positions - prior.mean[:2]).T).max()
        spread = math.sqrt(np.linalg.eigvalsh(prior.covariance[:2, :2])[-1]) + lever * math.sqrt(prior.covariance[2, 2])
        gap = np.hypot(*(positions[:, None] - known[None]).transpose(2, 0, 1)).min()
        return bool(gap <= self._options.place_radius + math.sqrt(self._gate) * spread)

    def _fits(self, hybrid_map: HybridMap, candidate: _Candidate) -> Iterator[tuple[float, Mode]]:
        """Appearance ratio and modes of the query in the candidate's place.

        The mass of a mode is its part of the integral of p(x) p(z | x) over all poses. Of it counts what lies in the
        candidate's place; so p(x | gamma) is not computed and pi(gamma) cancels.
        """
        place = candidate.place
        look = appearance_log_ratio(
            self._signature(candidate.fresh),
            self._signature(hybrid_map.keyframes(place.area)),
            self._options.appearance_weight,
        )
        for mode in match(self._views.grid(candidate.fresh), place.grid, candidate.prior, self._settings).modes:
            poses = se2.compose(mode.pose.mean, _stacked(candidate.fresh))
            if owner_at(place, poses, self._options.place_radius) == place.area:
                yield look, mode

    def _signature(self, keyframes: Collection[int]) -> NDArray[np.float64]:
        return signature([self._replica.scans[keyframe] for keyframe in keyframes])

    def _enter_new(self, parent: Parent, query: _Query, log_factor: float) -> Child:
        """New ground: the reference keyframe becomes the frame of a new area."""
        keyframes = tuple(query.poses)
        if keyframes not in self._named:
            self._areas = max(self._areas, *parent.hybrid_map.area_ids()) + 1
            self._named[keyframes] = self._areas
        area = self._named[keyframes]
        origin = PoseGaussian(np.zeros(3), self._floor)
        return self._entered(parent, query, area, origin, query.belief, log_factor)

    def _enter_tracked(self, parent: Parent, query: _Query, area: int) -> Child:
        """A known area in whose place the robot is known to be: no new arc where there is one."""
        belief = self._belief(parent, area)
        entry = belief.inverse().compose(query.belief)
        arc = None if parent.hybrid_map.arc(parent.area, area) else belief
        return self._entered(parent, query, area, entry, arc, 0.0)

    def _enter_known(self, parent: Parent, query: _Query, area: int, log_factor: float, mode: Mode) -> Child:
        """A known area, recognised."""
        return self._entered(
            parent, query, area, mode.pose, query.belief.compose(mode.measured.inverse()), log_factor + mode.log_mass
        )

    def _entered(
        self, parent: Parent, query: _Query, area: int, entry: PoseGaussian, arc: PoseGaussian | None, log_factor: float
    ) -> Child:
        """The robot and the query's keyframes are in ``area``, at ``entry`` = ``area_T_reference``."""
        relabelled = tuple(
            Relabelled(keyframe, parent.area, area, se2.compose(entry.mean, pose))
            for keyframe, pose in query.poses.items()
        )
        covariances = {
            keyframe: PoseGaussian(entry.mean, entry.covariance).compose(self._step(parent, query, keyframe)).covariance
            for keyframe in query.poses
        }
        return Child(
            parent.hypothesis,
            parent.log_weight + log_factor,
            area,
            parent.notes.entered(covariances),
            PoseGaussian(entry.mean, entry.covariance).compose(query.belief.inverse()),
            relabelled,
            () if arc is None else (self._arc(parent, area, arc),),
            reload=True,
        )

    def _step(self, parent: Parent, query: _Query, keyframe: int) -> PoseGaussian:
        """The belief over ``reference_T_base`` of a keyframe."""
        whole = parent.notes.covariances.get(keyframe, np.zeros((3, 3)))
        reference = query.belief.covariance - self._floor
        pose = query.poses[keyframe]
        return PoseGaussian(pose, relative_covariance(whole, reference, pose, np.zeros((3, 3))))

    def _arc(self, parent: Parent, area: int, belief: PoseGaussian) -> Arc:
        """The arc from the robot's area; it closes a loop where it joins two known areas that no arc joined."""
        known = parent.hybrid_map.arc_value(parent.area, area)
        revisited = area in parent.hybrid_map.area_ids()
        return Arc(parent.area, area, belief, closure=revisited if known is None else known.closure)

    def _join(self, parent: Parent, query: _Query, area: int, log_factor: float, mode: Mode) -> Child:
        """The robot stays in its area, which an arc now joins to a known one."""
        arc = Arc(parent.area, area, query.belief.compose(mode.measured.inverse()), closure=True)
        log_weight = parent.log_weight + log_factor + mode.log_mass
        return Child(parent.hypothesis, log_weight, parent.area, parent.notes, arcs=(arc,), reload=True)


def _stacked(poses: Mapping[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.array(list(poses.values())).reshape(-1, 3)


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf
