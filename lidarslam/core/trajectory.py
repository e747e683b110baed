"""A sequence of poses in time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, interpolate, inverse, is_rigid


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


def chain(T_world_first: FloatArray, relative_motions: FloatArray) -> FloatArray:
    """Poses (N+1, 4, 4) from a first pose and N relative motions `T_prev_curr`."""
    poses = [T_world_first]
    for T_prev_curr in relative_motions:
        poses.append(poses[-1] @ T_prev_curr)
    return np.stack(poses)
