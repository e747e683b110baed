"""Keyframes, and measurements of the graph besides loop closures: motion, attitude by gravity, GNSS positions."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint, inverse, log
from lidarslam.core.state import TRANSFORM, Shape
from lidarslam.core.trajectory import Trajectory
from lidarslam.mapping.global_map.georeference import GnssTrack, align_to_track
from lidarslam.mapping.loops.closure import RelativePose
from lidarslam.mapping.motion.prediction import GravityDirection

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
# Errors of GNSS are correlated over this time, seconds: positions within it count as one.
_CORRELATED_S = 10.0
# Standard deviations, metres: where none is stated, and at least. That of the height is larger by the factor.
_UNKNOWN_M, _LEAST_GNSS_M, _HEIGHT = 3.0, 0.02, 2.0


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


@dataclass(frozen=True, eq=False)
class AntennaPosition:
    """A measured position, assigned to the keyframe nearest in time."""

    key: int
    antenna: FloatArray  # (3,) in the keyframe's LiDAR frame, by the registered motion between both
    measured: FloatArray  # (3,) x east, y north, z up, metres
    sigmas: FloatArray  # (3,) metres
    repeats: float  # number of positions whose errors are correlated


@dataclass(frozen=True, eq=False)
class ProjectedTrack:
    """A GNSS track in a map projection."""

    track: GnssTrack
    projected: FloatArray  # (N, 3) metres
    scale: float  # of the projection at this place

    def aligned(self, trajectory: Trajectory) -> FloatArray:
        """T_map_world (4, 4) of a trajectory; the origin of the map is the first position."""
        T = align_to_track(trajectory, self.track, self.projected - self.projected[0], self.scale).T_map_world.copy()
        T[:3, 3] /= self.scale
        return T

    def positions(self, trajectory: Trajectory, keyframe_scans: Sequence[int]) -> list[AntennaPosition]:
        """The positions within the time of a trajectory (M poses), assigned to the keyframes among its scans."""
        track, scans = self.track, np.asarray(keyframe_scans)
        rows = np.flatnonzero(track.is_within(trajectory, self.projected))
        keys = np.abs(trajectory.stamps[scans][None, :] - track.stamps[rows, None]).argmin(axis=1)
        antennas = trajectory.at(track.stamps[rows]) @ np.append(track.lidar_antenna, 1.0)
        T_keyframe_world = inverse(trajectory.T_world_lidar[scans[keys]])
        antennas = np.einsum("nij,nj->ni", T_keyframe_world, antennas)[:, :3]
        measured = (self.projected[rows] - self.projected[0]) / self.scale
        repeats = max(1.0, len(rows) * _CORRELATED_S / max(float(np.ptp(track.stamps[rows])), _CORRELATED_S))
        stated = np.where(np.isfinite(track.sigma_m[rows]), track.sigma_m[rows], _UNKNOWN_M)
        sigmas = np.maximum(stated, _LEAST_GNSS_M)[:, None] * np.array([1.0, 1.0, _HEIGHT])
        return [
            AntennaPosition(int(key), antenna, position, sigma, repeats)
            for key, antenna, position, sigma in zip(keys, antennas, measured, sigmas, strict=True)
        ]
