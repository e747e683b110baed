"""Scans from arrays, which are checked before they are used."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.mounting import corrected, transform_of

# More columns than any point has are many points.
_MOST_COLUMNS = 32
# No sweep lasts longer, and no clock reading is smaller.
_LONGEST_OFFSET_S = 10.0
# Of a cloud as KITTI stores it: x, y, z, intensity.
_WITH_INTENSITY = 4
# Larger numbers, thousands of years, are not in seconds.
_LATEST_STAMP_S = 1e11
# Stamps jitter; a sweep that is longer than this many intervals between stamps has other units.
_MOST_INTERVALS = 4.0


def make_scan(points: ArrayLike, point_times: ArrayLike | None, stamp: float, config: ReaderConfig) -> Scan:
    """A scan, of copies, in upright axes, without the invalid points: NaN, at the origin, beyond 10 km.

    Args:
        points: (N, 3) x, y, z in metres; (N, 4) with the intensity; more columns, of which only x, y, z are taken; or
            a cloud of Open3D.
        point_times: (N,) seconds from the stamp.
        stamp: seconds.
        config: mounting of the points' axes, of which auto is upright; elevation correction; scale of the times.

    Raises:
        InputError: an array has another shape, or a time is not in seconds.
    """
    table = _numbers("points", getattr(points, "points", points))
    if not table.size:
        table = np.empty((0, 3))
    if table.ndim != 2 or not 3 <= table.shape[1] <= _MOST_COLUMNS:
        raise InputError(f"points must be (N, 3), x, y, z first, got the shape {table.shape}; give points.T of (3, N)")
    times = None if point_times is None else _times(point_times, len(table))
    intensities = np.array(table[:, 3]) if table.shape[1] == _WITH_INTENSITY else None
    scan = Scan.from_raw(np.array(table[:, :3], dtype=np.float64), stamp, times, intensities=intensities)
    return corrected(scan, transform_of(config.mounting), config.raised_deg(), config.time_scale)


def make_vector(name: str, numbers: ArrayLike) -> FloatArray:
    """Three finite numbers (3,), copied; InputError where they are something else."""
    vector = np.array(_numbers(name, numbers), dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{name} must be three finite numbers, got {numbers!r}")
    return vector


def check_stamp(stamp: float, last: float | None) -> float:
    """The stamp in seconds; InputError where it is no number of seconds, or not after the last one."""
    seconds = _numbers("stamp", stamp)
    if seconds.shape or not abs(seconds) <= _LATEST_STAMP_S:
        raise InputError(f"stamp must be a finite number of seconds, got {stamp!r}; multiply nanoseconds by 1e-9")
    if last is not None and seconds <= last:
        raise InputError(
            f"stamps must increase: {seconds:.9f} s is not after the scan before, {last:.9f} s; leave it out"
        )
    return float(seconds)


def check_sweep(scan: Scan, interval_s: float) -> None:
    """Refuse a sweep that is much longer than the longest time between two stamps so far."""
    if scan.time_offsets is None or not len(scan):
        return
    sweep_s = float(np.ptp(scan.time_offsets))
    if sweep_s > _MOST_INTERVALS * interval_s:
        raise InputError(
            f"point_times span {sweep_s:.3g} s, but scans are {interval_s:.3g} s apart; expected are seconds from the"
            " stamp: multiply times from 0 to 1 by the duration of a sweep"
        )


def _times(point_times: ArrayLike, count: int) -> FloatArray:
    seconds = np.array(_numbers("point_times", point_times).reshape(-1), dtype=np.float64)
    if len(seconds) != count:
        raise InputError(f"point_times must have one entry a point, got {len(seconds)} for {count} points")
    largest = float(np.abs(seconds[np.isfinite(seconds)]).max(initial=0.0))
    if largest > _LONGEST_OFFSET_S:
        raise InputError(
            f"point_times must be seconds from the stamp, fractions of one; got up to {largest:.6g}: subtract the stamp"
            " from absolute times, and multiply nanoseconds by 1e-9, microseconds by 1e-6"
        )
    return seconds


def _numbers(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} must be numbers, got {array.dtype}")
    return array
