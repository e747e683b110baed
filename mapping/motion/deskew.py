"""Motion compensation (deskewing) of sweeps to the scan's stamp."""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray, log
from lidarslam.core.state import Shape

# Below this squared angle the series are exact to double precision.
_SERIES_ANGLE2 = 0.25
_SINE = tuple((-1) ** k / math.factorial(2 * k + 1) for k in range(8))
_VERSINE = tuple((-1) ** k / math.factorial(2 * k + 2) for k in range(8))
_CUBIC = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(8))


@dataclass(frozen=True, eq=False)
class Sweep:
    """Points of a scan as measured, each in the LiDAR frame of its own instant."""

    points: Annotated[FloatArray, Shape(None, 3)]  # (N, 3)
    # (N,) seconds from the stamp; None when the points are motion compensated already
    times: Annotated[FloatArray, Shape(None)] | None = None
    # (N,) of features; None where points are of one kind
    kinds: Annotated[NDArray[np.int8], Shape(None)] | None = None

    def __len__(self) -> int:
        return len(self.points)

    def take(self, chosen: NDArray[np.intp]) -> "Sweep":
        """The points with some indices."""
        times = None if self.times is None else self.times.take(chosen)
        kinds = None if self.kinds is None else self.kinds.take(chosen)
        return Sweep(self.points.take(chosen, axis=0), times, kinds)

    def evened(self, turn_acceleration: FloatArray, middle_s: float) -> "Sweep":
        """The sweep as if the sensor had turned at its mean rate all the time; see `even`."""
        if self.times is None:
            return self
        return replace(self, points=even(self.points, self.times, turn_acceleration, middle_s))

    def compensated(self, velocity: FloatArray) -> FloatArray:
        """The points (N, 3) in the LiDAR frame at the stamp, for a constant velocity (6,)."""
        return self.points if self.times is None else move(self.points, self.times, velocity)

    def placed(self, velocity: FloatArray, T_world_lidar: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The compensated points (N, 3), and their places (N, 3) in the world at a pose (4, 4)."""
        points = np.ascontiguousarray(self.compensated(velocity))
        world = np.empty_like(points)
        _place(points, np.ascontiguousarray(T_world_lidar), world)
        return points, world


def body_velocity(T_prev_curr: FloatArray, interval_s: float) -> FloatArray:
    """Constant body velocity (6,), rotation first, of a motion (4, 4) over an interval."""
    return log(T_prev_curr) / interval_s


def even(points: FloatArray, times: FloatArray, turn_acceleration: FloatArray, middle_s: float) -> FloatArray:
    """Points (N, 3) of a sweep with times (N,) as if the sensor had turned at its mean rate all the time.

    That is the rate at `middle_s` from the stamp; the angular acceleration (3,) is in the LiDAR frame, rad/s^2. Other
    acceleration displaces points by millimetres only, and is not counted.
    """
    return move(points, (0.5 * times - middle_s) * times, np.pad(turn_acceleration, (0, 3)))


def deskew(
    points: FloatArray, time_offsets: FloatArray, velocity_before: FloatArray, velocity_after: FloatArray
) -> FloatArray:
    """Move points (N, 3), measured at times (N,) from the stamp, to the LiDAR frame at the stamp.

    A point `p` measured at offset t lies there at `exp(t * velocity) p`; the velocity (6,), rotation first, in that
    frame, is one before the stamp and one after it.
    """
    if np.array_equal(velocity_before, velocity_after):
        return move(points, time_offsets, velocity_after)
    moved = np.empty_like(points)
    for part, velocity in ((time_offsets < 0.0, velocity_before), (time_offsets >= 0.0, velocity_after)):
        moved[part] = move(points[part], time_offsets[part], velocity)
    return moved


def move(points: FloatArray, t: FloatArray, velocity: FloatArray) -> FloatArray:
    """`exp(t * velocity)` applied to points (N, 3), each at its own time (N,), without a matrix for each point.

    Rodrigues' formula for the rotation, the left Jacobian for the translation.
    """
    moved = np.empty((len(points), 3))
    _move(np.ascontiguousarray(points), np.ascontiguousarray(t), np.ascontiguousarray(velocity), moved)
    return moved


@compiled
def _place(points: FloatArray, T: FloatArray, placed: FloatArray) -> None:
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for axis in range(3):
            placed[n, axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]


@compiled
def _move(points: FloatArray, t: FloatArray, velocity: FloatArray, moved: FloatArray) -> None:
    rate2 = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    for n in range(len(points)):
        s = t[n]
        sine, versine, cubic = _coefficients(rate2 * s * s)
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        a, b, c = s * velocity[0], s * velocity[1], s * velocity[2]
        u, v, w = s * velocity[3], s * velocity[4], s * velocity[5]
        # Cross products of the rotation vector with the point, twice, and with the translation.
        px, py, pz = b * z - c * y, c * x - a * z, a * y - b * x
        qx, qy, qz = b * pz - c * py, c * px - a * pz, a * py - b * px
        gx, gy, gz = b * w - c * v, c * u - a * w, a * v - b * u
        hx, hy, hz = b * gz - c * gy, c * gx - a * gz, a * gy - b * gx
        moved[n, 0] = x + sine * px + versine * (qx + gx) + u + cubic * hx
        moved[n, 1] = y + sine * py + versine * (qy + gy) + v + cubic * hy
        moved[n, 2] = z + sine * pz + versine * (qz + gz) + w + cubic * hz


@compiled_part
def _coefficients(squared: float) -> tuple[float, float, float]:
    """sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3 of a^2, by their series for small angles."""
    if squared < _SERIES_ANGLE2:
        x, s, v, c = squared, _SINE, _VERSINE, _CUBIC
        sine = s[0] + x * (s[1] + x * (s[2] + x * (s[3] + x * (s[4] + x * (s[5] + x * (s[6] + x * s[7]))))))
        versine = v[0] + x * (v[1] + x * (v[2] + x * (v[3] + x * (v[4] + x * (v[5] + x * (v[6] + x * v[7]))))))
        cubic = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * (c[5] + x * (c[6] + x * c[7]))))))
        return sine, versine, cubic
    angle = math.sqrt(squared)
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    return sine / angle, 2.0 * half * half / squared, (angle - sine) / (squared * angle)
