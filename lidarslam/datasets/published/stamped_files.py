"""Files that the data sets of cars and robots have in common: scans named by their stamps, tables, and poses."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform, orthonormalize
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory, parse_numbers
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.scan_files import read_bin
from lidarslam.datasets.recording import FileRecording
from lidarslam.datasets.times.stamps import increasing_rows, stamps_from_names


class BinRecording(FileRecording):
    """A folder of .bin scans: x, y, z, intensity and perhaps a ring. A reader adds the stamps, and points' times."""

    def _read(self, index: int, faults: Faults) -> Scan:  # noqa: ARG002
        rows = read_bin(self._files[index], len(self._stored))
        rings = rows[:, 4] if len(self._stored) > 4 else None
        offsets = self._offsets(rows, index) if self._point_time else None
        return Scan.from_raw(rows[:, :3], self.stamps[index], offsets, rings, rows[:, 3])

    def _offsets(self, rows: NDArray[np.float32], index: int) -> FloatArray:
        raise NotImplementedError


class StampedRecording(FileRecording):
    """A folder in which `scan_folder` holds .bin scans named by clock readings in micro- or nanoseconds."""

    scan_folder: str

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        scans = folder / self.scan_folder
        files = np.array([path for path in scans.glob("*.bin") if not path.name.startswith(".")], dtype=object)
        if not len(files):
            raise InputError(f"{scans}: holds no .bin scan; give the folder of one sequence, above it")
        stamps = stamps_from_names([path.stem for path in files])
        if stamps is None or len(np.unique(stamps)) < len(stamps):
            raise InputError(f"{scans}: expected scans named by their stamps, such as 1561000444390857630.bin")
        order = np.argsort(stamps)
        super().__init__(folder, config, list(files[order]))
        self.stamps = stamps[order]


def read_table(path: Path, columns: int) -> FloatArray:
    """The rows (N, columns) of a table whose numbers are all finite; the first column is a stamp."""
    table = parse_numbers(path, columns)
    return np.asarray(table[np.isfinite(table).all(axis=1)])


def increasing(stamps: FloatArray, T_world_lidar: FloatArray) -> Trajectory | None:
    """The poses (N, 4, 4) whose stamps (N,) increase; None if there is none."""
    kept = increasing_rows(stamps)
    return Trajectory(stamps[kept], T_world_lidar[kept]) if kept.any() else None


def poses_of_rows(numbers: FloatArray) -> FloatArray:
    """Transforms (..., 4, 4) of the twelve numbers (..., 12) of their first three rows, as files round them."""
    rows = numbers.reshape(*numbers.shape[:-1], 3, 4)
    return orthonormalize(make_transform(rows[..., :3], rows[..., 3]))
