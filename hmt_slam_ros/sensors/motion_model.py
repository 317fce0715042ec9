"""The motion between two scans by odometry and inertia, with the noise of the odometry as it is learnt."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import matrix_inverse
from hmt_slam_ros.sensors.odometry import Odometry, OdometryBuffer
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion, increment_covariance, squared_accelerations
from hmt_slam_ros.sensors.stale_odometry import MAX_STEPS, SteadyMotionSearch

_RECENT_WEIGHT, _LONG_TERM_WEIGHT = 0.1, 0.02
"""Weight of the newest period between scans in the recent mean, and in the mean that outlasts a burst."""

_IRREGULAR = 3.0
"""Factor on the mean period beyond which a period is left out: it is due to stamps of arrival."""

_FORGETTING_FACTOR = 0.95
"""Weight of the past at each update of the odometry noise."""

_TIME_CONSTANTS = np.array([2.0, 2.0, 1.0])
"""Time for which a velocity lasts, forward, aside and turning, s."""

_JUMP = 10.0
"""Deviations of a velocity from the last one beyond which the velocity is unknown."""

_OUTLIER = 3.0
"""Deviations beyond which a step counts as slip, not as noise of the odometry."""

NOISY_FACTOR = 2.0
"""Factor on the deviations of the odometry model from which odometry counts as noisy."""


class Prediction(NamedTuple):
    """The motion since the last scan, before this scan is matched.

    :ivar odometry: by odometry, None where that is unknown.
    :ivar inertia: by the last velocity.
    :ivar fused: by odometry, and by inertia as far as odometry is noisier than its model.
    :ivar after_gap: whether scans were missing before this one, or its stamp goes back by as much.
    """

    odometry: RelativeMotion | None
    inertia: RelativeMotion
    fused: RelativeMotion
    after_gap: bool = False


@dataclass(frozen=True, eq=False)
class InertiaState:
    """The belief over the robot's velocity.

    :ivar velocity: shape (3,), the body's twist, m/s, m/s, rad/s.
    :ivar covariance: of the velocity, shape (3, 3).
    :ivar predicted_information: information of the predicted velocity, before the last update, shape (3, 3).
    :ivar long_term_period: mean time between scans over a while, s, 0 before the second scan.
    :ivar recent_period: mean time between the last scans, s, 0 before the second scan.
    :ivar last_interval: time between scans that the last prediction assumed, s.
    :ivar interval_error: shape (3,), error of the last prediction if that time is wrong, m, m, rad.
    """

    velocity: Float64
    covariance: Float64
    predicted_information: Float64
    long_term_period: float = 0.0
    recent_period: float = 0.0
    last_interval: float = 0.0
    interval_error: Float64 = field(default_factory=partial(np.zeros, 3))


class Inertia:
    """The robot's velocity from matched motions: a Kalman filter on the twist of the base.

    Stamps may be those of arrival, in bursts, while scans are taken evenly. So the time between two scans is taken for
    the mean of the difference of their stamps and of the recent period.

    :ivar state: the belief over the velocity.
    """

    def __init__(self, motion: MotionParameters, state: InertiaState | None = None) -> None:
        """:param state: to go on from."""
        self._acceleration = squared_accelerations(motion)
        self._floor = increment_covariance(np.zeros(3), motion)
        largest = self._acceleration * _TIME_CONSTANTS**2
        self._prior_information = np.linalg.inv(largest)
        self.state = state or InertiaState(np.zeros(3), largest, self._prior_information)
        self._last_forecast: tuple[InertiaState, float, tuple[RelativeMotion, InertiaState]] | None = None

    def predict(self, seconds: float) -> RelativeMotion:
        """The motion of the next ``seconds`` since the last scan."""
        motion, self.state = self.forecast(seconds)
        return motion

    def forecast(self, seconds: float) -> tuple[RelativeMotion, InertiaState]:
        """The motion of the next ``seconds`` since the last scan, and the state with it; kept for the next call."""
        last = self._last_forecast
        if last is None or last[0] is not self.state or last[1] != seconds:
            last = self._last_forecast = self.state, seconds, self._forecast(seconds)
        return last[2]

    def _forecast(self, seconds: float) -> tuple[RelativeMotion, InertiaState]:
        state = self.state
        long_term = _moving_mean(state.long_term_period, seconds, _LONG_TERM_WEIGHT)
        is_regular = long_term / _IRREGULAR < seconds < long_term * _IRREGULAR
        recent = _moving_mean(state.recent_period, seconds if is_regular else long_term, _RECENT_WEIGHT)
        interval, error = 0.5 * (seconds + recent), 0.5 * (seconds - recent) * state.velocity
        # Over a long time the velocity stays within what the accelerations admit.
        information = matrix_inverse(state.covariance + self._acceleration * interval**2) + self._prior_information
        covariance = matrix_inverse(information)
        predicted = InertiaState(state.velocity, covariance, information, long_term, recent, interval, error)
        lasting = _TIME_CONSTANTS * np.tanh(interval / _TIME_CONSTANTS)
        spread = covariance * interval**2 + np.outer(error, error) + self._floor
        return RelativeMotion(se2.exp(state.velocity * lasting), spread), predicted

    def is_gap(self, seconds: float) -> bool:
        """Whether ``seconds`` since the last scan are far more than usual, and more than a velocity lasts."""
        long_term = _moving_mean(self.state.long_term_period, seconds, _LONG_TERM_WEIGHT)
        return seconds > max(_IRREGULAR * long_term, float(_TIME_CONSTANTS.min()))

    def observe(self, increment: Float64, information: Float64, odometry: RelativeMotion | None = None) -> None:
        """Update the velocity by the motion that was predicted last.

        :param increment: ``start_T_end`` (3,) as matched.
        :param information: of the match (3, 3), in the frame of its end; 0 along directions that scans do not show.
        :param odometry: the same motion by odometry.
        """
        state = self.state
        if state.last_interval <= 0.0:
            return
        mean = se2.log(increment)
        if odometry is not None:
            by_match, by_odometry = information, matrix_inverse(odometry.covariance)
            information = by_match + by_odometry
            mean = matrix_inverse(information) @ (by_match @ mean + by_odometry @ se2.log(odometry.increment))
        # The error of the interval is common to all directions: Sherman-Morrison.
        shared = information @ state.interval_error
        information = information - np.outer(shared, shared) / (1.0 + state.interval_error @ shared)
        measured = information * state.last_interval**2
        covariance = matrix_inverse(state.predicted_information + measured)
        residual = mean / state.last_interval - state.velocity
        weighted = measured @ residual
        if float(residual @ weighted - weighted @ covariance @ weighted) > _JUMP**2:
            # One of the two poses was wrong, or the robot was kidnapped: its velocity is unknown.
            self.state = replace(state, velocity=np.zeros(3), covariance=matrix_inverse(self._prior_information))
        else:
            self.state = replace(state, velocity=state.velocity + covariance @ weighted, covariance=covariance)


def _moving_mean(mean: float, newest: float, weight: float) -> float:
    """The mean with a new value, or that value where there is no mean yet."""
    return mean + weight * (newest - mean) if mean else newest


@dataclass(frozen=True, eq=False)
class OdometryNoiseState:
    """Measured noise of the odometry relative to its model; at first that of one step as the model expects.

    :ivar weighted_ratios: shape (2,), weighted sums of squared differences to the matches, of translation and rotation,
        relative to those that the model expects.
    :ivar weights: shape (2,), the sums of these weights.
    """

    weighted_ratios: Float64 = field(default_factory=partial(np.ones, 2))
    weights: Float64 = field(default_factory=partial(np.ones, 2))


class OdometryNoise:
    """The noise of the odometry relative to its model: factors on its deviations, at least 1.

    They are squared differences between odometry and match over the last steps, relative to what the model expects.

    :ivar factors: on the deviations of translation and of rotation, shape (2,).
    """

    def __init__(self, state: OdometryNoiseState | None = None) -> None:
        """:param state: to go on from."""
        self.state = state or OdometryNoiseState()

    @property
    def state(self) -> OdometryNoiseState:
        """The sums over the last steps."""
        return self._state

    @state.setter
    def state(self, state: OdometryNoiseState) -> None:
        self._state, self.factors = state, np.sqrt(np.maximum(1.0, state.weighted_ratios / state.weights))
        self._variance_factors = _variance_factors(self.factors)
        self._lasting_factors = _variance_factors(np.minimum(self.factors, NOISY_FACTOR))

    def scale(self, odometry: RelativeMotion) -> RelativeMotion:
        """A step with the measured noise, from one with the model's covariance."""
        return RelativeMotion(odometry.increment, odometry.covariance * self._variance_factors)

    def fuse(self, odometry: RelativeMotion, interpolation: Float64, inertia: RelativeMotion) -> RelativeMotion:
        """The step by odometry and inertia together.

        Up to twice the noise of the model, errors are also due to lasting causes, such as floors and wrong radii. Noise
        beyond that, and errors of interpolation, are taken for independent from step to step, and inertia reduces them.

        :param odometry: with the model's covariance.
        :param interpolation: covariance of the error of interpolation, shape (3, 3).
        """
        lasting = odometry.covariance * self._lasting_factors
        independent = odometry.covariance * self._variance_factors - lasting + interpolation
        if not independent.any():
            return odometry._replace(covariance=lasting)
        fused = odometry._replace(covariance=independent).fuse(inertia)
        return fused._replace(covariance=fused.covariance + lasting)

    def learn(self, odometry: RelativeMotion, matched: Float64, information: Float64) -> None:
        """Update the noise by a step of odometry, with the model's covariance P, and the matched step.

        A match of covariance R moves the estimate by P (P + R)^-1 of the difference. The expected square of that, as a
        share of P, is also the share of a direction that the scans show, and the weight of the step.

        :param matched: ``start_T_end`` (3,).
        :param information: R^-1 in the frame of the end, shape (3, 3).
        """
        prior = matrix_inverse(odometry.covariance)
        expected = np.diag(np.linalg.solve(information + prior, information) @ odometry.covariance)
        squares = se2.log(se2.between(odometry.increment, matched)) ** 2
        shown = expected / np.diag(odometry.covariance)
        ratios, weights = _FORGETTING_FACTOR * self.state.weighted_ratios, _FORGETTING_FACTOR * self.state.weights
        for k, rows in enumerate(([0, 1], [2])):
            weight = shown[rows].mean()
            ratio = squares[rows].sum() / max(expected[rows].sum(), 1e-12)
            ratios[k] += weight * min(ratio, (_OUTLIER * self.factors[k]) ** 2)
            weights[k] += weight
        self.state = OdometryNoiseState(ratios, weights)


