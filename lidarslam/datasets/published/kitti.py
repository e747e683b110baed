"""KITTI: the odometry benchmark, drives of the raw data, and KITTI-360.

Odometry: `sequences/NN/{velodyne/*.bin, times.txt, calib.txt}` and `poses/NN.txt`. The scans are motion compensated by
the publishers. The poses are those of the left camera, `cam`; they are converted to the LiDAR's frame here, and nowhere
else.

Raw: `DATE/DATE_drive_NNNN_sync/{velodyne_points, oxts}`, synchronised. The scans are as measured, not motion
compensated. The calibration files are in the date's folder above the drive.

KITTI-360 (Liao et al., PAMI 2022): `data_3d_raw/..._sync/velodyne_points`, `data_poses`, `calibration`. The scans are
as measured, too. As on KITTI's car, the laser turns clockwise from the rear and faces forward at the stamp, as the data
set's own program for compensation assumes.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lidarslam.core.errors import InputError
from lidarslam.core.files import bounded_lines
from lidarslam.core.geometry import FloatArray, inverse, make_transform, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.text import count
from lidarslam.core.trajectory import Trajectory, parse_numbers, read_kitti_poses
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.folders.scan_files import numbered_scans
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.datasets.published.stamped_files import BinRecording, increasing, poses_of_rows, read_table
from lidarslam.datasets.recording import Recording, find_sequence, first_file
from lidarslam.datasets.times.azimuth import AZIMUTH_TIME, offsets_from_azimuth
from lidarslam.datasets.times.stamps import assumed_rate, mend_stamps, read_stamps, scan_rate

_POLE_DEG = 90.0
_EARTH_RADIUS_M = 6378137.0  # WGS 84, equator, as KITTI's own development kit has it
# Of a file of oxts.
_COLUMNS = 30
_POSITION_ACCURACY_COLUMN = 23
# Of the unit's own axes; the columns behind them are of the level ones.
_ACCELERATIONS, _ANGULAR_VELOCITIES = slice(11, 14), slice(17, 20)
# Sweeps of one drive last the same to 0.2 %; a larger difference than this part is a wrong stamp.
_SWEEP_TOLERANCE = 0.25
# Of KITTI-360.
_SCANS, _POINTS = "data_3d_raw", "velodyne_points"


def open_odometry(source: Path, config: ReaderConfig) -> Recording:
    """Open a sequence of the benchmark: its root, with `config.sequence`, or one `sequences/NN` folder."""
    return KittiOdometryRecording(find_sequence(source, source / "sequences", "velodyne", config.sequence), config)


class KittiOdometryRecording(BinRecording):
    """One sequence of the benchmark."""

    reader = "kitti-odometry"
    _notes = ("The scans are motion compensated by the publishers; they have no per-point time and need none.",)

    def __init__(self, folder: Path, config: ReaderConfig) -> None:
        files, self._numbers = numbered_scans(folder / "velodyne")
        super().__init__(folder, config, files)
        times, last = folder / "times.txt", int(self._numbers[-1])
        self._lines = len(read_stamps(times)) if times.is_file() else 0
        # Of every scan up to the last one or the last line: the truth has poses of absent scans, too.
        self._timing = stamps_of_rows(times, np.arange(max(last + 1, self._lines)), config)
        self._rate_is_assumed, self.stamps = not self._timing.from_clock, self._timing.stamps[self._numbers]
        # Of a link, beside it or beside its target.
        wholes = (folder.absolute(), folder.resolve())
        poses = (first_file((whole.parent.parent / "poses",), f"{whole.name}.txt") for whole in wholes)
        self._pose_file = next(filter(None, poses), None) or first_file(wholes, "poses.txt")
        self._truth_path = self._pose_file if (folder / "calib.txt").is_file() else None

    @property
    def name(self) -> str:
        """Such as kitti_04."""
        return f"kitti_{self._source.resolve().name}"

    @cached_property
    def T_cam_lidar(self) -> FloatArray | None:
        """The extrinsic calibration `Tr`, (4, 4); None without calib.txt."""
        path = self._source / "calib.txt"
        return read_tr(path) if path.is_file() else None

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of every pose with a stamp, also where the scan is absent."""
        T_cam_lidar = self.T_cam_lidar
        if self._pose_file is None or T_cam_lidar is None:
            return None
        T_cam0_cam = read_kitti_poses(self._pose_file)
        stamps = self._timing.stamps if self._timing.from_clock else np.arange(len(T_cam0_cam)) / self._config.rate_hz
        T_cam0_cam = T_cam0_cam[: len(stamps)]
        # The world is where the LiDAR was when the camera was at cam0, the frame of the pose file.
        T_world_lidar = inverse(T_cam_lidar) @ T_cam0_cam @ T_cam_lidar
        return Trajectory(stamps[: len(T_cam0_cam)], T_world_lidar)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Missing and superfluous stamps, scans and poses."""
        return tuple(self._warnings())

    def _warnings(self) -> Iterator[str]:
        last, poses = int(self._numbers[-1]), 0
        yield from self._timing.notes
        if len(self) <= last - self._numbers[0]:
            yield f"Of the scans {self._numbers[0]} to {last} only {len(self)} are there."
        if self._pose_file is not None and self._truth_path is None:
            yield f"There is no calib.txt, so {self._pose_file.name}, in the camera frame, cannot be used."
        elif self._pose_file is not None:
            with suppress(InputError):  # damaged, an error of `ground_truth`
                poses = len(read_kitti_poses(self._pose_file))
        others = [f"times.txt has {self._lines} lines"] if self._lines > last + 1 else []
        others += [f"{self._pose_file} has {poses} poses"] if poses not in (0, last + 1) else []
        if others:
            yield (
                f"{' and '.join(others)} for the scans up to number {last}; missing stamps continue at the rate of the"
                " others, and what is beyond is not used."
            )


class OxtsPoses(NamedTuple):
    """The poses of the GPS/IMU unit."""

    stamps: FloatArray  # (N,) seconds on the clock of the scans, NaN where there is none
    T_enu_imu: FloatArray  # (N, 4, 4) in an east-north-up frame; imu is x forward, y left, z up
    accuracy_m: FloatArray  # (N,) standard deviation of the position as the unit itself states it
    angular_velocities: FloatArray  # (N, 3) rad/s
    accelerations: FloatArray  # (N, 3) specific force, m/s^2
    geodetic: FloatArray  # (N, 3) latitude and longitude in degrees, altitude in metres


def oxts_poses(rows: FloatArray) -> FloatArray:
    """T_enu_imu (N, 4, 4) of rows (N, >=6): latitude, longitude (degrees), altitude (m), roll, pitch, yaw (radians).

    The position is the Mercator projection scaled by the cosine of the first latitude, so that metres are metres
    there; the rotation is Rz(yaw) Ry(pitch) Rx(roll), yaw counted from east (Geiger et al., IJRR 2013, and the
    raw development kit).
    """
    latitude, longitude = np.deg2rad(rows[:, 0]), np.deg2rad(rows[:, 1])
    scaled_radius = np.cos(latitude[0]) * _EARTH_RADIUS_M
    east = scaled_radius * longitude
    north = scaled_radius * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    R = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    return make_transform(R, np.column_stack([east, north, rows[:, 2]]))


class KittiRawRecording(BinRecording):
    """One drive of the raw data: a `..._sync` folder."""

    reader = "kitti-raw"
    imu_name = "oxts"
    point_time = AZIMUTH_TIME

    def __init__(self, drive: Path, config: ReaderConfig) -> None:
        folder = drive.resolve() / "velodyne_points"
        if any(folder.glob("data/*.txt")) and not any(folder.glob("data/*.bin")):
            raise InputError(
                f"{drive}: holds scans as text, as the ..._extract drives do: use the ..._sync drive of the same number"
            )
        files, self._numbers = numbered_scans(folder / "data")
        super().__init__(drive.resolve(), config, files)
        self._timing = stamps_of_rows(folder / "timestamps.txt", self._numbers, config)
        self.stamps, self._rate_is_assumed = self._timing.stamps, not self._timing.from_clock
        self._before_s, self._after_s, notes = sweep_durations(folder, self._numbers, self._timing, config)
        first, last = self._numbers[0], self._numbers[-1]
        gaps = (f"Of the scans {first} to {last} only {len(self)} are there.",) if len(self) <= last - first else ()
        self.warnings = (*self._timing.notes, *notes, *gaps)

    @cached_property
    def T_cam_lidar(self) -> FloatArray | None:
        """LiDAR to the rectified left grey camera, (4, 4); None without both camera calibration files."""
        T_cam_lidar, T_rect_cam = (self._calibration(f"calib_{name}_to_cam.txt") for name in ("velo", "cam"))
        return None if T_cam_lidar is None or T_rect_cam is None else T_rect_cam @ T_cam_lidar

    def _calibration(self, name: str) -> FloatArray | None:
        path = self._source.parent / name
        return read_raw_calibration(path) if path.is_file() else None

    @cached_property
    def oxts(self) -> OxtsPoses | None:
        """The poses of `oxts/data`; None without the unit."""
        folder = self._source / "oxts" / "data"
        if not folder.is_dir():
            return None
        files, numbers = numbered_scans(folder, ".txt")
        tables = [parse_numbers(path, _COLUMNS) for path in files]
        for path, table in zip(files, tables, strict=True):
            if len(table) != 1 or not np.isfinite(table[0, :6]).all() or not abs(table[0, 0]) < _POLE_DEG:
                expected = f"one line of {_COLUMNS} numbers that begins with a latitude"
                raise InputError(f"{path}: expected {expected}, got {len(table)} lines; copy the file again")
        rows = np.concatenate(tables)
        return OxtsPoses(
            self._oxts_stamps(numbers),
            oxts_poses(rows),
            rows[:, _POSITION_ACCURACY_COLUMN],
            rows[:, _ANGULAR_VELOCITIES],
            rows[:, _ACCELERATIONS],
            rows[:, :3],
        )

    def _oxts_stamps(self, numbers: NDArray[np.intp]) -> FloatArray:
        """Stamps (N,) of the unit's poses, by their numbers, on the clock of the scans, NaN where there is none.

        A row lies 11 to 23 ms after its scan's stamp, with jitter. Measured on the drives 0005 and 0009 against LiDAR
        odometry: with rows at the scans' stamps, the forward motion deviates by 25 and 54 mm and the yaw by 0.049 and
        0.010 degrees (standard deviations); with the rows' own stamps, by 15 and 12 mm, 0.018 and 0.008 degrees.
        """
        if not self._timing.from_clock:
            return numbers / self._config.rate_hz
        path = self._source / "oxts" / "timestamps.txt"
        if path.is_file():
            return _rows(path, numbers)
        scans = np.searchsorted(self._numbers, numbers).clip(max=len(self) - 1)
        return np.where(self._numbers[scans] == numbers, self.stamps[scans], np.nan)

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of the GPS/IMU unit; the world is the LiDAR's frame at the first of these poses."""
        oxts, T_lidar_imu = self.oxts, self._calibration("calib_imu_to_velo.txt")
        if oxts is None or T_lidar_imu is None:
            return None
        truth = increasing(oxts.stamps, oxts.T_enu_imu @ inverse(T_lidar_imu))
        return None if truth is None else truth.transformed(inverse(truth.T_world_lidar[0]))

    @cached_property
    def _truth_path(self) -> Path | None:
        return None if self.ground_truth is None else self._source / "oxts"

    @cached_property
    def imu(self) -> ImuSamples | None:
        """Angular velocities and accelerations of the GPS/IMU unit, one for each camera image."""
        oxts, T_lidar_imu = self.oxts, self._calibration("calib_imu_to_velo.txt")
        if oxts is None:
            return None
        return usable_samples(oxts.stamps, oxts.angular_velocities, oxts.accelerations, T_lidar_imu)

    def _offsets(self, rows: NDArray[np.float32], index: int) -> FloatArray:
        return offsets_from_azimuth(rows, float(self._before_s[index]), float(self._after_s[index]))

    @cached_property
    def _notes(self) -> tuple[str, ...]:
        oxts, truth = self.oxts, self.ground_truth
        if oxts is None:
            return ("There is no oxts folder, so there is no ground truth.",)
        if truth is None:
            return (
                "There is no calib_imu_to_velo.txt above the drive, so its oxts poses cannot be used as ground truth.",
            )
        median_m, left_out = float(np.median(oxts.accuracy_m)), len(oxts.stamps) - len(truth)
        accuracy = f"The ground truth is GPS/IMU; it states its own position accuracy as {median_m:.2f} m (median)."
        gaps = (f"{left_out} oxts rows without a stamp that increases were left out.",) if left_out else ()
        return *gaps, accuracy


