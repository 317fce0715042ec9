"""Where the robot goes between two scans, and how far that is to be trusted: by its odometry, by its inertia alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.covariance import inverse, propagate_covariance
from hmt_slam_ros.sensors.odometry import Odometry, OdometryBuffer

# Weight of the newest scan in the mean time between scans, of late and over a while that outlasts a burst.
_RECENT_WEIGHT, _LONG_TERM_WEIGHT = 0.1, 0.02
# A time between two scans beyond this factor on the usual is one of stamps of arrival.
_IRREGULAR = 3.0
# Weight of the past when odometry is judged once more.
_FORGETTING_FACTOR = 0.95
# For about this time, in s, a robot goes on as it went, forward and aside, and turning.
_TIME_CONSTANTS = np.array([2.0, 2.0, 1.0])
# A velocity that is so many deviations from the one before was none.
_JUMP = 10.0
# A step beyond this many deviations says that something slipped, not how noisy the odometry is.
_OUTLIER = 3.0
# Odometry with more than this many times the noise of its model is called noisy.
NOISY_FACTOR = 2.0
_DEGREES, _RADIANS = 180.0 / math.pi, math.pi / 180.0

Length = TypeVar("Length", float, NDArray[np.float64])


class RelativeMotion(NamedTuple):
    """A motion between two scans.

    :ivar increment: shape (3,), ``start_T_end``.
    :ivar covariance: shape (3, 3), in the frame of its end.
    """

    increment: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def compose(self, other: RelativeMotion) -> RelativeMotion:
        """Both motions, one after the other."""
        before = propagate_covariance(self.covariance, other.increment)
        return RelativeMotion(se2.compose(self.increment, other.increment), before + other.covariance)

    def fuse(self, other: RelativeMotion) -> RelativeMotion:
        """The same motion, of which two sources tell independently: the product of both Gaussians."""
        gain = self.covariance @ inverse(self.covariance + other.covariance)
        difference = se2.log(se2.between(self.increment, other.increment))
        increment = se2.compose(self.increment, se2.exp(gain @ difference))
        return RelativeMotion(increment, self.covariance - gain @ self.covariance)


NO_MOTION = RelativeMotion(np.zeros(3), np.zeros((3, 3)))
"""The robot stood still, for certain."""


class Prediction(NamedTuple):
    """The motion since the last scan, before this one is matched.

    :ivar odometry: what odometry says, None where it says nothing.
    :ivar inertia: what the velocity says.
    :ivar fused: what odometry says, and inertia as far as that is noisier than its model.
    """

    odometry: RelativeMotion | None
    inertia: RelativeMotion
    fused: RelativeMotion


@dataclass(frozen=True, eq=False)
class InertiaState:
    """What is known of the robot's velocity.

    :ivar velocity: shape (3,), the body's twist, m/s, m/s, rad/s.
    :ivar covariance: of the velocity, shape (3, 3).
    :ivar predicted_information: its information as predicted, before the last motion was observed, shape (3, 3).
    :ivar long_term_period: mean time between scans over a while, s, 0 before the second scan.
    :ivar recent_period: mean time between scans of late, s, likewise.
    :ivar last_interval: the time that the last prediction took for that between two scans, s.
    :ivar interval_error: shape (3,), how far off the last prediction is if that time is not true, m, m, rad.
    """

    velocity: NDArray[np.float64]
    covariance: NDArray[np.float64]
    predicted_information: NDArray[np.float64]
    long_term_period: float = 0.0
    recent_period: float = 0.0
    last_interval: float = 0.0
    interval_error: NDArray[np.float64] = field(default_factory=partial(np.zeros, 3))


class Inertia:
    """The robot's velocity, from the motions that scan matching found: a Kalman filter on the body's twist.

    Stamps may be those of arrival, in bursts, while the scans were taken evenly; so the time between two scans is
    taken to lie between its stamps' difference and the mean of late.
    """

    def __init__(self, motion: MotionParameters, state: InertiaState | None = None) -> None:
        """:param state: to go on from."""
        self._acceleration = _squared_accelerations(motion)
        self._floor = increment_covariance(np.zeros(3), motion)
        usual = self._acceleration * _TIME_CONSTANTS**2
        self._prior_information = np.linalg.inv(usual)
        state = state or InertiaState(np.zeros(3), usual, self._prior_information)
        self._velocity, self._covariance, self._predicted_information = (
            state.velocity,
            state.covariance,
            state.predicted_information,
        )
        self._long_term_period, self._recent_period = state.long_term_period, state.recent_period
        self._last_interval, self._interval_error = state.last_interval, state.interval_error

    @property
    def state(self) -> InertiaState:
        """All that is known."""
        return InertiaState(
            self._velocity,
            self._covariance,
            self._predicted_information,
            self._long_term_period,
            self._recent_period,
            self._last_interval,
            self._interval_error,
        )

    def predict(self, seconds: float) -> RelativeMotion:
        """The motion of the next ``seconds`` since the last scan."""
        self._update_periods(seconds)
        self._last_interval = 0.5 * (seconds + self._recent_period)
        self._interval_error = 0.5 * (seconds - self._recent_period) * self._velocity
        changed = self._covariance + self._acceleration * self._last_interval**2
        # However long it takes, the velocity stays within the usual.
        self._predicted_information = inverse(changed) + self._prior_information
        self._covariance = inverse(self._predicted_information)
        lasting = _TIME_CONSTANTS * np.tanh(self._last_interval / _TIME_CONSTANTS)
        spread = (
            self._covariance * self._last_interval**2
            + np.outer(self._interval_error, self._interval_error)
            + self._floor
        )
        return RelativeMotion(se2.exp(self._velocity * lasting), spread)

    def _update_periods(self, seconds: float) -> None:
        """Take the time since the last scan into the means; the first one makes them."""
        self._long_term_period = (
            self._long_term_period + _LONG_TERM_WEIGHT * (seconds - self._long_term_period)
            if self._long_term_period
            else seconds
        )
        regular = self._long_term_period / _IRREGULAR < seconds < self._long_term_period * _IRREGULAR
        newest = seconds if regular else self._long_term_period
        self._recent_period = (
            self._recent_period + _RECENT_WEIGHT * (newest - self._recent_period) if self._recent_period else newest
        )

    def observe(
        self, increment: NDArray[np.float64], information: NDArray[np.float64], odometry: RelativeMotion | None = None
    ) -> None:
        """Learn from the motion that was predicted last.

        :param increment: ``start_T_end`` (3,) as matched.
        :param information: of the match (3, 3), in the frame of its end; 0 along directions that scans do not show.
        :param odometry: what odometry says of it.
        """
        if self._last_interval <= 0.0:
            return
        mean = se2.log(increment)
        if odometry is not None:
            matched, told = information, inverse(odometry.covariance)
            information = matched + told
            mean = inverse(information) @ (matched @ mean + told @ se2.log(odometry.increment))
        doubted = information @ self._interval_error
        certain = information - np.outer(doubted, doubted) / (1.0 + self._interval_error @ doubted)
        measured = certain * self._last_interval**2
        self._covariance = inverse(self._predicted_information + measured)
        residual = mean / self._last_interval - self._velocity
        told = measured @ residual
        if float(residual @ told - told @ self._covariance @ told) > _JUMP**2:
            # One of the two poses was wrong, or the robot was carried: nothing is known of its velocity.
            self._velocity, self._covariance = np.zeros(3), inverse(self._prior_information)
        else:
            self._velocity = self._velocity + self._covariance @ told


@dataclass(frozen=True, eq=False)
class OdometryNoiseState:
    """What odometry turned out to be worth; at first, one step that was as the model says.

    So the first few steps do not count for much.

    :ivar weighted_ratios: shape (2,), weighted sums of the squared differences of late, of translation and rotation,
        against what the model expects of them.
    :ivar weights: shape (2,), the sums of these weights.
    """

    weighted_ratios: NDArray[np.float64] = field(default_factory=partial(np.ones, 2))
    weights: NDArray[np.float64] = field(default_factory=partial(np.ones, 2))


class OdometryNoise:
    """How many times as noisy as its model the odometry turned out to be: factors on its deviations, at least 1.

    The squared difference between odometry and match over the steps of late, against what the model expects of it.
    """

    def __init__(self, state: OdometryNoiseState | None = None) -> None:
        """:param state: to go on from."""
        state = state or OdometryNoiseState()
        self._weighted_ratios, self._weights = state.weighted_ratios.copy(), state.weights.copy()
        self._variance_factors = self._squared_factors()

    @property
    def state(self) -> OdometryNoiseState:
        """All that is known."""
        return OdometryNoiseState(self._weighted_ratios.copy(), self._weights.copy())

    def _squared_factors(self) -> NDArray[np.float64]:
        """On a covariance, shape (3, 3)."""
        scale = self.factors[[0, 0, 1]]
        return np.outer(scale, scale)

    @property
    def factors(self) -> NDArray[np.float64]:
        """On the deviation of translation and of rotation, shape (2,)."""
        return np.sqrt(np.maximum(1.0, self._weighted_ratios / self._weights))

    def scale(self, odometry: RelativeMotion) -> RelativeMotion:
        """A step with the model's covariance, with that which it turned out to have."""
        return odometry._replace(covariance=odometry.covariance * self._variance_factors)

    def fuse(self, odometry: RelativeMotion, inertia: RelativeMotion) -> RelativeMotion:
        """The step as inertia and odometry tell it together.

        Up to twice the noise of the model, errors are also due to what lasts, such as floors and wrong radii; what is
        beyond is taken to be independent from step to step, and is what inertia reduces.

        :param odometry: with the model's covariance.
        """
        if (self.factors <= NOISY_FACTOR).all():
            return self.scale(odometry)
        usual = np.minimum(self.factors, NOISY_FACTOR)[[0, 0, 1]]
        lasting = odometry.covariance * np.outer(usual, usual)
        beyond = odometry._replace(covariance=odometry.covariance * self._variance_factors - lasting)
        both = beyond.fuse(inertia)
        return both._replace(covariance=both.covariance + lasting)

    def learn(self, odometry: RelativeMotion, matched: NDArray[np.float64], information: NDArray[np.float64]) -> None:
        """Compare a step by odometry, with the model's covariance P, with the matched one.

        A match of covariance R moves the estimate by P (P + R)^-1 of the difference. What that is expected to be, as
        a share of P, is also how much the scans show of a direction, and the weight of the step.

        :param matched: ``start_T_end`` (3,).
        :param information: R^-1 in the frame of the end, shape (3, 3).
        """
        prior = inverse(odometry.covariance)
        expected = np.diag(np.linalg.solve(information + prior, information) @ odometry.covariance)
        squares = se2.log(se2.between(odometry.increment, matched)) ** 2
        shown = expected / np.diag(odometry.covariance)
        for k, rows in enumerate(([0, 1], [2])):
            weight = shown[rows].mean()
            ratio = squares[rows].sum() / max(expected[rows].sum(), 1e-12)
            self._weighted_ratios[k] = _FORGETTING_FACTOR * self._weighted_ratios[k] + weight * min(
                ratio, (_OUTLIER * self.factors[k]) ** 2
            )
            self._weights[k] = _FORGETTING_FACTOR * self._weights[k] + weight
        self._variance_factors = self._squared_factors()


