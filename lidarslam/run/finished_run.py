"""Runs read back from disk."""

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_tum
from lidarslam.datasets.folders.pcd import read_pcd
from lidarslam.datasets.folders.ply import read_ply
from lidarslam.datasets.folders.point_table import coordinates
from lidarslam.resume.unfinished import require_whole
from lidarslam.run import directory as files
from mapping.global_map.global_map import PointCloud

_CLOUD_READERS: dict[str, Callable[[Path], NDArray[np.void]]] = {".ply": read_ply, ".pcd": read_pcd}
# As .ply and as .pcd files call them.
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """What is looked at of a run.

    Attributes:
        name: of its directory.
        trajectory: the final poses.
        lost: (N,) which of them were lost.
        map_points: (M, 3) in the world, none when the map is missing.
        loops: (L, 2) pairs of scans between which loops were closed.
    """

    name: str
    trajectory: Trajectory
    lost: NDArray[np.bool_]
    map_points: FloatArray
    loops: NDArray[np.intp]


def load_run(path: Path) -> FinishedRun:
    """Read a run directory.

    Raises:
        InputError: there is no run, or a file of it is damaged.
    """
    trajectory = read_trajectory(path)
    return FinishedRun(
        path.resolve().name,
        trajectory,
        _lost(path / files.SCANS_CSV, trajectory),
        load_map(path).points,
        _loops(path / files.SUMMARY, len(trajectory)),
    )


def read_trajectory(path: Path) -> Trajectory:
    """The final poses of a run directory, as many as its summary says.

    Raises:
        InputError: there is no run, it did not finish, or its trajectory is damaged or cut off.
    """
    require_whole(path)
    if not (path / files.TRAJECTORY_TUM).is_file():
        raise InputError(f"{path}: not a run directory (no {files.TRAJECTORY_TUM}); make one with lidarslam run")
    trajectory = read_tum(path / files.TRAJECTORY_TUM)
    scans = _scans(path / files.SUMMARY)
    if scans not in (None, len(trajectory)):
        raise InputError(
            f"{path / files.TRAJECTORY_TUM}: holds {len(trajectory):,} poses, {files.SUMMARY} says {scans:,} scans:"
            " one of them is cut off; copy it or make the run again"
        )
    return trajectory


def load_map(path: Path) -> PointCloud:
    """The map of a run directory, or a .ply or .pcd file, with normals; empty when the run has none.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    file = path / files.MAP_PLY if path.is_dir() else path
    if not path.exists():
        raise InputError(f"{path}: no such file")
    require_whole(path)
    if not file.is_file() or not file.stat().st_size:
        return PointCloud(np.empty((0, 3)), np.empty((0, 3)))
    read = _CLOUD_READERS.get(file.suffix.lower())
    if read is None:
        raise InputError(f"{file}: not a readable point cloud; expected a .ply or .pcd file with points")
    table = read(file)
    try:
        points = coordinates(table)
    except ValueError as error:
        raise InputError(f"{file}: not a readable point cloud: {error}") from None
    normals = _normals(table)
    usable = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    if not usable.any():
        raise InputError(f"{file}: not a readable point cloud; expected points, found none that is finite")
    return PointCloud(points[usable], normals[usable])


def _normals(table: NDArray[np.void]) -> FloatArray:
    """The normals (N, 3) of a cloud, upright where it has none."""
    names = next((names for names in _NORMALS if set(names) <= set(table.dtype.names or ())), None)
    if names is None:
        return np.tile([0.0, 0.0, 1.0], (len(table), 1))
    return np.column_stack([table[name].astype(np.float64) for name in names])


def _loops(summary: Path, scans: int) -> NDArray[np.intp]:
    """The loops that a run closed; none for a run without a graph."""
    content = _read_summary(summary)
    if content is None:
        return np.empty((0, 2), dtype=np.intp)
    try:
        graph = content.get("pose_graph") or {"loops": []}
        pairs = [(loop["first_scan"], loop["second_scan"]) for loop in graph["loops"] if loop["accepted"]]
        loops = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise _no_summary(summary, error) from error
    return loops[((loops >= 0) & (loops < scans)).all(axis=1)]


def _scans(summary: Path) -> int | None:
    """How many scans a run had; None when nothing says so, as with one that was cut off."""
    try:
        scans = (_read_summary(summary) or {}).get("scans")
    except InputError:
        return None
    return scans if isinstance(scans, int) else None


def _read_summary(summary: Path) -> dict[str, Any] | None:
    """The content of summary.json; None when there is none."""
    if not summary.is_file():
        return None
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise _no_summary(summary, error) from error
    if not isinstance(content, dict):
        raise _no_summary(summary, f"expected keys and values, got a {type(content).__name__}")
    return content


def _no_summary(summary: Path, reason: object) -> InputError:
    return InputError(f"{summary}: not a run's summary ({reason}); make the run again")


def _lost(scans_csv: Path, trajectory: Trajectory) -> NDArray[np.bool_]:
    lost = np.zeros(len(trajectory), dtype=np.bool_)
    if scans_csv.is_file():
        try:
            with scans_csv.open(encoding="utf-8", newline="") as rows:
                statuses = [row["status"] for row in csv.DictReader(rows)]
        except KeyError as error:
            raise InputError(f"{scans_csv}: has no column 'status'; make the run again") from error
        except (UnicodeDecodeError, csv.Error) as error:
            raise InputError(f"{scans_csv}: not a table in UTF-8 ({error}); make the run again") from error
        if len(statuses) != len(lost):
            raise InputError(
                f"{scans_csv}: has {len(statuses):,} rows for {len(lost):,} poses; it is cut off, make the run again"
            )
        lost[:] = [status == Status.LOST.value for status in statuses]
    return lost
