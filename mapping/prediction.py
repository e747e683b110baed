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
# No pose is better than this, whatever its residuals say.
_LEAST_SIGMA = np.array([np.deg2rad(0.1)] * 3 + [0.005] * 3)


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
        sigmas = np.concatenate([_LEAST_SIGMA, _ANY_VELOCITY])
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

    def seen(self, change: FloatArray, interval_s: float) -> "Carrier":
        """The carrier after its velocity was seen to change by (6,) in a time."""
        seen = change / interval_s
        squared = (float(np.mean(seen[:3] ** 2)), float(np.mean(seen[3:] ** 2)))
        followed = [
            float(np.clip(np.sqrt((1.0 - _FOLLOWING) * old**2 + _FOLLOWING * _CAUTION**2 * new), least, most))
            for old, new, least, most in zip(
                (self.rotation, self.translation), squared, _CALMEST, _WILDEST, strict=True
            )
        ]
        return Carrier(*followed)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where a scan is expected before it is held against the map.

    Attributes:
        T_world_lidar: (4, 4) at the stamp.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
        pose_covariance: (6, 6) rotation first, in the LiDAR frame.
        velocity_covariance: (6, 6).
    """

    T_world_lidar: FloatArray
    velocity: FloatArray
    pose_covariance: FloatArray
    velocity_covariance: FloatArray


def predict(state: State, stamp: float, prior: Prior, carrier: Carrier, config: MappingConfig) -> Prediction:
    """Go on from the last scan's state with its velocity, and correct that by what the odometry says.

    A sweep's velocity was seen from its first point to its last. Where stamps stand at the start of sweeps, the next
    pose lies at the end of what was seen, and needs no extrapolation: turns on the spot are no surprise.
    """
    interval_s = stamp - state.stamp
    T_moved = exp(state.velocity * interval_s)
    F = np.eye(12)
    F[:6, :6] = adjoint(inverse(T_moved))
    F[:6, 6:] = interval_s * np.eye(6)
    covariance = F @ state.covariance @ F.T
    unseen_s = max(0.0, interval_s - state.seen_until_s)
    drift = carrier.acceleration * (interval_s**2 / 8.0 + unseen_s * interval_s)
    pose_covariance = covariance[:6, :6] + np.diag(drift**2 + _LEAST_SIGMA**2)
    velocity_covariance = covariance[6:, 6:] + np.diag((carrier.acceleration * interval_s) ** 2)
    T_world_lidar, velocity = state.T_world_lidar @ T_moved, state.velocity
    uncertainty = _uncertainty(prior, config)
    if prior.T_prev_curr is not None:
        error = log(inverse(T_world_lidar) @ state.T_world_lidar @ prior.T_prev_curr)
        step, pose_covariance = _fuse(pose_covariance, error, uncertainty)
        T_world_lidar = T_world_lidar @ exp(step)
    if prior.velocity is not None and interval_s > 0.0:
        difference = prior.velocity - velocity
        step, velocity_covariance = _fuse(velocity_covariance, difference, uncertainty * (_SHAKING / interval_s) ** 2)
        velocity = velocity + step
    return Prediction(T_world_lidar, velocity, pose_covariance, velocity_covariance)


def _uncertainty(prior: Prior, config: MappingConfig) -> FloatArray:
    """(6, 6) covariance of the odometry's motion: its own word, else the configuration's.

    Its errors go together from scan to scan, while the state that it is fused with takes each for a new one.
    """
    if prior.covariance is not None:
        return np.asarray(config.prior_caution**2 * prior.covariance, dtype=np.float64)
    sigmas = np.array([np.deg2rad(config.prior_rotation_deg)] * 3 + [config.prior_translation_m] * 3)
    return np.asarray(np.diag(sigmas**2), dtype=np.float64)


def _fuse(covariance: FloatArray, difference: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What to add to an estimate for a second one that differs, and the covariance of both together."""
    gain = covariance @ np.linalg.inv(covariance + other)
    return gain @ difference, covariance - gain @ covariance
