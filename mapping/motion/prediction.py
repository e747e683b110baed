"""Prediction of the next scan's pose and velocity by a Kalman filter of the last motion and the odometry."""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log
from lidarslam.core.state import TRANSFORM, Shape
from lidarslam.core.tracking import AXES
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import body_velocity

# Least standard deviations of any pose, rotation first.
LEAST_SIGMA = np.array([np.deg2rad(0.1)] * 3 + [0.005] * 3)
# Covariances (12, 12) of pose and velocity, where the velocity is unknown, and where tracking was lost.
_ANY_VELOCITY = np.array([np.deg2rad(100.0)] * 3 + [15.0] * 3)
UNKNOWN_VELOCITY = np.diag(np.concatenate([LEAST_SIGMA, _ANY_VELOCITY]) ** 2)
LOST_MOTION = np.diag(np.concatenate([[np.deg2rad(20.0)] * 3 + [1.0] * 3, _ANY_VELOCITY]) ** 2)
# Standard deviation along directions held at the prediction, m and m/s.
_HELD = 0.001
# The velocity of a lost sensor fades by this factor per scan.
FADING = 0.7
# Bounds of the process noise: standard deviations of the acceleration, rotation (rad/s^2) and translation (m/s^2).
_LEAST_ACCELERATION, _LARGEST_ACCELERATION = (np.deg2rad(150.0), 3.0), (np.deg2rad(4000.0), 60.0)
# Exponential smoothing of the observed acceleration, and factor above it: accelerations come in bursts.
_PROCESS_SMOOTHING, _PROCESS_MARGIN = 0.1, 4.0
# The mean velocity of an odometry differs from the velocity during the sweep by this factor of its standard deviation.
_VELOCITY_INFLATION = 2.0
# Error of a constant velocity within a sweep, per acceleration and square of the duration.
_UNEVEN = 1.0 / 8.0
# Smoothing of the odometry's normalised error and its square, and the gate of the latter: chi square, six degrees of
# freedom, 1 in 10,000.
_ODOMETRY_SMOOTHING, _GATE = 0.2, 27.9
# Directions with larger standard deviations are not measured: rotation, radians, and translation, metres.
_LARGEST_MEASURED = np.array([0.1] * 3 + [1.0] * 3)
# An odometry conflicts with a registration where their translations differ by more than this squared Mahalanobis
# distance by its own covariance, by this much, and by this share of the motion, but no faster than people walk: an
# odometry that is off by more than that is overruled.
_CONFLICT_SQUARED, _CONFLICT_M, _CONFLICT_SHARE, _WALKING_M_S = 16.0, 0.03, 0.25, 2.0
# Consistent motions in a row after which an odometry may reject a registration.
_PROVEN_AFTER = 10
# Share of the difference between a motion and the velocity of its sweeps that is corrected, and the largest difference
# that counts, rad/s and m/s: a sudden acceleration makes a larger one.
_CORRECTED_SHARE = 0.3
_MOST_CHANGE = np.array([np.deg2rad(3.0)] * 3 + [0.2] * 3)
# Sweeps follow one another where they cover this share of the interval between their stamps.
_COVERED = 0.8


@dataclass(frozen=True, eq=False)
class GravityDirection:
    """A measurement of gravity's direction: unit vectors upwards."""

    lidar: Annotated[FloatArray, Shape(3)]  # (3,) as measured, in the LiDAR frame
    world: Annotated[FloatArray, Shape(3)]  # (3,) as expected, in the world
    covariance: Annotated[FloatArray, Shape(3, 3)]  # (3, 3) of their difference, in the LiDAR frame

    def turned(self, R_prev_curr: FloatArray) -> "GravityDirection":
        """The direction in the LiDAR frame after a turn (3, 3)."""
        covariance = R_prev_curr.T @ self.covariance @ R_prev_curr
        return GravityDirection(R_prev_curr.T @ self.lidar, self.world, covariance)


