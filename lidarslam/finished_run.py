"""Runs read back from disk."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarslam import run_directory as files
from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import Status
from lidarslam.core.trajectory import Trajectory
from lidarslam.core.trajectory_io import read_tum
from lidarslam.unfinished import require_whole
from mapping.global_map import PointCloud


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
    require_whole(path)
    if not (path / files.TRAJECTORY_TUM).is_file():
        raise InputError(f"{path}: not a run directory (no {files.TRAJECTORY_TUM}); make one with lidarslam run")
    trajectory = read_tum(path / files.TRAJECTORY_TUM)
    return FinishedRun(
        path.resolve().name,
        trajectory,
        _lost(path / files.SCANS_CSV, trajectory),
        load_map(path).points,
        _loops(path / files.SUMMARY, len(trajectory)),
    )


def load_map(path: Path) -> PointCloud:
    """The map of a run directory, or a .ply or .pcd file, with normals; empty when the run has none.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    import open3d as o3d

    file = path / files.MAP_PLY if path.is_dir() else path
    if not path.exists():
        raise InputError(f"{path}: no such file")
    require_whole(path)
    if not file.is_file() or not file.stat().st_size:
        return PointCloud(np.empty((0, 3)), np.empty((0, 3)))
    _require_cloud(file)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(file)
    points = np.array(cloud.points, dtype=np.float64).reshape(-1, 3)
    if not len(points):
        raise _unreadable(file)
    if not cloud.has_normals():
        return PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    return PointCloud(points, np.array(cloud.normals, dtype=np.float64))


def _require_cloud(file: Path) -> None:
    """Look at the first bytes, because the reader of .ply files complains on standard error by itself."""
    with file.open("rb") as content:
        start = content.read(3)
    if file.suffix.lower() not in (".ply", ".pcd") or (file.suffix.lower() == ".ply" and start != b"ply"):
        raise _unreadable(file)


def _unreadable(file: Path) -> InputError:
    return InputError(f"{file}: not a readable point cloud; expected a .ply or .pcd file with points")


def _loops(summary: Path, scans: int) -> NDArray[np.intp]:
    """The loops that a run closed; none for a run without a graph."""
    if not summary.is_file():
        return np.empty((0, 2), dtype=np.intp)
    try:
        graph = json.loads(summary.read_text(encoding="utf-8")).get("pose_graph") or {"loops": []}
        pairs = [(loop["first_scan"], loop["second_scan"]) for loop in graph["loops"] if loop["accepted"]]
        loops = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{summary}: not a run's summary ({error}); make the run again") from error
    return loops[((loops >= 0) & (loops < scans)).all(axis=1)]


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
        lost[: len(statuses)] = [status == Status.LOST.value for status in statuses[: len(lost)]]
    return lost
