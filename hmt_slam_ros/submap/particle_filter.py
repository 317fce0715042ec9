"""The Rao-Blackwellized particle filter of one hypothesis in its current area, second step of Eq. (6).

Every particle has a pose, its own map in shared patches, and its own poses of the keyframes since the robot entered the
area. The map frame is the frame of the current area.

Between two filter steps all particles of a mode move by the match of one of them, its head. There is one mode, until a
match has several. Each then has particles by its mass, and goes by its own map, until the weights decide.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, matrix_inverse, rotate_covariance
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.consistency import ClutterEstimate, MapAgreement, compare_with_map
from hmt_slam_ros.registration.match_covariance import MatchError, estimate_match_error
from hmt_slam_ros.registration.scan_to_map import Prior
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import is_wide
from hmt_slam_ros.submap.local_filter import (
    FilterStep,
    LineFilterState,
    LocalFilter,
    ParticleFilterState,
    PlacedKeyframe,
    TrackedMode,
    TrackedMotion,
)
from hmt_slam_ros.submap.local_mapping import (
    MOST_MODES,
    LocalMapping,
    PreparedScan,
    ScanMatch,
    ScanMatcher,
    coincide,
    map_information,
)
from hmt_slam_ros.submap.pose_modes import (
    UNMOVED,
    PoseModes,
    allocate_particles,
    blur_information,
    draw_systematically,
    log_sum,
    mix_covariances,
    normalize_weights,
    spread_about,
)

_LEAD_MARGIN = 3.0
"""Log-likelihood ratio from which another particle leads, nats: docs/decisions/0006-pose-between-keyframes.md."""


class _TrackedGroup(NamedTuple):
    """The particles of a mode after a scan.

    :ivar rows: shape (k,), their numbers.
    :ivar mode: what is known of the mode.
    :ivar match: of the scan.
    :ivar increment: their motion since the last scan, ``start_T_end``, shape (3,).
    """

    rows: Int64
    mode: TrackedMode
    match: ScanMatch
    increment: Float64


class _GroupProposals(NamedTuple):
    """The proposals of the particles of a mode.

    :ivar rows: shape (k,), their numbers.
    :ivar static: surfels on static objects, shape (n, 4), base frame.
    :ivar prior: information of the prediction, map coordinates, shape (3, 3).
    :ivar proposals: of the k particles.
    """

    rows: Int64
    static: Float64
    prior: Float64
    proposals: scan_to_map.Proposals


class ParticleFilter:
    """M particles of one hypothesis in one area; attributes as in :class:`ParticleFilterState`."""

    def __init__(self, mapping: LocalMapping, hypothesis: int, area: int) -> None:
        self.mapping = mapping
        self.hypothesis = hypothesis
        self.area = area
        count = mapping.configuration.filter.particles
        self.poses = np.zeros((count, 3))
        self.log_weights = np.zeros(count)
        self.keyframes: list[int] = []
        self.keyframe_areas: list[int] = []
        self.keyframe_poses = np.zeros((count, 0, 3))
        self._tables = np.stack([mapping.pool.empty_table()] * count)
        self._predicted_poses = self.poses.copy()
        self._last_poses = self.poses.copy()
        self._modes = PoseModes.single(count)
        self.leader = 0
        self._matcher = ScanMatcher(mapping)
        self._least_share = mapping.configuration.motion.fault_probability
        self.tracking_covariance = np.zeros((3, 3))
        self.clutter_estimate = ClutterEstimate()

    @classmethod
    def from_state(cls, mapping: LocalMapping, state: ParticleFilterState) -> ParticleFilter:
        """The filter of a state; its patches are in the pool, which counts the tables already."""
        own = cls(mapping, state.hypothesis, state.area)
        own.poses, own.log_weights = state.poses, state.log_weights
        own.keyframes, own.keyframe_areas = list(state.keyframes), list(state.keyframe_areas)
        own.keyframe_poses, own._tables = state.keyframe_poses, state.tables
        own._predicted_poses, own._last_poses = state.predicted_poses, state.last_poses
        own._modes = PoseModes(state.modes, state.members)
        own.leader, own.tracking_covariance = state.leader, state.tracking_covariance
        own.clutter_estimate = state.clutter_estimate
        return own

    @property
    def state(self) -> ParticleFilterState:
        """The state without the patches; the tables have their numbers in the pool."""
        return ParticleFilterState(
            self.hypothesis,
            self.area,
            self.poses,
            self.log_weights,
            tuple(self.keyframes),
            tuple(self.keyframe_areas),
            self.keyframe_poses,
            self._tables,
            self._predicted_poses,
            self._last_poses,
            self._modes.tracked,
            self._modes.members,
            self.leader,
            self.tracking_covariance,
            self.clutter_estimate,
        )

    @property
    def pose(self) -> Float64:
        """The leading particle's ``area_T_base``, shape (3,)."""
        return self.poses[self.leader]

    def leading_keyframe_poses(self) -> Float64:
        """``map_T_base`` of the local map's keyframes under the leading particle, shape (K, 3)."""
        return self.keyframe_poses[self.leader]

    def branch(self, hypothesis: int) -> ParticleFilter:
        """A filter of the same state for a child hypothesis; maps are shared until written to."""
        # The tables alone are written to in place.
        tables = np.stack([self.mapping.pool.share(table) for table in self._tables])
        return ParticleFilter.from_state(self.mapping, replace(self.state, hypothesis=hypothesis, tables=tables))

    def release(self) -> None:
        """Free the maps."""
        for table in self._tables:
            self.mapping.pool.release(table)

    def track(self, prepared: PreparedScan, prediction: Prediction) -> TrackedMotion:
        """Match a scan between two keyframes under each mode, and move all its particles by one motion.

        Where the match has several modes, the particles are shared out among them by mass.
        """
        self.poses, self._predicted_poses = self.poses.copy(), self._predicted_poses.copy()
        self.log_weights = self.log_weights.copy()
        groups = list[_TrackedGroup]()
        for number in range(self._modes.count):
            most = MOST_MODES - len(groups) - (self._modes.count - 1 - number)
            groups += self._track_mode(number, prepared.surfels, prediction, most)
        rows, tracked = [group.rows for group in groups], [group.mode for group in groups]
        self._modes = PoseModes.from_rows(rows, tracked, len(self.poses))
        lead = groups[self._modes.number(self.leader)]
        covariances = [self._tracking_covariance(group) for group in groups]
        information = self._matcher.information(lead.match)
        self.tracking_covariance = covariances[0]
        if len(groups) > 1:
            self.log_weights -= self.log_weights.max()
            heads, shares = self._heads(), self._modes.shares(self.log_weights)
            motions = se2.between(self._last_poses[heads], self.poses[heads])
            motion = se2.between(self._last_poses[self.leader], self.pose)
            self.tracking_covariance = mix_covariances(motion, motions, covariances, shares)
            increments = np.array([group.increment for group in groups])
            information = blur_information(information, spread_about(lead.increment, increments, shares))
        return TrackedMotion(lead.increment, information, lead.match.contradicts_odometry)

    def _track_mode(self, number: int, points: Float64, prediction: Prediction, most: int) -> list[_TrackedGroup]:
        """Match a scan from the head of a mode, and move the particles of that mode.

        :param points: surfels of the scan, shape (n, 4), base frame.
        :param most: modes of the match at most.
        """
        mode, head, rows = self._modes.tracked[number], self._head(number), self._modes.rows(number)
        before, view = PoseGaussian(self.poses[head].copy(), mode.residual_covariance), self._view(head)
        matches = self._matcher.match(points, before, prediction, view)[: min(most, len(rows))]
        matches[0] = self._check(points, matches[0], head, mode, view)
        if len(matches) == 1:
            return [self._follow(rows, mode, matches[0], before.mean)]
        log_masses = np.array([match.log_mass for match in matches])
        log_mass, log_weight, groups = log_sum(log_masses), log_sum(self.log_weights[rows]), []
        for part, match in zip(self._share_out(rows, head, log_masses - log_mass), matches, strict=True):
            self.log_weights[part] += log_weight + match.log_mass - log_mass - log_sum(self.log_weights[part])
            own = replace(mode, counted_evidence=mode.counted_evidence + match.log_evidence - log_mass)
            groups.append(self._follow(part, own, match, before.mean))
        return groups

    def _check(self, points: Float64, match: ScanMatch, head: int, mode: TrackedMode, view: GridView) -> ScanMatch:
        """The best mode of a match, or one that agrees with the motion since the last keyframe, if that is better."""
        motion = mode.motion_since_update.compose(match.predicted_motion)
        predicted = se2.compose(self._predicted_poses[head], match.predicted_motion.increment)
        leg = PoseGaussian(predicted, motion.covariance)
        return self._matcher.check_since_keyframe(points, match, leg, motion, view)

    def _share_out(self, rows: Int64, head: int, log_masses: Float64) -> list[Int64]:
        """The particles ``rows`` of a mode by the modes of its match, of which the first keeps the head."""
        ordered = np.concatenate(([head], rows[rows != head]))
        counts = allocate_particles(np.exp(log_masses), len(rows))
        return np.split(ordered, np.cumsum(counts)[:-1])

    def _follow(self, rows: Int64, mode: TrackedMode, match: ScanMatch, before: Float64) -> _TrackedGroup:
        """Move particles by the motion from ``before``, the pose (3,) of their head, to a match."""
        step, increment = match.predicted_motion, se2.between(before, match.pose)
        self._predicted_poses[rows] = se2.compose(self._predicted_poses[rows], step.increment)
        self.poses[rows] = se2.compose(self.poses[rows], increment)
        followed = TrackedMode(
            mode.motion_since_update.compose(step),
            self._matcher.covariance(match),
            mode.counted_evidence,
            bool(match.hessian.any()),
        )
        return _TrackedGroup(rows, followed, match, increment)

    def _tracking_covariance(self, group: _TrackedGroup) -> Float64:
        """Covariance of a mode's motion since the last filter step, shape (3, 3), right tangent frame."""
        match = group.match
        information = map_information(group.mode.motion_since_update.covariance, match.pose[2])
        information = information + match.hessian / self.mapping.alignment.inflation
        return rotate_covariance(matrix_inverse(information), -match.pose[2])

    def _head(self, number: int) -> int:
        return self._modes.head(number, self.leader, self.log_weights)

    def _heads(self) -> list[int]:
        """The head of each mode."""
        return [self._head(number) for number in range(self._modes.count)]

    def _view(self, particle: int) -> GridView:
        return self.mapping.pool.view(self._tables[particle])

    def _leading_view(self) -> GridView:
        return self._view(self.leader)

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:
        """Draw every particle from its optimal proposal, weight it, and resample where the ESS is low."""
        if self._modes.count > 1:
            counted = np.array([mode.counted_evidence for mode in self._modes.tracked])
            self.log_weights = self.log_weights - counted[self._modes.members]
            self._join_coinciding()
        settings = self.mapping.configuration
        groups = [self._propose(number, prepared.surfels) for number in range(self._modes.count)]
        proposed, evidences = np.empty((len(self.poses), 3)), np.empty(len(self.poses))
        noise = random_stream(settings.seed, Purpose.PARTICLES, step).standard_normal(proposed.shape)
        for group in groups:
            proposed[group.rows], evidences[group.rows] = group.proposals.modes, group.proposals.evidences
            deviations = np.linalg.cholesky(group.proposals.covariances)
            noise[group.rows] = np.einsum("mij,mj->mi", deviations, noise[group.rows])
        self.log_weights = self.log_weights + evidences
        self.log_weights -= self.log_weights.max()
        leader = self._elect_leader()
        leader_changed, self.leader = leader != self.leader, leader
        self.poses = proposed + noise
        # A head keeps its mode, so that the published path has no sampling noise.
        heads = self._heads()
        self.poses[heads] = proposed[heads]
        self.poses[:, 2] = se2.wrap(self.poses[:, 2])
        increment = se2.between(self._last_poses[leader], self.poses[leader])
        error, information = self._assess(groups, heads)
        effective = 1.0 / float(np.sum(normalize_weights(self.log_weights) ** 2))
        if effective < settings.filter.ess_fraction * len(self.poses) or self._has_refuted_mode():
            self._resample(step)
        self._restart_prediction()
        return FilterStep(increment, error, information, effective, leader_changed, len(groups))

    def _propose(self, number: int, points: Float64) -> _GroupProposals:
        """The proposals of the particles of a mode.

        :param points: surfels of the scan, shape (n, 4), base frame.
        """
        settings, mode, head = self.mapping.configuration, self._modes.tracked[number], self._head(number)
        rows, covariance, view = self._modes.rows(number), mode.motion_since_update.covariance, self._view(head)
        if not mode.shows_map and is_wide(covariance, settings.filter):
            # A match from here would end in some minimum, with a covariance that leaves the truth out.
            points = points[:0]
        prior = map_information(covariance, self.poses[head, 2])
        static = self._matcher.static_points(points, Prior(self._predicted_poses[head], prior), covariance, view)
        proposals = scan_to_map.propose_all(
            points,
            static,
            self.poses[rows],
            self._predicted_poses[rows],
            prior,
            self._tables[rows],
            view,
            self.mapping.alignment,
            self.mapping.beam_model,
            settings.matching.sharpness,
            settings.matching.temper,
        )
        return _GroupProposals(rows, static, prior, proposals)

    def _assess(self, groups: Sequence[_GroupProposals], heads: Sequence[int]) -> tuple[MatchError, Float64]:
        """The error of the leader's motion, and the information (3, 3) of its match, in the light of all modes."""
        number = self._modes.number(self.leader)
        errors = [self._match_error(group, head) for group, head in zip(groups, heads, strict=True)]
        hessian = _hessian(groups[number], self.leader)
        temper = self.mapping.configuration.matching.temper
        information = rotate_covariance(temper * hessian, -self.pose[2])
        if len(groups) == 1:
            return errors[0], information
        shares, motions = self._modes.shares(self.log_weights), se2.between(self._last_poses[heads], self.poses[heads])
        motion = motions[number]
        error = MatchError(
            mix_covariances(motion, motions, [error.pose_covariance for error in errors], shares),
            mix_covariances(motion, motions, [error.drift_covariance for error in errors], shares),
            np.einsum("k,kij->ij", shares, np.array([error.gain for error in errors])),
        )
        return error, blur_information(information, spread_about(motion, motions, shares))

    def _match_error(self, group: _GroupProposals, head: int) -> MatchError:
        return estimate_match_error(
            group.static,
            self.poses[head],
            _hessian(group, head),
            group.prior,
            self._view(head),
            self.mapping.alignment,
            self.mapping.match_noise,
        )

    def _join_coinciding(self) -> None:
        """Join modes whose heads are in one basin; of two, the one with the leader or the heavier one remains."""
        shares, members = self._modes.shares(self.log_weights), self._modes.members
        own = self._modes.number(self.leader)
        order = sorted(range(self._modes.count), key=lambda number: (number != own, -shares[number]))
        heads, kept = self._heads(), list[int]()
        for number in order:
            pose = self.poses[heads[number]]
            into = next((other for other in kept if coincide(pose, self.poses[heads[other]])), None)
            if into is None:
                kept.append(number)
            else:
                members = np.where(members == number, into, members)
        self._modes = self._modes.select(kept, members)

    def _has_refuted_mode(self) -> bool:
        """Whether a mode is less probable than an odometry fault."""
        return self._modes.count > 1 and bool(self._modes.shares(self.log_weights).min() < self._least_share)

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """Agreement of a scan with the leader's map, at its pose."""
        return compare_with_map(
            prepared.surfels, prepared.laser_position, self.pose, self._leading_view(), self.mapping.hit_distance
        )

    def _elect_leader(self) -> int:
        """The particle of largest weight in the heaviest mode; the last mode and leader where none is clearly better.

        Along a corridor all particles fit alike, and the pose would jump from one to the other.
        """
        rows = [self._modes.rows(number) for number in range(self._modes.count)]
        log_shares = np.array([log_sum(self.log_weights[own]) for own in rows])
        number, own = int(np.argmax(log_shares)), self._modes.number(self.leader)
        if log_shares[number] - log_shares[own] > _LEAD_MARGIN:
            return self._head(number)
        heaviest = int(rows[own][np.argmax(self.log_weights[rows[own]])])
        lead = self.log_weights[heaviest] - self.log_weights[self.leader]
        return heaviest if lead > _LEAD_MARGIN else self.leader

    def _restart_prediction(self) -> None:
        """Predict from the current poses."""
        self._predicted_poses = self.poses.copy()
        self._last_poses = self.poses.copy()
        self._modes = self._modes.after_filter_step()

    def initialize(self, pose: PoseGaussian) -> None:
        """Set all particles to the mean of ``map_T_base``, with its covariance as the residual one."""
        self.poses = np.repeat(pose.mean[None], len(self.poses), axis=0)
        self.log_weights = np.zeros(len(self.poses))
        self.tracking_covariance = np.zeros((3, 3))
        self._restart_prediction()
        self._modes = PoseModes.single(len(self.poses), replace(UNMOVED, residual_covariance=pose.covariance))

    def _resample(self, step: int) -> None:
        """Systematic resampling within each mode; the leader is kept, and is the first particle afterwards.

        Modes that are refuted end. The others have particles by their shares, one at least, and weights for the rest.
        """
        shares, own = self._modes.shares(self.log_weights), self._modes.number(self.leader)
        kept = [number for number in range(len(shares)) if shares[number] >= self._least_share or number == own]
        kept.sort(key=lambda number: number != own)
        shares = shares[kept] / shares[kept].sum()
        counts = allocate_particles(shares, len(self.poses))
        offset = random_stream(self.mapping.configuration.seed, Purpose.RESAMPLING, step).random()
        drawn = [self._draw(number, count, offset) for number, count in zip(kept, counts, strict=True)]
        ancestors = np.concatenate(drawn)
        tables = np.stack([self.mapping.pool.share(self._tables[a]) for a in ancestors])
        self.release()
        self._tables = tables
        self.poses, self.keyframe_poses = self.poses[ancestors], self.keyframe_poses[ancestors]
        self.log_weights = np.repeat(np.log(shares / counts), counts)
        self.log_weights -= self.log_weights.max()
        rows = np.split(np.arange(len(ancestors)), np.cumsum(counts)[:-1])
        self._modes = PoseModes.from_rows(rows, [self._modes.tracked[number] for number in kept], len(ancestors))
        self.leader = 0

    def _draw(self, number: int, count: int, offset: float) -> Int64:
        """``count`` particles of a mode by their weights, ascending; the leader is among them, and first."""
        rows = self._modes.rows(number)
        drawn = rows[draw_systematically(normalize_weights(self.log_weights[rows]), count, offset)]
        if self._modes.number(self.leader) != number:
            return drawn
        if self.leader not in drawn:
            drawn[0] = self.leader
        return np.concatenate((drawn[drawn == self.leader], drawn[drawn != self.leader]))

    def add_keyframe(self, keyframe: int, scan: Scan) -> None:
        """Insert a scan into every particle's map at that particle's pose."""
        self.mapping.insert_scan(self._tables, self.poses, scan)
        self.keyframes.append(keyframe)
        self.keyframe_areas.append(self.area)
        self.keyframe_poses = np.concatenate((self.keyframe_poses, self.poses[:, None]), axis=1)

    def drop_keyframes(self, keyframes: Collection[int]) -> None:
        """Remove keyframes, but not their scans from the maps."""
        remaining = [k for k, keyframe in enumerate(self.keyframes) if keyframe not in keyframes]
        self.keyframes = [self.keyframes[k] for k in remaining]
        self.keyframe_areas = [self.keyframe_areas[k] for k in remaining]
        self.keyframe_poses = self.keyframe_poses[:, remaining]

    def change_area(self, area: int, area_T_previous: Float64, content: Sequence[PlacedKeyframe]) -> None:
        """Change to the frame of another area and load its local map, the same for all particles."""
        self._end_diverged_modes()
        self.area = area
        self.poses = se2.compose(area_T_previous, self.poses)
        self._predicted_poses = se2.compose(area_T_previous, self._predicted_poses)
        self._last_poses = se2.compose(area_T_previous, self._last_poses)
        self._load_submap(content)

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Rebuild the local map after its keyframes moved; the poses of all particles in the anchor stay."""
        self._end_diverged_modes()
        before = self.keyframe_poses[:, self.keyframes.index(anchor)]
        relative = [se2.between(before, poses) for poses in (self.poses, self._predicted_poses, self._last_poses)]
        self._load_submap(content)
        after = self.keyframe_poses[:, self.keyframes.index(anchor)]
        self.poses, self._predicted_poses, self._last_poses = (se2.compose(after, poses) for poses in relative)

    def _end_diverged_modes(self) -> None:
        """End the modes whose keyframes lie elsewhere than the leader's, since their maps end.

        Their particles go on from the leader. The covariances that the filter steps gave have what they differ by.
        """
        sources, kept = np.arange(len(self.poses)), list[int]()
        for number, head in enumerate(self._heads()):
            pairs = zip(self.keyframe_poses[head], self.leading_keyframe_poses(), strict=True)
            if all(coincide(pose, leading) for pose, leading in pairs):
                kept.append(number)
            else:
                sources[self._modes.rows(number)] = self.leader
        if len(kept) == self._modes.count:
            return
        self._modes = self._modes.select(kept, self._modes.members[sources])
        self.poses, self.keyframe_poses = self.poses[sources], self.keyframe_poses[sources]
        self._predicted_poses, self._last_poses = self._predicted_poses[sources], self._last_poses[sources]

    def _load_submap(self, content: Sequence[PlacedKeyframe]) -> None:
        self.release()
        table = self.mapping.pool.empty_table()
        for keyframe in content:
            self.mapping.insert_scan(table[None], keyframe.pose[None], keyframe.scan)
        count = len(self.poses)
        self._tables = np.stack([table] + [self.mapping.pool.share(table) for _ in range(count - 1)])
        self.keyframes = [keyframe.keyframe for keyframe in content]
        self.keyframe_areas = [keyframe.area for keyframe in content]
        poses = np.array([keyframe.pose for keyframe in content]).reshape(-1, 3)
        self.keyframe_poses = np.repeat(poses[None], count, axis=0)


def _hessian(group: _GroupProposals, particle: int) -> Float64:
    """Information of the points at the proposal of a particle, map coordinates, shape (3, 3)."""
    hessian: Float64 = group.proposals.hessians[int(np.searchsorted(group.rows, particle))]
    return hessian


class ParticleFilters:
    """The factory of particle filters, for all areas."""

    def __init__(self, mapping: LocalMapping) -> None:
        """:raises HmtSlamError: where ``local_map.kind`` asks for lines."""
        kind = mapping.configuration.local_map.kind
        if kind != "grid":
            raise HmtSlamError(f"local_map.kind = {kind} needs the filters of the landmarks: give them to metric SLAM")
        self._mapping = mapping

    def new(self, hypothesis: int, area: int) -> LocalFilter:
        """A filter with an empty map."""
        return ParticleFilter(self._mapping, hypothesis, area)

    def restore(self, state: ParticleFilterState | LineFilterState) -> LocalFilter:
        """The filter of a state; the patches of its grids are in the pool.

        :raises HmtSlamError: where its local map has lines.
        """
        if isinstance(state, LineFilterState):
            raise HmtSlamError("the saved map has local maps of lines: go on from it with its own local_map.kind")
        return ParticleFilter.from_state(self._mapping, state)

    def select(self, own: LocalFilter, area: int, content: Sequence[PlacedKeyframe]) -> LocalFilter:  # noqa: ARG002
        """The filter for the next area, which is always ``own``."""
        return own
