"""Which scans become keyframes: when the sensor has moved on, turned, or sees little of what it saw."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.core.state import Saved, State
from mapping.pose_graph.graph_config import KeyframeConfig
from mapping.surfels.voxel_hash import key_steps, point_keys

# The spacing follows the scene: the median range over this, within these limits.
_RANGES_APART, _LEAST_M, _MOST_M = 4.0, 0.5, 4.0
# Cells in which two scans are compared, as a part of the median range; finer ones differ from noise alone.
_CELL_RANGES = 0.1
# More points than this do not tell more about how much two scans see of one another.
_COMPARED_POINTS = 1500


class KeyframeSelector:
    """Remembers the last keyframe, and says when the next is due."""

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self._T_world_keyframe: FloatArray | None = None
        self._cells = np.empty(0, dtype=np.int64)
        self._cell_m, self._distance_m = 1.0, _LEAST_M

    def state(self) -> State:
        """The last keyframe."""
        return {
            "T_world_keyframe": self._T_world_keyframe,
            "cells": self._cells,
            "cell_m": self._cell_m,
            "distance_m": self._distance_m,
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state."""
        self._T_world_keyframe = saved.optional_array("T_world_keyframe", (4, 4))
        self._cells = saved.array("cells", (None,), np.int64)
        self._cell_m, self._distance_m = saved.number("cell_m"), saved.number("distance_m")

    def is_due(self, T_world_lidar: FloatArray, points: FloatArray) -> bool:
        """Whether a scan with a pose (4, 4) and points (N, 3) in its LiDAR frame should be one; the first is."""
        if self._T_world_keyframe is None:
            return True
        T_keyframe_lidar = inverse(self._T_world_keyframe) @ T_world_lidar
        if np.linalg.norm(T_keyframe_lidar[:3, 3]) >= self._distance_m:
            return True
        if np.rad2deg(rotation_angle(T_keyframe_lidar)) >= self._config.turn_deg:
            return True
        return self._overlap(T_keyframe_lidar, points) < self._config.least_overlap

    def take(self, T_world_lidar: FloatArray, points: FloatArray) -> None:
        """This scan is the keyframe now."""
        self._T_world_keyframe = T_world_lidar
        range_m = float(np.median(np.linalg.norm(points, axis=1))) if len(points) else 1.0
        follows = float(np.clip(range_m / _RANGES_APART, _LEAST_M, _MOST_M))
        self._distance_m = follows if self._config.distance_m is None else self._config.distance_m
        self._cell_m = max(1e-3, _CELL_RANGES * range_m)
        self._cells = np.unique(self._grown(points))

    def _overlap(self, T_keyframe_lidar: FloatArray, points: FloatArray) -> float:
        """The share of a scan's points that lie where the keyframe saw something; 1 for a scan without points."""
        points = points[:: max(1, len(points) // _COMPARED_POINTS)]
        if not len(points) or not len(self._cells):
            return 1.0
        keys = point_keys(transform_points(T_keyframe_lidar, points), self._cell_m)
        row = np.searchsorted(self._cells, keys).clip(max=len(self._cells) - 1)
        return float(np.mean(self._cells[row] == keys))

    def _grown(self, points: FloatArray) -> NDArray[np.int64]:
        """The cells of points and those that share a face with them, so that noise does not count."""
        steps = key_steps(np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]).astype(np.int64))
        return np.add.outer(point_keys(points, self._cell_m), steps).ravel()
