"""The result of registering a scan to a local map."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.mapping.motion.measured_pose import MeasuredPose
from lidarslam.mapping.motion.prediction import MotionState
from lidarslam.mapping.tracking.fit import Fit


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
    degenerate: tuple[str, ...] = ()  # names of the directions along which the prediction was kept
    iterations: int = 0  # of the registration
    added: bool = False  # whether the scan is good enough for the map, and was inserted
    # whether the sensor was tracked from the scan before; else it was relocalised, or only predicted
    is_connected: bool = True
    turn_rate: FloatArray | None = None  # (3,) rad/s within the sweep, in the LiDAR frame; None without point times
    measured: MeasuredPose | None = None  # by the correspondences alone; None without a registration, or an IMU
