"""An IMU whose samples come one after the other, beside the scans."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state.stateful import Stateful
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.mapping.inertial.comparison import Comparison, MountingError
from lidarslam.mapping.inertial.inertial import Inertial
from lidarslam.mapping.motion.prediction import GravityDirection, Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan

# Samples that are kept, seconds; scans between two comparisons, and turns that one needs.
_KEPT_S, _EVERY, _FEWEST_TURNS = 6.0, 10, 30
# Clock and rotation are corrected once the clock is this certain, seconds.
_CLOCK_SIGMA_S = 0.001
_FEWEST_SAMPLES = 3


class ImuStream(Stateful):
    """An IMU's part in the prior of each scan; `InertialPrediction` of the samples that have come so far.

    The rotation is found by the turns of the first scans where none is given. Errors of clock and rotation are
    corrected as soon as the scans show them, and an IMU that contradicts them is no longer used.

    Args:
        T_lidar_imu: (4, 4) extrinsic calibration; None where it is not known.
        warn: called with what is corrected, or wrong.
    """

    def __init__(self, T_lidar_imu: FloatArray | None, warn: Callable[[str], None]) -> None:
        self._T_lidar_imu, self._warn = T_lidar_imu, warn
        self.is_placed = T_lidar_imu is not None  # whether somebody has said where it is, or that it is not known
        self._rows: deque[FloatArray] = deque()
        self._last_s, self._lock = -np.inf, Lock()
        self._offset_s = 0.0
        self._inertial: Inertial | None = None
        self._comparison: Comparison | None = None
        self._scans, self._is_wrong = 0, False

    @property
    def last_s(self) -> float:
        """The stamp of the last sample, seconds; minus infinity before the first."""
        return self._last_s

    @property
    def direction(self) -> GravityDirection | None:
        """Gravity as measured until the last scan; None where nothing was."""
        return None if self._inertial is None else self._inertial.direction

    @property
    def warnings(self) -> list[str]:
        """What is wrong with the IMU, one sentence each."""
        if not self._rows:
            return ["no sample of the IMU came"]
        if self._inertial is None and not self._is_wrong:
            return ["the IMU's rotation was not observable, and it was not used: give odometry.imu_rotation_deg"]
        return [] if self._inertial is None else self._inertial.warnings

    def place(self, T_lidar_imu: FloatArray | None) -> None:
        """Take the extrinsic calibration (4, 4) that became known since; None: it will not."""
        self._T_lidar_imu, self.is_placed = T_lidar_imu, True

    def add(self, stamp: float, angular_velocity: FloatArray, acceleration: FloatArray) -> None:
        """Take the next sample, from any thread: seconds on the clock of the scans, rad/s and m/s^2 (3,) each.

        Raises:
            InputError: the stamp is not after the last one.
        """
        with self._lock:
            if not stamp > self._last_s:
                raise InputError(f"stamps must increase: {stamp:.9f} s is not after the last, {self._last_s:.9f} s")
            self._last_s = stamp
            self._rows.append(np.concatenate([[stamp], angular_velocity, acceleration]))
            while self._rows[0][0] < stamp - _KEPT_S:
                self._rows.popleft()

    def take_up(self, scan: Scan) -> Scan:
        """Use the samples that have come; the sweep as if the sensor had turned evenly. Call it before `prior`."""
        samples = self._samples()
        if samples is None or self._is_wrong:
            return scan
        if self._comparison is None:
            T = np.eye(4) if self._T_lidar_imu is None else self._T_lidar_imu
            self._comparison = Comparison(samples, T)
        self._comparison.use(samples)
        if self._T_lidar_imu is None:
            return scan
        if self._inertial is None:
            self._inertial = Inertial(samples, self._T_lidar_imu)
        self._inertial.use(samples)
        return self._inertial.gyroscope.evened(scan)

    def prior(self, scan: Scan, prior: Prior) -> Prior:
        """The odometry's prior, with the state that the IMU predicts."""
        return prior if self._inertial is None else self._inertial.prior(scan, prior)

    def update(self, scan: Scan, mapped: MappedScan) -> None:
        """Follow the result of a scan, and compare the IMU with the scans so far."""
        if self._inertial is not None:
            self._inertial.update(scan, mapped)
        if self._comparison is None:
            return
        follows = mapped.registered and mapped.is_connected
        self._comparison.add(scan.stamp, mapped.state.T_world_lidar, follows)
        self._scans += 1
        if self._scans % _EVERY:
            return
        if self._T_lidar_imu is None:
            with suppress(MountingError):
                self._begin_anew(make_transform(self._comparison.mounting().R_lidar_imu, np.zeros(3)))
        elif len(self._comparison) >= _FEWEST_TURNS:
            self._align(self._comparison, self._T_lidar_imu)

    def _align(self, comparison: Comparison, T_lidar_imu: FloatArray) -> None:
        """Correct the errors of clock and rotation that are clear; an IMU that contradicts the scans is left alone."""
        contradiction, found = comparison.contradiction(), comparison.alignment()
        if contradiction is not None:
            self._warn(f"{contradiction}; it was not used from scan {self._scans} on")
            self._begin_anew(T_lidar_imu)
            self._is_wrong = True
        elif found.offset_sigma_s < _CLOCK_SIGMA_S and (sentences := found.sentences()):
            for sentence in sentences:
                self._warn(sentence)
            self._offset_s += found.significant_offset_s
            self._begin_anew(found.corrected(T_lidar_imu))

    def _begin_anew(self, T_lidar_imu: FloatArray) -> None:
        self._T_lidar_imu, self._inertial, self._comparison = T_lidar_imu, None, None

    def _samples(self) -> ImuSamples | None:
        with self._lock:
            rows = np.array(self._rows)
        if len(rows) < _FEWEST_SAMPLES:
            return None
        samples = usable_samples(rows[:, 0] - self._offset_s, rows[:, 1:4], rows[:, 4:], None)
        return samples if samples is not None and len(samples) >= _FEWEST_SAMPLES else None
