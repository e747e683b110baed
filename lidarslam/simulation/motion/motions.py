"""Motions of a body through a world: poses at any time, without end."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from lidarslam.core.geometry import FloatArray, make_transform

# Columns of `Motion.base`.
CHANNELS = ("x", "y", "z", "roll", "pitch", "yaw", "activity")


@dataclass(frozen=True, eq=False)
class Sway:
    """K sines on top of a motion, in the body's frame; they grow with the motion's activity and vanish at rest."""

    axes: tuple[int, ...] = ()  # indices into x, y, z, roll, pitch, yaw
    amplitudes: tuple[float, ...] = ()  # metres or radians
    frequencies_hz: tuple[float, ...] = ()
    phases: tuple[float, ...] = ()

    def at(self, times: FloatArray) -> FloatArray:
        """Deflections (N, 6) at times (N,), full size."""
        deflections = np.zeros((len(times), 6))
        sines = zip(self.axes, self.amplitudes, self.frequencies_hz, self.phases, strict=True)
        for axis, amplitude, frequency, phase in sines:
            deflections[:, axis] += amplitude * np.sin(2.0 * np.pi * frequency * times + phase)
        return deflections


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a body, x forwards and z up, whose origin is on the ground under it (or which flies).

    Cubic splines go through `base`: world position, roll, pitch, yaw and activity (0 to 1), with
    R_world_body = Rz(yaw) Ry(pitch) Rx(roll).
    """

    name: str  # of the carrier, or "given"
    times: FloatArray  # (K,) from 0 to `duration_s`
    base: FloatArray  # (K, 7)
    sway: Sway
    sensor_height_m: float  # of a LiDAR above the body's origin
    repeats: bool = True  # another lap follows a lap; else the body stays where it is in the end
    rests: bool = True  # a lap begins and ends at rest; else its last pose is its first, whole turns of yaw aside

    def __post_init__(self) -> None:
        if self.base.shape != (len(self.times), len(CHANNELS)) or self.times[0] != 0.0:
            raise ValueError(f"Motion.base must be ({len(self.times)}, {len(CHANNELS)}), got {self.base.shape}")

    @property
    def duration_s(self) -> float:
        """Time of one lap."""
        return float(self.times[-1])

    @cached_property
    def _spline(self) -> "CubicSpline[np.float64]":
        if self.repeats and not self.rests:
            return _closed_spline(self.times, self.base)
        return CubicSpline(self.times, self.base, bc_type="clamped" if self.repeats else "natural")

    def pose_at(self, times: FloatArray) -> FloatArray:
        """T_world_body (N, 4, 4) at times (N,), seconds from the start; twice differentiable."""
        since = np.maximum(times, 0.0)
        lap_time = np.mod(since, self.duration_s) if self.repeats else np.minimum(since, self.duration_s)
        state = self._spline(lap_time)
        x, y, z, roll, pitch, yaw = (state[:, :6] + state[:, 6:] * self.sway.at(times)).T
        # Sway along x and y is the body's, not the world's.
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = x - state[:, 0], y - state[:, 1]
        position = np.stack([state[:, 0] + c * dx - s * dy, state[:, 1] + s * dx + c * dy, z], axis=-1)
        return make_transform(rotations(roll, pitch, yaw), position)


def _closed_spline(times: FloatArray, values: FloatArray) -> "CubicSpline[np.float64]":
    """Through values (K, D) at times (K,), with equal derivatives at either end: a periodic spline and a trend."""
    slope = (values[-1] - values[0]) / times[-1]
    level = values - np.multiply.outer(times, slope)
    level[-1] = level[0]
    spline = CubicSpline(times, level, bc_type="periodic")
    spline.c[2] += slope
    spline.c[3] += np.multiply.outer(times[:-1], slope)
    return spline


def rotations(roll: FloatArray, pitch: FloatArray, yaw: FloatArray) -> FloatArray:
    """Rz(yaw) Ry(pitch) Rx(roll), (N, 3, 3), of angles (N,) in radians."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0).copy()