@dataclass(frozen=True, eq=False)
class Prior:
    """Measurements of a scan's motion by odometry and IMU; None where there is none."""

    T_prev_curr: FloatArray | None = None  # (4, 4) motion since the previous scan
    velocity: FloatArray | None = None  # (6,) during the sweep, in the LiDAR frame, rotation first
    # (6, 6) of the error `xi` in `T_true = T_prev_curr @ exp(xi)`, rotation first; None for the configured standard
    # deviations
    covariance: FloatArray | None = None
    inertial: "MotionState | None" = None  # the state that an IMU predicts
    turn_rate: FloatArray | None = None  # (3,) of the first sweep, where it was estimated apart, in the LiDAR frame
    is_smoothed: bool = False  # whether the smoothed start estimated it
    caution: float = 10.0  # factor on the odometry's own standard deviations: its errors are correlated in time

    def motion_covariance(self, config: MappingConfig) -> FloatArray:
        """(6, 6) of the motion: the odometry's own, with its caution, or the configured one."""
        if self.covariance is not None:
            return np.asarray(self.caution**2 * self.covariance, dtype=np.float64)
        sigmas = np.array([np.deg2rad(config.prior_rotation_deg)] * 3 + [config.prior_translation_m] * 3)
        return np.asarray(np.diag(sigmas**2), dtype=np.float64)

    def allows(self, T_prev_curr: FloatArray) -> bool:
        """Whether a motion (4, 4) is within the odometry's own uncertainty; true where it has none."""
        if self.covariance is None or self.T_prev_curr is None:
            return True
        return _squared_error(self, T_prev_curr, self.covariance) < _GATE


@dataclass(frozen=True, eq=False)
class MotionState:
    """Pose and velocity of a scan with 12 degrees of freedom."""

    stamp: float  # seconds
    T_world_lidar: Annotated[FloatArray, TRANSFORM]  # (4, 4) at the stamp
    velocity: Annotated[FloatArray, Shape(6)]  # (6,) during the sweep, in the LiDAR frame, rotation first
    # (12, 12) of the errors of pose and velocity; the pose's is `xi` in `T_true = T_world_lidar @ exp(xi)`
    covariance: Annotated[FloatArray, Shape(12, 12)]
    seen_until_s: float = 0.0  # time from the stamp to the sweep's last point, over which the velocity was observed

    def fused(self, other: "MotionState") -> "MotionState":
        """The mean of two states, weighted by their information."""
        gain = np.linalg.solve(self.covariance + other.covariance, self.covariance).T
        away = np.concatenate([log(inverse(self.T_world_lidar) @ other.T_world_lidar), other.velocity - self.velocity])
        step, P = gain @ away, self.covariance - gain @ self.covariance
        T, velocity = self.T_world_lidar @ exp(step[:6]), self.velocity + step[6:]
        return replace(self, T_world_lidar=T, velocity=velocity, covariance=0.5 * (P + P.T))


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """A pose, and the information of its error `xi` in `T_true = T_world_lidar @ exp(xi)`, rotation first."""

    T_world_lidar: FloatArray  # (4, 4); arbitrary along directions that are not measured
    information: FloatArray  # (6, 6), zero along directions that are not measured

    @classmethod
    def minimum(cls, T_world_lidar: FloatArray, hessian: FloatArray, gradient: FloatArray) -> "MeasuredPose":
        """The minimum of a cost with Hessian (6, 6) and gradient (6,) at a pose (4, 4)."""
        values, vectors = np.linalg.eigh(hessian * np.outer(_LARGEST_MEASURED, _LARGEST_MEASURED))
        axes, values = vectors[:, values > 1.0], values[values > 1.0]
        step = -_LARGEST_MEASURED * (axes @ ((axes.T @ (_LARGEST_MEASURED * gradient)) / values))
        rows = axes / _LARGEST_MEASURED[:, None]
        return cls(T_world_lidar @ exp(step), np.asarray((rows * values) @ rows.T, dtype=np.float64))

    def without(self, direction: FloatArray) -> "MeasuredPose":
        """The measurement, marginalised over a direction (6,) of the error."""
        along = self.information @ direction
        total = float(direction @ along)
        return self if total <= 0.0 else replace(self, information=self.information - np.outer(along, along) / total)


@dataclass(frozen=True)
class ProcessNoise:
    """White noise of the sensor's acceleration: standard deviations, adapted to the observed motion."""

    rotation: float = float(np.deg2rad(1000.0))  # about each axis, rad/s^2
    translation: float = 15.0  # along each axis, m/s^2

    @property
    def acceleration(self) -> FloatArray:
        """(6,) rotation first."""
        return np.array([self.rotation] * 3 + [self.translation] * 3)

    def updated(self, change: FloatArray, interval_s: float, variance: FloatArray) -> "ProcessNoise":
        """The noise after a change (6,) of the estimated velocity within an interval.

        The change's own variance (6,) is subtracted: estimates that scatter for lack of structure are no acceleration.
        """
        observed = (np.maximum(change**2 - variance, 0.0) / interval_s**2).reshape(2, 3).mean(axis=1)
        before = np.array([self.rotation, self.translation])
        squared = (1.0 - _PROCESS_SMOOTHING) * before**2 + _PROCESS_SMOOTHING * _PROCESS_MARGIN**2 * observed
        rotation, translation = np.clip(np.sqrt(squared), _LEAST_ACCELERATION, _LARGEST_ACCELERATION)
        return ProcessNoise(float(rotation), float(translation))


