"""The Rao-Blackwellized particle filter of one hypothesis in its current area, second step of Eq. (6).

Every particle has a pose, its own map in shared patches, and its own poses of the keyframes since the robot entered the
area. The map frame is the frame of the current area. Between two filter steps, all particles of a mode of the pose move
by one match with the map.
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
from hmt_slam_ros.sensors.relative_motion import has_wide_heading, is_wide
from hmt_slam_ros.submap.local_filter import (
    FilterStep,
    LineFilterState,
    LocalFilter,
    ParticleFilterState,
    PlacedKeyframe,
    TrackedMode,
    TrackedMotion,
)
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.pose_modes import MotionMixture, PoseModes, log_sum, normalize_weights, share_out
from hmt_slam_ros.submap.scan_matcher import MOST_MODES, ScanMatch, ScanMatcher, map_information


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

    def hessian(self, particle: int) -> Float64:
        """Information of the points at the proposal of a particle, map coordinates, shape (3, 3)."""
        return np.asarray(self.proposals.hessians[int(np.searchsorted(self.rows, particle))])


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
        self._predicted_poses, self._last_poses = self.poses.copy(), self.poses.copy()
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
            heads, shares = self._modes.heads(self.leader, self.log_weights), self._modes.shares(self.log_weights)
            motions = se2.between(self._last_poses[heads], self.poses[heads])
            motion = se2.between(self._last_poses[self.leader], self.pose)
            self.tracking_covariance = MotionMixture(motion, motions, shares).mix_covariances(covariances)
            increments = np.array([group.increment for group in groups])
            information = MotionMixture(lead.increment, increments, shares).blur_information(information)
        return TrackedMotion(lead.increment, information, lead.match.contradicts_odometry)

    def _track_mode(self, number: int, points: Float64, prediction: Prediction, most: int) -> list[_TrackedGroup]:
        """Match a scan from the head of a mode, and move the particles of that mode.

        :param points: surfels of the scan, shape (n, 4), base frame.
        :param most: modes of the match at most.
        """
        mode, rows = self._modes.tracked[number], self._modes.rows(number)
        head = self._modes.head(number, self.leader, self.log_weights)
        before, view = PoseGaussian(self.poses[head].copy(), mode.residual_covariance), self._view(head)
        matches = self._matcher.match(points, before, prediction, view)[: min(most, len(rows))]
        matches[0] = self._check(points, matches[0], head, mode, view)
        if len(matches) == 1:
            return [self._follow(rows, mode, matches[0], before.mean)]
        log_masses = np.array([match.log_mass for match in matches])
        log_mass, log_weight, groups = log_sum(log_masses), log_sum(self.log_weights[rows]), []
        for part, match in zip(share_out(rows, head, log_masses - log_mass), matches, strict=True):
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

    def _follow(self, rows: Int64, mode: TrackedMode, match: ScanMatch, before: Float64) -> _TrackedGroup:
        """Move particles by the motion from ``before``, the pose (3,) of their head, to a match."""
        step, increment = match.predicted_motion, se2.between(before, match.pose)
        self._predicted_poses[rows] = se2.compose(self._predicted_poses[rows], step.increment)
        self.poses[rows] = se2.compose(self.poses[rows], increment)
        motion, residual = mode.motion_since_update.compose(step), self._matcher.covariance(match)
        followed = TrackedMode(motion, residual, mode.counted_evidence, bool(match.hessian.any()))
        return _TrackedGroup(rows, followed, match, increment)

    def _tracking_covariance(self, group: _TrackedGroup) -> Float64:
        """Covariance of a mode's motion since the last filter step, shape (3, 3), right tangent frame."""
        match = group.match
        information = map_information(group.mode.motion_since_update.covariance, match.pose[2])
        information = information + match.hessian / self.mapping.alignment.inflation
        return rotate_covariance(matrix_inverse(information), -match.pose[2])

    def _view(self, particle: int) -> GridView:
        return self.mapping.pool.view(self._tables[particle])

    def _leading_view(self) -> GridView:
        return self._view(self.leader)

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:
        """Draw every particle from its optimal proposal, weight it, and resample where the ESS is low."""
        if self._modes.count > 1:
            counted = np.array([mode.counted_evidence for mode in self._modes.tracked])
            self.log_weights = self.log_weights - counted[self._modes.members]
            self._modes = self._modes.join_coinciding(self.poses, self.leader, self.log_weights)
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
        leader = self._modes.elect_leader(self.leader, self.log_weights)
        leader_changed, self.leader = leader != self.leader, leader
        self.poses = proposed + noise
        # A head keeps its mode, so that the published path has no sampling noise.
        heads = self._modes.heads(leader, self.log_weights)
        self.poses[heads] = proposed[heads]
        self.poses[:, 2] = se2.wrap(self.poses[:, 2])
        increment = se2.between(self._last_poses[leader], self.poses[leader])
        error, information = self._assess(groups, heads)
        effective = 1.0 / float(np.sum(normalize_weights(self.log_weights) ** 2))
        refuted = self._modes.has_refuted(self.log_weights, self._least_share)
        if effective < settings.filter.ess_fraction * len(self.poses) or refuted:
            self._resample(step)
        self._restart_prediction()
        return FilterStep(increment, error, information, effective, leader_changed, len(groups))

    def _propose(self, number: int, points: Float64) -> _GroupProposals:
        """The proposals of the particles of a mode.

        :param points: surfels of the scan, shape (n, 4), base frame.
        """
        settings, mode, rows = self.mapping.configuration, self._modes.tracked[number], self._modes.rows(number)
        head = self._modes.head(number, self.leader, self.log_weights)
        covariance, view = mode.motion_since_update.covariance, self._view(head)
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
        temper = self.mapping.configuration.matching.temper
        information = rotate_covariance(temper * groups[number].hessian(self.leader), -self.pose[2])
        if len(groups) == 1:
            return errors[0], information
        shares, motions = self._modes.shares(self.log_weights), se2.between(self._last_poses[heads], self.poses[heads])
        mixture = MotionMixture(motions[number], motions, shares)
        return mixture.mix_errors(errors), mixture.blur_information(information)

    def _match_error(self, group: _GroupProposals, head: int) -> MatchError:
        pose, hessian, view = self.poses[head], group.hessian(head), self._view(head)
        alignment, noise = self.mapping.alignment, self.mapping.match_noise
        return estimate_match_error(group.static, pose, hessian, group.prior, view, alignment, noise)

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """Agreement of a scan with the leader's map, at its pose."""
        view, hit_distance = self._leading_view(), self.mapping.hit_distance
        return compare_with_map(prepared.surfels, prepared.laser_position, self.pose, view, hit_distance)

    def _restart_prediction(self) -> None:
        """Predict from the current poses."""
        self._predicted_poses, self._last_poses = self.poses.copy(), self.poses.copy()
        self._modes = self._modes.after_filter_step()

    def initialize(self, pose: PoseGaussian) -> None:
        """Set all particles to the mean of ``map_T_base``, with its covariance as the residual one."""
        self.poses = np.repeat(pose.mean[None], len(self.poses), axis=0)
        self.log_weights = np.zeros(len(self.poses))
        self.tracking_covariance = np.zeros((3, 3))
        self._restart_prediction()
        self._modes = PoseModes.single(len(self.poses), pose.covariance)

    def _resample(self, step: int) -> None:
        """Resample the particles within each mode, without the refuted modes; maps are shared until written to."""
        offset = random_stream(self.mapping.configuration.seed, Purpose.RESAMPLING, step).random()
        drawn = self._modes.resample(self.leader, self.log_weights, self._least_share, offset)
        ancestors, self.log_weights, self._modes = drawn
        tables = np.stack([self.mapping.pool.share(self._tables[a]) for a in ancestors])
        self.release()
        self._tables, self.leader = tables, 0
        self.poses, self.keyframe_poses = self.poses[ancestors], self.keyframe_poses[ancestors]

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
        """Change to the frame of another area and load its local map, the same for all particles.

        That has the newest keyframe where the leading particle has it. Particles that are farther apart than keyframes
        stay where they are from that keyframe. What they differ by is in the covariance of the arc.
        """
        self._end_diverged_modes()
        self.area = area
        if self.keyframes and self.keyframes[-1] in {placed.keyframe for placed in content}:
            own = self.keyframe_poses[:, -1]
            if self._are_scattered(own):
                self._move_particles(se2.compose(own[self.leader], se2.inverse(own)))
        self._move_particles(np.repeat(area_T_previous[None], len(self.poses), axis=0))
        self._load_submap(content)

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Rebuild the local map after its keyframes moved; the poses of all particles in the anchor stay."""
        self._end_diverged_modes()
        before = self.keyframe_poses[:, self.keyframes.index(anchor)]
        relative = [se2.between(before, poses) for poses in (self.poses, self._predicted_poses, self._last_poses)]
        self._load_submap(content)
        after = self.keyframe_poses[:, self.keyframes.index(anchor)]
        self.poses, self._predicted_poses, self._last_poses = (se2.compose(after, poses) for poses in relative)

    def _are_scattered(self, poses: Float64) -> bool:
        """Whether poses of the particles, (m, 3), are farther from the leading one than keyframes from each other."""
        offsets = se2.between(poses[self.leader], poses)
        moment = (normalize_weights(self.log_weights)[:, None] * offsets).T @ offsets
        settings = self.mapping.configuration.filter
        largest = float(np.linalg.eigvalsh(moment[:2, :2])[-1])
        return largest > settings.keyframe_distance**2 or has_wide_heading(moment, settings)

    def _move_particles(self, motions: Float64) -> None:
        """Move each particle in the map by a motion of its own, (m, 3)."""
        previous = (self.poses, self._predicted_poses, self._last_poses)
        self.poses, self._predicted_poses, self._last_poses = (se2.compose(motions, own) for own in previous)

    def _end_diverged_modes(self) -> None:
        """End the modes whose maps end; the covariances that the filter steps gave have what they differ by."""
        modes, sources = self._modes.end_diverged(self.keyframe_poses, self.leader, self.log_weights)
        if modes.count < self._modes.count:
            self._modes = modes
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
