"""The scan matcher: the modes of the match of a scan with a submap.

A scan is matched with the submap from the pose that odometry predicts, or from inertia where odometry fails.

Odometry is right or, with a small probability, uninformative (slip, lost readings); then inertia predicts the motion.
Each of the two is a prior, and the prior under which scan and map have the larger evidence wins. In a uniform corridor
both fit, and odometry as the sharper prior wins. Inertia is tried where odometry leads to no match, or jumps: a reset
may lead to where the map looks alike. Where a match is searched for, several poses may be probable: all of them are the
match, each with its mass.

The uncertainty that a match leaves is propagated to the next scan. Otherwise, where a corridor shows little, the pose
would stay at the first poor fit while the robot drives on. Where the uncertainty is large, the match is searched for.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import (
    PoseGaussian,
    chi_square_gate,
    matrix_inverse,
    propagate_covariance,
    rotate_covariance,
)
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.dynamic_rejection import reject_dynamic
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, is_jump
from hmt_slam_ros.submap.local_mapping import LocalMapping

_SEARCH_POINTS = 90
"""Points of a scan that a search uses, about."""

MOST_MODES = 4
"""Peaks of a search that are refined, and modes of a pose at most: docs/decisions/0050-modes-of-a-match.md."""

_MAX_DISTANCE, _MAX_ANGLE = 0.2, math.radians(6.0)
"""Error of a prediction beyond which Gauss-Newton may end in another minimum, m and rad.

Beyond it, and for poor fits, a search is used: docs/decisions/0006-pose-between-keyframes.md.
"""

_REACH = 2.5
"""Range of a search, in deviations of the prediction."""

_AMBIGUOUS = 3.0
"""Difference of the evidence below which two matches are equally good, nats: decision 0006."""

_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance up to which odometry agrees with a match; 3 degrees of freedom."""


class ScanMatch(NamedTuple):
    """One mode of the match of a scan, under one prior.

    :ivar pose: the mode, ``map_T_base``, shape (3,).
    :ivar hessian: information of the points at the mode, map coordinates, shape (3, 3).
    :ivar prior: over poses.
    :ivar predicted_motion: the motion behind the prior.
    :ivar log_evidence: of scan and map under the prior, nats.
    :ivar log_mass: log of its share among all modes, up to a constant, nats; also has the probabilities that odometry
        is right, and that the scan shows something of the map.
    :ivar contradicts_odometry: whether the scan contradicts the odometry, if there was any.
    """

    pose: Float64
    hessian: Float64
    prior: scan_to_map.Prior
    predicted_motion: RelativeMotion
    log_evidence: float
    log_mass: float
    contradicts_odometry: bool = False


