"""What a run remembers of every scan: a row in scans.csv at once, and the few numbers the summary needs."""

import contextlib
import csv
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TextIO

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline import STAGES, ScanResult
from lidarslam.run_directory import SCANS_CSV, RunDirectory

COLUMNS = (
    "index",
    "stamp",
    "status",
    "points",
    "points_dropped",
    "points_used",
    "residual_m",
    "inlier_ratio",
    "degenerate_directions",
    *(f"ms_{stage}" for stage in STAGES),
    "message",
)


@dataclass
class ScanLog:
    """The scans of a run so far; two poses and a few numbers each, no points."""

    _writer: Any
    stamps: list[float] = field(default_factory=list)
    statuses: list[Status] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    stage_ms: list[list[float]] = field(default_factory=list)
    points_read: int = 0
    points_dropped: int = 0
    warnings: list[str] = field(default_factory=list)
    _T_world_lidar: list[FloatArray] = field(default_factory=list)
    _T_odom_lidar: list[FloatArray] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    @contextlib.contextmanager
    def open(cls, directory: RunDirectory) -> Iterator["ScanLog"]:
        """Log to the run's scans.csv, which appears when the run ends well."""
        with directory.open_text(SCANS_CSV) as out:
            yield cls(_header(out))

    def add(self, result: ScanResult) -> None:
        """Take note of one scan."""
        ms = [result.stage_ms.get(stage, 0.0) for stage in STAGES]
        row = [
            len(self),
            f"{result.stamp:.9f}",
            result.status.value,
            result.points_read,
            result.points_dropped,
            result.points_used,
            _number(result.residual_m),
            _number(result.inlier_ratio),
            " ".join(result.degenerate),
            *(f"{value:.2f}" for value in ms),
            result.message,
        ]
        self._writer.writerow(row)
        self.stamps.append(result.stamp)
        self.statuses.append(result.status)
        self.messages.append(result.message)
        self.stage_ms.append(ms)
        self.points_read += result.points_read
        self.points_dropped += result.points_dropped
        self._T_world_lidar.append(result.T_world_lidar)
        self._T_odom_lidar.append(result.T_odom_lidar)

    def warn(self, message: str) -> None:
        """Keep a sentence for the summary."""
        self.warnings.append(message)

    def correct(self, T_world_lidar: FloatArray) -> None:
        """Take other poses (N, 4, 4), one for each scan, as the final ones."""
        if T_world_lidar.shape != (len(self), 4, 4):
            raise ValueError(f"expected a pose for each of {len(self)} scans, got {T_world_lidar.shape}")
        self._T_world_lidar = list(T_world_lidar)

    @property
    def trajectory(self) -> Trajectory:
        """The final poses."""
        return Trajectory(np.array(self.stamps), np.array(self._T_world_lidar))

    @property
    def odometry(self) -> Trajectory:
        """The odometry's own poses."""
        return Trajectory(np.array(self.stamps), np.array(self._T_odom_lidar))


def _header(out: TextIO) -> Any:
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    return writer


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
