"""A drive of KITTI-360 (Liao et al., PAMI 2022): `data_3d_raw/..._sync/velodyne_points`, `data_poses`, `calibration`.

The scans are as measured, not motion compensated. As on KITTI's car, the laser turns clockwise from the rear and faces
forward at the stamp, as the data set's own program for compensation assumes.
"""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform, orthonormalize
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, parse_numbers
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.scan_files import numbered_scans, read_bin
from lidarslam.datasets.published.kitti_files import read_calibration, read_sweep_timing
from lidarslam.datasets.published.stamped_files import increasing, read_table
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.stored_recording import FileRecording, choose_sequence
from lidarslam.datasets.times.point_time import PointTimeModel
from lidarslam.datasets.times.stamps import scan_rate

SCANS = "data_3d_raw"
_POINTS = "velodyne_points"


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a drive: the data set's root, with `config.sequence` such as 0003, or a folder in its data_3d_raw.

    Raises:
        InputError: no such drive, no scan, or a damaged stamp file.
    """
    return Kitti360Recording(_find_drive(source, config.sequence), config)


def _find_drive(source: Path, wanted: str | None) -> Path:
    if (source / _POINTS).is_dir():
        return source.resolve()
    names = sorted(path.parent.name for path in (source / SCANS).glob(f"*/{_POINTS}") if path.is_dir())
    return (source / SCANS / choose_sequence(source, names, wanted, "drive")).resolve()


class Kitti360Recording(FileRecording):
    """One drive."""

    reader = "kitti-360"

    def __init__(self, drive: Path, config: ReaderConfig) -> None:
        files, self._numbers = numbered_scans(drive / _POINTS / "data")
        super().__init__(drive, config, files)
        self._timing = read_sweep_timing(drive / _POINTS, self._numbers, config)
        self.stamps = self._timing.stamps
        self._sweep_s = 1.0 / (scan_rate(self.stamps) or config.rate_hz)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of the drive's poses, for the scans that have one; the world is the first one's LiDAR frame."""
        path, T_pose_lidar = self._truth_path(), self._T_pose_lidar
        if path is None or T_pose_lidar is None:
            return None
        rows = read_table(path, 13)
        rows = rows[np.isin(rows[:, 0], self._numbers)]
        if not len(rows):
            return None
        T_world_pose = np.stack([_transform(row) for row in rows[:, 1:]])
        T_world_lidar = T_world_pose @ T_pose_lidar
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
        return _transform(T_pose_cam) @ inverse(_transform(T_lidar_cam[0]))

    def _read(self, index: int, faults: Faults) -> Scan:  # noqa: ARG002
        rows = read_bin(self._files[index])
        offsets = None
        if self._config.time_reference != "none":
            offsets = -self._sweep_s * np.arctan2(rows[:, 1], rows[:, 0]).astype(np.float64) / (2.0 * np.pi)
        return Scan.from_raw(rows[:, :3], self.stamps[index], offsets, intensities=rows[:, 3])

    def _truth_path(self) -> Path | None:
        path = self._source.parent.parent / "data_poses" / self._source.name / "poses.txt"
        return path if path.is_file() else None

    def _point_time_model(self) -> PointTimeModel | None:
        return None if self._config.time_reference == "none" else PointTimeModel("azimuth", "s", "relative")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Stamps that were interpolated or made from the rate."""
        # There are no files of the sweeps' starts and ends, unlike in KITTI's raw data.
        return tuple(note for note in self._timing.notes if "sweeps" not in note)

    def _notes(self) -> Iterator[str]:
        yield "Points are taken as they are: the correction of elevation that KITTI's scans get is not applied."
        if self._truth_path() is not None and self._T_pose_lidar is None:
            yield "There is no calibration folder beside data_3d_raw, so the poses cannot be used as ground truth."


def _transform(numbers: FloatArray) -> FloatArray:
    """(4, 4) of the twelve numbers of its first three rows."""
    rows = numbers.reshape(3, 4)
    return orthonormalize(make_transform(rows[:, :3], rows[:, 3]))
