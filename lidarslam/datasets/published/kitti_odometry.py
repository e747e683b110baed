"""The KITTI odometry benchmark: `sequences/NN/{velodyne/*.bin, times.txt, calib.txt}` and `poses/NN.txt`.

The scans are motion compensated by the publishers. The poses are those of the left camera, `cam`; they are converted to
the LiDAR's frame here, and nowhere else.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.trajectory import Trajectory, read_kitti_poses
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.folders.scan_files import numbered_scans
from lidarslam.datasets.published.kitti_raw import read_tr
from lidarslam.datasets.published.stamped_files import BinRecording
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.stored_recording import find_sequence, first_file
from lidarslam.datasets.times.stamps import assumed_rate, increasing_rows, read_stamps


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a sequence of the benchmark: its root, with `config.sequence`, or one `sequences/NN` folder."""
    return KittiOdometryRecording(find_sequence(source, source / "sequences", "velodyne", config.sequence), config)


class KittiOdometryRecording(BinRecording):
    """One sequence."""

    reader = "kitti-odometry"
    _notes = ("The scans are motion compensated by the publishers; they have no per-point time and need none.",)

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        files, self._numbers = numbered_scans(folder / "velodyne")
        super().__init__(folder, config, files)
        self._times = self._read_times()
        self._rate_is_assumed = not len(self._times)
        last = int(self._numbers[-1])
        if (folder / "times.txt").is_file() and last >= len(self._times) < 2:
            raise InputError(
                f"{folder / 'times.txt'}: expected {last + 1} stamps, one for every scan up to {files[-1].name}, got"
                f" {len(self._times)}; complete it, or remove it to use the rate"
            )
        self.stamps = self._stamps_of(self._numbers)
        whole = folder.resolve()
        poses = first_file((whole.parent.parent / "poses",), f"{whole.name}.txt")
        self._pose_file = poses or first_file((whole,), "poses.txt")
        self._truth_path = self._pose_file if (folder / "calib.txt").is_file() else None

    def _read_times(self) -> FloatArray:
        path = self._source / "times.txt"
        times = read_stamps(path) if path.is_file() else np.empty(0)
        increasing = increasing_rows(times)
        if not increasing.all():
            raise InputError(
                f"{path}: expected stamps that increase from line to line, those at line"
                f" {int(np.argmin(increasing)) + 1} and perhaps others do not; mend it, or remove it to use the rate"
            )
        return times

    def _stamps_of(self, numbers: NDArray[np.intp]) -> FloatArray:
        """The stamps (N,) of scans by their numbers; those beyond the last line continue at the median rate."""
        if self._rate_is_assumed:
            return numbers / self._config.rate_hz
        last_line = len(self._times) - 1
        beyond = np.maximum(numbers - last_line, 0)
        period_s = float(np.median(np.diff(self._times))) if beyond.any() else 0.0
        return np.asarray(self._times[np.minimum(numbers, last_line)] + period_s * beyond, dtype=np.float64)

    @property
    def name(self) -> str:
        """Such as kitti_04."""
        return f"kitti_{self._source.resolve().name}"

    @cached_property
    def T_cam_lidar(self) -> FloatArray | None:
        """The extrinsic calibration `Tr`, (4, 4); None without calib.txt."""
        path = self._source / "calib.txt"
        return read_tr(path) if path.is_file() else None

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of every pose with a stamp, also where the scan is absent."""
        T_cam_lidar = self.T_cam_lidar
        if self._pose_file is None or T_cam_lidar is None:
            return None
        T_cam0_cam = read_kitti_poses(self._pose_file)
        if not self._rate_is_assumed:
            T_cam0_cam = T_cam0_cam[: max(len(self._times), int(self._numbers[-1]) + 1)]
        # The world is where the LiDAR was when the camera was at cam0, the frame of the pose file.
        T_world_lidar = inverse(T_cam_lidar) @ T_cam0_cam @ T_cam_lidar
        return Trajectory(self._stamps_of(np.arange(len(T_cam0_cam))), T_world_lidar)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Missing and superfluous stamps, scans and poses."""
        return tuple(self._warnings())

    def _warnings(self) -> Iterator[str]:
        last, lines, poses = int(self._numbers[-1]), len(self._times), 0
        if self._rate_is_assumed:
            yield assumed_rate("There is no times.txt", self._config)
        if len(self) <= last - self._numbers[0]:
            yield f"Of the scans {self._numbers[0]} to {last} only {len(self)} are there."
        if self._pose_file is not None and self._truth_path is None:
            yield f"There is no calib.txt, so {self._pose_file.name}, in the camera frame, cannot be used."
        elif self._pose_file is not None:
            with suppress(InputError):  # damaged, an error of `ground_truth`
                poses = len(read_kitti_poses(self._pose_file))
        up_to = f"for the scans up to number {last}"
        if 0 < lines <= last:
            yield f"times.txt has only {lines} lines {up_to}; the missing stamps continue at its rate."
        if 0 < poses <= last:
            yield f"{self._pose_file} has only {poses} poses {up_to}."
        counts = ((lines, f"times.txt has {lines} lines"), (poses, f"{self._pose_file} has {poses} poses"))
        if more := [said for number, said in counts if number > last + 1]:
            yield f"{' and '.join(more)} {up_to}; those beyond are not used."
