"""How fast along a way, from rest to rest: within limits, without jerks."""

import numpy as np
from scipy.interpolate import CubicSpline

from lidarslam.core.geometry import FloatArray

TIME_STEP_S = 0.01


def rest_to_rest(
    positions: FloatArray, speed_limits: FloatArray, acceleration: float, smoothing_s: float
) -> tuple[FloatArray, FloatArray]:
    """Positions (N,) and speeds (N,) at steps of `TIME_STEP_S` on the quickest way that keeps the limits.

    The quickest way has constant acceleration between the limits; averaged in time over a window of `smoothing_s` to
    either side it keeps both limits on speed and acceleration (the average of what keeps a limit keeps it too), and
    its acceleration is continuous.

    Args:
        positions: (M,) increasing from 0.
        speed_limits: (M,) positive, at the positions.
        acceleration: of speeding up and slowing down.
        smoothing_s: half the window; the window's weights are (1 - x^2)^2.
    """
    squares = speed_limits**2
    squares[[0, -1]] = 0.0
    gain = 2.0 * acceleration * positions
    squares = gain + np.minimum.accumulate(squares - gain)
    squares = np.minimum.accumulate((squares + gain)[::-1])[::-1] - gain
    speeds = np.sqrt(np.maximum(squares, 0.0))
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(positions) / (speeds[:-1] + speeds[1:]))])
    moments = TIME_STEP_S * np.arange(int(np.ceil(times[-1] / TIME_STEP_S)) + 1)
    piece = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    since = np.minimum(moments, times[-1]) - times[piece]
    rise = np.diff(speeds)[piece] / np.diff(times)[piece]
    travelled = positions[piece] + since * (speeds[piece] + 0.5 * rise * since)
    smooth = smoothed(travelled, smoothing_s, ends="rest")
    return smooth, np.gradient(smooth, TIME_STEP_S)


def smoothed(values: FloatArray, half_width_s: float, ends: str = "same") -> FloatArray:
    """Values (N,) averaged over a window of time.

    Args:
        values: at steps of `TIME_STEP_S`.
        half_width_s: half the window.
        ends: "same" keeps the number of values, taking those outside as the first and last; "rest" adds the window's
            width, so that the result starts and ends exactly at the first and last value.
    """
    n = max(round(half_width_s / TIME_STEP_S), 1)
    weights = (1.0 - (np.arange(-n, n + 1) / (n + 1.0)) ** 2) ** 2
    padding = n if ends == "same" else 2 * n
    padded = np.pad(values, padding, mode="edge")
    averaged = np.convolve(padded, weights / weights.sum(), mode="valid")
    return np.asarray(averaged)


def invert(values: FloatArray, positions: FloatArray) -> CubicSpline[np.float64]:
    """A smooth function from increasing values (M,) to the positions (M,) where they are taken."""
    return CubicSpline(values, positions)
