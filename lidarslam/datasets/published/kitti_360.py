"""A drive of KITTI-360 (Liao et al., PAMI 2022): `data_3d_raw/..._sync/velodyne_points`, `data_poses`, `calibration`.

The scans are as measured, not motion compensated. As on KITTI's car, the laser turns clockwise from the rear and faces
forward at the stamp, as the data set's own program for compensation assumes.
"""

from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory, parse_numbers
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.folders.scan_files import numbered_scans
from lidarslam.datasets.published.kitti_raw import read_calibration, read_sweep_timing
from lidarslam.datasets.published.stamped_files import BinRecording, increasing, poses_of_rows, read_table
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.stored_recording import find_sequence, first_file
from lidarslam.datasets.times.azimuth import AZIMUTH_TIME
from lidarslam.datasets.times.stamps import scan_rate

_SCANS, _POINTS = "data_3d_raw", "velodyne_points"


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a drive: the data set's root, with `config.sequence` such as 0003, or a folder in its data_3d_raw."""
    drive = find_sequence(source, source / _SCANS, _POINTS, config.sequence, "drive")
    return Kitti360Recording(drive.resolve(), config)


class Kitti360Recording(BinRecording):
    """One drive."""

    reader = "kitti-360"
    point_time = AZIMUTH_TIME

    def __init__(self, drive: Path, config: ReaderConfig) -> None:
        files, self._numbers = numbered_scans(drive / _POINTS / "data")
        super().__init__(drive, config, files)
        timing = read_sweep_timing(drive / _POINTS, self._numbers, config)
        self.stamps = timing.stamps
        # There are no files of the sweeps' starts and ends, unlike in KITTI's raw data.
        self.warnings = tuple(note for note in timing.notes if "sweeps" not in note)
        self._sweep_s = 1.0 / (scan_rate(self.stamps) or config.rate_hz)
        self._truth_path = first_file((drive.parent.parent / "data_poses" / drive.name,), "poses.txt")

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of the drive's poses, for the scans that have one; the world is the first one's LiDAR frame."""
        path, T_pose_lidar = self._truth_path, self._T_pose_lidar
        if path is None or T_pose_lidar is None:
            return None
        rows = read_table(path, 13)
        rows = rows[np.isin(rows[:, 0], self._numbers)]
        if not len(rows):
            return None
        T_world_lidar = poses_of_rows(rows[:, 1:]) @ T_pose_lidar
        stamps = self.stamps[np.searchsorted(self._numbers, rows[:, 0])]
        return increasing(stamps, inverse(T_world_lidar[0]) @ T_world_lidar)

    @cached_property
    def _T_pose_lidar(self) -> FloatArray | None:
        folder = self._source.parent.parent / "calibration"
        to_lidar, to_pose = folder / "calib_cam_to_velo.txt", folder / "calib_cam_to_pose.txt"
        if not (to_lidar.is_file() and to_pose.is_file()):
            return None
        T_pose_cam, T_lidar_cam = read_calibration(to_pose).get("image_00"), parse_numbers(to_lidar, 12)
        if T_pose_cam is None or len(T_pose_cam) != 12 or len(T_lidar_cam) != 1:
            raise InputError(f"{folder}: expected 12 numbers in {to_lidar.name} and at `image_00:` in {to_pose.name}")
        return poses_of_rows(T_pose_cam) @ inverse(poses_of_rows(T_lidar_cam[0]))

    def _offsets(self, rows: NDArray[np.float32], index: int) -> FloatArray:  # noqa: ARG002
        return -self._sweep_s * np.arctan2(rows[:, 1], rows[:, 0]).astype(np.float64) / (2.0 * np.pi)

    @cached_property
    def _notes(self) -> tuple[str, ...]:
        note = "Points are taken as they are: the correction of elevation that KITTI's scans get is not applied."
        if self._truth_path is None or self._T_pose_lidar is not None:
            return (note,)
        return note, "There is no calibration folder beside data_3d_raw, so the poses cannot be used as ground truth."
