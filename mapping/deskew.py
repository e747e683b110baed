"""Motion compensation: every point of a sweep where it would have been seen at the scan's stamp."""

import numpy as np

from lidarslam.core.geometry import FloatArray, log


def deskew(points: FloatArray, time_offsets: FloatArray, T_prev_curr: FloatArray, interval_s: float) -> FloatArray:
    """Move points to the scan's stamp, assuming the motion since the previous scan went on through the sweep.

    A point seen at offset t lies at `exp(t / interval * log(T_prev_curr))` in the frame of the stamp.

    Args:
        points: (N, 3) as measured, each in the LiDAR frame of its own instant.
        time_offsets: (N,) seconds from the stamp.
        T_prev_curr: motion between the stamps of the previous scan and this one.
        interval_s: time between these stamps.
    """
    if not len(points) or interval_s <= 0.0:
        return points
    omega, v = np.split(log(T_prev_curr) / interval_s, 2)
    return _move(points, time_offsets, omega, v)


def _move(points: FloatArray, t: FloatArray, omega: FloatArray, v: FloatArray) -> FloatArray:
    """exp(t (omega, v)) applied point by point, without a matrix a point.

    The rotation is Rodrigues' formula about a common axis, so its three coefficients are all that differs.
    """
    rate = float(np.linalg.norm(omega))
    if rate * float(np.abs(t).max()) < 1e-9:
        return points + t[:, None] * v
    axis = omega / rate
    angle = rate * t
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    along = np.cross(axis, v)
    # Translation part of the exponential: the left Jacobian applied to v t.
    shift = t[:, None] * v + (versine / rate)[:, None] * along + (t - sine / rate)[:, None] * np.cross(axis, along)
    turned = np.cross(axis, points)
    return points + sine[:, None] * turned + versine[:, None] * np.cross(axis, turned) + shift
