"""Integration of an IMU's samples: turns between instants, and sweeps as of a constant rate."""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log, make_transform
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan

# Longest step of the integration: within it the axis of rotation is taken as constant.
_STEP_S = 0.0025
# A gap between samples is longer than this many usual intervals, and than this time, seconds.
_GAP_INTERVALS, _LEAST_GAP_S = 3.0, 0.02
_NO_BIAS = np.zeros(3)


class Gyroscope:
    """An IMU's two samples or more in the LiDAR's axes, linear between stamps, by the extrinsic rotation (3, 3)."""

    def __init__(self, samples: ImuSamples, R_lidar_imu: FloatArray) -> None:
        from scipy.interpolate import make_interp_spline  # takes a while to load

        self._stamps = samples.stamps
        self._rows = np.hstack([samples.angular_velocities @ R_lidar_imu.T, samples.accelerations @ R_lidar_imu.T])
        # From the first stamp on: of clocks that count from 1970 half the digits would be lost.
        self._curve = make_interp_spline(self._stamps - self._stamps[0], self._rows, k=1).antiderivative()
        self._longest_s = max(_GAP_INTERVALS * float(np.median(np.diff(samples.stamps))), _LEAST_GAP_S)

    def _integrals(self, instants: FloatArray) -> FloatArray:
        """(M - 1, 6) of angular velocity and specific force, from each of M instants to the next."""
        return np.diff(self._curve(instants - self._stamps[0]), axis=0)

    def _samples(self, instants: FloatArray) -> FloatArray:
        """(M, 6) at M instants."""
        return np.asarray(self._curve(instants - self._stamps[0], 1), dtype=np.float64)

    def means(self, instants: FloatArray) -> FloatArray:
        """(M - 1, 6) mean angular velocity and specific force between M instants."""
        inside = np.clip(instants, self._stamps[0], self._stamps[-1])
        steps = np.diff(inside)
        with np.errstate(divide="ignore", invalid="ignore"):
            means = self._integrals(inside) / steps[:, None]
        return np.where(steps[:, None] > 0.0, means, self._samples(inside[1:]))

    def covers(self, first_s: float, last_s: float) -> bool:
        """Whether samples without a gap surround a time."""
        before, after = np.searchsorted(self._stamps, (first_s, last_s), "right")
        near = self._stamps[max(0, before - 1) : after + 1]
        at_ends = first_s >= near[0] - self._longest_s and last_s <= near[-1] + self._longest_s if len(near) else False
        return bool(at_ends and (np.diff(near) <= self._longest_s).all())

    def within(self, first_s: float, last_s: float, step_s: float) -> FloatArray:
        """(M,) even instants of a time that samples cover, as far as they do."""
        first_s, last_s = np.clip([first_s, last_s], self._stamps[0], self._stamps[-1])
        return np.linspace(first_s, last_s, max(2, int(np.ceil((last_s - first_s) / step_s)) + 1))

    def turn(self, first_s: float, last_s: float, bias: FloatArray) -> FloatArray:
        """(3, 3) R_first_last of the LiDAR between two instants; the bias (3,) is of the LiDAR's axes, rad/s."""
        steps = max(1, int(np.ceil(abs(last_s - first_s) / _STEP_S)))
        return np.asarray(self.rotations(np.linspace(first_s, last_s, steps + 1), bias)[-1], dtype=np.float64)

    def rotations(self, instants: FloatArray, bias: FloatArray) -> FloatArray:
        """(N, 3, 3) R_first_t of the LiDAR at N instants, the first of which is the reference."""
        inside = np.clip(instants, self._stamps[0], self._stamps[-1])  # the last rate is held for the rest
        angles = self._integrals(inside)[:, :3]
        beyond = np.diff(instants) - np.diff(inside)
        if beyond.any():
            angles = angles + beyond[:, None] * self._samples(inside[1:])[:, :3]
        steps = exp(np.pad(angles - np.diff(instants)[:, None] * bias, ((0, 0), (0, 3)))).reshape(-1, 4, 4)[:, :3, :3]
        rotations: FloatArray = np.empty((len(instants), 3, 3))
        rotations[0] = np.eye(3)
        for n, step in enumerate(steps):
            rotations[n + 1] = rotations[n] @ step
        return rotations

    def mean_rate(self, scan: Scan) -> FloatArray | None:
        """(3,) the constant rate during a sweep, rad/s, with the bias; None where sweep or samples have no times."""
        turns = self._turns(scan)
        return None if turns is None else turns[2]

    def evened(self, scan: Scan) -> Scan:
        """The sweep as if the sensor had turned at `mean_rate` all the time.

        Methods that compensate a sweep with one angular velocity then compensate it for the whole turn. The bias, a
        constant rate, has no part in it.
        """
        turns = self._turns(scan)
        if turns is None or scan.time_offsets is None:
            return scan
        times, T_stamp_t, rate = turns
        steady = exp(np.pad(times[:, None] * rate, ((0, 0), (0, 3))))
        remaining = log(inverse(steady) @ T_stamp_t)[:, :3]
        vectors = np.stack([np.interp(scan.time_offsets, times, axis) for axis in remaining.T], axis=1)
        return replace(scan, points=_rotated(scan.points, vectors))

    def _turns(self, scan: Scan) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Times (N,) during a sweep, the turns (N, 4, 4) since its stamp, and the nearest constant rate (3,)."""
        if scan.time_offsets is None or not len(scan):
            return None
        begin, end = min(0.0, float(scan.time_offsets.min())), max(0.0, float(scan.time_offsets.max()))
        if end <= begin or not self.covers(scan.stamp + begin, scan.stamp + end):
            return None
        times = np.union1d(np.linspace(begin, end, max(2, int(np.ceil((end - begin) / _STEP_S)) + 1)), [0.0])
        rotations = self.rotations(scan.stamp + times, _NO_BIAS)
        T_stamp_t = make_transform(rotations[np.searchsorted(times, 0.0)].T @ rotations, np.zeros(3))
        return times, T_stamp_t, np.asarray(times @ log(T_stamp_t)[:, :3] / (times @ times), dtype=np.float64)


def _rotated(points: FloatArray, vectors: FloatArray) -> FloatArray:
    """Points (N, 3), each turned by its own rotation vector (N, 3)."""
    angle2 = np.einsum("ij,ij->i", vectors, vectors)
    angle = np.sqrt(angle2)
    sine, versine = np.sinc(angle / np.pi)[:, None], 0.5 * np.sinc(0.5 * angle / np.pi)[:, None] ** 2
    once = np.cross(vectors, points)
    return np.asarray(points + sine * once + versine * np.cross(vectors, once), dtype=np.float64)
