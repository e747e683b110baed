"""The keyframes of one recording: submaps, edges along the trajectory, attitudes by gravity; loop closures come later.

Scans come with the poses that scan-to-map registration gave them. Some become keyframes, by distance, by turn, and by
overlap with the last one; the points seen until the next one are the submap of each."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log, rotation_angle, transform_points
from lidarslam.core.scan import PointAttributes
from lidarslam.core.state import TRANSFORM, BlockFile, Shape, Stateful
from lidarslam.mapping.config import KeyframeConfig
from lidarslam.mapping.global_map.global_map import GlobalMap, VoxelMeans
from lidarslam.mapping.global_map.voxels import Layout
from lidarslam.mapping.loops.closure import RelativePose
from lidarslam.mapping.motion.prediction import GravityDirection
from lidarslam.mapping.registration.sampled_scan import CellSizes
from lidarslam.mapping.surfels.surfel_map import SurfelMap
from lidarslam.mapping.surfels.voxel_hash import key_steps, point_keys

# The spacing follows the scene: the median range over this, within these limits.
_RANGES_APART, _LEAST_APART_M, _MOST_APART_M = 4.0, 0.5, 4.0
# The next keyframe is due when less than this share of a scan lies where the last keyframe saw something.
_LEAST_OVERLAP = 0.5
# Cells in which two scans are compared, as a part of the median range; finer ones differ from noise alone.
_CELL_RANGES = 0.1
# The overlap's error with this many points is below 2 %.
_COMPARED_POINTS = 1500
# Drift of scan-to-map registration between keyframes, one standard deviation: a floor, and growth per distance.
# Compared with true errors of simulated recordings.
_LEAST_RAD, _LEAST_M = np.deg2rad(0.03), 0.005
_RAD_PER_M, _M_PER_M = np.deg2rad(0.02), 0.003
# An odometry without a map drifts faster by about this factor.
_UNMAPPED = 5.0
# Where tracking was lost the edge only keeps the graph in one piece.
_LOST_RAD, _LOST_M, _LOST_M_PER_M = np.deg2rad(20.0), 1.0, 0.5
# Odometry covariances assume independent errors, but errors repeat from scan to scan: factor on standard deviations.
_ODOMETRY_CAUTION = 10.0
# Errors of the accelerometer repeat from one measurement to the next: least standard deviation.
_LEAST_TILT = float(np.deg2rad(0.2))


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


@dataclass(frozen=True, eq=False)
class MotionSinceKeyframe:
    """The odometry's motion composed since the last keyframe; at first none."""

    length_m: float = 0.0  # path length
    lost: bool = False  # whether tracking was lost since
    # (4, 4); None once a scan had none
    T_keyframe_lidar: Annotated[FloatArray, TRANSFORM] | None = field(default_factory=lambda: np.eye(4))
    # (6, 6) of it, rotation first
    covariance: Annotated[FloatArray, Shape(6, 6)] = field(default_factory=lambda: np.zeros((6, 6)))

    def then(self, scan: GraphScan, step_m: float) -> "MotionSinceKeyframe":
        """One scan further: first-order propagation of the covariance."""
        path = self.length_m + step_m, self.lost or scan.lost
        if self.T_keyframe_lidar is None or scan.T_prev_curr is None or scan.motion_covariance is None:
            return MotionSinceKeyframe(*path, None, self.covariance)
        A = adjoint(inverse(scan.T_prev_curr))
        covariance = A @ self.covariance @ A.T + scan.motion_covariance
        return MotionSinceKeyframe(*path, self.T_keyframe_lidar @ scan.T_prev_curr, covariance)


def trajectory_edges(
    key: int, T_first_second: FloatArray, motion: MotionSinceKeyframe, before: FloatArray | None,
    now: FloatArray | None, one_map: bool = True,
) -> list[RelativePose]:  # fmt: skip
    """Edges to a keyframe from the one before: of the registered trajectory, and of the odometry where it has a motion.

    Covariances (6, 6) of the poses before and now are in the LiDAR frame, None without registration to a map; with
    `one_map` both were registered to the same one.
    """
    registered = now is not None
    covariance = drift_covariance(motion.length_m, registered and one_map, motion.lost)
    if now is not None and before is not None and not motion.lost:
        A = adjoint(inverse(T_first_second))
        covariance = covariance + now + A @ before @ A.T
    edges = [RelativePose(key - 1, key, T_first_second, covariance)]
    if registered and motion.T_keyframe_lidar is not None:
        edges.append(RelativePose(key - 1, key, motion.T_keyframe_lidar, _ODOMETRY_CAUTION**2 * motion.covariance))
    return edges


