"""Keyframe selection: by distance, by turn, and by overlap with the last keyframe."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.core.state import TRANSFORM, Shape, Stateful
from lidarslam.mapping.config import KeyframeConfig
from lidarslam.mapping.motion.prediction import GravityDirection
from lidarslam.mapping.surfels.voxel_hash import key_steps, point_keys

# The spacing follows the scene: the median range over this, within these limits.
_RANGES_APART, _LEAST_M, _MOST_M = 4.0, 0.5, 4.0
# The next keyframe is due when less than this share of a scan lies where the last keyframe saw something.
_LEAST_OVERLAP = 0.5
# Cells in which two scans are compared, as a part of the median range; finer ones differ from noise alone.
_CELL_RANGES = 0.1
# The overlap's error with this many points is below 2 %.
_COMPARED_POINTS = 1500


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


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A keyframe of the pose graph."""

    scan: int  # its index among all scans
    segment: int  # stretch of continuous tracking, across which no drift model holds
    path_m: float  # path length from the recording's start
    # (6, 6) of its registration to the map, rotation first; None when it was not registered
    covariance: Annotated[FloatArray, Shape(6, 6)] | None


class KeyframeSelector(Stateful):
    """Remembers the last keyframe, and decides when the next is due."""

    _T_world_keyframe: Annotated[FloatArray, TRANSFORM] | None
    _cells: Annotated[NDArray[np.int64], Shape(None)]
    _cell_m: float
    _distance_m: float

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._T_world_keyframe = None
        self._cells = np.empty(0, dtype=np.int64)
        self._cell_m, self._distance_m = 1.0, _LEAST_M

    def is_due(self, T_world_lidar: FloatArray, points: FloatArray) -> bool:
        """Whether a scan with a pose (4, 4) and points (N, 3) in its LiDAR frame becomes one; the first does."""
        if self._T_world_keyframe is None:
            return True
        T_keyframe_lidar = inverse(self._T_world_keyframe) @ T_world_lidar
        return bool(
            np.linalg.norm(T_keyframe_lidar[:3, 3]) >= self._distance_m
            or np.rad2deg(rotation_angle(T_keyframe_lidar)) >= self._config.turn_deg
            or self._overlap(T_keyframe_lidar, points) < _LEAST_OVERLAP
        )

    def take(self, T_world_lidar: FloatArray, points: FloatArray) -> None:
        """Make this scan the last keyframe."""
        self._T_world_keyframe = T_world_lidar
        range_m = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 1.0
        follows = float(np.clip(range_m / _RANGES_APART, _LEAST_M, _MOST_M))
        self._distance_m = follows if self._config.distance_m is None else self._config.distance_m
        self._cell_m = max(1e-3, _CELL_RANGES * range_m)
        # The cells of points and those that share a face with them, so that noise does not count.
        steps = key_steps(np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]).astype(np.int64))
        self._cells = np.unique(np.add.outer(point_keys(points, self._cell_m), steps))

    def _overlap(self, T_keyframe_lidar: FloatArray, points: FloatArray) -> float:
        """The share of a scan's points that lie where the keyframe saw something; 1 for a scan without points."""
        points = points[:: max(1, len(points) // _COMPARED_POINTS)]
        if not len(points) or not len(self._cells):
            return 1.0
        return float(np.isin(point_keys(transform_points(T_keyframe_lidar, points), self._cell_m), self._cells).mean())
