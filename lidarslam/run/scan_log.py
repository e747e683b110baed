"""What a run remembers of every scan: a row in scans.csv at once, and the few numbers the summary needs."""

import contextlib
import csv
import os
import shutil
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.pipeline import STAGES, ScanResult
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


def _doubles(values: FloatArray | None = None) -> "array[float]":
    """Numbers (whatever their shape) after one another, and more to come."""
    numbers = array("d")
    if values is not None:
        numbers.frombytes(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return numbers


def _poses(numbers: "array[float]") -> FloatArray:
    return np.array(numbers).reshape(-1, 4, 4)


class _Rows:
    """A table that is written row by row, and knows how far it is."""

    def __init__(self, out: BinaryIO, size: int = 0, checksum: int = 0) -> None:
        self._out = out
        self._size, self._checksum = size, checksum
        self._writer = csv.writer(self, lineterminator="\n")
        if not size:
            self.add(COLUMNS)

    @classmethod
    def restored(cls, out: BinaryIO, saved: Saved) -> "_Rows":
        """The table as it was; rows that came later are cut off."""
        size, checksum = saved.integer("size"), saved.integer("checksum")
        if zlib.crc32(out.read(size)) != checksum:
            raise InputError(f"{out.name}: is damaged; begin again with --overwrite")
        out.truncate(size)
        out.seek(size)
        return cls(out, size, checksum)

    def add(self, row: Any) -> None:
        """One row."""
        self._writer.writerow(row)

    def write(self, text: str) -> int:
        """What the writer of rows calls."""
        content = text.encode()
        self._size, self._checksum = self._size + len(content), zlib.crc32(content, self._checksum)
        return self._out.write(content)

    def state(self) -> State:
        """How far it is; up to there it is on the disk by now."""
        self._out.flush()
        os.fsync(self._out.fileno())
        return {"size": self._size, "checksum": self._checksum}


@dataclass
class ScanLog:
    """The scans of a run so far; two poses and a few numbers each, some 350 bytes, and no points."""

    _rows: _Rows
    stamps: "array[float]" = field(default_factory=_doubles)
    statuses: list[Status] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    points_read: int = 0
    points_dropped: int = 0
    warnings: list[str] = field(default_factory=list)
    # Numbers after one another: an array of its own for each pose would take twice the memory.
    _stage_ms: "array[float]" = field(default_factory=_doubles)
    _T_world_lidar: "array[float]" = field(default_factory=_doubles)
    _T_odom_lidar: "array[float]" = field(default_factory=_doubles)

    def __len__(self) -> int:
        return len(self.stamps)

    @classmethod
    @contextlib.contextmanager
    def open(cls, directory: RunDirectory, rows: Path | None = None, saved: Saved | None = None) -> Iterator["ScanLog"]:
        """Log to the run's scans.csv, which appears when the run ends well.

        Args:
            directory: of the run.
            rows: a file for the table until then, so that it outlives the program.
            saved: a state to go on from, whose rows are there.

        Raises:
            InputError: the rows are damaged.
        """
        if rows is None:
            with directory.replacing(SCANS_CSV) as partial, partial.open("wb") as out:
                yield cls(_Rows(out))
            return
        with rows.open("wb" if saved is None else "r+b") as out:
            log = cls(_Rows(out)) if saved is None else cls._restored(out, saved)
            yield log
            out.flush()
            with directory.replacing(SCANS_CSV) as partial:
                shutil.copyfile(rows, partial)

    def state(self) -> State:
        """All of it; the rows are on the disk by now.

        Raises:
            OSError: the disk is full.
        """
        return {
            "rows": self._rows.state(),
            "stamps": np.array(self.stamps),
            "statuses": [status.value for status in self.statuses],
            "messages": list(self.messages),
            "stage_ms": self.stage_ms,
            "points_read": self.points_read,
            "points_dropped": self.points_dropped,
            "warnings": list(self.warnings),
            "T_world_lidar": _poses(self._T_world_lidar),
            "T_odom_lidar": _poses(self._T_odom_lidar),
        }

    @classmethod
    def _restored(cls, out: BinaryIO, saved: Saved) -> "ScanLog":
        stamps = saved.array("stamps", (None,))
        statuses, messages = saved.texts("statuses"), saved.texts("messages")
        if not len(stamps) == len(statuses) == len(messages) or not set(statuses) <= {s.value for s in Status}:
            raise saved.refuse(f"{len(stamps)} scans have {len(statuses)} statuses and {len(messages)} messages")
        return cls(
            _Rows.restored(out, saved.part("rows")),
            _doubles(stamps),
            [Status(status) for status in statuses],
            messages,
            saved.integer("points_read"),
            saved.integer("points_dropped"),
            saved.texts("warnings"),
            _doubles(saved.array("stage_ms", (len(stamps), len(STAGES)))),
            _doubles(saved.array("T_world_lidar", (len(stamps), 4, 4))),
            _doubles(saved.array("T_odom_lidar", (len(stamps), 4, 4))),
        )

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
        self._rows.add(row)
        self.stamps.append(result.stamp)
        self.statuses.append(result.status)
        self.messages.append(result.message)
        self.points_read += result.points_read
        self.points_dropped += result.points_dropped
        self._stage_ms.extend(ms)
        self._T_world_lidar.extend(result.T_world_lidar.ravel())
        self._T_odom_lidar.extend(result.T_odom_lidar.ravel())

    def warn(self, message: str) -> None:
        """Keep a sentence for the summary, once."""
        if message not in self.warnings:
            self.warnings.append(message)

    def correct(self, T_world_lidar: FloatArray) -> None:
        """Take other poses (N, 4, 4), one for each scan, as the final ones."""
        if T_world_lidar.shape != (len(self), 4, 4):
            raise ValueError(f"expected a pose for each of {len(self)} scans, got {T_world_lidar.shape}")
        self._T_world_lidar = _doubles(T_world_lidar)

    @property
    def stage_ms(self) -> FloatArray:
        """(N, 6) wall time of each of the `STAGES`."""
        return np.array(self._stage_ms).reshape(-1, len(STAGES))

    @property
    def trajectory(self) -> Trajectory:
        """The final poses."""
        return Trajectory(np.array(self.stamps), _poses(self._T_world_lidar))

    @property
    def odometry(self) -> Trajectory:
        """The odometry's own poses."""
        return Trajectory(np.array(self.stamps), _poses(self._T_odom_lidar))


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
