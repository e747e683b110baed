"""A recording in upright axes, with its elevations and the times of its points corrected."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.trajectory import Trajectory
from lidarslam.datasets.config import Mounting
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.mounting import UPRIGHT, Guess, corrected, guess_mounting, transform_of, written
from lidarslam.datasets.recording import Recording, RecordingInfo

# Step between the scans that a guess uses.
_STEP = 4


class MountedRecording:
    """A recording whose LiDAR frame is turned to x forward, z up: scans, ground truth and extrinsics.

    Args:
        recorded: in its own axes.
        mounting: of these; auto: guessed from the first scans, when it is needed.
        raised_deg: added to the elevations of all points, above the recorded x-y plane.
        time_scale: factor on the points' times from their scan's stamp.
    """

    def __init__(
        self, recorded: Recording, mounting: Mounting, raised_deg: float = 0.0, time_scale: float = 1.0
    ) -> None:
        self.recorded = recorded
        self.raised_deg = raised_deg
        self._time_scale = time_scale
        self._mounting = mounting

    @cached_property
    def _guess(self) -> Guess:
        if self._mounting != "auto":
            return Guess(self._mounting)
        try:
            return guess_mounting(scan.points for scan in self.recorded.scans(step=_STEP, faults=Faults()))
        except InputError:  # raised again when the scans are read
            return UPRIGHT

    @cached_property
    def T_upright_recorded(self) -> FloatArray:
        """(4, 4) the rotation from the recorded axes."""
        return transform_of(self._guess.mounting)

    @property
    def _is_turned(self) -> bool:
        return not np.array_equal(self.T_upright_recorded, np.eye(4))

    @property
    def name(self) -> str:
        """A short name."""
        return self.recorded.name

    def __len__(self) -> int:
        return len(self.recorded)

    @property
    def ground_truth(self) -> Trajectory | None:
        """T_world_lidar, of the upright axes; the world is the truth's."""
        truth = self.recorded.ground_truth
        if truth is None or not self._is_turned:
            return truth
        return Trajectory(truth.stamps, truth.T_world_lidar @ inverse(self.T_upright_recorded))

    @property
    def T_cam_lidar(self) -> FloatArray | None:
        """Extrinsic calibration of a KITTI recording."""
        T_cam_recorded = self.recorded.T_cam_lidar
        if T_cam_recorded is None or not self._is_turned:
            return T_cam_recorded
        return np.asarray(T_cam_recorded @ inverse(self.T_upright_recorded), dtype=np.float64)

    @property
    def imu(self) -> ImuSamples | None:
        """The samples of the IMU, with its extrinsic calibration to the upright axes."""
        samples = self.recorded.imu
        if samples is None or samples.T_lidar_imu is None or not self._is_turned:
            return samples
        return replace(samples, T_lidar_imu=self.T_upright_recorded @ samples.T_lidar_imu)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Of the recording, and of a guess."""
        warning = self._guess.warning
        return (*self.recorded.warnings, *(() if warning is None else (warning,)))

    def scans(
        self, start: int = 0, stop: int | None = None, step: int = 1, faults: Faults | None = None
    ) -> Iterator[Scan]:
        """The scans with the indices of `range(start, stop, step)`, in upright axes."""
        _ = self.T_upright_recorded  # guessed before the first scan: two passes over one file may not alternate
        scans = self.recorded.scans(start, stop, step, faults)
        is_as_recorded = not (self._is_turned or self.raised_deg) and self._time_scale == 1.0
        return scans if is_as_recorded else map(self._upright, scans)

    def _upright(self, scan: Scan) -> Scan:
        return corrected(scan, self.T_upright_recorded, self.raised_deg, self._time_scale)

    def describe(self) -> RecordingInfo:
        """The contents of the recording, and its mounting unless it is upright."""
        info, notes = self.recorded.describe(), []
        if self._guess.warning is not None:
            notes.append(f"{self._guess.warning[0].upper()}{self._guess.warning[1:]}.")
        elif self._is_turned:
            notes.append(f"The scans are turned upright, as reader.mounting={written(self._guess.mounting)}.")
        if self.raised_deg:
            notes.append(
                f"Every point is raised by {self.raised_deg:g} degrees of elevation, before every method alike."
            )
        return replace(info, first=self._upright(info.first), notes=(*info.notes, *notes))


def recorded_axes(recording: Recording) -> tuple[Recording, FloatArray]:
    """The recording in its own axes, and T_upright_recorded (4, 4)."""
    if isinstance(recording, MountedRecording):
        return recording.recorded, recording.T_upright_recorded
    return recording, np.eye(4)


def elevation_of(recording: Recording) -> tuple[float, float]:
    """The degrees by which a recording's points are raised, and the cosine between its recorded z axis and up."""
    if not isinstance(recording, MountedRecording):
        return 0.0, 1.0
    return recording.raised_deg, float(recording.T_upright_recorded[2, 2])
