"""What `lidarslam view --picture` and `--video` draw: runs, comparisons, and clouds alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.folders.scan_files import read_ply
from lidarslam.evaluation.report.error_colours import DISTANCE_FIELD
from lidarslam.evaluation.trajectory.alignment import align
from lidarslam.evaluation.trajectory.association import associate
from lidarslam.evaluation.trajectory.metrics import absolute_errors
from lidarslam.storage.comparison_folder import run_directories
from lidarslam.storage.directory import MAP_PLY, TRAJECTORY_TUM
from lidarslam.storage.finished_run import read_statuses, read_trajectory, shown_map
from lidarslam.viewer.drawing.colouring import Quantity
from lidarslam.viewer.picture import DrawnRun


def load_drawn_runs(paths: Sequence[Path], truth: Trajectory | None = None) -> list[DrawnRun]:
    """Runs, the runs of a comparison, and .ply or .pcd files.

    Args:
        paths: of them.
        truth: of the recording, for errors.

    Raises:
        InputError: a path is none of these, or has neither a map nor a trajectory.
    """
    return [_load(path, truth) for given in paths for path in run_directories(given)]


def require_quantity(run: DrawnRun, quantity: Quantity) -> None:
    """Refuse to colour a run by what is not known of it.

    Raises:
        InputError: it has no such attribute, or there is nothing to compare with.
    """
    known = run.cloud.attributes.rgb if quantity == "rgb" else run.point_values(quantity)
    if known is None:
        known = run.pose_values(quantity)
    if known is None or not np.isfinite(known).any():
        raise InputError(f"{run.name}: cannot be coloured by {quantity}: {_LACKS[quantity]}")


_NOT_IN_MAP = "the map has none; its recording has none, or global_map.fields leaves it out"
_LACKS: dict[Quantity, str] = {
    "height": "there is no map",
    "intensity": _NOT_IN_MAP,
    "rgb": _NOT_IN_MAP,
    "error": "its recording has no ground truth, or is not there any more; a map with its distances to a reference map"
    " is made by `lidarslam evaluate RUN --reference-map MAP --errors errors.ply`",
}


def _load(path: Path, truth: Trajectory | None) -> DrawnRun:
    name, cloud = path.resolve().name, shown_map(path)
    has_trajectory = (path / TRAJECTORY_TUM).is_file()
    if path.is_file() or ((path / MAP_PLY).is_file() and not has_trajectory):
        if not len(cloud):
            raise InputError(f"{path}: holds no map to draw")
        return DrawnRun(name, cloud, distances_m=_distances_m(path, len(cloud)))
    trajectory = read_trajectory(path)
    errors_m = None if truth is None else _errors_m(trajectory, truth)
    return DrawnRun(name, cloud, trajectory.positions, read_statuses(path, len(trajectory)), errors_m)


def _errors_m(trajectory: Trajectory, truth: Trajectory) -> FloatArray | None:
    """Distances (N,) of the poses to the truth, aligned as for the ATE; None where they share no instants."""
    try:
        association = associate(trajectory, truth)
    except InputError:
        return None
    errors_m = np.full(len(trajectory), np.nan)
    errors_m[association.rows] = absolute_errors(association, align(association.estimate, association.reference))[0]
    return errors_m


def _distances_m(path: Path, points: int) -> FloatArray | None:
    """The distances to a reference map in a file of `evaluate --errors`; None in any other."""
    if path.suffix.lower() != ".ply":
        return None
    table = read_ply(path)
    found = DISTANCE_FIELD in (table.dtype.names or ()) and len(table) == points
    return table[DISTANCE_FIELD].astype(np.float64) if found else None