def open_360(source: Path, config: ReaderConfig) -> Recording:
    """Open a drive: the data set's root, with `config.sequence` such as 0003, or a folder in its data_3d_raw."""
    drive = find_sequence(source, source / _SCANS, _POINTS, config.sequence, "drive")
    return Kitti360Recording(drive.resolve(), config)


class Kitti360Recording(BinRecording):
    """One drive of KITTI-360."""

    reader = "kitti-360"
    point_time = AZIMUTH_TIME

    def __init__(self, drive: Path, config: ReaderConfig) -> None:
        files, self._numbers = numbered_scans(drive / _POINTS / "data")
        super().__init__(drive, config, files)
        # There are no files of the sweeps' starts and ends, unlike in KITTI's raw data.
        timing = stamps_of_rows(drive / _POINTS / "timestamps.txt", self._numbers, config)
        self.stamps, self.warnings, self._rate_is_assumed = timing.stamps, timing.notes, not timing.from_clock
        self._sweep_s = 1.0 / (scan_rate(self.stamps) or config.rate_hz)
        self._truth_path = first_file((drive.parent.parent / "data_poses" / drive.name,), "poses.txt")

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of the drive's poses, for the scans that have one; the world is the first one's LiDAR frame."""
        path, T_pose_lidar = self._truth_path, self._T_pose_lidar
        if path is None or T_pose_lidar is None:
            return None
        rows = read_table(path, 13)
        rows = rows[np.isin(rows[:, 0], self._numbers)]
        if not len(rows):
            return None
        T_world_lidar = poses_of_rows(rows[:, 1:]) @ T_pose_lidar
        stamps = self.stamps[np.searchsorted(self._numbers, rows[:, 0])]
        return increasing(stamps, inverse(T_world_lidar[0]) @ T_world_lidar)

    @cached_property
    def _T_pose_lidar(self) -> FloatArray | None:
        folder = self._source.parent.parent / "calibration"
        to_lidar, to_pose = folder / "calib_cam_to_velo.txt", folder / "calib_cam_to_pose.txt"
        if not (to_lidar.is_file() and to_pose.is_file()):
            return None
        T_pose_cam, T_lidar_cam = read_entry(to_pose, 12, "image_00"), parse_numbers(to_lidar, 12)
        if len(T_lidar_cam) != 1:
            raise InputError(f"{to_lidar}: expected one line of 12 numbers")
        return poses_of_rows(T_pose_cam) @ inverse(poses_of_rows(T_lidar_cam[0]))

    def _offsets(self, rows: NDArray[np.float32], index: int) -> FloatArray:  # noqa: ARG002
        return -self._sweep_s * np.arctan2(rows[:, 1], rows[:, 0]).astype(np.float64) / (2.0 * np.pi)

    @cached_property
    def _notes(self) -> tuple[str, ...]:
        note = "Points are taken as they are: the correction of elevation that KITTI's scans get is not applied."
        if self._truth_path is None or self._T_pose_lidar is not None:
            return (note,)
        return note, "There is no calibration folder beside data_3d_raw, so the poses cannot be used as ground truth."


def read_entry(path: Path, count: int, *names: str) -> FloatArray:
    """The numbers of the line of a calibration file that has one of the names."""
    for line in bounded_lines(path):
        name, _, values = line.partition(":")
        if name.strip() in names:
            with suppress(ValueError):
                numbers = np.array(values.split(), dtype=np.float64)
                if len(numbers) == count and np.isfinite(numbers).all():
                    return numbers
    raise InputError(f"{path}: expected a line `{names[0]}:` with {count} numbers; copy the file again")


def _rigid(path: Path, R: FloatArray, t: FloatArray) -> FloatArray:
    """The transform (4, 4), re-orthonormalised: the files round to seven digits or fewer."""
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0.0:
        raise InputError(f"{path}: holds a rotation matrix that is none; expected orthonormal rows, right-handed")
    return orthonormalize(make_transform(R, t))


def read_tr(path: Path) -> FloatArray:
    """T_cam_lidar (4, 4) of the odometry benchmark's calib.txt, its line `Tr` or `Tr_velo_to_cam`."""
    rows = read_entry(path, 12, "Tr", "Tr_velo_to_cam").reshape(3, 4)
    return _rigid(path, rows[:, :3], rows[:, 3])


