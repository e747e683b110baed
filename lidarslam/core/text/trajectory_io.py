"""TUM text files <-> trajectories."""

from pathlib import Path

from lidarslam.core.pose_text import format_tum_poses, read_tum_poses
from lidarslam.core.trajectory import Trajectory


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file; lines may stand in any order, of equal stamps the first is kept.

    Raises:
        InputError: the file is missing or a line is not a pose.
    """
    return Trajectory(*read_tum_poses(path))


def format_tum(trajectory: Trajectory) -> str:
    """The trajectory as TUM text, nine decimals, quaternions with qw >= 0."""
    return format_tum_poses(trajectory.stamps, trajectory.T_world_lidar)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file."""
    path.write_text(format_tum(trajectory), encoding="utf-8")
