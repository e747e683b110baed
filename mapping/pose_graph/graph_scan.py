"""The input of the pose graph, scan by scan; light, so that the pipeline imports no GTSAM."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class GraphScan:
    """A scan with its pose and motion.

    Attributes:
        T_world_lidar: (4, 4) as registered.
        points: (N, 3) in the LiDAR frame at the stamp, compensated and thinned.
        covariance: (6, 6) of the pose when it was registered to a map, rotation first; None when it was not.
        T_prev_curr: (4, 4) the odometry's motion since the scan before; None without one.
        motion_covariance: (6, 6) of that; None when the odometry has none.
        lost: whether tracking was lost, so that the motion from the scan before is unknown.
        belongs_in_map: whether its points are added to the submap.
    """

    T_world_lidar: FloatArray
    points: FloatArray
    covariance: FloatArray | None
    T_prev_curr: FloatArray | None
    motion_covariance: FloatArray | None
    lost: bool
    belongs_in_map: bool