def _variance_factors(factors: Float64) -> Float64:
    """Factors on a covariance, shape (3, 3), from those on the deviations of translation and rotation."""
    scale = factors[[0, 0, 1]]
    return np.outer(scale, scale)


@dataclass(frozen=True, eq=False)
class MotionState:
    """State of the motion between scans.

    :ivar readings: the odometry readings that are still needed.
    :ivar odometry_pose: shape (3,), ``odom_T_base`` at the last scan, m and rad.
    :ivar noise: measured noise of the odometry.
    :ivar inertia: belief over the velocity, None before the first scan.
    :ivar stamp: of the last scan, ns, None before the first.
    :ivar interpolation_gap: half the product of the times from the last scan to the readings around it, s^2, None where
        odometry does not enclose it.
    :ivar since_keyframe: motion by odometry since the last keyframe event, None where it is unknown.
    :ivar last_motion: motion by odometry to the last scan, None where it is unknown.
    """

    readings: tuple[Odometry, ...] = ()
    odometry_pose: Float64 = field(default_factory=partial(np.zeros, 3))
    noise: OdometryNoiseState = field(default_factory=OdometryNoiseState)
    inertia: InertiaState | None = None
    stamp: int | None = None
    interpolation_gap: float | None = None
    since_keyframe: RelativeMotion | None = None
    last_motion: RelativeMotion | None = None


