"""The direction of gravity in the world of a run, by the IMU of its recording."""

from pathlib import Path

import numpy as np

from lidarslam.config.settings import load_config
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.datasets.mounted_recording import recorded_axes
from lidarslam.datasets.registry import open_recording
from lidarslam.exports.source import read_source
from lidarslam.storage.directory import CONFIG
from lidarslam.storage.finished_run import read_trajectory

_FEWEST = 10


def upwards(run: Path) -> FloatArray:
    """Unit vector (3,) upwards: the mean specific force in the world, without the change of the velocity.

    Raises:
        InputError: the recording has no IMU whose rotation is known, or is not there any more.
    """
    source = read_source(run, "is needed for the direction of gravity; level by the ground instead")
    recording, trajectory = open_recording(source.path, source.reader), read_trajectory(run)
    samples, instead = recording.imu, "level by the ground instead, with --level ground"
    if samples is None:
        raise InputError(f"{source.path}: has no IMU; {instead}")
    T_lidar_imu, T_recorded_imu = samples.T_lidar_imu, load_config(run / CONFIG).odometry.T_recorded_imu
    if T_recorded_imu is not None:
        T_lidar_imu = recorded_axes(recording)[1] @ T_recorded_imu
    if T_lidar_imu is None:
        raise InputError(f"{source.path}: the rotation of its IMU is not known; {instead}")
    stamps = trajectory.stamps
    during = (samples.stamps >= stamps[0]) & (samples.stamps <= stamps[-1])
    if during.sum() < _FEWEST or len(trajectory) < 3:
        raise InputError(f"{source.path}: its IMU has too few samples during the run; {instead}")
    R_world_imu = trajectory.at(samples.stamps[during])[:, :3, :3] @ T_lidar_imu[:3, :3]
    force = np.einsum("nij,nj->ni", R_world_imu, samples.accelerations[during]).mean(axis=0)
    velocities = np.diff(trajectory.positions, axis=0) / np.diff(stamps)[:, None]
    force = force - (velocities[-1] - velocities[0]) / trajectory.duration_s
    return np.asarray(force / np.linalg.norm(force))
