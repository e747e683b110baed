"""The trajectories of a run on disk, and how good they are by the truth that came with the recording."""

from evaluation.trajectory_metrics import TrajectoryMetrics, evaluate_trajectory
from lidarslam import run_directory as files
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import format_kitti, format_tum
from lidarslam.datasets.recording import Recording
from lidarslam.run_directory import RunDirectory
from lidarslam.scan_log import ScanLog


def ground_truth(recording: Recording, log: ScanLog) -> Trajectory | None:
    """The recording's truth; a damaged one costs the metrics, not the run."""
    try:
        return recording.ground_truth
    except InputError as error:
        log.warn(f"no metrics: {error}")
        return None


def write_trajectories(
    directory: RunDirectory, recording: Recording, truth: Trajectory | None, log: ScanLog
) -> TrajectoryMetrics | None:
    """Write the poses of a run, final ones and the odometry's, and its errors where there is a truth to tell them."""
    T_cam_lidar = _camera(recording, log)
    trajectory = log.trajectory
    directory.write_text(files.TRAJECTORY_TUM, format_tum(trajectory))
    directory.write_text(files.ODOMETRY_TUM, format_tum(log.odometry))
    poses = trajectory.T_world_lidar
    if T_cam_lidar is not None:  # the devkit compares camera poses
        poses = T_cam_lidar @ poses @ inverse(T_cam_lidar)
    directory.write_text(files.TRAJECTORY_KITTI, format_kitti(poses))
    if truth is None:
        return None
    try:
        metrics = evaluate_trajectory(trajectory, truth)
    except InputError as error:
        log.warn(f"no metrics: {error}")
        return None
    directory.write_json(files.METRICS, metrics.to_json())
    return metrics


def _camera(recording: Recording, log: ScanLog) -> FloatArray | None:
    """T_cam_lidar; a damaged calibration costs the camera's frame, not the run."""
    try:
        return recording.T_cam_lidar
    except InputError as error:
        log.warn(f"{files.TRAJECTORY_KITTI} is in the LiDAR's frame: {error}")
        return None
