"""An IMU whose samples arrive one by one, along with the scans."""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from threading import Lock

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.datasets.imu_samples import usable_samples
from lidarslam.mapping.inertial.comparison import (
    FEWEST_COMPARED,
    MOST_CORRECTIONS,
    Comparison,
    MountingError,
    no_gravity,
)
from lidarslam.mapping.inertial.inertial import KNOWN_LEVER_M, UNKNOWN_LEVER_M, Inertial
from lidarslam.mapping.motion.prediction import GravityDirection, Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan

# Samples that are kept, seconds; scans between two comparisons.
_KEPT_S, _EVERY = 6.0, 10
_FEWEST_SAMPLES = 3
# Samples that are too late for this share of the sweeps are a fault.
_LATE_SHARE, _FEWEST_SWEEPS = 0.2, 20


class ImuStream(Stateful):
    """An IMU's part in the prior of each scan; `InertialPrediction` of the samples that have arrived so far.

    The rotation is found by the turns of the first scans where none is given. Errors of clock and rotation are
    corrected as soon as the scans show them, and an IMU that contradicts them is no longer used; `warn` is told.
    """

    def __init__(self, T_lidar_imu: FloatArray | None, warn: Callable[[str], None]) -> None:
        self._T_lidar_imu, self._warn = T_lidar_imu, warn
        self._lever_sigma_m = KNOWN_LEVER_M
        self.is_placed = T_lidar_imu is not None  # whether its extrinsic calibration is given, or given as unknown
        self._rows: deque[FloatArray] = deque()
        self.last_s, self._lock = -np.inf, Lock()  # the stamp of the last sample; minus infinity before the first
        self.offset_s = 0.0  # the estimated delay of the samples' stamps, seconds
        self._inertial: Inertial | None = None
        self._comparison: Comparison | None = None
        self._corrections_left = MOST_CORRECTIONS
        self._scans, self._late, self._is_wrong = 0, 0, False
        self._said: set[str] = set()

    @property
    def direction(self) -> GravityDirection | None:
        """Gravity as measured until the last scan; None where it was not."""
        return None if self._inertial is None else self._inertial.direction

    @property
    def warnings(self) -> list[str]:
        """Faults of the IMU, one sentence each."""
        if not self._rows:
            return ["no sample of the IMU came"]
        if self._inertial is None and not self._is_wrong:
            return ["the IMU's rotation was not observable, and it was not used: give odometry.imu_rotation_deg"]
        warnings = [] if self._inertial is None else self._inertial.warnings
        if self._scans >= _FEWEST_SWEEPS and self._late > _LATE_SHARE * self._scans:
            warnings.append(f"samples of the IMU came too late for {self._late} of {self._scans} sweeps")
        return warnings

    def place(self, T_lidar_imu: FloatArray | None) -> None:
        """Take the extrinsic calibration (4, 4) that has become known; None: it remains unknown."""
        self.is_placed = True
        self._begin_anew(T_lidar_imu)

    def add(self, stamp: float, angular_velocity: FloatArray, acceleration: FloatArray) -> None:
        """Take the next sample (3,), rad/s and m/s^2, stamped by the clock of the scans, from any thread.

        InputError where the stamp is not after the last one.
        """
        with self._lock:
            if not stamp > self.last_s:
                raise InputError(f"stamps must increase: {stamp:.9f} s is not after the last, {self.last_s:.9f} s")
            self.last_s = stamp
            self._rows.append(np.concatenate([[stamp], angular_velocity, acceleration]))
            while self._rows[0][0] < stamp - _KEPT_S:
                self._rows.popleft()

    def take_up(self, scan: Scan) -> Scan:
        """Use the samples that have arrived; the sweep as if the sensor had turned evenly. Call it before `prior`."""
        samples = None if self._is_wrong else self._samples()
        if samples is None:
            return scan
        if (wrong := no_gravity(samples)) is not None:
            self._give_up(wrong)
            return scan
        T_lidar_imu = self._T_lidar_imu
        if self._corrections_left:
            if self._comparison is None:
                self._comparison = Comparison(samples, np.eye(4) if T_lidar_imu is None else T_lidar_imu)
            self._comparison.use(samples)
        if T_lidar_imu is None:
            return scan
        if self._inertial is None:
            self._inertial = Inertial(samples, T_lidar_imu, self._lever_sigma_m)
        self._inertial.use(samples)
        end_s = scan.stamp + (scan.time_offsets.max() if scan.time_offsets is not None and len(scan) else 0.0)
        self._late += not self._inertial.gyroscope.covers(scan.stamp, float(end_s))
        return self._inertial.gyroscope.evened(scan)

    def prior(self, scan: Scan, prior: Prior) -> Prior:
        """The odometry's prior, with the state that the IMU predicts."""
        return prior if self._inertial is None else self._inertial.prior(scan, prior)

    def update(self, scan: Scan, mapped: MappedScan) -> None:
        """Update with the result of a scan, and compare the IMU with the scans so far."""
        if self._inertial is not None:
            self._inertial.update(scan, mapped)
        self._scans += 1
        if self._comparison is None:
            return
        # The pose by the correspondences alone is independent of the IMU.
        alone = None if self._inertial is None else mapped.measured
        pose = (alone or mapped.state).T_world_lidar
        self._comparison.add(scan.stamp, pose, mapped.registered and mapped.is_connected)
        if self._scans % _EVERY:
            return
        if self._T_lidar_imu is None:
            with suppress(MountingError):
                self._lever_sigma_m = UNKNOWN_LEVER_M
                self._begin_anew(make_transform(self._comparison.mounting().R_lidar_imu, np.zeros(3)))
        elif len(self._comparison) >= FEWEST_COMPARED:
            self._align(self._comparison, self._T_lidar_imu)

    def _align(self, comparison: Comparison, T_lidar_imu: FloatArray) -> None:
        """Correct clear errors of clock and rotation; an IMU that contradicts the scans is not corrected."""
        contradiction, found = comparison.contradiction(), comparison.alignment()
        if contradiction is not None:
            self._give_up(contradiction)
        elif found.is_certain:
            sentences = found.sentences()
            self._corrections_left = self._corrections_left - 1 if sentences else 0
            for sentence in sentences:
                self._warn(sentence)
            self.offset_s += found.significant_offset_s
            if sentences:
                self._begin_anew(found.corrected(T_lidar_imu))
            if not self._corrections_left:
                self._comparison = None

    def _give_up(self, reason: str) -> None:
        self._warn(f"{reason}; it was not used from scan {self._scans} on")
        self._begin_anew(self._T_lidar_imu)
        self._is_wrong = True

    def _begin_anew(self, T_lidar_imu: FloatArray | None) -> None:
        self._T_lidar_imu, self._inertial, self._comparison = T_lidar_imu, None, None

    def _samples(self) -> ImuSamples | None:
        with self._lock:
            rows = np.array(self._rows)
        if len(rows) < _FEWEST_SAMPLES:
            return None
        samples = usable_samples(rows[:, 0] - self.offset_s, rows[:, 1:4], rows[:, 4:], None)
        for note in samples.notes if samples is not None else ():
            kind = "".join(character for character in note if not character.isdigit())
            if kind not in self._said:
                self._said.add(kind)
                self._warn(note.rstrip("."))
        return samples if samples is not None and len(samples) >= _FEWEST_SAMPLES else None
