"""Data sets that evalio reads: its scans, IMU samples, true poses and extrinsic calibrations as a recording.

evalio decodes points one after another; the scans between the wanted ones are decoded too.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, orthonormalize
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.folders.scan_files import scan_indices
from lidarslam.datasets.published import evalio_names
from lidarslam.datasets.recording import ImuSummary, PointField, Recording, RecordingInfo
from lidarslam.datasets.times.point_time import PointTimeModel
from lidarslam.datasets.times.stamps import increasing_rows

_POINT = attrgetter("x", "y", "z", "intensity", "row")
_FIELDS = (*((name, "float64") for name in ("x", "y", "z", "intensity")), ("t", "ns"), ("row", "uint8"))
# Their true orientations are missing or made up.
_POSITIONS_ALONE = ("enwide", "fomo")
_UNREADABLE = "scans were left out: evalio could not read on"


def open_recording(source: Path, config: ReaderConfig) -> Recording:  # noqa: ARG001
    """Open a sequence in the folder DATASET/SEQUENCE that evalio downloads it to.

    Raises:
        InputError: evalio is not installed, does not know the sequence, or a file of it is missing.
    """
    evalio_names.require_known(source)
    from evalio import datasets

    recording = EvalioRecording(source, datasets.get_sequence(evalio_names.full_name(source)))
    recording.require_files()
    return recording


class EvalioRecording:
    """One sequence; implements `Recording`."""

    T_cam_lidar: FloatArray | None = None

    def __init__(self, folder: Path, sequence: Any) -> None:
        self._folder = folder.absolute()
        self._sequence = sequence  # evalio.datasets.Dataset

    @contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """evalio's data folder as that of this recording, and any error of evalio as one of the input."""
        from evalio.datasets import set_data_dir

        set_data_dir(self._folder.parent.parent)
        try:
            yield
        except Exception as error:  # of whatever library reads the data set
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise InputError(f"{self._folder}: evalio cannot read {what} ({reason}); download it again") from error

    def require_files(self) -> None:
        """Check that every file is there.

        Raises:
            InputError: one is missing.
        """
        with self._reading("its list of files"):
            missing = [file for file in self._sequence.files() if not (self._folder / file).exists()]
        if missing:
            command = evalio_names.how_to_get(self._folder)
            raise InputError(f"{self._folder}: {missing[0]} is missing, the download is not complete; {command}")

    @property
    def name(self) -> str:
        """Such as hilti_2022_basement_2."""
        return str(self._sequence.full_name).replace("/", "_")

    @cached_property
    def _length(self) -> int:
        with self._reading("the scans"):
            return len(self._sequence.data_iter())  # that of the sequence itself may be a number in its source

    def __len__(self) -> int:
        return self._length

    @cached_property
    def _T_imu_lidar(self) -> FloatArray:
        return orthonormalize(np.asarray(self._sequence.imu_T_lidar().to_mat(), dtype=np.float64))

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar: evalio's poses of the IMU with the extrinsic calibration."""
        with self._reading("the true poses"):
            truth = self._sequence.ground_truth()
            if truth is None or not len(truth):
                return None
            stamps = np.array([stamp.to_nsec() for stamp in truth.stamps]) * 1e-9
            T_world_imu = orthonormalize(np.stack([pose.to_mat() for pose in truth.poses]))
        kept = increasing_rows(stamps)
        return Trajectory(stamps[kept], T_world_imu[kept] @ self._T_imu_lidar)

    @cached_property
    def imu(self) -> ImuSamples | None:
        """All samples; None where gravity was taken off the accelerations."""
        if not np.any(self._sequence.imu_params().gravity):
            return None
        with self._reading("the IMU"):
            samples = [(one.stamp.to_nsec(), *one.gyro, *one.accel) for one in self._sequence.data_iter().imu_iter()]
        if not samples:
            return None
        table = np.array(samples)
        stamps = np.array([sample[0] for sample in samples]) * 1e-9
        kept = increasing_rows(stamps)
        return ImuSamples(stamps[kept], table[kept, 1:4], table[kept, 4:7], inverse(self._T_imu_lidar))

    def _imu_summary(self) -> ImuSummary | None:
        """By the index of bags; else by the samples."""
        from evalio.datasets import RosbagIter

        parameters = self._sequence.imu_params()
        if not np.any(parameters.gravity):
            return None
        with self._reading("the IMU"):
            iterator = self._sequence.data_iter()
            if isinstance(iterator, RosbagIter):
                number = sum(one.msgcount for one in iterator.connections_imu)
            else:
                number = sum(1 for _ in iterator.imu_iter())
        return ImuSummary(f"{parameters.brand} {parameters.model}", number, float(parameters.rate), True)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Truth without orientations."""
        if self._folder.parent.name in _POSITIONS_ALONE:
            return ("The truth has positions alone; errors of rotation against it say nothing.",)
        return ()

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`; see `Recording`."""
        indices, given = scan_indices(len(self), start, stop, step), 0
        try:
            for scan in self._read(indices):
                given += 1
                yield scan
        except InputError as error:
            if faults is None:
                raise
            faults.leave_out(_UNREADABLE, str(error), len(indices) - given)

    def _read(self, wanted: range) -> Iterator[Scan]:
        with self._reading("the scans"):
            measurements = self._sequence.data_iter().lidar_iter()
        for index in range(wanted.stop):
            with self._reading(f"scan {index}"):
                measurement = next(measurements)
                scan = _scan(measurement) if index in wanted else None
            if scan is not None:
                yield scan

    def describe(self) -> RecordingInfo:
        """By the first scan; see `Recording`."""
        first = next(self.scans(0, 1), None)
        if first is None:
            raise InputError(f"{self._folder}: holds no scan; download it again")
        lidar = self._sequence.lidar_params()
        return RecordingInfo(
            reader="evalio",
            scans=len(self),
            first=first,
            last_stamp=first.stamp + (len(self) - 1) / lidar.rate,
            ground_truth=self._folder if self.ground_truth is not None else None,
            point_time=None if first.time_offsets is None else PointTimeModel("t", "ns", "relative"),
            imu=self._imu_summary(),
            fields=tuple(PointField(name, kind) for name, kind in _FIELDS),
            notes=(
                f"{self._sequence.full_name} by evalio, {lidar.brand} {lidar.model}; stamps at the start of a sweep.",
                f"The duration is that of the scans at {lidar.rate:g} Hz, the sensor's rate.",
                *self.warnings,
            ),
        )


def _scan(measurement: Any) -> Scan:
    """The scan of a LidarMeasurement, whose stamp is the start of the sweep."""
    table = np.array(list(map(_POINT, measurement.points)), dtype=np.float64).reshape(-1, 5)
    measured = table[:, :3].any(axis=1)  # evalio fills up its grid of rows and columns with zeros
    table, offsets = table[measured], np.array(measurement.to_vec_stamps(), dtype=np.float64)[measured]
    known = len(offsets) and np.ptp(offsets) > 0.0
    return Scan.from_raw(
        table[:, :3], measurement.stamp.to_nsec() * 1e-9, offsets if known else None, table[:, 4], table[:, 3]
    )
