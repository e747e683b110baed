"""The result of registering a scan to a local map: an attempt with its fit, and the scan with its status."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.core.tracking import AXES, Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import MeasuredPose, MotionState, Prediction
from lidarslam.mapping.registration.local_map import LocalMap
from lidarslam.mapping.registration.registration import Registration
from lidarslam.mapping.registration.sampled_scan import CellSizes, SampledScan
from lidarslam.mapping.tracking.fit import Fit

# A correction beyond this many standard deviations of the prediction, and beyond degrees and metres, is a jump.
_MOST_SIGMAS = 5.0
_LEAST_JUMP = np.array([np.deg2rad(10.0)] * 3 + [0.5] * 3)
# A smaller one is unexpected: amid trucks that pass on both sides, a standing car appears to move by 0.2 m. At 10 Hz,
# corrections beyond four standard deviations are below 0.08 m on ten recordings of cars, robots and handhelds.
_LEAST_UNEXPECTED = np.array([np.deg2rad(10.0)] * 3 + [0.1] * 3)
# Speeds beyond the predicted ones, m/s and rad/s, that a sensor may have for this time after it was tracked; then
# it may have been carried anywhere. The same where a consistent odometry measured the motion since.
_MORE_SPEED_M_S, _MORE_TURN_RAD_S, _REACH_S = 3.0, np.deg2rad(200.0), 1.0
_ODOMETRY_ERROR_M_S, _ODOMETRY_ERROR_RAD_S, _ODOMETRY_REACH_S = 0.3, np.deg2rad(20.0), 3.0
# Overlap with a map that may be too thin from which a registration counts; and its largest correction, degrees and
# cells, where the map is of several scans at their predictions.
_FOUNDED_OVERLAP, _AGREEING = 0.2, (np.deg2rad(3.0), 0.5)
# An IMU that predicts a position to this constrains it where the scan does not, metres.
_HELD_M = 0.02
# A turn that a gyroscope measured is known to this.
_MEASURED_TURN = np.deg2rad(5.0)
# A scan that may be anywhere needs a much better fit, and a clearly better one than at the next best place this many
# cells away. On simulated recordings the inlier ratio was 57 to 74 % at wrong places, at right ones 94 % and more; the
# share of inliers depends on how much of the view is new.
_RELIABLE_RATIO, _RELIABLE_SHARE, _RELIABLE_SUPPORT = 0.85, 0.4, 0.6
_RIVAL_QUALITY, _RIVAL_CELLS = 1.2, 4.0
# At the end of the messages of scans that are degraded for no other reason.
NOT_CONFIRMED = "not confirmed yet"


@dataclass(frozen=True, eq=False)
class Attempt:
    """A registration attempt."""

    prediction: Prediction  # that the result is compared with
    local_map: LocalMap  # that the scan was registered to
    registration: Registration | None  # None where there were too few correspondences
    fit: Fit  # of the scan to the map
    status: Status  # by the fit
    relocalised: bool = False  # whether it began elsewhere than at the prediction
    rival: FloatArray | None = None  # (3,) from here to another place that fits nearly as well, in the world, metres
    elsewhere: tuple[FloatArray, ...] = ()  # other poses (4, 4) at which a scan of unknown velocity fits

    @property
    def is_reliable(self) -> bool:
        """Whether the fit suffices without a prediction."""
        ratio, share, support = self.fit.inlier_ratio or 0.0, self.fit.inlier_share, self.fit.support or 0.0
        fits = ratio > _RELIABLE_RATIO and share > _RELIABLE_SHARE and support > _RELIABLE_SUPPORT
        return self.status is Status.OK and fits

    @property
    def quality(self) -> float:
        """Score among attempts."""
        return self.fit.quality

    @property
    def T_world_lidar(self) -> FloatArray:
        """(4, 4) the registered pose; the predicted one without a registration."""
        return (self.registration or self.prediction).T_world_lidar

    @cached_property
    def unconstrained(self) -> tuple[str, ...]:
        """Names of the LiDAR frame's axes along which the registration is unconstrained.

        Nothing, or no more than the noise of normals, constrains them; fewer than half of the points that do fit; or
        another pose along them fits nearly as well.
        """
        names = set() if self.registration is None else set(self.registration.degeneracy.names)
        weakest = None if self.fit.is_constrained else self.fit.weakest
        unsupported = self.fit.unsupported if self.status is Status.DEGRADED else None
        for direction in (weakest, unsupported, self.rival):
            if direction is not None:
                along = np.abs(self.T_world_lidar[:3, :3].T @ np.array(direction))
                names.add(AXES[3 + int(along.argmax())])
        return tuple(name for name in AXES if name in names)

    @property
    def uncertain(self) -> tuple[str, ...]:
        """Names of the unconstrained axes along which no IMU constrains the position, either."""
        is_ambiguous = self.rival is not None or self.status is not Status.OK
        if is_ambiguous or self.registration is None or not self.prediction.is_inertial:
            return self.unconstrained
        sigmas_m = np.sqrt(np.diag(self.registration.covariance)[3:6])
        held = [axis for axis, sigma_m in zip(AXES[3:], sigmas_m, strict=True) if sigma_m < _HELD_M]
        return tuple(name for name in self.unconstrained if name not in held)

    @cached_property
    def correction(self) -> FloatArray:
        """(6,) from the predicted pose to the registered one."""
        return log(inverse(self.prediction.T_world_lidar) @ self.T_world_lidar)

    @property
    def corrected_by(self) -> tuple[float, float]:
        """Angle, radians, and distance, metres, of the correction."""
        return float(np.linalg.norm(self.correction[:3])), float(np.linalg.norm(self.correction[3:]))

    @cached_property
    def has_jumped(self) -> bool:
        """Whether the correction exceeds every motion that the prediction allows for."""
        return self._exceeds(_LEAST_JUMP)

    @property
    def is_unexpected(self) -> bool:
        """Whether the correction is improbable by the prediction, and larger than those of tracked motions at 10 Hz."""
        return self._exceeds(_LEAST_UNEXPECTED)

    def _exceeds(self, least: FloatArray) -> bool:
        sigmas = np.sqrt(np.diag(self.prediction.covariance)[:6])
        return bool((np.abs(self.correction) > np.maximum(_MOST_SIGMAS * sigmas, least)).any())

    def is_reachable(self, tracked_s: float | None, motion_is_measured: bool) -> bool:
        """Whether the sensor can have moved here since the time at which it was tracked; anywhere if it never was."""
        since_s = np.inf if tracked_s is None else self.prediction.stamp - tracked_s
        if motion_is_measured:
            speed, turn, reach_s = _ODOMETRY_ERROR_M_S, _ODOMETRY_ERROR_RAD_S, _ODOMETRY_REACH_S
        else:
            speed = float(np.linalg.norm(self.prediction.velocity[3:])) + _MORE_SPEED_M_S
            turn, reach_s = _MORE_TURN_RAD_S, _REACH_S
        if since_s > reach_s:
            return True
        angle, distance_m = self.corrected_by
        most = _MEASURED_TURN if self.prediction.is_inertial else _LEAST_JUMP[0] + turn * since_s
        return bool(angle < most and distance_m < _LEAST_JUMP[3] + speed * since_s)

    def confirms_map(self, of_predictions: bool, has_rings: bool) -> bool:
        """Whether a map, of one scan or of several at their predictions, suffices for this registration.

        One scan without rings may fit anywhere. Several that were inserted with a wrong motion make planes all the
        same; what fits these agrees with the predicted motion only by chance.
        """
        if self.status is Status.LOST:
            return False
        if not of_predictions:
            return has_rings or self.rival is None
        angle, distance_m = self.corrected_by
        agrees = angle < _AGREEING[0] and distance_m < _AGREEING[1] * self.local_map.cell_m
        return agrees and not self.unconstrained and self.fit.overlap >= _FOUNDED_OVERLAP

    def uncertain_velocity(self, scan: SampledScan, last: MotionState, continuous_time: bool) -> FloatArray:
        """Velocity (6,) after a jump or a relocalisation from the last scan's state.

        After a relocalisation only the estimate within the sweep is known. After a jump one of two sweeps was bent by a
        wrong velocity: the mean velocity between the two poses.
        """
        interval_s = scan.stamp - last.stamp
        if not self.relocalised:
            if interval_s > 0.0:
                return body_velocity(inverse(last.T_world_lidar) @ self.T_world_lidar, interval_s)
            return np.zeros(6)
        assert self.registration is not None
        return self.registration.velocity if continuous_time and scan.sweep.times is not None else np.zeros(6)

    def rival_of(self, others: Iterable["Attempt"]) -> FloatArray | None:
        """(3,) from here to the best other place where the scan fits nearly as well, in the world, metres."""
        apart_m = _RIVAL_CELLS * self.local_map.cell_m
        for other in sorted(others, key=lambda other: -other.quality):
            away: FloatArray = other.T_world_lidar[:3, 3] - self.T_world_lidar[:3, 3]
            if np.linalg.norm(away) > apart_m and _RIVAL_QUALITY * other.quality > self.quality:
                return away
        return None


def best_of(attempts: Iterable[Attempt]) -> Attempt | None:
    """The attempt of highest quality; None of none."""
    return max(attempts, key=lambda attempt: attempt.quality, default=None)


@dataclass(frozen=True, eq=False)
class MappedScan:
    """Result of a scan."""

    state: MotionState  # pose at the stamp and velocity during the sweep, with their covariance
    T_world_predicted: FloatArray  # (4, 4) predicted pose
    registered: bool  # whether the pose is that of a registration; else it is the predicted one
    # status, message: tracking status, and its reason
    status: Status
    message: str = ""
    fit: Fit | None = None  # to the map; None where the scan was not compared with it
    # names of the directions along which the prediction was kept, or the odometry measures other motions
    degenerate: tuple[str, ...] = ()
    iterations: int = 0  # of the registration
    added: bool = False  # whether the scan is good enough for the map, and was inserted
    # whether the sensor was tracked from the scan before; else it was relocalised, or only predicted
    is_connected: bool = True
    turn_rate: FloatArray | None = None  # (3,) rad/s within the sweep, in the LiDAR frame; None without point times
    # (6,) body velocity of the first scan as the second shows it, in the result of the second; None in all others
    first_velocity: FloatArray | None = None
    cells_m: CellSizes | None = None  # of a local map
    has_surfels: bool = False  # whether that map is one of surfels
    measured: MeasuredPose | None = None  # by the correspondences alone; None without a registration, or an IMU
    elsewhere: tuple[FloatArray, ...] = ()  # other poses (4, 4) at which a scan of unknown velocity fits

    @property
    def quality(self) -> float:
        """Score of the fit; 0 without one."""
        return 0.0 if self.fit is None else self.fit.quality

    @classmethod
    def lost(cls, prediction: Prediction, reason: str, fit: Fit | None = None) -> "MappedScan":
        """A scan that stays at its prediction, out of the map."""
        T_world_lidar = prediction.T_world_lidar
        state = MotionState(prediction.stamp, T_world_lidar, prediction.velocity, prediction.covariance)
        return cls(state, T_world_lidar, False, Status.LOST, reason, fit, is_connected=False)


def judge(
    attempt: Attempt, is_unconfirmed: bool, unexpected: bool, adrift: bool, conflict: str | None, config: TrackingConfig
) -> tuple[Status, str]:
    """The status of the fit; degraded as well for a pose that is unconfirmed, ambiguous, unexpected or unconstrained.

    Adrift is a map that was begun at an unknown pose in the one before; a conflict is the axis along which the odometry
    has measured other motions for several scans.
    """
    if attempt.status is not Status.OK:
        return attempt.status, attempt.fit.explain(config)
    assert attempt.registration is not None
    uncertain, (angle, distance_m) = attempt.uncertain, attempt.corrected_by
    degenerate = [name for name in attempt.registration.degeneracy.names if name in uncertain]
    where = f"{np.rad2deg(angle):.0f} deg and {distance_m:.2f} m from the prediction"
    reservations = (
        (attempt.relocalised, f"relocalised in the map, {where}; {NOT_CONFIRMED}"),
        (attempt.has_jumped, where),
        (is_unconfirmed, f"relocalised a moment ago; {NOT_CONFIRMED}"),
        (attempt.rival is not None, "the scene is repetitive: another motion since the last scan fits nearly as well"),
        (unexpected, "registered, but neither odometry nor last motion predicted this pose"),
        (adrift, "in a new map; its pose in the map before is unknown"),
        (degenerate, f"degenerate along {', '.join(degenerate)}: the prediction was kept"),
        (uncertain, f"hardly constrained along {', '.join(uncertain)}: it may slide"),
        (conflict, f"the odometry measures other motions along {conflict}, as amid people who walk along"),
    )
    message = next((message for applies, message in reservations if applies), "")
    return (Status.DEGRADED if message else Status.OK), message
