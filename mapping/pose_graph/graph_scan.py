"""The input of the pose graph, scan by scan; light, so that the pipeline imports no GTSAM."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.motion.prediction import GravityDirection


@dataclass(frozen=True, eq=False)
class GraphScan:
    """A scan with its pose and motion."""

    T_world_lidar: FloatArray  # (4, 4) as registered
    points: FloatArray  # (N, 3) in the LiDAR frame at the stamp, compensated and thinned
    # (6, 6) of the pose when it was registered to a map, rotation first; None when it was not
    covariance: FloatArray | None
    T_prev_curr: FloatArray | None  # (4, 4) the odometry's motion since the scan before; None without one
    motion_covariance: FloatArray | None  # (6, 6) of that; None when the odometry has none
    lost: bool  # whether tracking was lost, so that the motion from the scan before is unknown
    belongs_in_map: bool  # whether its points are added to the submap
    gravity: GravityDirection | None = None  # as an IMU measured it, in the LiDAR frame; None where it did not