def drift_covariance(length_m: float, registered: bool = True, lost: bool = False) -> FloatArray:
    """(6, 6) of the drift along a path, rotation first."""
    if lost:
        sigma_rad, sigma_m = _LOST_RAD, _LOST_M + _LOST_M_PER_M * length_m
    else:
        factor = 1.0 if registered else _UNMAPPED
        sigma_rad, sigma_m = factor * (_LEAST_RAD + _RAD_PER_M * length_m), factor * (_LEAST_M + _M_PER_M * length_m)
    return np.diag(np.array([sigma_rad] * 3 + [sigma_m] * 3) ** 2)


def squared_error(edge: RelativePose, poses: Sequence[FloatArray]) -> float:
    """Squared Mahalanobis distance of an edge from keyframe poses (4, 4)."""
    error = log(inverse(poses[edge.first] @ edge.T_first_second) @ poses[edge.second])
    return float(error @ np.linalg.solve(edge.covariance, error))


def first_connected(count: int, pairs: Sequence[tuple[int, int]]) -> NDArray[np.intp]:
    """For each of `count` nodes the first one of its connected component, given the pairs that are joined."""
    from scipy.sparse import coo_array  # takes a while to load
    from scipy.sparse.csgraph import connected_components

    ends = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    adjacency = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, labels = connected_components(adjacency, directed=False)
    _, firsts = np.unique(labels, return_index=True)
    return np.asarray(firsts[labels], dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Attitude:
    """Where a keyframe's LiDAR frame has the world's vertical; unit vectors."""

    key: int
    lidar: Annotated[FloatArray, Shape(3)]  # (3,) in the keyframe
    world: Annotated[FloatArray, Shape(3)]  # (3,) in the world of its recording
    sigma: float  # radians


def measured_attitude(
    scan: GraphScan, keyframes: Sequence[Keyframe], scan_poses: Sequence[FloatArray]
) -> list[Attitude]:
    """Gravity as measured with the latest scan, in the last keyframe; empty where it was not measured."""
    if scan.gravity is None or not keyframes:
        return []
    T_lidar_keyframe = inverse(scan.T_world_lidar) @ scan_poses[keyframes[-1].scan]
    gravity = scan.gravity.turned(T_lidar_keyframe[:3, :3])
    sigma = max(_LEAST_TILT, float(np.sqrt(np.linalg.eigvalsh(gravity.covariance)[-1])))
    return [Attitude(len(keyframes) - 1, gravity.lidar, gravity.world, sigma)]


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
        self._cell_m, self._distance_m = 1.0, _LEAST_APART_M

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
        follows = float(np.clip(range_m / _RANGES_APART, _LEAST_APART_M, _MOST_APART_M))
        self._distance_m = follows if self._config.distance_m is None else self._config.distance_m
        self._cell_m = max(1e-3, _CELL_RANGES * range_m)
        # The cells of points and those that share a face with them, so that noise does not count.
        steps = key_steps(np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]).astype(np.int64))
        self._cells = np.unique(np.add.outer(np.unique(point_keys(points, self._cell_m)), steps))

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

    def add(self, scan: GraphScan) -> VoxelMeans | None:
        """Add the next scan; the points of the one before have been drawn by now.

        Where it is a keyframe, the submap of the one before is complete, and returned.
        """
        complete = None
        if self.scan_poses:
            step_m = float(np.linalg.norm(scan.T_world_lidar[:3, 3] - self.scan_poses[-1][:3, 3]))
            self._motion = self._motion.then(scan, step_m)
            self._path_m += step_m
        self.scan_poses.append(scan.T_world_lidar)
        if scan.belongs_in_map and len(scan.points) and self._selector.is_due(scan.T_world_lidar, scan.points):
            started = time.perf_counter()
            self._selector.take(scan.T_world_lidar, scan.points)
            complete = self.end_recording()
            self._begin_keyframe(scan)
            self.keyframe_ms.append(1e3 * (time.perf_counter() - started))
        self.attitudes += measured_attitude(scan, self.keyframes, self.scan_poses)
        return complete

    def redrawn_local_map(self, cells_m: CellSizes) -> SurfelMap | None:  # noqa: ARG002
        """None: without loop closures the running local map stays as it is."""
        return None

    def end_recording(self) -> VoxelMeans | None:
        """Keep, and return, the submap of the last keyframe: there are no more scans, or another keyframe follows."""
        if not self._is_submap_open:
            return None
        means, self._submap = self.means(len(self.keyframes) - 1), None
        self._keep(means)
        return means

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
