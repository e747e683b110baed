"""Speed profiles along a way, from rest to rest or round and round: within limits, without jerks."""

import numpy as np
from scipy.interpolate import CubicSpline

from lidarslam.core.geometry import FloatArray

TIME_STEP_S = 0.01


def rest_to_rest(
    positions: FloatArray, speed_limits: FloatArray, acceleration: float, smoothing_s: float
) -> FloatArray:
    """Positions (N,) at steps of `TIME_STEP_S` on the quickest way that keeps the limits.

    The quickest way has constant acceleration between the limits; averaged in time over a window of `smoothing_s` to
    either side it keeps both limits on speed and acceleration (the average of what keeps a limit keeps it too), and
    its acceleration is continuous.

    Args:
        positions: (M,) increasing from 0.
        speed_limits: (M,) positive, at the positions.
        acceleration: of speeding up and slowing down.
        smoothing_s: half the window; the window's weights are (1 - x^2)^2.
    """
    limits = speed_limits.copy()
    limits[[0, -1]] = 0.0
    speeds = _within_acceleration(positions, limits, acceleration)
    times = _arrivals(positions, speeds)
    moments = TIME_STEP_S * np.arange(int(np.ceil(times[-1] / TIME_STEP_S)) + 1, dtype=np.float64)
    return smoothed(_travelled(positions, speeds, times, moments), smoothing_s, ends="rest")


def round_and_round(
    positions: FloatArray, speed_limits: FloatArray, acceleration: float, smoothing_s: float
) -> FloatArray:
    """As `rest_to_rest` for one lap of a closed way, whose last position is the first: at speed where it closes.

    The lap's time is rounded up to whole steps, all speeds that much lower.
    """
    lap = positions[-1]
    three = np.concatenate([positions[:-1], positions[:-1] + lap, positions + 2.0 * lap])
    limits = np.concatenate([speed_limits[:-1], speed_limits[:-1], speed_limits])
    middle = slice(len(positions) - 1, 2 * len(positions) - 1)
    speeds = _within_acceleration(three, limits, acceleration)[middle]
    times = _arrivals(positions, speeds)
    steps = int(np.ceil(times[-1] / TIME_STEP_S))
    travelled = _travelled(positions, speeds, times, float(times[-1]) / steps * np.arange(steps + 1, dtype=np.float64))
    smooth = smoothed(np.concatenate([travelled[:-1] - lap, travelled, travelled[1:] + lap]), smoothing_s)
    return np.asarray(smooth[steps : 2 * steps + 1] - smooth[steps])


def travelled_at(lengths: FloatArray, parameters: FloatArray, travelled: FloatArray) -> FloatArray:
    """Parameters (N,) of a path at travelled lengths (N,), from those (M,) at increasing lengths (M,); never back."""
    found = CubicSpline(lengths, parameters)(travelled)
    return np.clip(np.maximum.accumulate(found), parameters[0], parameters[-1])


def _within_acceleration(positions: FloatArray, speed_limits: FloatArray, acceleration: float) -> FloatArray:
    """The highest speeds (M,) within the limits (M,) that constant acceleration can reach and leave in time."""
    gain = 2.0 * acceleration * positions
    squares = gain + np.minimum.accumulate(speed_limits**2 - gain)
    squares = np.minimum.accumulate((squares + gain)[::-1])[::-1] - gain
    return np.asarray(np.sqrt(np.maximum(squares, 0.0)))


def _arrivals(positions: FloatArray, speeds: FloatArray) -> FloatArray:
    """Times (M,) at the positions (M,), from 0."""
    return np.concatenate([[0.0], np.cumsum(2.0 * np.diff(positions) / (speeds[:-1] + speeds[1:]))])


def _travelled(positions: FloatArray, speeds: FloatArray, times: FloatArray, moments: FloatArray) -> FloatArray:
    """Positions (N,) at moments (N,), with constant acceleration between the positions (M,)."""
    piece = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    since = np.minimum(moments, times[-1]) - times[piece]
    rise = np.diff(speeds)[piece] / np.diff(times)[piece]
    return np.asarray(positions[piece] + since * (speeds[piece] + 0.5 * rise * since))


def smoothed(values: FloatArray, half_width_s: float, ends: str = "same") -> FloatArray:
    """Values (N,) at steps of `TIME_STEP_S` averaged over a window of twice that width, the first and last held.

    Ends "same" keep the number of values; "rest" adds the window's width, so that the result starts and ends exactly
    at the first and last value.
    """
    n = max(round(half_width_s / TIME_STEP_S), 1)
    weights = (1.0 - (np.arange(-n, n + 1) / (n + 1.0)) ** 2) ** 2
    padded = np.pad(values, n if ends == "same" else 2 * n, mode="edge")
    return np.asarray(np.convolve(padded, weights / weights.sum(), mode="valid"))
