"""What the way from one keyframe to the next says in the pose graph: edges of the trajectory and of the odometry."""

import numpy as np

from lidarslam.core.geometry import FloatArray, adjoint, inverse
from lidarslam.core.state import Saved
from mapping.pose_graph.g2o import Edge
from mapping.pose_graph.graph_config import TrajectoryEdgeConfig
from mapping.pose_graph.graph_scan import GraphScan


class Way:
    """What happened since the last keyframe: the odometry's motion, how far it went, and whether tracking was lost."""

    def __init__(self) -> None:
        self.T_keyframe_lidar: FloatArray | None = np.eye(4)  # the odometry's; None once it failed
        self.covariance: FloatArray = np.zeros((6, 6))
        self.length_m = 0.0
        self.lost = False

    def restore(self, saved: Saved) -> None:
        """Go on from what was saved, which is all of it."""
        self.T_keyframe_lidar = saved.optional_array("T_keyframe_lidar", (4, 4))
        self.covariance = saved.array("covariance", (6, 6))
        self.length_m, self.lost = saved.number("length_m"), saved.flag("lost")

    def go(self, scan: GraphScan, step_m: float) -> None:
        """One scan further."""
        self.length_m += step_m
        self.lost |= scan.lost
        if self.T_keyframe_lidar is None or scan.T_prev_curr is None or scan.motion_covariance is None:
            self.T_keyframe_lidar = None
            return
        self.T_keyframe_lidar = self.T_keyframe_lidar @ scan.T_prev_curr
        A = adjoint(inverse(scan.T_prev_curr))
        self.covariance = A @ self.covariance @ A.T + scan.motion_covariance


def trajectory_edges(
    key: int,
    T_first_second: FloatArray,
    way: Way,
    before: FloatArray | None,
    now: FloatArray | None,
    config: TrajectoryEdgeConfig,
) -> list[Edge]:
    """From the keyframe before to this one: what the trajectory says, and what the odometry says beside it.

    Args:
        key: of this keyframe; the one before has the key below.
        T_first_second: (4, 4) from this keyframe to the one before, as the trajectory has it.
        way: between them.
        before, now: (6, 6) covariance of either pose, rotation first, in the LiDAR frame; None of one that was not
            laid on the map.
        config: how far each is believed.
    """
    mapped = now is not None
    covariance = trajectory_covariance(way.length_m, mapped, way.lost, config)
    if now is not None and before is not None and not way.lost:
        A = adjoint(inverse(T_first_second))
        covariance = covariance + now + A @ before @ A.T
    edges = [Edge(key - 1, key, T_first_second, covariance, "refinement" if mapped else "odometry")]
    if mapped and way.T_keyframe_lidar is not None:
        doubted = config.odometry_caution**2 * way.covariance
        edges.append(Edge(key - 1, key, way.T_keyframe_lidar, doubted, "odometry"))
    return edges


def trajectory_covariance(length_m: float, mapped: bool, lost: bool, config: TrajectoryEdgeConfig) -> FloatArray:
    """(6, 6) of the motion from one keyframe to the next, as far as drift goes; rotation first."""
    if lost:
        sigma_deg, sigma_m = config.lost_rotation_deg, config.lost_translation_m + 0.5 * length_m
    else:
        factor = 1.0 if mapped else config.unmapped_factor
        sigma_deg = factor * (config.rotation_deg + config.drift_deg_per_m * length_m)
        sigma_m = factor * (config.translation_m + 0.01 * config.drift_percent * length_m)
    return np.diag(np.array([np.deg2rad(sigma_deg)] * 3 + [sigma_m] * 3) ** 2)
