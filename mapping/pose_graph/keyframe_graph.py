"""The keyframes of one recording: their submaps, and edges along the trajectory; loop closures come later.

Scans come with the poses that scan-to-map registration gave them. Some become keyframes, by distance, by turn, and by
overlap with the last one; the points seen until the next one are the submap of each."""

import time
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, rotation_angle, transform_points
from lidarslam.core.scan import PointAttributes
from lidarslam.core.state import TRANSFORM, BlockFile, Shape, Stateful
from lidarslam.mapping.config import KeyframeConfig
from lidarslam.mapping.global_map.global_map import GlobalMap, VoxelMeans
from lidarslam.mapping.global_map.voxels import Layout
from lidarslam.mapping.loops.closure import RelativePose
from lidarslam.mapping.pose_graph.edges import (
    Attitude,
    GraphScan,
    Keyframe,
    MotionSinceKeyframe,
    measured_attitude,
    trajectory_edges,
)
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.surfels.voxel_hash import key_steps, point_keys

# The spacing follows the scene: the median range over this, within these limits.
_RANGES_APART, _LEAST_M, _MOST_M = 4.0, 0.5, 4.0
# The next keyframe is due when less than this share of a scan lies where the last keyframe saw something.
_LEAST_OVERLAP = 0.5
# Cells in which two scans are compared, as a part of the median range; finer ones differ from noise alone.
_CELL_RANGES = 0.1
# The overlap's error with this many points is below 2 %.
_COMPARED_POINTS = 1500


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
        cells = point_keys(transform_points(T_keyframe_lidar, points), self._cell_m)
        # The keyframe's are sorted: several times as fast as `np.isin`, which sorts both.
        next_cells = self._cells.take(np.searchsorted(self._cells, cells), mode="clip")
        return float((next_cells == cells).mean())


class SubmapStore(BlockFile):
    """Submaps in order, in a file: hours of recording would not fit into memory. See `BlockFile`."""

    _layouts: list[Layout]

    def __init__(self, directory: Path | None = None, file: Path | None = None) -> None:
        super().__init__(directory, file)
        self._layouts = []

    def append(self, means: VoxelMeans) -> None:
        """Keep one more; OSError where the disk is full."""
        self.write(np.ascontiguousarray(means.rows, dtype="<f4").tobytes())
        self._layouts.append(means.layout)

    def __getitem__(self, index: int) -> VoxelMeans:
        layout = self._layouts[index]
        return VoxelMeans(np.frombuffer(self.read(index), dtype="<f4").reshape(-1, layout.width), layout)


class KeyframeGraph(Stateful):
    """Follows one recording, scan after scan; submaps are kept in a file, see `BlockFile`."""

    scan_poses: list[Annotated[FloatArray, TRANSFORM]]  # as registered
    keyframe_ms: list[float]  # wall time of each keyframe
    keyframes: list[Keyframe]
    edges: list[RelativePose]  # along the trajectory
    attitudes: list[Attitude]  # of keyframes
    redraws: list[int]  # numbers of keyframes when the running local map was rebuilt
    store: SubmapStore  # of all keyframes but the last, until `end_recording`
    _selector: KeyframeSelector
    _submap: GlobalMap | None  # of the last keyframe, in its frame
    _motion: MotionSinceKeyframe
    _path_m: float
    _segment: int

    def __init__(self, config: KeyframeConfig, directory: Path | None = None, file: Path | None = None) -> None:
        self._selector = KeyframeSelector(config)
        self.store = SubmapStore(directory, file)
        self.scan_poses, self.keyframe_ms, self.keyframes, self.edges = [], [], [], []
        self.attitudes, self.redraws = [], []
        self._submap = None
        self._motion, self._path_m, self._segment = MotionSinceKeyframe(), 0.0, 0

    def draw(
        self, points: FloatArray, T_world_lidar: FloatArray, voxel_size_m: float, known: PointAttributes | None = None
    ) -> None:
        """Add points (N, 3) of the latest scan, at its pose as registered, to the submap of the last keyframe."""
        if self._is_submap_open:
            self._submap = self._submap or GlobalMap(voxel_size_m)
            self._submap.add(points, inverse(self.scan_poses[self.keyframes[-1].scan]) @ T_world_lidar, known)

    def add(self, scan: GraphScan) -> None:
        """Add the next scan; the points of the one before have been drawn by now."""
        if self.scan_poses:
            step_m = float(np.linalg.norm(scan.T_world_lidar[:3, 3] - self.scan_poses[-1][:3, 3]))
            self._motion = self._motion.then(scan, step_m)
            self._path_m += step_m
        self.scan_poses.append(scan.T_world_lidar)
        if scan.belongs_in_map and len(scan.points) and self._selector.is_due(scan.T_world_lidar, scan.points):
            started = time.perf_counter()
            self._selector.take(scan.T_world_lidar, scan.points)
            self.end_recording()
            self._begin_keyframe(scan)
            self.keyframe_ms.append(1e3 * (time.perf_counter() - started))
        self.attitudes += measured_attitude(scan, self.keyframes, self.scan_poses)

    def redrawn_local_map(self, cell_m: float) -> SurfelMap | None:  # noqa: ARG002
        """None: without loop closures the running local map stays as it is."""
        return None

    def end_recording(self) -> None:
        """Keep the submap of the last keyframe: there are no more scans, or another keyframe follows."""
        if self._is_submap_open:
            means, self._submap = self.means(len(self.keyframes) - 1), None
            self._keep(means)

    def close(self) -> None:
        """Release the submaps on disk."""
        self.store.close()

    def means(self, key: int) -> VoxelMeans:
        """The submap of a keyframe, also of the one that still grows."""
        if key < len(self.store):
            return self.store[key]
        return (self._submap or GlobalMap(1.0)).means()

    @property
    def _is_submap_open(self) -> bool:
        """Whether the last keyframe's submap still grows."""
        return len(self.store) < len(self.keyframes)

    def _keep(self, means: VoxelMeans) -> None:
        """Keep the submap of the last keyframe."""
        self.store.append(means)

    def _begin_keyframe(self, scan: GraphScan, one_map: bool = True) -> None:
        """The latest scan becomes a keyframe; with `one_map` it was registered to the same one as the last keyframe."""
        motion, self._motion = self._motion, MotionSinceKeyframe()
        if self.keyframes:
            last = self.keyframes[-1]
            T_first_second = inverse(self.scan_poses[last.scan]) @ scan.T_world_lidar
            covariances = last.covariance, scan.covariance
            self.edges += trajectory_edges(len(self.keyframes), T_first_second, motion, *covariances, one_map)
            self._segment += motion.lost  # the drift model does not hold across
        self.keyframes.append(Keyframe(len(self.scan_poses) - 1, self._segment, self._path_m, scan.covariance))
