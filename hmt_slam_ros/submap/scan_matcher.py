"""Where a scan was taken: matching from what odometry predicts, and from inertia where the scans contradict that.

Odometry is right or, with a small probability, says nothing about the motion (wheels slip, readings are lost); then
inertia predicts it. Each of the two is a prior; the one under which scan and map have the larger evidence is believed.
In a corridor that looks the same all along, both fit, and odometry as the sharper prior wins.

Where a corridor tells little, a scan fits in many places a little, and a pose that were certain after each scan would
stay in the first of them while the robot drives on. So what the scans leave open is carried on to the next one, and
where that is much, the best of all fits around is looked for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.covariance import inverse, propagate_covariance, rotate_covariance
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.dynamic_rejection import reject_dynamic
from hmt_slam_ros.sensors.motion_model import Prediction, RelativeMotion
from hmt_slam_ros.submap.local_mapping import LocalMapping

_SEARCH_POINTS = 90
# Peaks of a search that are refined.
_PEAKS = 4
# Farther from the prediction than this, in m and rad, Gauss-Newton may end in another minimum.
_MAX_DISTANCE, _MAX_ANGLE = 0.2, math.radians(6.0)
# Deviations of the prediction to which a search reaches.
_REACH = 2.5
# Matches whose evidence differs by less than this, nats, may as well be each other.
_AMBIGUOUS = 3.0
# Odometry whose distance from the match is within this share of all is not doubted.
_GATE = chi_square_gate(0.999)


class ScanMatch(NamedTuple):
    """A scan matched under one prior.

    :ivar pose: the mode, ``map_T_base``, shape (3,).
    :ivar hessian: information of the points at the mode, map coordinates, shape (3, 3).
    :ivar prior: over poses.
    :ivar predicted_motion: the motion that the prior came from.
    :ivar log_evidence: of scan and map under the prior, nats.
    :ivar contradicts_odometry: whether the scan contradicts the odometry that there was.
    """

    pose: Float64
    hessian: Float64
    prior: scan_to_map.Prior
    predicted_motion: RelativeMotion
    log_evidence: float
    contradicts_odometry: bool = False


class ScanMatcher:
    """Matches scans against one map after another, with the settings of a process."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping = mapping
        self._settings = mapping.configuration.matching
        self._fault_probability = mapping.configuration.motion.fault_probability
        self._log_fault, self._log_no_fault = math.log(self._fault_probability), math.log1p(-self._fault_probability)

    def match(self, points: Float64, before: PoseGaussian, prediction: Prediction, view: GridView) -> ScanMatch:
        """The scan's pose.

        :param points: surfels of the scan, shape (n, 4), base frame.
        :param before: ``map_T_base`` at the last scan.
        """
        if prediction.odometry is None:
            return self._match_with_prior(points, before, prediction.inertia, view)
        by_odometry = self._match_with_prior(points, before, prediction.fused, view)
        if self._agrees_with_prediction(points, by_odometry, view):
            return by_odometry
        by_inertia = self._match_with_prior(points, before, prediction.inertia, view)
        right = by_odometry.log_evidence + self._log_no_fault
        if not self._fits_map(points, by_inertia.pose, view):
            # Unknown space has evidence 0: what was found has to be part of the map as well.
            right = max(0.0, right)
        if by_inertia.log_evidence + self._log_fault > right:
            return self._fuse_with_slip(points, before, prediction, by_inertia, view)
        return (
            by_odometry if by_odometry.hessian.any() else self._inflate_if_unobserved(by_odometry, prediction.inertia)
        )

    def check_since_keyframe(
        self, points: Float64, match: ScanMatch, leg: PoseGaussian, step: RelativeMotion, view: GridView
    ) -> ScanMatch:
        """The match, or another one where it contradicts the motion predicted since the last keyframe and need not.

        What walks along a corridor draws the robot with it a little by every scan, of which no single one contradicts
        odometry; all of them together do. Without what contradicts the leg, the scan is matched from where that leads
        as well, and the match so far is believed if odometry has failed and the scan shows it.

        :param leg: belief over ``map_T_base`` by the leg's prediction.
        :param step: that prediction.
        """
        prior = _map_prior(leg)
        if match.contradicts_odometry or _mahalanobis2(match.pose, prior) <= _GATE:
            return match
        still = reject_dynamic(points, match.pose, prior, view, self._mapping.alignment)
        otherwise = self._refine(points, still, prior.mean, prior, step, view)
        if not self._fits_map(points, otherwise.pose, view) or _mahalanobis2(otherwise.pose, prior) > _GATE:
            return match
        right = otherwise.log_evidence + self._log_no_fault
        return otherwise if right > match.log_evidence + self._log_fault else match

    def _fuse_with_slip(
        self, points: Float64, before: PoseGaussian, prediction: Prediction, found: ScanMatch, view: GridView
    ) -> ScanMatch:
        """The match with odometry widened along what the scan contradicts; along a corridor it still tells how far."""
        odometry = prediction.odometry
        assert odometry is not None
        predicted = se2.compose(before.mean, odometry.increment)
        information = rotate_covariance(found.hessian, -predicted[2])
        shown = np.linalg.solve(information + inverse(odometry.covariance), information)
        difference = shown @ se2.log(se2.between(predicted, found.pose))
        widened = RelativeMotion(odometry.increment, odometry.covariance + np.outer(difference, difference))
        step = widened.fuse(prediction.inertia)
        prior = _map_prior(_predict_pose(before, step))
        return self._refine(points, points, found.pose, prior, step, view)._replace(contradicts_odometry=True)

    def _inflate_if_unobserved(self, match: ScanMatch, inertia: RelativeMotion) -> ScanMatch:
        """Odometry where no scan proves it: its covariance is that of both predictions, each by its probability."""
        step = match.predicted_motion
        difference = se2.log(se2.between(step.increment, inertia.increment))
        otherwise = inertia.covariance + np.outer(difference, difference)
        return match._replace(
            predicted_motion=RelativeMotion(step.increment, step.covariance + self._fault_probability * otherwise)
        )

    def covariance(self, match: ScanMatch) -> Float64:
        """Of the pose, shape (3, 3), right tangent frame.

        Tempered: one scan after the other is matched with the same map, and errs as the one before.
        """
        return inverse(
            rotate_covariance(self._settings.temper * match.hessian + match.prior.information, -match.pose[2])
        )

    def information(self, match: ScanMatch) -> Float64:
        """What the match alone tells of the motion since the scan before, in the frame of the pose, shape (3, 3).

        For correlated beams, but not tempered: where two scans err alike, their difference does not.
        """
        return rotate_covariance(match.hessian / self._mapping.alignment.inflation, -match.pose[2])

    def _agrees_with_prediction(self, points: Float64, match: ScanMatch, view: GridView) -> bool:
        return _mahalanobis2(match.pose, match.prior) <= _GATE and self._fits_map(points, match.pose, view)

    def _fits_map(self, points: Float64, pose: Float64, view: GridView) -> bool:
        share = scan_to_map.matched_fraction(points, pose, view, self._mapping.hit_distance)
        return not len(points) or share >= self._settings.matched_fraction

    def _match_with_prior(
        self, points: Float64, before: PoseGaussian, step: RelativeMotion, view: GridView
    ) -> ScanMatch:
        """The pose under one prior; where that is wide, or the prediction leads to a poor fit, search around it."""
        predicted = _predict_pose(before, step)
        prior, covariance = _map_prior(predicted), predicted.covariance
        match = self._refine(points, self.static_points(points, prior, covariance, view), prior.mean, prior, step, view)
        if not _exceeds_basin(covariance) and self._fits_map(points, match.pose, view):
            return match
        lattice = self._search_lattice(predicted)
        starts = scan_to_map.correlative_search(
            points[:: max(1, len(points) // _SEARCH_POINTS)],
            prior,
            lattice,
            view,
            self._mapping.beam_model,
            self._settings.temper,
            _PEAKS,
        )
        found = [self._refine(points, points, start, prior, step, view) for start in starts]
        best = self._least_misfit(points, [match, *found], view)
        # Relative to unknown space: where nothing fits, the scan shows nothing of the map.
        unmatched = ScanMatch(prior.mean, np.zeros((3, 3)), prior, step, self._log_fault)
        return max([unmatched, best], key=lambda one: one.log_evidence)

    def _least_misfit(self, points: Float64, found: list[ScanMatch], view: GridView) -> ScanMatch:
        """The match of the least misfit among those that the evidence, which forgives much, does not tell apart."""
        least = max(match.log_evidence for match in found) - _AMBIGUOUS
        alike = [match for match in found if match.log_evidence >= least]
        if len(alike) == 1:
            return alike[0]
        alignment = self._mapping.alignment
        return min(alike, key=lambda one: scan_to_map.misfit(points, one.pose, one.prior, view, alignment))

    def static_points(self, points: Float64, prior: scan_to_map.Prior, covariance: Float64, view: GridView) -> Float64:
        """The points to be matched under a prior: all where its covariance is too wide to tell what moved."""
        return (
            points
            if _exceeds_basin(covariance)
            else reject_dynamic(points, prior.mean, prior, view, self._mapping.alignment)
        )

    def _refine(
        self,
        points: Float64,
        still: Float64,
        start: Float64,
        prior: scan_to_map.Prior,
        step: RelativeMotion,
        view: GridView,
    ) -> ScanMatch:
        pose, hessian = scan_to_map.align(still, start, prior, view, self._mapping.alignment)
        log_evidence = scan_to_map.laplace_log_evidence(
            points, pose, hessian, prior, view, self._mapping.beam_model, self._settings.temper
        )
        return ScanMatch(pose, hessian, prior, step, log_evidence)

    def _search_lattice(self, predicted: PoseGaussian) -> scan_to_map.Lattice:
        """The poses to search for around the one that is predicted."""
        settings, cell = self._settings, self._mapping.pool.cell
        reach = _REACH * np.sqrt(np.diag(rotate_covariance(predicted.covariance, predicted.mean[2])))
        reach[:2] = np.clip(reach[:2], settings.search_distance, settings.wide_distance)
        reach[2] = np.clip(reach[2], math.radians(settings.search_angle), math.radians(settings.wide_angle))
        turn = math.radians(settings.search_step)
        counts = np.ceil(reach / np.array([2.0 * cell, 2.0 * cell, turn])).astype(np.int64)
        return scan_to_map.Lattice(2, turn, counts)


def _predict_pose(before: PoseGaussian, step: RelativeMotion) -> PoseGaussian:
    covariance = propagate_covariance(before.covariance, step.increment) + step.covariance
    return PoseGaussian(se2.compose(before.mean, step.increment), covariance)


def _mahalanobis2(pose: Float64, prior: scan_to_map.Prior) -> float:
    """Squared Mahalanobis distance of a pose from a prior's mean."""
    return -2.0 * scan_to_map.log_prior(pose, prior)


def _map_prior(predicted: PoseGaussian) -> scan_to_map.Prior:
    return scan_to_map.Prior(predicted.mean, map_information(predicted.covariance, predicted.mean[2]))


def _exceeds_basin(covariance: Float64) -> bool:
    """Whether a pose of this covariance, in its own frame, may be beyond Gauss-Newton's basin."""
    (xx, xy, _), (_, yy, _), (_, _, turn) = covariance.tolist()
    largest = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
    return largest > (_MAX_DISTANCE / _REACH) ** 2 or turn > (_MAX_ANGLE / _REACH) ** 2


def map_information(covariance: Float64, theta: float) -> Float64:
    """Inverse, in the map frame, of a covariance in the body's tangent frame, both (3, 3)."""
    return inverse(rotate_covariance(covariance, theta))
