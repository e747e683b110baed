"""The log of a run: a row of scans.csv for each scan, and its poses and timings in memory."""

import contextlib
import csv
import io
import os
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, Shape, State, Stateful, decode
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import STAGES, ScanResult
from lidarslam.run.directory import SCANS_CSV, RunDirectory

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


# What is kept of each scan, beside status and message: 320 bytes.
_ROW = np.dtype(
    [
        ("stamp", np.float64),
        ("total_ms", np.float64),
        ("stage_ms", np.float64, len(STAGES)),
        ("T_world_lidar", np.float64, (4, 4)),
        ("T_odom_lidar", np.float64, (4, 4)),
    ]
)
_NUMBERS = _ROW.itemsize // np.dtype(np.float64).itemsize


class _Table(Stateful):
    """A CSV file that is written row by row, with its size and checksum so far."""

    _size: int
    _checksum: int

    def __init__(self, out: BinaryIO) -> None:
        self._out = out
        self._size = self._checksum = 0

    def add(self, row: Any) -> None:
        """One row."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(row)
        content = text.getvalue().encode()
        self._size, self._checksum = self._size + len(content), zlib.crc32(content, self._checksum)
        self._out.write(content)

    def state(self) -> State:
        """Size and checksum; the rows are on the disk by now."""
        self._out.flush()
        os.fsync(self._out.fileno())
        return super().state()

    def _after_restore(self) -> None:
        """Cut off the rows that came later."""
        self._out.seek(0)
        if zlib.crc32(self._out.read(self._size)) != self._checksum:
            raise InputError(f"{self._out.name}: is damaged; begin again with --overwrite")
        self._out.truncate(self._size)
        self._out.seek(self._size)


class ScanLog(Stateful):
    """The scans of a run so far; no points.

    Attributes:
        statuses, messages: of each scan.
        points_read, points_dropped: of all scans.
        warnings: sentences for the summary.
    """

    statuses: list[Status]
    messages: list[str]
    points_read: int
    points_dropped: int
    warnings: list[str]
    _table: _Table

    def __init__(self, out: BinaryIO) -> None:
        self.statuses, self.messages, self.warnings = [], [], []
        self.points_read = self.points_dropped = 0
        self._table = _Table(out)
        self._rows = bytearray()  # of `_ROW`: half the memory of an array for each pose

    def __len__(self) -> int:
        return len(self.statuses)

    @classmethod
    @contextlib.contextmanager
    def open(cls, directory: RunDirectory, rows: Path | None = None, saved: Saved | None = None) -> Iterator["ScanLog"]:
        """Log to the run's scans.csv, which appears when the block ends without an error.

        Args:
            directory: of the run.
            rows: a file for the table until then, which outlives the process.
            saved: a state to go on from, whose rows are there.

        Raises:
            InputError: the rows are damaged.
        """
        if rows is None:
            with directory.replacing(SCANS_CSV) as partial, partial.open("wb") as out:
                log = cls(out)
                log._table.add(COLUMNS)
                yield log
            return
        with rows.open("wb" if saved is None else "r+b") as out:
            log = cls(out)
            if saved is None:
                log._table.add(COLUMNS)
            else:
                log.restore(saved)
            yield log
            out.flush()
            with directory.replacing(SCANS_CSV) as partial:
                shutil.copyfile(rows, partial)

    def state(self) -> State:
        """All of it; the rows of the table are on the disk by now."""
        return super().state() | {"rows": np.frombuffer(bytes(self._rows)).reshape(-1, _NUMBERS)}

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        super().restore(saved)
        rows = decode(Annotated[FloatArray, Shape(len(self), _NUMBERS)], saved.value("rows"), saved.at("rows"))
        self._rows = bytearray(rows.tobytes())

    def _after_restore(self) -> None:
        if len(self.statuses) != len(self.messages):
            raise ValueError(f"{len(self.statuses)} scans have {len(self.messages)} messages")

    def add(self, result: ScanResult, total_ms: float = 0.0) -> None:
        """Log one scan; `total_ms` is the wall time since the scan before was done."""
        stage_ms = [result.stage_ms.get(stage, 0.0) for stage in STAGES]
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
            *(f"{ms:.2f}" for ms in stage_ms),
            result.message,
        ]
        self._table.add(row)
        numbers = (result.stamp, total_ms, stage_ms, result.T_world_lidar, result.T_odom_lidar)
        self._rows += np.array(numbers, dtype=_ROW).tobytes()
        self.statuses.append(result.status)
        self.messages.append(result.message)
        self.points_read += result.points_read
        self.points_dropped += result.points_dropped

    def warn(self, message: str) -> None:
        """Keep a sentence for the summary, once."""
        if message not in self.warnings:
            self.warnings.append(message)

    def correct(self, T_world_lidar: FloatArray) -> None:
        """Replace the poses (N, 4, 4) by those that the pose graph corrected."""
        if T_world_lidar.shape != (len(self), 4, 4):
            raise ValueError(f"expected a pose for each of {len(self)} scans, got {T_world_lidar.shape}")
        rows = np.frombuffer(self._rows, _ROW)
        rows["T_world_lidar"] = T_world_lidar

    @property
    def stamps(self) -> FloatArray:
        """(N,) seconds."""
        return self._column("stamp")

    @property
    def total_ms(self) -> FloatArray:
        """(N,) wall time from one scan done to the next."""
        return self._column("total_ms")

    @property
    def stage_ms(self) -> FloatArray:
        """(N, 6) wall time of each of the `STAGES`."""
        return self._column("stage_ms")

    @property
    def trajectory(self) -> Trajectory:
        """The final poses."""
        return Trajectory(self.stamps, self._column("T_world_lidar"))

    @property
    def odometry(self) -> Trajectory:
        """The poses of the odometry alone."""
        return Trajectory(self.stamps, self._column("T_odom_lidar"))

    def _column(self, name: str) -> FloatArray:
        return np.frombuffer(self._rows, _ROW)[name].copy()  # a view would keep the buffer from growing


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