@dataclass(frozen=True, eq=False)
class MotionState:
    """What is known of the motion between scans.

    :ivar readings: the odometry readings that are still needed.
    :ivar odometry_pose: shape (3,), ``odom_T_base`` at the last scan, m and rad.
    :ivar noise: what odometry turned out to be worth.
    :ivar inertia: what is known of the velocity, None before the first scan.
    :ivar stamp: of the last scan, ns, None before the first.
    :ivar interpolation_gap: half the product of the times from the last scan to the readings around it, s^2, None where
        odometry does not enclose it.
    :ivar since_keyframe: the motion by odometry since the last keyframe event, None where it is unknown.
    :ivar last_motion: the motion by odometry to the last scan, likewise.
    """

    readings: tuple[Odometry, ...] = ()
    odometry_pose: NDArray[np.float64] = field(default_factory=partial(np.zeros, 3))
    noise: OdometryNoiseState = field(default_factory=OdometryNoiseState)
    inertia: InertiaState | None = None
    stamp: int | None = None
    interpolation_gap: float | None = None
    since_keyframe: RelativeMotion | None = None
    last_motion: RelativeMotion | None = None


class MotionModel:
    """Predicts the motion between scans, and learns from what scan matching makes of it.

    :ivar odometry: the readings.
    :ivar noise: what they turned out to be worth.
    :ivar odometry_pose: ``odom_T_base`` (3,) at the last scan; where odometry said nothing, carried on as matched.
    """

    def __init__(self, motion: MotionParameters, state: MotionState | None = None) -> None:
        """:param state: to go on from."""
        state = state or MotionState()
        self.odometry = OdometryBuffer(state.readings)
        self.noise = OdometryNoise(state.noise)
        self.odometry_pose = state.odometry_pose
        self._motion = motion
        self._inertia = Inertia(motion, state.inertia)
        self._squared_accelerations = _squared_accelerations(motion)
        self._stamp, self._interpolation_gap = state.stamp, state.interpolation_gap
        self._since_keyframe, self._last_motion = state.since_keyframe, state.last_motion

    @property
    def state(self) -> MotionState:
        """All that is known."""
        return MotionState(
            self.odometry.readings,
            self.odometry_pose,
            self.noise.state,
            self._inertia.state,
            self._stamp,
            self._interpolation_gap,
            self._since_keyframe,
            self._last_motion,
        )

    def predict(self, stamp: int) -> Prediction:
        """The motion from the last scan to the one at ``stamp``, ns; at the first scan, which sets the start, none."""
        step = self._odometry_motion(stamp)
        if self._stamp is None:
            self._stamp = stamp
            return Prediction(None, NO_MOTION, NO_MOTION)
        seconds = max(0.0, 1e-9 * (stamp - self._stamp))
        self._stamp = stamp
        if self._since_keyframe is not None:
            self._since_keyframe = None if step is None else self._since_keyframe.compose(step)
        inertia = self._inertia.predict(seconds)
        self._last_motion = None if step is None else self.noise.scale(step)
        return Prediction(self._last_motion, inertia, inertia if step is None else self.noise.fuse(step, inertia))

    def _odometry_motion(self, stamp: int) -> RelativeMotion | None:
        """What odometry says of the motion from the last scan, None where it is unknown at either end."""
        found, gap = self.odometry.pose_at(stamp), self._interpolation_gap
        if found is None:
            self._interpolation_gap = None
            return None
        before, (self.odometry_pose, self._interpolation_gap) = self.odometry_pose, found
        if gap is None:
            return None
        increment = se2.between(before, self.odometry_pose)
        covariance = increment_covariance(increment, self._motion)
        return RelativeMotion(
            increment, covariance + (gap**2 + self._interpolation_gap**2) * self._squared_accelerations
        )

    def observe(
        self, increment: NDArray[np.float64], information: NDArray[np.float64], contradicted: bool = False
    ) -> None:
        """Learn the velocity from the motion that was predicted last.

        :param increment: ``start_T_end`` (3,) as matched.
        :param information: of the match (3, 3), in the frame of its end; 0 along directions that scans do not show.
        :param contradicted: whether the scan contradicts odometry.
        """
        self._inertia.observe(increment, information, None if contradicted else self._last_motion)
        if self._interpolation_gap is None:
            self.odometry_pose = se2.compose(self.odometry_pose, increment)

    def observe_keyframe(self, increment: NDArray[np.float64], information: NDArray[np.float64]) -> None:
        """Learn the noise of odometry from the motion since the last keyframe.

        :param increment: (3,), as matched.
        :param information: of the keyframe's match, in its own frame, (3, 3).
        """
        if self._since_keyframe is not None:
            self.noise.learn(self._since_keyframe, increment, information)
        self._since_keyframe = NO_MOTION


