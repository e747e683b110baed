"""What a pose graph is told of each scan; light, so that whoever tells it imports no GTSAM."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class GraphScan:
    """A scan as the graph wants it.

    Attributes:
        T_world_lidar: (4, 4) as refined.
        points: (N, 3) in the LiDAR frame at the stamp, compensated and thinned.
        covariance: (6, 6) of the pose when it was registered to a map, rotation first; None when it was not.
        T_prev_curr: (4, 4) the odometry's motion since the scan before; None when it measured nothing.
        motion_covariance: (6, 6) of that; None when the odometry does not say.
        lost: whether the pose is a guess, or was found again with no way there from the scan before.
        belongs_in_map: whether it is good enough to draw with.
    """

    T_world_lidar: FloatArray
    points: FloatArray
    covariance: FloatArray | None
    T_prev_curr: FloatArray | None
    motion_covariance: FloatArray | None
    lost: bool
    belongs_in_map: bool