LARGEST_PROCESS_NOISE = ProcessNoise(*_LARGEST_ACCELERATION)


@dataclass(frozen=True, eq=False)
class OdometryNoise:
    """Scale of an odometry's errors against its stated covariance."""

    variance: float = 1.0  # factor on the covariance, at least one
    agreed: int = 0  # consistent motions in a row
    mean: Annotated[FloatArray, Shape(6)] = field(default_factory=lambda: np.zeros(6))  # smoothed error

    def updated(self, prior: Prior, T_prev_curr: FloatArray, config: MappingConfig) -> "OdometryNoise":
        """The noise after a registered motion (4, 4), by the odometry's normalised squared error."""
        if prior.T_prev_curr is None:
            return self
        error = log(inverse(prior.T_prev_curr) @ T_prev_curr)
        squared = float(error @ np.linalg.solve(prior.motion_covariance(config), error))
        variance = max(1.0, self.variance + _ODOMETRY_SMOOTHING * (squared / 6.0 - self.variance))
        mean = self.mean + _ODOMETRY_SMOOTHING * (error - self.mean)
        return OdometryNoise(variance, self.agreed + 1 if squared < _GATE * self.variance else 0, mean)

    def covariance(self, prior: Prior, config: MappingConfig) -> FloatArray:
        """(6, 6) of a motion for the prediction: inflated by large errors, and by a bias, which poses would inherit.

        The bias is tested by the normalised square of the mean error: `6 a / (2 - a)` for independent errors that are
        smoothed by a.
        """
        covariance = prior.motion_covariance(config)
        own = covariance if prior.covariance is None else prior.covariance
        bias = (2.0 / _ODOMETRY_SMOOTHING - 1.0) * float(self.mean @ np.linalg.solve(own, self.mean)) / 6.0
        return max(self.variance, bias) * covariance

    def agrees(self, prior: Prior, T_prev_curr: FloatArray, config: MappingConfig) -> bool | None:
        """Whether a registered motion (4, 4) passes the gate of a proven odometry; None where there is none."""
        if not self.is_proven(prior):
            return None
        return _squared_error(prior, T_prev_curr, prior.motion_covariance(config)) <= _GATE * self.variance

    def likelihood(self, prior: Prior, T_prev_curr: FloatArray, config: MappingConfig) -> float:
        """Of a registered motion (4, 4) by a proven odometry, relative to the odometry's own; one without that."""
        if not self.is_proven(prior):
            return 1.0
        squared = _squared_error(prior, T_prev_curr, prior.motion_covariance(config)) / self.variance
        return float(np.exp(-0.5 * squared))

    def conflict(self, prior: Prior, T_prev_curr: FloatArray, interval_s: float) -> str | None:
        """The axis along which the odometry's translation differs most from a registered motion's (4, 4).

        None where the two agree, where the odometry is overruled, and with an IMU.
        """
        if prior.T_prev_curr is None or prior.covariance is None or prior.inertial is not None:
            return None
        apart = log(inverse(prior.T_prev_curr) @ T_prev_curr)[3:]
        moved_m = max(float(np.linalg.norm(T[:3, 3])) for T in (prior.T_prev_curr, T_prev_curr))
        least_m, most_m = max(_CONFLICT_M, _CONFLICT_SHARE * moved_m), _WALKING_M_S * interval_s
        if not least_m < float(np.linalg.norm(apart)) < most_m:
            return None
        squared = float(apart @ np.linalg.solve(self.variance * prior.covariance[3:, 3:], apart))
        return AXES[3 + int(np.abs(apart).argmax())] if squared > _CONFLICT_SQUARED else None

    def is_proven(self, prior: Prior) -> bool:
        """Whether there is an odometry, which was consistent so far."""
        return prior.T_prev_curr is not None and self.agreed >= _PROVEN_AFTER


