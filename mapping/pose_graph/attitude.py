"""Attitudes of keyframes by gravity, which holds roll and pitch in the graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.state import Shape
from lidarslam.mapping.pose_graph.graph_scan import GraphScan
from lidarslam.mapping.pose_graph.keyframes import Keyframe

# Errors of the accelerometer repeat from one measurement to the next: least standard deviation.
_LEAST_SIGMA = float(np.deg2rad(0.2))


@dataclass(frozen=True, eq=False)
class Attitude:
    """Where a keyframe's LiDAR frame has the world's vertical; unit vectors."""

    key: int
    lidar: Annotated[FloatArray, Shape(3)]  # (3,) in the keyframe
    world: Annotated[FloatArray, Shape(3)]  # (3,) in the world of its recording
    sigma: float  # radians

    def __post_init__(self) -> None:
        if not self.sigma > 0.0:
            raise ValueError(f"an attitude has the standard deviation {self.sigma:g}")


def measured_attitude(
    scan: GraphScan, keyframes: Sequence[Keyframe], scan_poses: Sequence[FloatArray]
) -> list[Attitude]:
    """Gravity as measured with the latest scan, in the last keyframe; nothing where nothing was measured."""
    if scan.gravity is None or not keyframes:
        return []
    T_lidar_keyframe = inverse(scan.T_world_lidar) @ scan_poses[keyframes[-1].scan]
    gravity = scan.gravity.turned(T_lidar_keyframe[:3, :3])
    sigma = max(_LEAST_SIGMA, float(np.sqrt(np.linalg.eigvalsh(gravity.covariance)[-1])))
    return [Attitude(len(keyframes) - 1, gravity.lidar, gravity.world, sigma)]
