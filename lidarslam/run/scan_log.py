"""The log of a run: poses, timings and status of each scan, for scans.csv and summary.json."""

import csv
import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import Saved, State, Stateful
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.pipeline.estimates import STAGES, ScanEstimate
from lidarslam.storage.directory import SIGMAS

COLUMNS = (
    *("index", "stamp", "status", "points", "points_dropped", "points_used", "residual_m", "inlier_ratio"),
    *("degenerate_directions", *SIGMAS, "odometry_asked", *(f"ms_{stage}" for stage in STAGES), "message"),
)

_STATUSES = tuple(Status)
# The numbers of a scan; NaN where there is none.
_ROW = np.dtype(
    [
        ("stamp", "f8"),
        ("status", "u1"),
        ("points", "i8"),
        ("points_dropped", "i8"),
        ("points_used", "i8"),
        ("residual_m", "f8"),
        ("inlier_ratio", "f8"),
        ("sigmas", "f8", len(SIGMAS)),
        ("turn_rate", "f8", 3),
        ("odometry_asked", "?"),
        ("total_ms", "f8"),  # from the scan before done to this one done
        ("stage_ms", "f8", len(STAGES)),
        ("T_world_lidar", "f8", (4, 4)),
        ("T_odom_lidar", "f8", (4, 4)),
    ]
)


class ScanLog(Stateful):
    """The scans of a run so far; no points."""

    messages: list[str]  # of each scan
    warnings: list[str]  # sentences for the summary
    degenerate: list[str]  # of each scan, the names of its degenerate directions with spaces between

    def __init__(self) -> None:
        self.messages, self.warnings, self.degenerate = [], [], []
        self._rows = bytearray()  # of `_ROW`

    def __len__(self) -> int:
        return len(self._rows) // _ROW.itemsize

    def add(self, result: ScanEstimate, total_ms: float = 0.0) -> None:
        """Log one scan; `total_ms` is the wall time since the previous scan was done."""
        row = (
            result.stamp,
            _STATUSES.index(result.status),
            result.points_read,
            result.points_dropped,
            result.points_used,
            np.nan if result.residual_m is None else result.residual_m,
            np.nan if result.inlier_ratio is None else result.inlier_ratio,
            np.full(len(SIGMAS), np.nan) if result.covariance is None else np.sqrt(np.diag(result.covariance)),
            np.full(3, np.nan) if result.turn_rate is None else result.turn_rate,
            result.is_odometry_asked,
            total_ms,
            [result.stage_ms.get(stage, 0.0) for stage in STAGES],
            result.T_world_lidar,
            result.T_odom_lidar,
        )
        self.degenerate.append(" ".join(result.degenerate))
        self.messages.append(result.message)
        self._rows += np.array(row, dtype=_ROW).tobytes()  # last, as Ctrl-C may interrupt: `len` counts rows

    def warn(self, message: str) -> None:
        """Keep a sentence for the summary, without repetition."""
        if message not in self.warnings:
            self.warnings.append(message)

    def correct(self, T_world_lidar: FloatArray) -> None:
        """Replace the poses (N, 4, 4) by those that the pose graph corrected."""
        rows = self.table
        rows["T_world_lidar"] = T_world_lidar
        self._rows = bytearray(rows.tobytes())

    def mark(self, indices: Sequence[int], status: Status, message: str) -> None:
        """Replace the status of scans, and its reason."""
        rows = self.table
        rows["status"][list(indices)] = _STATUSES.index(status)
        self._rows = bytearray(rows.tobytes())
        for index in indices:
            self.messages[index] = message

    @property
    def table(self) -> NDArray[np.void]:
        """(N,) the numbers of all scans, by the names of `_ROW`; a copy, as a view would keep the log from growing."""
        return np.frombuffer(bytearray(self._rows), _ROW)

    @property
    def statuses(self) -> list[Status]:
        """Of each scan."""
        return [_STATUSES[index] for index in self.table["status"]]

    @property
    def stamps(self) -> FloatArray:
        """(N,) seconds."""
        return self.table["stamp"]

    @property
    def trajectory(self) -> Trajectory:
        """The final poses."""
        return Trajectory(self.stamps, self.table["T_world_lidar"])

    @property
    def odometry(self) -> Trajectory:
        """The poses of the odometry alone."""
        return Trajectory(self.stamps, self.table["T_odom_lidar"])

    def format_csv(self) -> str:
        """The content of scans.csv: a row per scan, empty where there is no number."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(COLUMNS)
        rows = zip(self.table, self.degenerate, self.messages, strict=False)
        for index, (row, degenerate, message) in enumerate(rows):
            counts = (row["points"], row["points_dropped"], row["points_used"])
            fit = ("" if np.isnan(row[name]) else f"{row[name]:.4f}" for name in ("residual_m", "inlier_ratio"))
            sigmas = ("" if np.isnan(sigma) else f"{sigma:.3g}" for sigma in row["sigmas"])
            ms = (f"{ms:.2f}" for ms in row["stage_ms"])
            status, asked = _STATUSES[row["status"]].value, int(row["odometry_asked"])
            numbers = (*counts, *fit, degenerate, *sigmas, asked, *ms)
            writer.writerow([index, f"{row['stamp']:.9f}", status, *numbers, message])
        return out.getvalue()

    def state(self) -> State:
        """See `Stateful`."""
        return super().state() | {"rows": self.table}

    def restore(self, saved: Saved) -> None:
        """See `Stateful`."""
        super().restore(saved)
        self._rows = bytearray(saved.value("rows").tobytes())