class ScanMatcher:
    """Matches scans with maps."""

    def __init__(self, mapping: LocalMapping) -> None:
        self._mapping = mapping
        self._settings = mapping.configuration.matching
        self._fault_probability = mapping.configuration.motion.fault_probability
        self._log_fault, self._log_no_fault = math.log(self._fault_probability), math.log1p(-self._fault_probability)

    def match(self, points: Float64, before: PoseGaussian, prediction: Prediction, view: GridView) -> list[ScanMatch]:
        """All modes of the match of a scan, under two priors; the first is the one to believe.

        There are several only where a search was made. None is as improbable as an odometry fault against another.

        :param points: surfels of the scan, shape (n, 4), base frame.
        :param before: belief over ``map_T_base`` at the last scan.
        """
        modes = self._find_modes(points, before, prediction, view)
        return [self._without_inertia(before, prediction, mode) for mode in modes]

    def _find_modes(
        self, points: Float64, before: PoseGaussian, prediction: Prediction, view: GridView
    ) -> list[ScanMatch]:
        """The modes of :meth:`match`, in which inertia counts for scans that show nothing as well."""
        by_odometry = self._match_with_prior(points, before, prediction.fused, view)
        best = self._select_best(points, by_odometry, view)
        if prediction.odometry is None or (
            self._agrees_with_prediction(points, best, view)
            and not (best.hessian.any() and is_jump(prediction.odometry, prediction.inertia))
        ):
            return self._select_modes(points, best, by_odometry, view)
        by_inertia = self._match_with_prior(points, before, prediction.inertia, view)
        best_by_inertia = self._select_best(points, by_inertia, view)
        log_odometry = best.log_mass + self._log_no_fault
        if not self._fits_map(points, best_by_inertia.pose, view):
            # Unknown space has evidence 0, which a match outside the map has to exceed.
            log_odometry = max(0.0, log_odometry)
        best = best._replace(log_mass=log_odometry)
        if best_by_inertia.log_mass + self._log_fault > log_odometry:
            best = self._assume_slip(best_by_inertia)
        candidates = [match._replace(log_mass=match.log_mass + self._log_no_fault) for match in by_odometry]
        candidates += [self._assume_slip(match) for match in by_inertia]
        modes = self._select_modes(points, best, candidates, view)
        return [self._complete(points, before, prediction, mode, view, is_alone=len(modes) == 1) for mode in modes]

    def check_since_keyframe(
        self, points: Float64, match: ScanMatch, leg: PoseGaussian, step: RelativeMotion, view: GridView
    ) -> ScanMatch:
        """The match, or a match that agrees with the motion predicted since the last keyframe, if that is better.

        A person who walks along a corridor pulls the match a little in every scan. No single scan contradicts odometry
        then, but their sum does. So the scan is also matched from the leg's prediction, without the points that
        contradict it. The first match stands if the evidence for it outweighs an odometry fault.

        :param leg: belief over ``map_T_base`` by the prediction since the last keyframe.
        :param step: that prediction.
        """
        prior = _map_prior(leg)
        if match.contradicts_odometry or _mahalanobis2(match.pose, prior) <= _GATE:
            return match
        static = reject_dynamic(points, match.pose, prior, view, self._mapping.alignment)
        other = self._refine(points, static, prior.mean, prior, step, view)
        if not self._fits_map(points, other.pose, view) or _mahalanobis2(other.pose, prior) > _GATE:
            return match
        log_odometry = other.log_evidence + self._log_no_fault
        if log_odometry <= match.log_mass + self._log_fault:
            return match
        return other._replace(predicted_motion=match.predicted_motion, log_mass=match.log_mass)

    def _assume_slip(self, match: ScanMatch) -> ScanMatch:
        return match._replace(log_mass=match.log_mass + self._log_fault, contradicts_odometry=True)

    def _complete(
        self,
        points: Float64,
        before: PoseGaussian,
        prediction: Prediction,
        match: ScanMatch,
        view: GridView,
        *,
        is_alone: bool,
    ) -> ScanMatch:
        """A mode with what odometry still says of the motion, though the scan does not confirm it.

        :param is_alone: whether there is no other mode.
        """
        if match.contradicts_odometry:
            return self._fuse_with_slip(points, before, prediction, match, view, is_alone=is_alone)
        return match if match.hessian.any() else self._with_fault(match, prediction.inertia)

    def _fuse_with_slip(
        self,
        points: Float64,
        before: PoseGaussian,
        prediction: Prediction,
        match: ScanMatch,
        view: GridView,
        *,
        is_alone: bool,
    ) -> ScanMatch:
        """The match with odometry, widened along what the scan contradicts: in a corridor it still informs the rest.

        A mode that is not alone goes by the match where odometry is contradicted: another mode may go by odometry. Its
        mass remains that under inertia, since its prior comes from the match.
        """
        odometry = prediction.odometry
        assert odometry is not None
        predicted = se2.compose(before.mean, odometry.increment)
        information = rotate_covariance(match.hessian, -predicted[2])
        gain = np.linalg.solve(information + matrix_inverse(odometry.covariance), information)
        difference = gain @ se2.log(se2.between(predicted, match.pose))
        increment = odometry.increment if is_alone else se2.compose(odometry.increment, se2.exp(difference))
        widened = RelativeMotion(increment, odometry.covariance + np.outer(difference, difference))
        step = widened.fuse(prediction.inertia)
        prior = _map_prior(_predict_pose(before, step))
        fused = self._refine(points, points, match.pose, prior, step, view)
        return fused._replace(log_mass=match.log_mass, contradicts_odometry=True)

    @staticmethod
    def _without_inertia(before: PoseGaussian, prediction: Prediction, match: ScanMatch) -> ScanMatch:
        """A match without evidence has the covariance of odometry: velocities that no scan shows add nothing to it."""
        if match.hessian.any() or prediction.odometry is None or match.predicted_motion is not prediction.fused:
            return match
        step = prediction.fused._replace(covariance=prediction.odometry.covariance)
        return match._replace(predicted_motion=step, prior=_map_prior(_predict_pose(before, step)))

    def _with_fault(self, match: ScanMatch, inertia: RelativeMotion) -> ScanMatch:
        """A match without evidence for odometry: its covariance is that of both predictions, by their probabilities."""
        step = match.predicted_motion
        difference = se2.log(se2.between(step.increment, inertia.increment))
        fault = self._fault_probability * (inertia.covariance + np.outer(difference, difference))
        return match._replace(predicted_motion=RelativeMotion(step.increment, step.covariance + fault).bound_heading())

    def covariance(self, match: ScanMatch) -> Float64:
        """Covariance of the pose, shape (3, 3), right tangent frame.

        Tempered, since successive scans are matched with the same map and have common errors.
        """
        return matrix_inverse(
            rotate_covariance(self._settings.temper * match.hessian + match.prior.information, -match.pose[2])
        )

    def information(self, match: ScanMatch) -> Float64:
        """Information of the match alone on the motion since the last scan, in the frame of the pose, shape (3, 3).

        For correlated beams, but not tempered: common errors of two scans cancel in their difference.
        """
        return rotate_covariance(match.hessian / self._mapping.alignment.inflation, -match.pose[2])

    def _agrees_with_prediction(self, points: Float64, match: ScanMatch, view: GridView) -> bool:
        return _mahalanobis2(match.pose, match.prior) <= _GATE and self._fits_map(points, match.pose, view)

    def _fits_map(self, points: Float64, pose: Float64, view: GridView) -> bool:
        share = scan_to_map.matched_fraction(points, pose, view, self._mapping.hit_distance)
        return not len(points) or share >= self._settings.matched_fraction

    def _match_with_prior(
        self, points: Float64, before: PoseGaussian, step: RelativeMotion, view: GridView
    ) -> list[ScanMatch]:
        """The match under one prior, and those of a search where it is wide, or the prediction leads to a poor fit."""
        predicted = _predict_pose(before, step)
        prior, covariance = _map_prior(predicted), predicted.covariance
        match = self._refine(points, self.static_points(points, prior, covariance, view), prior.mean, prior, step, view)
        if not exceeds_basin(covariance) and self._fits_map(points, match.pose, view):
            return [match]
        lattice = self._search_lattice(predicted)
        starts = scan_to_map.correlative_search(
            points[:: max(1, len(points) // _SEARCH_POINTS)],
            prior,
            lattice,
            view,
            self._mapping.beam_model,
            self._settings.temper,
            MOST_MODES,
        )
        return [match, *(self._refine(points, points, start, prior, step, view) for start in starts)]

    def _select_best(self, points: Float64, matches: list[ScanMatch], view: GridView) -> ScanMatch:
        """The best match under one prior; its prediction where nothing matches."""
        if len(matches) == 1:
            return matches[0]
        best = self._least_misfit(points, matches, view)
        # Evidence is relative to unknown space: the scan may show nothing of the map, which is as improbable as a fault
        # against a match that fits it. One that does not has to exceed unknown space.
        least = self._log_fault if self._fits_map(points, best.pose, view) else 0.0
        return best if best.log_evidence > least else self._make_unmatched(best)

    def _make_unmatched(self, match: ScanMatch) -> ScanMatch:
        """The prediction behind a match, for a scan that shows nothing of the map."""
        return match._replace(
            pose=match.prior.mean, hessian=np.zeros((3, 3)), log_evidence=0.0, log_mass=self._log_fault
        )

    def _select_modes(
        self, points: Float64, best: ScanMatch, matches: list[ScanMatch], view: GridView
    ) -> list[ScanMatch]:
        """The distinct modes among matches that fit the map, and that the scan shows nothing of it; the best one first.

        :param matches: of a search; the first is that of the prediction to go by where nothing matches. A single one is
            the best.
        """
        if len(matches) == 1:
            return [best]
        candidates = [match for match in matches if self._fits_map(points, match.pose, view)]
        unmatched = self._make_unmatched(matches[0])
        # Where the map contradicts the scan at the prediction, it is not new ground that the scan shows.
        contradiction = min(0.0, matches[0].log_evidence)
        candidates.append(unmatched._replace(log_mass=unmatched.log_mass + contradiction))
        least = max(match.log_mass for match in (best, *candidates)) + self._log_fault
        modes = [best]
        for match in sorted(candidates, key=lambda match: -match.log_mass):
            if match.log_mass > least and not any(coincide(match.pose, mode.pose) for mode in modes):
                modes.append(match)
        modes = modes[:MOST_MODES]
        # Odometry leads where a slip is not clearly more probable.
        probable = [mode for mode in modes if mode.log_mass >= best.log_mass - _AMBIGUOUS]
        lead = next((mode for mode in probable if not mode.contradicts_odometry), best)
        return [lead, *(mode for mode in modes if mode is not lead)]

    def _least_misfit(self, points: Float64, matches: list[ScanMatch], view: GridView) -> ScanMatch:
        """The match of least misfit among those of about the largest evidence, which is robust but not precise."""
        least = max(match.log_evidence for match in matches) - _AMBIGUOUS
        candidates = [match for match in matches if match.log_evidence >= least]
        if len(candidates) == 1:
            return candidates[0]
        alignment = self._mapping.alignment
        return min(candidates, key=lambda match: scan_to_map.misfit(points, match.pose, match.prior, view, alignment))

    def static_points(self, points: Float64, prior: scan_to_map.Prior, covariance: Float64, view: GridView) -> Float64:
        """The points on static objects; all where the covariance of the prior is too wide to decide."""
        if exceeds_basin(covariance):
            return points
        return reject_dynamic(points, prior.mean, prior, view, self._mapping.alignment)

    def _refine(
        self,
        points: Float64,
        static: Float64,
        start: Float64,
        prior: scan_to_map.Prior,
        step: RelativeMotion,
        view: GridView,
    ) -> ScanMatch:
        pose, hessian = scan_to_map.align(static, start, prior, view, self._mapping.alignment)
        log_evidence = scan_to_map.laplace_log_evidence(
            points, pose, hessian, prior, view, self._mapping.beam_model, self._settings.temper
        )
        return ScanMatch(pose, hessian, prior, step, log_evidence, log_evidence)

    def _search_lattice(self, predicted: PoseGaussian) -> scan_to_map.Lattice:
        """The lattice of poses around the prediction."""
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


def coincide(pose: Float64, other: Float64) -> bool:
    """Whether two poses, each (3,), are in the same basin of Gauss-Newton."""
    x, y, turn = se2.between(pose, other).tolist()
    return math.hypot(x, y) <= _MAX_DISTANCE and abs(turn) <= _MAX_ANGLE


def exceeds_basin(covariance: Float64) -> bool:
    """Whether a pose of this covariance, in its own frame, may be outside the basin of Gauss-Newton."""
    (xx, xy, _), (_, yy, _), (_, _, turn) = covariance.tolist()
    largest = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
    return largest > (_MAX_DISTANCE / _REACH) ** 2 or turn > (_MAX_ANGLE / _REACH) ** 2


def map_information(covariance: Float64, theta: float) -> Float64:
    """Inverse, in the map frame, of a covariance in the body's tangent frame, both (3, 3)."""
    return matrix_inverse(rotate_covariance(covariance, theta))
