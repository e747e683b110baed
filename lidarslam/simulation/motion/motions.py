"""How a body moves through a world: poses at any time, without end."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from lidarslam.core.geometry import FloatArray, make_transform

# Columns of `Motion.base`.
CHANNELS = ("x", "y", "z", "roll", "pitch", "yaw", "activity")
_AXES = CHANNELS[:6]


@dataclass(frozen=True, eq=False)
class Sway:
    """Sines on top of a motion, in the body's frame; they grow with the motion's activity and vanish at rest.

    Attributes:
        axes: (K,) indices into x, y, z, roll, pitch, yaw.
        amplitudes: (K,) metres or radians.
        frequencies_hz, phases: (K,).
    """

    axes: tuple[int, ...] = ()
    amplitudes: tuple[float, ...] = ()
    frequencies_hz: tuple[float, ...] = ()
    phases: tuple[float, ...] = ()

    def at(self, times: FloatArray) -> FloatArray:
        """Deflections (N, 6) at times (N,), full size."""
        deflections = np.zeros((len(times), len(_AXES)))
        for axis, amplitude, frequency, phase in zip(
            self.axes, self.amplitudes, self.frequencies_hz, self.phases, strict=True
        ):
            deflections[:, axis] += amplitude * np.sin(2.0 * np.pi * frequency * times + phase)
        return deflections


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of a body, x forwards and z up, whose origin is on the ground under it (or which flies).

    Attributes:
        name: of the carrier, or of the trajectory that is followed.
        times: (K,) from 0 to `duration_s`.
        base: (K, 7) world position, roll, pitch, yaw and activity (0 to 1) at the times; cubic splines go through
            them. R_world_body = Rz(yaw) Ry(pitch) Rx(roll).
        sway: what comes on top, seeded.
        sensor_height_m: how far above the body's origin a LiDAR sits.
        repeats: whether another lap follows a lap; else the body stays where it is in the end.
        rests: whether a lap begins and ends at rest; else its last pose is its first, whole turns of yaw aside, and the
            next lap follows without a halt.
    """

    name: str
    times: FloatArray
    base: FloatArray
    sway: Sway
    sensor_height_m: float
    repeats: bool = True
    rests: bool = True

    def __post_init__(self) -> None:
        if self.base.shape != (len(self.times), len(CHANNELS)) or self.times[0] != 0.0:
            raise ValueError(f"Motion.base must be ({len(self.times)}, {len(CHANNELS)}), got {self.base.shape}")

    @property
    def duration_s(self) -> float:
        """Time of one lap."""
        return float(self.times[-1])

    @cached_property
    def _spline(self) -> CubicSpline[np.float64]:
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


def _closed_spline(times: FloatArray, values: FloatArray) -> CubicSpline[np.float64]:
    """Through values (K, D) at times (K,), with equal derivatives at either end, whatever the values differ by there.

    A periodic spline of what is left without a linear trend, and the trend on top.
    """
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
    R = np.empty((len(roll), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = -sp, cp * sr, cp * cr
    return R
