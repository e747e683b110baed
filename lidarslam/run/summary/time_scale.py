"""Scale of the points' times, from how fast sensors turn within their sweeps and from scan to scan."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, inverse, log
from lidarslam.core.trajectory import Trajectory

# Turns that are slower, rad/s, and fewer scans decide nothing; of scans farther apart, a shaken sensor turns otherwise
# in between.
_LEAST_RATE, _FEWEST, _MOST_INTERVAL_S = np.deg2rad(5.0), 15, 0.15
# A share of the intervals by which they may differ.
_EVEN = 0.5
# Ratios with the right times: 0.99 to 1.19 on simulated and real recordings; with doubled ones 0.5 to 0.7.
_RIGHT = (0.75, 1.4)


def time_scale(
    trajectory: Trajectory, turn_rates: FloatArray, is_tracked: NDArray[np.bool_]
) -> tuple[float, int] | None:
    """Ratio of the turn rates within sweeps to those from scan to scan; one where the points' times are right.

    Args:
        trajectory: of N scans.
        turn_rates: (N, 3) rad/s within each sweep, in the LiDAR frame; NaN where unknown.
        is_tracked: (N,) whether the pose is right.

    Returns:
        It, and the number of scans that turned; None where too few did.
    """
    T, interval_s = trajectory.T_world_lidar, np.diff(trajectory.stamps)
    if len(T) < _FEWEST or np.median(interval_s) > _MOST_INTERVAL_S:
        return None
    rates = log(inverse(T[:-1]) @ T[1:])[:, :3] / interval_s[:, None]
    is_even = np.abs(interval_s / np.median(interval_s) - 1.0) < _EVEN
    is_even &= is_tracked[:-1] & is_tracked[1:]
    # A sweep may lie before or after its stamp.
    around, within = 0.5 * (rates[:-1] + rates[1:]), turn_rates[1:-1]
    turns = is_even[:-1] & is_even[1:] & np.isfinite(within).all(axis=1)
    turns &= np.linalg.norm(around, axis=1) > _LEAST_RATE
    if turns.sum() < _FEWEST:
        return None
    return float((within * around)[turns].sum() / (around[turns] ** 2).sum()), int(turns.sum())


def time_scale_warning(found: tuple[float, int] | None) -> str | None:
    """What a ratio says of the points' times; None where it is near one, or unknown."""
    if found is None or _RIGHT[0] < found[0] < _RIGHT[1]:
        return None
    ratio, scans = found
    fault = "backwards" if ratio < 0.0 else "too long" if ratio < 1.0 else "too short"
    return (
        f"the points' times are {fault}, as it seems: within the sweeps of {scans} scans the sensor turns {ratio:.2f}"
        " times as fast as from scan to scan; check reader.time_unit and reader.time_field, or correct them with"
        f" --set reader.time_scale={'-1' if ratio < 0.0 else 'FACTOR'}"
    )
