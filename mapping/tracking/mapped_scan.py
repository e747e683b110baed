"""The result of registering a scan to a local map: its pose, and its tracking status with the reason in words."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import TrackingConfig
from lidarslam.mapping.motion.prediction import LOST_MOTION, MeasuredPose, MotionState, Prediction
from lidarslam.mapping.tracking.attempt import Attempt
from lidarslam.mapping.tracking.fit import Fit

# At the end of the messages of scans that are degraded for no other reason.
NOT_CONFIRMED = "not confirmed yet"


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
    measured: MeasuredPose | None = None  # by the correspondences alone; None without a registration, or an IMU

    @classmethod
    def lost(cls, prediction: Prediction, reason: str, fit: Fit | None = None, fading: float = 1.0) -> "MappedScan":
        """A scan that stays at its prediction, out of the map; its velocity fades by a factor."""
        T_world_lidar = prediction.T_world_lidar
        state = MotionState(prediction.stamp, T_world_lidar, fading * prediction.velocity, LOST_MOTION)
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
    degenerate, correction = attempt.registration.degeneracy.names, attempt.correction
    angle_deg, distance_m = np.rad2deg(np.linalg.norm(correction[:3])), np.linalg.norm(correction[3:])
    where = f"{angle_deg:.0f} deg and {distance_m:.2f} m from the prediction"
    reservations = (
        (attempt.relocalised, f"relocalised in the map, {where}; {NOT_CONFIRMED}"),
        (attempt.has_jumped, where),
        (is_unconfirmed, f"relocalised a moment ago; {NOT_CONFIRMED}"),
        (attempt.ambiguous, "the scene is repetitive: another motion since the last scan fits nearly as well"),
        (unexpected, "registered, but neither odometry nor last motion predicted this pose"),
        (adrift, "in a new map; its pose in the map before is unknown"),
        (degenerate, f"degenerate along {', '.join(degenerate)}: the prediction was kept"),
        (attempt.unconstrained, f"hardly constrained along {', '.join(attempt.unconstrained)}: it may slide"),
        (conflict, f"the odometry measures other motions along {conflict}, as amid people who walk along"),
    )
    message = next((message for applies, message in reservations if applies), "")
    return (Status.DEGRADED if message else Status.OK), message
