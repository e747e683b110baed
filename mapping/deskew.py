"""Motion compensation: every point of a sweep where it would have been seen at the scan's stamp."""

import numpy as np

from lidarslam.core.geometry import FloatArray, log


def body_velocity(T_prev_curr: FloatArray, interval_s: float) -> FloatArray:
    """The constant velocity (6,) in the body's frame, rotation first, that makes a motion in a time."""
    return log(T_prev_curr) / interval_s


def deskew(
    points: FloatArray, time_offsets: FloatArray, velocity_before: FloatArray, velocity_after: FloatArray
) -> FloatArray:
    """Move points to the scan's stamp, given how the sensor moved up to it and from it on.

    A point seen at offset t from the stamp lies at `exp(t * velocity)` in the frame of the stamp.

    Args:
        points: (N, 3) as measured, each in the LiDAR frame of its own instant.
        time_offsets: (N,) seconds from the stamp.
        velocity_before: (6,) for points before the stamp, rotation first, in the frame of the stamp.
        velocity_after: (6,) for points after it.
    """
    if not len(points):
        return points
    if time_offsets.min() >= 0.0 or np.array_equal(velocity_before, velocity_after):
        return move(points, time_offsets, velocity_after)
    if time_offsets.max() <= 0.0:
        return move(points, time_offsets, velocity_before)
    before = time_offsets < 0.0
    moved = np.empty_like(points)
    moved[before] = move(points[before], time_offsets[before], velocity_before)
    moved[~before] = move(points[~before], time_offsets[~before], velocity_after)
    return moved


def move(points: FloatArray, t: FloatArray, velocity: FloatArray) -> FloatArray:
    """`exp(t * velocity)` applied to points (N, 3), each at its own time (N,), without a matrix a point.

    The rotation is Rodrigues' formula about a common axis, so its coefficients are all that differs.
    """
    omega, v = velocity[:3], velocity[3:]
    rate = float(np.linalg.norm(omega))
    if rate * float(np.abs(t).max()) < 1e-9:
        return points + t[:, None] * v
    axis = omega / rate
    angle = rate * t
    sine, versine = np.sin(angle)[:, None], (1.0 - np.cos(angle))[:, None]
    along = np.cross(axis, v)
    # Translation part of the exponential: the left Jacobian applied to v t.
    shift = t[:, None] * v + versine / rate * along + (t[:, None] - sine / rate) * np.cross(axis, along)
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(points + sine * (points @ K.T) + versine * (points @ (K @ K).T) + shift)
