"""A synchronised drive of KITTI's raw data: `DATE/DATE_drive_NNNN_sync/{velodyne_points, oxts}`.

The scans are as measured, not motion compensated. The calibration files lie in the date's folder above the drive.
"""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults, first_readable, readable_scans
from lidarslam.datasets.folders.scan_files import KITTI_FIELDS, numbered_scans, read_bin, scan_indices
from lidarslam.datasets.kitti import correction
from lidarslam.datasets.kitti.calibration import read_rectification, read_rotation_translation
from lidarslam.datasets.kitti.oxts import OxtsPoses, read_oxts
from lidarslam.datasets.kitti.raw_timing import offsets_from_azimuth, read_sweep_timing
from lidarslam.datasets.point_time import PointTimeModel
from lidarslam.datasets.recording import PointField, PointTime, Recording, RecordingInfo
from lidarslam.datasets.stamps import increasing_rows, read_stamps


def open_recording(source: Path, config: ReaderConfig) -> Recording:
    """Open a `..._sync` drive folder.

    Raises:
        InputError: the folder is no such drive, or a stamp file is damaged.
    """
    data = source / "velodyne_points" / "data"
    if not data.is_dir():
        raise InputError(f"{source}: expected a drive folder with velodyne_points/data in it, found none")
    if any(data.glob("*.txt")) and not any(data.glob("*.bin")):
        raise InputError(
            f"{source}: holds scans as text, as the unsynchronised ..._extract drives do; expected .bin scans:"
            " use the ..._sync drive of the same number"
        )
    return KittiRawRecording(source.resolve(), config)


class KittiRawRecording:
    """One drive; implements `Recording`."""

    def __init__(self, drive: Path, config: ReaderConfig) -> None:
        self._drive = drive
        self._config = config
        self._files, self._numbers = numbered_scans(drive / "velodyne_points" / "data")
        self._timing = read_sweep_timing(drive / "velodyne_points", self._numbers, config.rate_hz)

    @property
    def name(self) -> str:
        """The drive's name."""
        return self._drive.name

    @cached_property
    def T_cam_lidar(self) -> FloatArray | None:
        """LiDAR to the rectified left grey camera, (4, 4); None without both camera calibration files."""
        lidar_to_cam, rectification = (self._calibration(f"calib_{n}_to_cam.txt") for n in ("velo", "cam"))
        if lidar_to_cam is None or rectification is None:
            return None
        return read_rectification(rectification) @ read_rotation_translation(lidar_to_cam)

    def _calibration(self, name: str) -> Path | None:
        path = self._drive.parent / name
        return path if path.is_file() else None

    @cached_property
    def _oxts(self) -> OxtsPoses | None:
        folder = self._drive / "oxts" / "data"
        return read_oxts(folder) if folder.is_dir() else None

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar of the GPS/IMU unit; the world is the LiDAR's frame at the first of these poses.

        Raises:
            InputError: an OXTS, stamp or calibration file is damaged.
        """
        oxts, calibration = self._oxts, self._calibration("calib_imu_to_velo.txt")
        if oxts is None or calibration is None:
            return None
        T_enu_lidar = oxts.T_enu_imu @ inverse(read_rotation_translation(calibration))
        stamps = self._oxts_stamps(oxts)
        kept = increasing_rows(stamps)
        if not kept.any():
            return None
        T_enu_lidar = T_enu_lidar[kept]
        return Trajectory(stamps[kept], inverse(T_enu_lidar[0]) @ T_enu_lidar)

    def _oxts_stamps(self, oxts: OxtsPoses) -> FloatArray:
        """Stamps (N,) of the unit's poses on the clock of the scans, NaN where there is none.

        A synchronised drive pairs a scan with a packet of the unit, which sends 100 a second, so a row lies 11 to
        23 ms after its scan's stamp and jitters. Its own stamp is the right one. Measured on the drives 0005 and
        0009 against LiDAR odometry from scan to scan: taking rows as simultaneous with the scans, the forward
        motion deviates by 25 and 54 mm and the yaw by 0.049 and 0.010 degrees (standard deviations); interpolating
        between the rows' own stamps, by 15 and 12 mm, 0.018 and 0.008 degrees. No constant shift improves on that.
        """
        if not self._timing.from_clock:
            return oxts.numbers / self._config.rate_hz
        path = self._drive / "oxts" / "timestamps.txt"
        if path.is_file():
            rows, table = oxts.numbers, read_stamps(path)
        else:
            # The scan with the row's number stands in.
            rows = np.searchsorted(self._numbers, oxts.numbers)
            scans = np.append(self._numbers, -1)
            rows, table = np.where(scans[rows] == oxts.numbers, rows, len(self)), self._timing.stamps
        return np.append(table, np.nan)[np.minimum(rows, len(table))]

    def __len__(self) -> int:
        return len(self._files)

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; per-point times come from the azimuth.

        Raises:
            InputError: the range makes no sense, or a scan file is damaged and `faults` is None.
        """
        return readable_scans(scan_indices(len(self), start, stop, step), self._read, faults)

    def _read(self, index: int) -> Scan:
        points = read_bin(self._files[index])[:, :3]
        timing = self._timing
        offsets = None
        if self._config.time_reference != "none":
            # The elevation correction turns points in their vertical plane, so azimuths are the same before it.
            offsets = offsets_from_azimuth(points, float(timing.before_s[index]), float(timing.after_s[index]))
        corrected = correction.correct_elevation(points, correction.ELEVATION_DEG)
        return Scan.from_raw(corrected, timing.stamps[index], offsets)

    def describe(self) -> RecordingInfo:
        """What `lidarslam info` prints.

        Raises:
            InputError: no scan can be read, or an OXTS or calibration file is damaged.
        """
        _, first, unreadable = first_readable(self._drive, range(len(self)), self._read)
        return RecordingInfo(
            reader="kitti-raw",
            scans=len(self),
            first=first,
            last_stamp=float(self._timing.stamps[-1]),
            ground_truth=None if self.ground_truth is None else self._drive / "oxts",
            point_time=PointTime.of_scan(first, PointTimeModel("azimuth", "s", "relative")),
            fields=tuple(PointField(name, "float32") for name in KITTI_FIELDS),
            notes=(*self._notes(), *unreadable.warnings()),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is missing, and stamps that were mended."""
        first, last = self._numbers[0], self._numbers[-1]
        gaps = (f"Of the scans {first} to {last} only {len(self)} are there.",) if len(self) <= last - first else ()
        return (*self._timing.notes, *gaps)

    def _notes(self) -> Iterator[str]:
        yield correction.NOTE
        yield from self.warnings
        if self._oxts is None:
            yield "There is no oxts folder, so there is no ground truth."
            return
        truth = self.ground_truth
        if truth is None:
            yield "There is no calib_imu_to_velo.txt above the drive, so its oxts poses cannot be used as ground truth."
            return
        if len(truth) < len(self._oxts.numbers):
            yield f"{len(self._oxts.numbers) - len(truth)} oxts rows without a stamp that increases were left out."
        median_m = float(np.median(self._oxts.accuracy_m))
        yield f"The ground truth is GPS/IMU; it states its own position accuracy as {median_m:.2f} m (median)."
