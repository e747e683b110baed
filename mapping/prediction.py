"""Where the next scan is expected: how the sensor was moving and what an odometry says, each as far as trusted."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, exp, inverse, log
from lidarslam.core.state import Saved
from mapping.config import MappingConfig

# Accelerations of carriers, one standard deviation, rotation about each axis and translation along it: what is
# supposed at first, and the least and most that is ever supposed.
_USUAL = (np.deg2rad(1000.0), 15.0)
_CALMEST = (np.deg2rad(150.0), 3.0)
_WILDEST = (np.deg2rad(4000.0), 60.0)
# How fast the supposition follows what is seen, and how much more than that it stays: surprises come in bursts.
_FOLLOWING = 0.1
_CAUTION = 4.0
# What is known of a sensor before its first scans, and after it was lost.
_ANY_VELOCITY = np.array([np.deg2rad(100.0)] * 3 + [15.0] * 3)
_ASTRAY = np.array([np.deg2rad(20.0)] * 3 + [1.0] * 3)
# An odometry's velocity is less certain than its motion over the time by this factor: of a carrier that shakes faster
# than sweeps follow one another it tells a part only, again and again.
_SHAKING = 2.0
# Displacement within a sweep by which a constant velocity misses a changing one, per acceleration and square of time.
_UNEVEN = 1.0 / 8.0
# How fast the odometry's noise follows its errors, and beyond what squared innovation its motion is improbable: that of
# chi square with six degrees of freedom, one time in ten thousand.
_NOISE_FOLLOWING = 0.2
_GATE = 27.9
# Motions in a row after which an odometry may contradict a registration.
_PROVEN_BY = 10
# No pose is better than this, whatever its residuals say.
LEAST_SIGMA = np.array([np.deg2rad(0.1)] * 3 + [0.005] * 3)


@dataclass(frozen=True, eq=False)
class Prior:
    """What an odometry says of a scan; None where it says nothing.

    Attributes:
        T_prev_curr: (4, 4) the motion since the previous scan.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
        covariance: (6, 6) of the error `xi` in `T_true = T_prev_curr @ exp(xi)`, rotation first; None where the
            odometry does not say: the configuration's.
    """

    T_prev_curr: FloatArray | None = None
    velocity: FloatArray | None = None
    covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class State:
    """A scan's pose and motion.

    Attributes:
        stamp: seconds.
        T_world_lidar: (4, 4) at the stamp.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
        covariance: (12, 12) of the errors of pose and velocity; the pose's is `xi` in
            `T_true = T_world_lidar @ exp(xi)`.
        seen_until_s: from the stamp to the last point of the sweep; up to there the velocity was seen.
    """

    stamp: float
    T_world_lidar: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    seen_until_s: float = 0.0

    @classmethod
    def first(cls, stamp: float, velocity: FloatArray | None) -> "State":
        """At the origin, moving anyhow unless something is known."""
        sigmas = np.concatenate([LEAST_SIGMA, _ANY_VELOCITY])
        return cls(stamp, np.eye(4), np.zeros(6) if velocity is None else velocity, np.diag(sigmas**2))

    @classmethod
    def restored(cls, saved: Saved) -> "State":
        """What was saved, which is all of it."""
        return cls(
            saved.number("stamp"),
            saved.array("T_world_lidar", (4, 4)),
            saved.array("velocity", (6,)),
            saved.array("covariance", (12, 12)),
            saved.number("seen_until_s"),
        )

    @classmethod
    def moving(cls, state: "State", velocity: FloatArray) -> "State":
        """At the pose of a state, with another velocity (6,) that is hardly known."""
        sigmas = np.concatenate([LEAST_SIGMA, _ANY_VELOCITY])
        return cls(state.stamp, state.T_world_lidar, velocity, np.diag(sigmas**2), state.seen_until_s)

    @classmethod
    def astray(cls, stamp: float, T_world_lidar: FloatArray, velocity: FloatArray) -> "State":
        """Somewhere near here, moving anyhow."""
        sigmas = np.concatenate([_ASTRAY, _ANY_VELOCITY])
        return cls(stamp, T_world_lidar, velocity, np.diag(sigmas**2))


@dataclass(frozen=True)
class Carrier:
    """How much a carrier shakes its sensor: standard deviations of its accelerations.

    Attributes:
        rotation: about each axis, rad/s^2.
        translation: along each axis, m/s^2.
    """

    rotation: float = _USUAL[0]
    translation: float = _USUAL[1]

    @classmethod
    def wildest(cls) -> "Carrier":
        """One that anything is believed of."""
        return cls(*_WILDEST)

    @classmethod
    def restored(cls, saved: Saved) -> "Carrier":
        """What was saved, which is all of it."""
        return cls(saved.number("rotation"), saved.number("translation"))

    @property
    def acceleration(self) -> FloatArray:
        """(6,) rotation first."""
        return np.array([self.rotation] * 3 + [self.translation] * 3)

    def seen(self, change: FloatArray, interval_s: float, variance: FloatArray) -> "Carrier":
        """The carrier after its velocity was estimated to have changed by (6,) in a time.

        A change that its own variance (6,) explains is no acceleration: where little is to be seen velocities scatter,
        and a carrier thought to be wild because of it would let them scatter the more.
        """
        seen = np.maximum(change**2 - variance, 0.0) / interval_s**2
        squared = (float(np.mean(seen[:3])), float(np.mean(seen[3:])))
        followed = [
            float(np.clip(np.sqrt((1.0 - _FOLLOWING) * old**2 + _FOLLOWING * _CAUTION**2 * new), least, most))
            for old, new, least, most in zip(
                (self.rotation, self.translation), squared, _CALMEST, _WILDEST, strict=True
            )
        ]
        return Carrier(*followed)


@dataclass(frozen=True)
class OdometryNoise:
    """How much larger an odometry's errors are than its covariance states.

    Attributes:
        variance: factor on the covariance; never less than one.
        agreed: motions in a row that were not contradicted.
    """

    variance: float = 1.0
    agreed: int = 0

    @classmethod
    def restored(cls, saved: Saved) -> "OdometryNoise":
        """What was saved, which is all of it."""
        return cls(saved.number("variance"), saved.integer("agreed"))

    def seen(self, prior: Prior, T_prev_curr: FloatArray, config: MappingConfig) -> "OdometryNoise":
        """The noise after a registered motion (4, 4), by the normalised squared error of the odometry's."""
        if prior.T_prev_curr is None:
            return self
        squared = _squared_error(prior, T_prev_curr, config)
        variance = max(1.0, self.variance + _NOISE_FOLLOWING * (squared / 6.0 - self.variance))
        return OdometryNoise(variance, self.agreed + 1 if squared < _GATE * self.variance else 0)

    def contradicts(self, prior: Prior, T_prev_curr: FloatArray, config: MappingConfig) -> bool:
        """Whether a registered motion (4, 4) is improbable, given that of an odometry which has agreed so far."""
        if prior.T_prev_curr is None or self.agreed < _PROVEN_BY:
            return False
        return _squared_error(prior, T_prev_curr, config) > _GATE * self.variance