def _squared_error(prior: Prior, T_prev_curr: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance of the odometry's motion from another one (4, 4), by its covariance (6, 6)."""
    assert prior.T_prev_curr is not None
    error = log(inverse(prior.T_prev_curr) @ T_prev_curr)
    return float(error @ np.linalg.solve(covariance, error))


@dataclass(frozen=True, eq=False)
class Prediction(MotionState):
    """Predicted state of a scan before its registration."""

    contradicted: bool = False  # whether the odometry's motion fails the innovation test against the last velocity
    is_inertial: bool = False  # whether an IMU has a part in it
    is_smoothed: bool = False  # whether the smoothed start has

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of the position."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:6, 3:6])[-1]))

    def is_held_within(self, distance_m: float) -> bool:
        """Whether it is an IMU's, with no larger standard deviation of the position."""
        return self.is_inertial and self.sigma_m < distance_m

    def holds(self, T_world_lidar: FloatArray, within_m: float) -> bool:
        """Whether it is smoothed, or an IMU's known to a distance, and a pose (4, 4) agrees with it."""
        if not (self.is_smoothed or self.is_held_within(within_m)):
            return False
        away = log(inverse(self.T_world_lidar) @ T_world_lidar)
        return float(away @ np.linalg.solve(self.covariance[:6, :6], away)) < _GATE

    def sigma_along(self, direction: FloatArray) -> float:
        """Standard deviation of the position along a direction (3,) of the world, metres."""
        along = self.T_world_lidar[:3, :3].T @ direction
        return float(np.sqrt(along @ self.covariance[3:6, 3:6] @ along))

    def displaced(self, away: FloatArray) -> "Prediction":
        """The prediction displaced by a vector (3,) of the world."""
        T_world_lidar = self.T_world_lidar.copy()
        T_world_lidar[:3, 3] += away
        return replace(self, T_world_lidar=T_world_lidar)

    def held_along(self, direction: FloatArray) -> "Prediction":
        """The prediction with its translation and velocity along a direction (3,) of the world held."""
        along = self.T_world_lidar[:3, :3].T @ direction
        H = np.zeros((2, 12))
        H[0, 3:6] = H[1, 9:] = along
        PH = self.covariance @ H.T
        covariance = self.covariance - PH @ np.linalg.solve(H @ PH + _HELD**2 * np.eye(2), PH.T)
        return replace(self, covariance=0.5 * (covariance + covariance.T))


def predict(
    last: MotionState, stamp: float, prior: Prior, process_noise: ProcessNoise, config: MappingConfig,
    seen_from_s: float = 0.0, odometry_noise: OdometryNoise = OdometryNoise(),
) -> Prediction:  # fmt: skip
    """Propagate the last state to a stamp, and update it with the odometry's measurements.

    The velocity is constant during a sweep and changes between two sweeps by white noise of the acceleration. Pose
    and velocity are correlated: a velocity inconsistent with the motion between the poses is improbable. The next
    sweep begins `seen_from_s` before its stamp.
    """
    interval_s = stamp - last.stamp
    joint, contradicted = _Joint.propagated(last, interval_s, seen_from_s, process_noise), False
    covariance = odometry_noise.covariance(prior, config)
    if prior.T_prev_curr is not None:
        T_expected = inverse(joint.T_world_last) @ joint.T_world_next
        H = np.zeros((6, 24))
        H[:, :6], H[:, 12:18] = -adjoint(inverse(T_expected)), np.eye(6)
        joint, squared = joint.updated(H, log(inverse(T_expected) @ prior.T_prev_curr), covariance)
        contradicted = squared > _GATE
    if prior.velocity is not None and interval_s > 0.0:
        H = np.zeros((6, 24))
        H[:, 18:] = np.eye(6)
        noise = covariance * (_VELOCITY_INFLATION / interval_s) ** 2
        joint, _ = joint.updated(H, prior.velocity - joint.next_velocity, noise)
    state = MotionState(stamp, joint.T_world_next, joint.next_velocity, joint.covariance[12:, 12:])
    if prior.inertial is not None:
        state = state.fused(prior.inertial)
    state.covariance[:6, :6] += np.diag(LEAST_SIGMA**2)
    return Prediction(
        stamp, state.T_world_lidar, state.velocity, state.covariance, contradicted=contradicted,
        is_inertial=prior.inertial is not None, is_smoothed=prior.is_smoothed,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Joint:
    """The last and the next state with their joint covariance (24, 24): last pose, velocity, next pose, velocity."""

    T_world_last: FloatArray
    T_world_next: FloatArray
    next_velocity: FloatArray
    covariance: FloatArray

    @classmethod
    def propagated(cls, last: MotionState, interval_s: float, seen_from_s: float, noise: ProcessNoise) -> "_Joint":
        T_last_next = exp(last.velocity * interval_s)
        F = np.eye(12)
        F[:6, :6] = adjoint(inverse(T_last_next))
        F[:6, 6:] = interval_s * np.eye(6)
        P = np.zeros((24, 24))
        P[:12, :12] = last.covariance
        P[12:, :12] = F @ last.covariance
        P[:12, 12:] = P[12:, :12].T
        P[12:, 12:] = F @ last.covariance @ F.T + _process_covariance(last, interval_s, seen_from_s, noise)
        return cls(last.T_world_lidar, last.T_world_lidar @ T_last_next, last.velocity, P)

    def updated(self, H: FloatArray, innovation: FloatArray, noise: FloatArray) -> tuple["_Joint", float]:
        """Kalman update by a measurement with Jacobian H (M, 24), and the normalised squared innovation."""
        PH = self.covariance @ H.T
        S = H @ PH + noise
        gain = np.linalg.solve(S, PH.T).T
        step = gain @ innovation
        P = self.covariance - gain @ PH.T
        T_world_last, T_world_next = self.T_world_last @ exp(step[:6]), self.T_world_next @ exp(step[12:18])
        joint = _Joint(T_world_last, T_world_next, self.next_velocity + step[18:], 0.5 * (P + P.T))
        return joint, float(innovation @ np.linalg.solve(S, innovation))


def _process_covariance(last: MotionState, interval_s: float, seen_from_s: float, noise: ProcessNoise) -> FloatArray:
    """(12, 12) of pose and velocity after an interval.

    The old velocity holds until the end of the last sweep, the new one from the beginning of the next, their mean in a
    gap between the two.
    """
    gap_s = min(max(0.0, interval_s - last.seen_until_s - seen_from_s), interval_s)
    ahead_s = min(seen_from_s, interval_s) + 0.5 * gap_s
    change = (noise.acceleration * interval_s) ** 2
    swept_s = interval_s - gap_s
    uneven = (noise.acceleration * swept_s**2 * _UNEVEN) ** 2 + noise.acceleration**2 * interval_s * gap_s**3 / 12.0
    Q = np.zeros((12, 12))
    Q[:6, :6] = np.diag(change * ahead_s**2 + uneven)
    Q[:6, 6:] = Q[6:, :6] = np.diag(change * ahead_s)
    Q[6:, 6:] = np.diag(change)
    return Q


def velocity_error(last: MotionState, state: MotionState, share: float) -> FloatArray:
    """Velocity (6,) of the motion between two sweeps' poses, less their mean velocity.

    In this share of the interval the sensor moves with the first sweep's velocity.
    """
    motion = body_velocity(inverse(last.T_world_lidar) @ state.T_world_lidar, state.stamp - last.stamp)
    return np.asarray(motion - (share * last.velocity + (1.0 - share) * state.velocity), dtype=np.float64)


def corrected_by_motion(state: MotionState, last: MotionState, seen_from_s: float, observed: FloatArray) -> MotionState:
    """The state with its velocity corrected by the motion since the last one, and the likeliest pose given that.

    Sweeps that are bent equally fit one another and the map that they make, so that their registration hardly observes
    a bias in common. The motion between the poses of successive sweeps does: on average, it is their velocity. The map
    receives the corrected sweeps, and the next velocity is estimated from that, so that a bias fades away.

    The sweep begins `seen_from_s` before its stamp; the last one's velocity is the corrected one. After a gap between
    the two, the state stays as it is, and so does its part along directions that the registration did not observe
    (`observed`, (6, 6), projects onto the others): motion and velocity are predictions there, and would amplify one
    another.
    """
    interval_s, covered_s = state.stamp - last.stamp, last.seen_until_s + seen_from_s
    if not covered_s > _COVERED * interval_s > 0.0:
        return state
    error, P = velocity_error(last, state, last.seen_until_s / covered_s), state.covariance
    correction = observed @ (_CORRECTED_SHARE * np.clip(error, -_MOST_CHANGE, _MOST_CHANGE))
    T_world_lidar = state.T_world_lidar @ exp(observed @ P[:6, 6:] @ np.linalg.solve(P[6:, 6:], correction))
    return replace(state, T_world_lidar=T_world_lidar, velocity=state.velocity + correction)
