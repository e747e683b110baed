"""The trajectories of a run on disk, and how good they are by the truth that came with the recording."""

from collections.abc import Callable
from typing import TypeVar

from evaluation.trajectory.metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import inverse
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import format_kitti, format_tum
from lidarslam.datasets.recording import Recording
from lidarslam.run import directory as files
from lidarslam.run.directory import RunDirectory
from lidarslam.run.scan_log import ScanLog

_NO_METRICS = "no metrics"
T = TypeVar("T")


def ground_truth(recording: Recording, log: ScanLog) -> Trajectory | None:
    """The recording's truth; a damaged one costs the metrics, not the run."""
    return _unless_damaged(lambda: recording.ground_truth, log, _NO_METRICS)


def write_trajectories(
    directory: RunDirectory, recording: Recording, truth: Trajectory | None, log: ScanLog
) -> TrajectoryMetrics | None:
    """Write the poses of a run, final ones and the odometry's, and its errors where there is a truth to tell them."""
    T_cam_lidar = _unless_damaged(
        lambda: recording.T_cam_lidar, log, f"{files.TRAJECTORY_KITTI} is in the LiDAR's frame"
    )
    trajectory = log.trajectory
    directory.write_text(files.TRAJECTORY_TUM, format_tum(trajectory))
    directory.write_text(files.ODOMETRY_TUM, format_tum(log.odometry))
    poses = trajectory.T_world_lidar
    if T_cam_lidar is not None:  # the devkit compares camera poses
        poses = T_cam_lidar @ poses @ inverse(T_cam_lidar)
    directory.write_text(files.TRAJECTORY_KITTI, format_kitti(poses))
    if truth is None:
        return None
    metrics = _unless_damaged(lambda: evaluate_trajectory(trajectory, truth), log, _NO_METRICS)
    if metrics is not None:
        directory.write_json(files.METRICS, metrics.to_json())
    return metrics


def _unless_damaged(read: Callable[[], T], log: ScanLog, cost: str) -> T | None:
    """What came with the recording; a warning that says what it costs, where it is damaged."""
    try:
        return read()
    except InputError as error:
        log.warn(f"{cost}: {error}")
        return None