def _squared_error(prior: Prior, T_prev_curr: FloatArray, config: MappingConfig) -> float:
    """The odometry's squared error, in standard deviations, if a motion (4, 4) is right."""
    assert prior.T_prev_curr is not None
    error = log(inverse(prior.T_prev_curr) @ T_prev_curr)
    return float(error @ np.linalg.solve(_uncertainty(prior, config), error))


@dataclass(frozen=True, eq=False)
class Prediction:
    """The state expected of a scan before it is registered.

    Attributes:
        T_world_lidar: (4, 4) at the stamp.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
        covariance: (12, 12) joint covariance of the errors of pose and velocity, as in `State`.
        contradicted: whether the odometry's motion is improbable, given the motion before.
    """

    T_world_lidar: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    contradicted: bool = False


def predict(
    state: State, stamp: float, prior: Prior, carrier: Carrier, config: MappingConfig, seen_from_s: float = 0.0,
    noise: OdometryNoise = OdometryNoise(),
) -> Prediction:  # fmt: skip
    """Propagate the last state to a stamp, and update it with the odometry's measurements.

    The velocity is constant during a sweep and changes between two of them by white noise of the carrier's
    acceleration. Sweeps follow one another without a gap, so pose and velocity are correlated: a velocity that
    disagrees with the way between the poses is improbable, however well the sweep fits when bent by it.

    Args:
        state: of the last scan.
        stamp: of the next one.
        prior: the odometry's measurements.
        carrier: accelerations to expect.
        config: of an odometry without a covariance.
        seen_from_s: from the first point of the next sweep to its stamp.
        noise: of the odometry.
    """
    interval_s = stamp - state.stamp
    joint = _Joint.of(state, interval_s, seen_from_s, carrier)
    uncertainty, contradicted = noise.variance * _uncertainty(prior, config), False
    if prior.T_prev_curr is not None:
        contradicted = joint.contradicts(prior.T_prev_curr, uncertainty)
        joint = joint.measured_motion(prior.T_prev_curr, uncertainty)
    if prior.velocity is not None and interval_s > 0.0:
        joint = joint.measured_velocity(prior.velocity, uncertainty * (_SHAKING / interval_s) ** 2)
    covariance = joint.covariance[12:, 12:]
    covariance[:6, :6] += np.diag(LEAST_SIGMA**2)
    return Prediction(joint.T_world_curr, joint.curr_velocity, covariance, contradicted)