def _squared_accelerations(motion: MotionParameters) -> NDArray[np.float64]:
    """Squares of the accelerations that robots have, on the diagonal (3, 3), in m^2/s^4 and rad^2/s^4."""
    return np.diag([motion.acceleration**2, motion.acceleration**2, math.radians(motion.turn_acceleration) ** 2])


def increment_covariance(increment: NDArray[np.float64], motion: MotionParameters) -> NDArray[np.float64]:
    """Covariance (3, 3) of an odometry increment in the frame of its end, m and rad."""
    return path_covariance(math.hypot(increment[0], increment[1]), abs(float(se2.wrap(increment[2]))), motion)


def path_covariance(distance: float, angle: float, motion: MotionParameters) -> NDArray[np.float64]:
    """Covariance (3, 3) of the odometry over a path, in the frame of its end, m and rad.

    Standard deviations grow linearly with the distance (m) and the angle (rad) travelled; the lateral deviation equals
    the longitudinal one.
    """
    translation, rotation = path_standard_deviations(distance, angle, motion)
    return np.array(((translation**2, 0.0, 0.0), (0.0, translation**2, 0.0), (0.0, 0.0, rotation**2)))


def path_standard_deviations(distance: Length, angle: Length, motion: MotionParameters) -> tuple[Length, Length]:
    """The deviations of translation (m), in either direction, and rotation (rad) that `path_covariance` squares.

    :param distance: m, one or an array of them.
    :param angle: rad, likewise.
    """
    translation = (
        motion.translation_floor
        + motion.translation_from_translation * distance
        + motion.translation_from_rotation * (angle * _DEGREES)
    )
    rotation = (motion.rotation_floor + motion.rotation_from_translation * distance) * _RADIANS
    return translation, rotation + motion.rotation_from_rotation * angle