def read_raw_calibration(path: Path) -> FloatArray:
    """The transform (4, 4) of a raw calibration file: T_B_A of calib_A_to_B.txt, T_rect_cam of calib_cam_to_cam.txt."""
    if path.name == "calib_cam_to_cam.txt":
        return _rigid(path, read_entry(path, 9, "R_rect_00").reshape(3, 3), np.zeros(3))
    return _rigid(path, read_entry(path, 9, "R").reshape(3, 3), read_entry(path, 3, "T"))


class ScanStamps(NamedTuple):
    """The stamps of N scans."""

    stamps: FloatArray  # (N,) seconds, strictly increasing
    from_clock: bool  # whether they are clock readings; else they are made from the rate
    notes: tuple[str, ...]  # facts for the user


def stamps_of_rows(path: Path, numbers: NDArray[np.intp], config: ReaderConfig) -> ScanStamps:
    """By a file with a row for every scan, which the numbers (N,) are, blank for a missing one; else by the rate."""
    try:
        stamps, replaced = mend_stamps(_rows(path, numbers), numbers.astype(np.float64))
    except ValueError:
        missing = f"There is no {path.name} with two stamps that increase"
        return ScanStamps(numbers / config.rate_hz, False, (assumed_rate(missing, config),))
    said = f"{count(replaced, 'stamp')} of {path.name} interpolated: missing, repeated or backwards."
    return ScanStamps(stamps, True, (said,) if replaced else ())


