"""What `lidarslam view --picture` draws: runs, comparisons, and clouds alone."""

from collections.abc import Sequence
from pathlib import Path

from lidarslam.core.errors import InputError
from lidarslam.storage.comparison_folder import run_directories
from lidarslam.storage.directory import MAP_PLY, TRAJECTORY_TUM
from lidarslam.storage.finished_run import read_statuses, read_trajectory, shown_map
from lidarslam.viewer.picture import DrawnRun


def load_drawn_runs(paths: Sequence[Path]) -> list[DrawnRun]:
    """Runs, the runs of a comparison, and .ply or .pcd files.

    Raises:
        InputError: a path is none of these, or has neither a map nor a trajectory.
    """
    return [_load(path) for given in paths for path in run_directories(given)]


def _load(path: Path) -> DrawnRun:
    name, cloud = path.resolve().name, shown_map(path)
    has_trajectory = (path / TRAJECTORY_TUM).is_file()
    if path.is_file() or ((path / MAP_PLY).is_file() and not has_trajectory):
        if not len(cloud):
            raise InputError(f"{path}: holds no map to draw")
        return DrawnRun(name, cloud)
    trajectory = read_trajectory(path)
    return DrawnRun(name, cloud, trajectory.positions, read_statuses(path, len(trajectory)))
