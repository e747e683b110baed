"""Apollo-SouthBay: `pcds/*.pcd` and `poses/gt_poses.txt`, a line of index, stamp, position and quaternion per scan."""

from functools import cached_property
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory, parse_numbers
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.folders.scan_folder import ScanFolderRecording
from lidarslam.datasets.published.stamped_files import poses_wxyz
from lidarslam.datasets.recording import Recording, find_sequence
from lidarslam.datasets.times.stamps import increasing_rows

_COLUMNS = 9


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a folder with pcds and poses, or `config.sequence` of one above several such."""
    return ApolloRecording(find_sequence(source, source, "poses/gt_poses.txt", config.sequence), config)


class ApolloRecording(ScanFolderRecording):
    """One sequence; its scans are read as those of any folder."""

    reader = "apollo"
    _truth_path: Path

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        super().__init__(folder / "pcds", config)
        self._sequence = folder
        self._truth_path = folder / "poses" / "gt_poses.txt"
        self._rows = self._read_poses()
        self.stamps = self._rows[:, 1]
        self._has_stamps, self._folder_notes = True, ()
        if not increasing_rows(self.stamps).all():
            raise InputError(f"{self._truth_path}: expected stamps that increase from line to line; mend it")

    def _read_poses(self) -> FloatArray:
        """The rows (N, 9) of the scans; by the index where the scans are named so, else in their order."""
        rows = parse_numbers(self._truth_path, _COLUMNS)
        numbers = [int(path.stem) if path.stem.isdecimal() else -1 for path in self._files]
        by_index = {int(row[0]): row for row in rows}
        if all(number in by_index for number in numbers):
            return np.array([by_index[number] for number in numbers])
        if len(rows) != len(self._files):
            raise InputError(
                f"{self._truth_path}: expected a line for each of the {len(self._files)} scans, by its index or in"
                f" their order, got {len(rows)} lines; download it again"
            )
        return rows

    @property
    def name(self) -> str:
        """The sequence's folder."""
        return self._sequence.resolve().name

    @cached_property
    def ground_truth(self) -> Trajectory:
        """T_world_lidar at every scan; the poses are taken for those of the scans' frame."""
        # The scalar is the last of the file's four numbers.
        quaternions = np.roll(self._rows[:, 5:9], 1, axis=1)
        return Trajectory(self.stamps, poses_wxyz(self._truth_path, self._rows[:, 2:5], quaternions))
