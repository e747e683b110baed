"""A sequence of poses in time."""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import cannot_write
from lidarslam.core.geometry import FloatArray, interpolate, inverse, is_rigid
from lidarslam.core.pose_text import format_kitti, format_tum_poses, read_kitti_poses, read_tum_poses

TextFormat = Literal["tum", "kitti"]

# KITTI's LiDAR turns ten times a second.
_KITTI_RATE_HZ = 10.0


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """Poses of the LiDAR in a world frame."""

    stamps: FloatArray  # (N,) float64, seconds, strictly increasing
    T_world_lidar: FloatArray  # (N, 4, 4) float64, rigid

    def __post_init__(self) -> None:
        if self.stamps.ndim != 1:
            raise ValueError(f"Trajectory.stamps must be (N,), got {self.stamps.shape}")
        if self.T_world_lidar.shape != (len(self.stamps), 4, 4):
            raise ValueError(
                f"Trajectory.T_world_lidar must be ({len(self.stamps)}, 4, 4), got {self.T_world_lidar.shape}"
            )
        if not np.isfinite(self.stamps).all():
            raise ValueError("Trajectory.stamps must be finite")
        steps = np.diff(self.stamps)
        if (steps <= 0.0).any():
            row = int(np.argmax(steps <= 0.0))
            raise ValueError(
                f"Trajectory.stamps must increase, got {self.stamps[row]:.9f} then {self.stamps[row + 1]:.9f}"
                f" at rows {row} and {row + 1}"
            )
        if not is_rigid(self.T_world_lidar):
            raise ValueError("Trajectory.T_world_lidar must hold rigid transforms")

    @classmethod
    def load(cls, path: str | PathLike[str], format: TextFormat | None = None) -> "Trajectory":
        """Read a text file.

        Args:
            path: of the file.
            format: `tum`, lines `stamp tx ty tz qx qy qz qw`; `kitti`, as `from_kitti`; None: `kitti` for the suffix
                .kitti, else `tum`.

        Raises:
            InputError: the file is missing, or a line is not a pose.
        """
        if _format_of(path, format) == "kitti":
            return cls.from_kitti(path)
        return cls(*read_tum_poses(Path(path)))

    @classmethod
    def from_kitti(
        cls, path: str | PathLike[str], stamps: ArrayLike | None = None, T_cam_lidar: FloatArray | None = None
    ) -> "Trajectory":
        """Read KITTI's text format: the first three rows of a pose matrix a line, without stamps.

        Args:
            path: of the file.
            stamps: (N,) seconds; None: scans come at 10 Hz, from 0.
            T_cam_lidar: (4, 4) where the poses are those of a camera, as in KITTI's ground truth: the extrinsic
                calibration, which makes them those of the LiDAR. None: they are as they stand in the file.

        Raises:
            InputError: the file is missing, a line is not a pose, or there are not as many stamps as poses.
        """
        poses = read_kitti_poses(Path(path))
        times = np.arange(len(poses)) / _KITTI_RATE_HZ if stamps is None else np.array(stamps, dtype=np.float64)
        if times.shape != (len(poses),):
            raise InputError(f"{path}: holds {len(poses):,} poses, and the stamps have the shape {times.shape}")
        return cls(times, poses if T_cam_lidar is None else inverse(T_cam_lidar) @ poses @ T_cam_lidar)

    def save(self, path: str | PathLike[str], format: TextFormat | None = None) -> None:
        """Write a text file; one that is there is replaced.

        Args:
            path: of the file.
            format: as of `load`; KITTI's has no stamps.

        Raises:
            OutputError: the file cannot be written.
        """
        is_kitti = _format_of(path, format) == "kitti"
        text = format_kitti(self.T_world_lidar) if is_kitti else format_tum_poses(self.stamps, self.T_world_lidar)
        try:
            Path(path).write_text(text, encoding="utf-8")
        except OSError as error:
            raise cannot_write(Path(path), error) from error

    def __len__(self) -> int:
        return len(self.stamps)

    def __repr__(self) -> str:
        return f"Trajectory({len(self):,} poses, {self.length_m:.1f} m in {self.duration_s:.1f} s)"

    @property
    def positions(self) -> FloatArray:
        """(N, 3) positions of the LiDAR in the world."""
        return self.T_world_lidar[:, :3, 3]

    @property
    def length_m(self) -> float:
        """Length of the path."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def distances(self) -> FloatArray:
        """(N,) metres travelled up to each pose, starting at 0."""
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])[: len(self)]

    @property
    def duration_s(self) -> float:
        """Time from the first to the last pose."""
        return float(self.stamps[-1] - self.stamps[0]) if len(self) else 0.0

    def relative_motions(self) -> FloatArray:
        """(N-1, 4, 4) motions `T_prev_curr` between consecutive poses."""
        return inverse(self.T_world_lidar[:-1]) @ self.T_world_lidar[1:]

    def transformed(self, T_new_world: FloatArray) -> "Trajectory":
        """The same trajectory in another world frame."""
        return Trajectory(self.stamps, T_new_world @ self.T_world_lidar)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp] | slice) -> "Trajectory":
        """The chosen poses, in the order of time."""
        return Trajectory(self.stamps[chosen], self.T_world_lidar[chosen])

    def at(self, stamps: FloatArray, extrapolation_s: float = 0.0) -> FloatArray:
        """Poses (M, 4, 4) at the given stamps (M,), interpolated at constant body velocity between neighbours.

        Stamps up to `extrapolation_s` outside the trajectory are extrapolated with its first or last motion.

        Raises:
            ValueError: a stamp lies farther outside, or there are fewer than two poses.
        """
        if len(self) < 2:
            raise ValueError(f"interpolation needs two poses or more, the trajectory has {len(self)}")
        outside = (stamps < self.stamps[0] - extrapolation_s) | (stamps > self.stamps[-1] + extrapolation_s)
        if outside.any():
            raise ValueError(
                f"stamp {stamps[outside][0]:.6f} lies outside the trajectory"
                f" ({self.stamps[0]:.6f} to {self.stamps[-1]:.6f})"
            )
        left = np.clip(np.searchsorted(self.stamps, stamps, side="right") - 1, 0, len(self) - 2)
        fraction = (stamps - self.stamps[left]) / (self.stamps[left + 1] - self.stamps[left])
        return interpolate(self.T_world_lidar[left], self.T_world_lidar[left + 1], fraction)


def _format_of(path: str | PathLike[str], format: TextFormat | None) -> TextFormat:
    return format or ("kitti" if Path(path).suffix.lower() == ".kitti" else "tum")


def chain(T_world_first: FloatArray, relative_motions: FloatArray) -> FloatArray:
    """Poses (N+1, 4, 4) from a first pose and N relative motions `T_prev_curr`."""
    poses = [T_world_first]
    for T_prev_curr in relative_motions:
        poses.append(poses[-1] @ T_prev_curr)
    return np.stack(poses)
