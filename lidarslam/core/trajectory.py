"""A sequence of poses in time, and its text files.

TUM: `stamp tx ty tz qx qy qz qw`, one pose per line, `#` comments. KITTI: twelve numbers per line, the first three rows
of the pose matrix, no stamps.
"""

from array import array
from dataclasses import dataclass
from io import StringIO
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines, cannot_write
from lidarslam.core.geometry import FloatArray, interpolate, inverse, is_rigid, make_transform, orthonormalize

TextFormat = Literal["tum", "kitti"]

# KITTI's LiDAR turns ten times a second.
_KITTI_RATE_HZ = 10.0
# Survey coordinates are far below; squares of much larger numbers overflow.
_FARTHEST_M = 1e9
# What the lines of a trajectory hold, by their numbers.
_FORMATS = {
    8: "; TUM text has lines `stamp tx ty tz qx qy qz qw`, KITTI's twelve numbers, which has no stamps",
    12: "; KITTI text has the first three rows of a pose matrix a line, TUM's eight numbers",
}


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
        return read_tum(Path(path))

    @classmethod
    def from_kitti(
        cls, path: str | PathLike[str], stamps: ArrayLike | None = None, T_cam_lidar: FloatArray | None = None
    ) -> "Trajectory":
        """Read KITTI's text format: the first three rows of a pose matrix per line, without stamps.

        Args:
            path: of the file.
            stamps: (N,) seconds; None: scans come at 10 Hz, from 0.
            T_cam_lidar: (4, 4) where the poses are those of a camera, as in KITTI's ground truth: the extrinsic
                calibration, which makes them those of the LiDAR. None: they are used as they are in the file.

        Raises:
            InputError: the file is missing, a line is not a pose, or there are not as many stamps as poses.
        """
        poses = read_kitti_poses(Path(path))
        times = np.arange(len(poses)) / _KITTI_RATE_HZ if stamps is None else np.array(stamps, dtype=np.float64)
        if times.shape != (len(poses),):
            raise InputError(f"{path}: holds {len(poses):,} poses, and the stamps have the shape {times.shape}")
        return cls(times, poses if T_cam_lidar is None else inverse(T_cam_lidar) @ poses @ T_cam_lidar)

    def save(self, path: str | PathLike[str], format: TextFormat | None = None) -> None:
        """Write a text file, in a format as of `load`, where KITTI's has no stamps; one that is there is replaced."""
        is_kitti = _format_of(path, format) == "kitti"
        text = format_kitti(self.T_world_lidar) if is_kitti else format_tum(self)
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

        ValueError where a stamp lies farther outside, or there are fewer than two poses.
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


def parse_numbers(path: Path, columns: int, may_have_names: bool = False) -> FloatArray:
    """The (N, columns) numbers of a text file, commas as blanks; InputError where a line has others.

    With `may_have_names`, the first line may hold names of the columns.
    """
    numbers = array("d")
    for number, line in enumerate(bounded_lines(path), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            if len(words) == columns:
                numbers.extend(map(float, words))
                continue
        except ValueError:  # part of the line may have been taken, which no one reads any more
            pass
        if may_have_names and not numbers and any(word[0].isalpha() for word in words):
            continue
        got, hint = line.strip()[:60], _FORMATS.get(columns, "")
        raise InputError(f"{path}:{number}: expected {columns} numbers, got {len(words)} words, {got!r}{hint}")
    return np.array(numbers, dtype=np.float64).reshape(-1, columns)


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file, in any order, of equal stamps the first; InputError where a line is not a pose."""
    table = parse_numbers(path, columns=8)
    if not len(table):
        raise InputError(f"{path}: holds no pose; expected lines `stamp tx ty tz qx qy qz qw`")
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if not np.isfinite(table).all() or (np.abs(norms - 1.0) > 0.05).any():
        raise InputError(f"{path}: holds numbers that are no poses; expected `stamp tx ty tz qx qy qz qw`")
    _require_near(path, table[:, 1:4])
    _, first = np.unique(table[:, 0], return_index=True)
    table = table[first]
    from scipy.spatial.transform import Rotation  # takes a while to load

    R = Rotation.from_quat(table[:, 4:]).as_matrix()
    return Trajectory(table[:, 0], make_transform(R, table[:, 1:4]))


def format_tum(trajectory: Trajectory) -> str:
    """The trajectory as TUM text, nine decimals, quaternions with qw >= 0."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(trajectory.T_world_lidar[:, :3, :3]).as_quat(canonical=True)
    out = StringIO()
    np.savetxt(out, np.column_stack([trajectory.stamps, trajectory.positions, quaternions]), fmt="%.9f")
    return out.getvalue()


def read_kitti_poses(path: Path) -> FloatArray:
    """The poses (N, 4, 4) of a KITTI file, in whatever frame; InputError where a line is not a pose."""
    rows = parse_numbers(path, columns=12).reshape(-1, 3, 4)
    if not len(rows):
        raise InputError(f"{path}: holds no pose; expected twelve numbers a line")
    T = make_transform(rows[:, :, :3], rows[:, :, 3])
    if not np.isfinite(T).all() or (np.abs(np.linalg.det(T[:, :3, :3]) - 1.0) > 1e-2).any():
        raise InputError(f"{path}: holds rows that are no poses; expected the first three rows of a rigid transform")
    _require_near(path, T[:, :3, 3])
    return orthonormalize(T)


def read_transform(path: Path) -> FloatArray:
    """A rigid transform (4, 4), four rows of four numbers in a text file; InputError where it is anything else."""
    T = parse_numbers(path, columns=4)
    if T.shape != (4, 4) or not is_rigid(T, tolerance=1e-3):
        raise InputError(f"{path}: expected a rigid transform of four rows of four numbers, the last 0 0 0 1")
    return orthonormalize(T)


def _require_near(path: Path, positions: FloatArray) -> None:
    farthest = float(np.abs(positions).max())
    if farthest > _FARTHEST_M:
        raise InputError(f"{path}: a position lies {farthest:.3g} m from the origin; expected metres")


def format_kitti(poses: FloatArray) -> str:
    """Poses (N, 4, 4) as KITTI text."""
    out = StringIO()
    np.savetxt(out, poses[:, :3].reshape(-1, 12), fmt="%.9e")
    return out.getvalue()


# Scans over which the noise of positions is measured, and its least standard deviation in a motion that counts: below,
# gaits sway as much.
_NOISE_SCANS, _LEAST_NOISE_M = 5, 0.04


def lengthened_by_noise_m(positions: FloatArray, sigmas_m: FloatArray) -> FloatArray:
    """By how much noise of the positions (N, 3) lengthens each motion between them (N - 1,), metres.

    Its variance is that of the positions' second differences over a few scans, but at most that of their standard
    deviations (N, 3), NaN where unknown: handheld and legged sensors sway, and are registered better than that.
    """
    moved_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    if len(positions) < _NOISE_SCANS:
        return np.zeros_like(moved_m)
    second = np.diff(positions, n=2, axis=0)
    padded = np.pad((second**2).sum(axis=1) / 6.0, 1 + _NOISE_SCANS // 2, mode="edge")
    seen = np.convolve(padded, np.full(_NOISE_SCANS, 1.0 / _NOISE_SCANS), mode="valid")
    variances = np.minimum(seen, np.nansum(sigmas_m**2, axis=1))
    of_motions = variances[:-1] + variances[1:]
    shorter_m = np.sqrt(np.maximum(moved_m**2 - of_motions, 0.0))
    return np.where(of_motions > _LEAST_NOISE_M**2, moved_m - shorter_m, 0.0)
