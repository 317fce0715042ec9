"""The Rao-Blackwellized particle filter of one hypothesis in its current area, second step of Eq. (6).

Every particle has a pose, its own map in shared patches, and its own poses of the keyframes since the robot entered the
area. The map frame is the frame of the current area.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, matrix_inverse, rotate_covariance
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.consistency import ClutterEstimate, MapAgreement, compare_with_map
from hmt_slam_ros.registration.match_covariance import estimate_match_error
from hmt_slam_ros.registration.scan_to_map import Prior
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, is_wide
from hmt_slam_ros.submap.local_filter import (
    FilterStep,
    LineFilterState,
    LocalFilter,
    ParticleFilterState,
    PlacedKeyframe,
    TrackedMotion,
)
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan, ScanMatcher, map_information

_LEAD_MARGIN = 3.0
"""Log-likelihood ratio from which another particle leads, nats: docs/decisions/0006-pose-between-keyframes.md."""


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
        self._motion_since_update = NO_MOTION
        self.leader = 0
        self._matcher = ScanMatcher(mapping)
        # Whether the last scan shows anything of the map.
        self._shows_map = True
        self.tracking_covariance = np.zeros((3, 3))
        self.residual_covariance = NO_MOTION.covariance
        self.clutter_estimate = ClutterEstimate()

    @classmethod
    def from_state(cls, mapping: LocalMapping, state: ParticleFilterState) -> ParticleFilter:
        """The filter of a state; its patches are in the pool, which counts the tables already."""
        own = cls(mapping, state.hypothesis, state.area)
        own.poses, own.log_weights = state.poses, state.log_weights
        own.keyframes, own.keyframe_areas = list(state.keyframes), list(state.keyframe_areas)
        own.keyframe_poses, own._tables = state.keyframe_poses, state.tables
        own._predicted_poses, own._last_poses = state.predicted_poses, state.last_poses
        own._motion_since_update = state.motion_since_update
        own.leader, own.tracking_covariance = state.leader, state.tracking_covariance
        own.residual_covariance, own.clutter_estimate = state.residual_covariance, state.clutter_estimate
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
            self._motion_since_update,
            self.leader,
            self.tracking_covariance,
            self.residual_covariance,
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
        """Match a scan between two keyframes, and move all particles by the leader's motion."""
        points = prepared.surfels
        before, view = PoseGaussian(self.pose, self.residual_covariance), self._leading_view()
        match = self._matcher.match(points, before, prediction, view)
        self._predicted_poses = se2.compose(self._predicted_poses, match.predicted_motion.increment)
        self._motion_since_update = self._motion_since_update.compose(match.predicted_motion)
        leg = PoseGaussian(self._predicted_poses[self.leader], self._motion_since_update.covariance)
        match = self._matcher.check_since_keyframe(points, match, leg, self._motion_since_update, view)
        self._shows_map = bool(match.hessian.any())
        increment = se2.between(before.mean, match.pose)
        self.poses = se2.compose(self.poses, increment)
        information = map_information(self._motion_since_update.covariance, match.pose[2])
        information = information + match.hessian / self.mapping.alignment.inflation
        self.residual_covariance = self._matcher.covariance(match)
        self.tracking_covariance = rotate_covariance(matrix_inverse(information), -match.pose[2])
        return TrackedMotion(increment, self._matcher.information(match), match.contradicts_odometry)

    def _leading_view(self) -> GridView:
        return self.mapping.pool.view(self._tables[self.leader])

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:
        """Draw every particle from its optimal proposal, weight it, and resample where the ESS is low."""
        settings = self.mapping.configuration
        points = prepared.surfels
        if not self._shows_map and is_wide(self._motion_since_update.covariance, settings.filter):
            # A match from here would end in some minimum, with a covariance that leaves the truth out.
            points = points[:0]
        prior = map_information(self._motion_since_update.covariance, self.pose[2])
        view, predicted = self._leading_view(), Prior(self._predicted_poses[self.leader], prior)
        static = self._matcher.static_points(points, predicted, self._motion_since_update.covariance, view)
        proposals = scan_to_map.propose_all(
            points,
            static,
            self.poses,
            self._predicted_poses,
            prior,
            self._tables,
            view,
            self.mapping.alignment,
            self.mapping.beam_model,
            settings.matching.sharpness,
            settings.matching.temper,
        )
        self.log_weights = self.log_weights + proposals.evidences
        self.log_weights -= self.log_weights.max()
        leader = self._elect_leader()
        random = random_stream(settings.seed, Purpose.PARTICLES, step).standard_normal(proposals.modes.shape)
        self.poses = proposals.modes + np.einsum("mij,mj->mi", np.linalg.cholesky(proposals.covariances), random)
        # The leader keeps the mode, so that the published path has no sampling noise.
        self.poses[leader] = proposals.modes[leader]
        self.poses[:, 2] = se2.wrap(self.poses[:, 2])
        error = estimate_match_error(
            static,
            self.poses[leader],
            proposals.hessians[leader],
            prior,
            self.mapping.pool.view(self._tables[leader]),
            self.mapping.alignment,
            self.mapping.match_noise,
        )
        information = rotate_covariance(settings.matching.temper * proposals.hessians[leader], -self.poses[leader, 2])
        effective = 1.0 / float(np.sum(_normalize_weights(self.log_weights) ** 2))
        increment = se2.between(self._last_poses[leader], self.poses[leader])
        leader_changed, self.leader = leader != self.leader, leader
        if effective < settings.filter.ess_fraction * len(self.poses):
            self._resample(step)
        self._restart_prediction()
        return FilterStep(increment, error, information, effective, leader_changed)

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """Agreement of a scan with the leader's map, at its pose."""
        return compare_with_map(
            prepared.surfels, prepared.laser_position, self.pose, self._leading_view(), self.mapping.hit_distance
        )

    def _elect_leader(self) -> int:
        """The particle of largest weight; the last leader where no other is clearly more likely.

        Along a corridor all particles fit alike, and the pose would jump from one to the other.
        """
        heaviest = int(np.argmax(self.log_weights))
        lead = self.log_weights[heaviest] - self.log_weights[self.leader]
        return heaviest if lead > _LEAD_MARGIN else self.leader

    def _restart_prediction(self) -> None:
        """Predict from the current poses."""
        self._predicted_poses = self.poses.copy()
        self._last_poses = self.poses.copy()
        self._motion_since_update = NO_MOTION
        self.residual_covariance = NO_MOTION.covariance

    def initialize(self, pose: PoseGaussian) -> None:
        """Set all particles to the mean of ``map_T_base``, with its covariance as the residual one."""
        self.poses = np.repeat(pose.mean[None], len(self.poses), axis=0)
        self.log_weights = np.zeros(len(self.poses))
        self.tracking_covariance = np.zeros((3, 3))
        self._restart_prediction()
        self.residual_covariance = pose.covariance

    def _resample(self, step: int) -> None:
        """Systematic resampling; the leader is kept, and is the first particle afterwards."""
        weights = _normalize_weights(self.log_weights)
        offset = random_stream(self.mapping.configuration.seed, Purpose.RESAMPLING, step).random()
        positions = (np.arange(len(weights)) + offset) / len(weights)
        ancestors = np.minimum(np.searchsorted(np.cumsum(weights), positions), len(weights) - 1)
        leader = self.leader
        if leader not in ancestors:
            ancestors[0] = leader
        ancestors = np.concatenate((ancestors[ancestors == leader], ancestors[ancestors != leader]))
        tables = np.stack([self.mapping.pool.share(self._tables[a]) for a in ancestors])
        self.release()
        self._tables = tables
        self.poses, self.keyframe_poses = self.poses[ancestors], self.keyframe_poses[ancestors]
        self.log_weights = np.zeros(len(weights))
        self.leader = 0

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
        self.area = area
        self.poses = se2.compose(area_T_previous, self.poses)
        self._predicted_poses = se2.compose(area_T_previous, self._predicted_poses)
        self._last_poses = se2.compose(area_T_previous, self._last_poses)
        self._load_submap(content)

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Rebuild the local map after its keyframes moved; the poses of all particles in the anchor stay."""
        before = self.keyframe_poses[:, self.keyframes.index(anchor)]
        relative = [se2.between(before, poses) for poses in (self.poses, self._predicted_poses, self._last_poses)]
        self._load_submap(content)
        after = self.keyframe_poses[:, self.keyframes.index(anchor)]
        self.poses, self._predicted_poses, self._last_poses = (se2.compose(after, poses) for poses in relative)

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


def _normalize_weights(log_weights: Float64) -> Float64:
    weights = np.exp(log_weights - log_weights.max())
    return weights / weights.sum()


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