@dataclass(frozen=True, eq=False)
class _Joint:
    """The last state and the next, with their joint covariance (24, 24): last pose, velocity, next pose, velocity."""

    T_world_last: FloatArray
    T_world_curr: FloatArray
    curr_velocity: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, state: State, interval_s: float, seen_from_s: float, carrier: Carrier) -> "_Joint":
        T_moved = exp(state.velocity * interval_s)
        F = np.eye(12)
        F[:6, :6] = adjoint(inverse(T_moved))
        F[:6, 6:] = interval_s * np.eye(6)
        joint = np.zeros((24, 24))
        joint[:12, :12] = state.covariance
        joint[12:, :12] = F @ state.covariance
        joint[:12, 12:] = joint[12:, :12].T
        joint[12:, 12:] = F @ state.covariance @ F.T + _process_noise(state, interval_s, seen_from_s, carrier)
        return cls(state.T_world_lidar, state.T_world_lidar @ T_moved, state.velocity, joint)

    def measured_motion(self, T_last_curr: FloatArray, covariance: FloatArray) -> "_Joint":
        return self._updated(*self._motion_innovation(T_last_curr), covariance)

    def contradicts(self, T_last_curr: FloatArray, covariance: FloatArray) -> bool:
        """Whether a motion (4, 4) with this covariance fails the innovation test."""
        H, innovation = self._motion_innovation(T_last_curr)
        return bool(innovation @ np.linalg.solve(H @ self.covariance @ H.T + covariance, innovation) > _GATE)

    def _motion_innovation(self, T_last_curr: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Jacobian (6, 24) of the motion since the last scan, and how far a measured one differs (6,)."""
        T_expected = inverse(self.T_world_last) @ self.T_world_curr
        H = np.zeros((6, 24))
        H[:, :6], H[:, 12:18] = -adjoint(inverse(T_expected)), np.eye(6)
        return H, log(inverse(T_expected) @ T_last_curr)

    def measured_velocity(self, velocity: FloatArray, covariance: FloatArray) -> "_Joint":
        H = np.zeros((6, 24))
        H[:, 18:] = np.eye(6)
        return self._updated(H, velocity - self.curr_velocity, covariance)

    def _updated(self, H: FloatArray, innovation: FloatArray, noise: FloatArray) -> "_Joint":
        """Kalman update by a measurement with Jacobian H (6, 24)."""
        PH = self.covariance @ H.T
        gain = np.linalg.solve(H @ PH + noise, PH.T).T
        step = gain @ innovation
        covariance = self.covariance - gain @ PH.T
        return _Joint(
            self.T_world_last @ exp(step[:6]),
            self.T_world_curr @ exp(step[12:18]),
            self.curr_velocity + step[18:],
            0.5 * (covariance + covariance.T),
        )


def _process_noise(state: State, interval_s: float, seen_from_s: float, carrier: Carrier) -> FloatArray:
    """(12, 12) what the velocity may change by, and the way with it.

    Up to the end of the last sweep the way is gone with its velocity, from the beginning of the next one with the new
    velocity, and in a gap between the two with one in between.
    """
    gap_s = min(max(0.0, interval_s - state.seen_until_s - seen_from_s), interval_s)
    ahead_s = min(seen_from_s, interval_s) + 0.5 * gap_s
    change = (carrier.acceleration * interval_s) ** 2
    swept_s = interval_s - gap_s
    uneven = (carrier.acceleration * swept_s**2 * _UNEVEN) ** 2 + carrier.acceleration**2 * interval_s * gap_s**3 / 12.0
    Q = np.zeros((12, 12))
    Q[:6, :6] = np.diag(change * ahead_s**2 + uneven)
    Q[:6, 6:] = Q[6:, :6] = np.diag(change * ahead_s)
    Q[6:, 6:] = np.diag(change)
    return Q


def _uncertainty(prior: Prior, config: MappingConfig) -> FloatArray:
    """(6, 6) covariance of the odometry's motion: its own, inflated because its errors are correlated over time, else
    the configuration's."""
    if prior.covariance is not None:
        return np.asarray(config.prior_caution**2 * prior.covariance, dtype=np.float64)
    sigmas = np.array([np.deg2rad(config.prior_rotation_deg)] * 3 + [config.prior_translation_m] * 3)
    return np.asarray(np.diag(sigmas**2), dtype=np.float64)