def sweep_durations(
    folder: Path, numbers: NDArray[np.intp], timing: ScanStamps, config: ReaderConfig
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Seconds (N,) from the start of a sweep to its stamp, and from there to its end; facts for the user.

    By timestamps_start.txt and timestamps_end.txt in a `velodyne_points` folder. The laser faces forward at the stamp,
    which triggers the cameras.
    """
    stamps = timing.stamps
    if not timing.from_clock:
        half = np.full(len(numbers), 0.5 / config.rate_hz)
        return half, half, ()
    period = float(np.median(np.diff(stamps) / np.diff(numbers))) if len(stamps) > 1 else 1.0 / config.rate_hz
    start, end = (_rows(folder / f"timestamps_{which}.txt", numbers) for which in ("start", "end"))
    before_s, wrong_starts = _plausible(stamps - start, 0.5 * period)
    after_s, wrong_ends = _plausible(end - stamps, 0.5 * period)
    said = "ends of sweeps missing or implausible, and replaced: sweeps are taken to be seamless."
    is_wrong = wrong_starts or wrong_ends
    return before_s, after_s, (f"{count(wrong_starts, 'start')} and {wrong_ends} {said}",) if is_wrong else ()


def _rows(path: Path, numbers: NDArray[np.intp]) -> FloatArray:
    """The stamps of the rows with these numbers, NaN where there is none."""
    stamps = read_stamps(path) if path.is_file() else np.empty(0)
    return np.append(stamps, np.nan)[np.minimum(numbers, len(stamps))]


def _plausible(durations: FloatArray, expected: float) -> tuple[FloatArray, int]:
    wrong = ~(np.abs(durations - expected) < _SWEEP_TOLERANCE * expected)  # NaN is wrong too
    return np.where(wrong, expected, durations), int(np.count_nonzero(wrong))