class MotionModel:
    """Prediction of the motion between scans, which learns from scan matching.

    :ivar odometry: the readings.
    :ivar noise: measured noise of the readings.
    """

    def __init__(self, motion: MotionParameters, state: MotionState | None = None) -> None:
        """:param state: to go on from."""
        state = state or MotionState()
        self.odometry = OdometryBuffer(state.readings)
        self.noise = OdometryNoise(state.noise)
        self._motion = motion
        self._inertia = Inertia(motion, state.inertia)
        self._squared_accelerations = squared_accelerations(motion)
        self._search: tuple[int, Odometry | None, SteadyMotionSearch] | None = None
        # All but the three parts above, which change in place.
        self._state = replace(state, readings=(), noise=OdometryNoiseState(), inertia=None)

    @property
    def state(self) -> MotionState:
        """The whole state, as a value."""
        return replace(
            self._state, readings=self.odometry.readings, noise=self.noise.state, inertia=self._inertia.state
        )

    @property
    def odometry_pose(self) -> Float64:
        """``odom_T_base`` (3,) at the last scan; where odometry is unknown, continued by the matched motion."""
        return self._state.odometry_pose

    def settle_odometry(self, stamp: int) -> float | None:
        """Remove stale readings before a scan is predicted; later readings may have to decide whether they are.

        :param stamp: of the scan, ns, up to which there are readings.
        :returns: time over which readings were stale, s, 0 for none; None as long as the decision is open.
        """
        last = self._state.stamp
        if last is None or self._state.interpolation_gap is None or stamp <= last:
            return 0.0
        interval = stamp - last
        count = min(MAX_STEPS, 1 + round(self._motion.patience * 1e9) // interval)
        stamps = range(stamp, stamp + count * interval, interval)
        search = self._steady_motion_search(stamp, interval * 1e-9)
        steps = search.extend(self.odometry.poses_at(stamps[search.step_count :]))
        if steps is None:
            return 0.0 if self.odometry.covers(stamps[-1]) else None
        if steps > 1:
            self.odometry.remove_between(last, last + steps * interval)
        return (steps - 1) * interval * 1e-9

    def _steady_motion_search(self, stamp: int, seconds: float) -> SteadyMotionSearch:
        """The search that goes on while a scan waits, new for each scan and sequence of readings.

        :param seconds: from the last scan to the scan at ``stamp`` (ns).
        """
        first = self.odometry.readings[0] if self.odometry.readings else None
        if self._search is None or self._search[0] != stamp or self._search[1] is not first:
            search = SteadyMotionSearch(
                self._state.odometry_pose,
                self._inertia.forecast(seconds)[0],
                self._squared_accelerations * seconds**4,
                self._odometry_covariance,
                self._motion.fault_probability,
            )
            self._search = (stamp, first, search)
        return self._search[2]

    def _odometry_covariance(self, step: Float64) -> Float64:
        """The covariance (3, 3) of odometry over a motion, a twist (3,), with the measured noise."""
        return self.noise.scale(RelativeMotion(step, increment_covariance(step, self._motion))).covariance

    def predict(self, stamp: int) -> Prediction:
        """The motion from the last scan to the scan at ``stamp``, ns; none at the first scan."""
        last_gap, last, since = self._state.interpolation_gap, self._state.stamp, self._state.since_keyframe
        step = self._odometry_motion(stamp)
        self._state = replace(self._state, stamp=stamp)
        if last is None:
            return Prediction(None, NO_MOTION, NO_MOTION)
        seconds = 1e-9 * (stamp - last)
        after_gap = self._inertia.is_gap(abs(seconds))
        inertia = self._inertia.predict(max(0.0, seconds))
        if step is None:
            self._state = replace(self._state, since_keyframe=None, last_motion=None)
            return Prediction(None, inertia, inertia, after_gap)
        interpolation = self._interpolation_covariance(last_gap, abs(seconds))
        scaled = self.noise.scale(step)
        odometry = scaled._replace(covariance=scaled.covariance + interpolation)
        total = step._replace(covariance=step.covariance + interpolation)
        self._state = replace(
            self._state, since_keyframe=None if since is None else since.compose(total), last_motion=odometry
        )
        return Prediction(odometry, inertia, self.noise.fuse(step, interpolation, inertia), after_gap)

    def _interpolation_covariance(self, last_gap: float | None, seconds: float) -> Float64:
        """Covariance (3, 3) of the error that interpolation between readings adds to the motion since the last scan.

        The error of a pose is the acceleration times ``interpolation_gap``. Within one long gap the two errors are
        alike: the motion is off by the error of its velocity, which is the acceleration times half of the gap at most.

        :param last_gap: ``interpolation_gap`` at the last scan.
        :param seconds: since then.
        """
        gap = self._state.interpolation_gap
        assert gap is not None
        assert last_gap is not None
        independent, common = last_gap**2 + gap**2, 2.0 * max(last_gap, gap) * seconds**2
        return np.asarray(min(independent, common) * self._squared_accelerations)

    def _odometry_motion(self, stamp: int) -> RelativeMotion | None:
        """The motion from the last scan by the readings, None where that is unknown at either end."""
        interpolated = self.odometry.pose_at(stamp)
        if interpolated is None:
            self._state = replace(self._state, interpolation_gap=None)
            return None
        (pose, gap), last_pose, last_gap = interpolated, self._state.odometry_pose, self._state.interpolation_gap
        self._state = replace(self._state, odometry_pose=pose, interpolation_gap=gap)
        if last_gap is None:
            return None
        increment = se2.between(last_pose, pose)
        return RelativeMotion(increment, increment_covariance(increment, self._motion))

    def observe(self, increment: Float64, information: Float64, contradicted: bool = False) -> None:
        """Update the velocity by the motion that was predicted last.

        :param increment: ``start_T_end`` (3,) as matched.
        :param information: of the match (3, 3), in the frame of its end; 0 along directions that scans do not show.
        :param contradicted: whether the scan contradicts odometry.
        """
        self._inertia.observe(increment, information, None if contradicted else self._state.last_motion)
        if self._state.interpolation_gap is None:
            self._state = replace(self._state, odometry_pose=se2.compose(self.odometry_pose, increment))

    def observe_keyframe(self, increment: Float64, information: Float64) -> None:
        """Update the noise of odometry by the motion since the last keyframe.

        :param increment: (3,), as matched.
        :param information: of the keyframe's match, in its own frame, (3, 3).
        """
        if self._state.since_keyframe is not None:
            self.noise.learn(self._state.since_keyframe, increment, information)
        self._state = replace(self._state, since_keyframe=NO_MOTION)
