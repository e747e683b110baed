"""The points of a sweep, ring after ring in the order of measurement."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan

# A cloud is stored ring after ring when nearly all azimuths run in one sense, over at least this many rings.
_SAME_WAY, _FEWEST_RINGS = 0.95, 4
# Width of the bins of elevation in which rings are peaks, and least height of a peak as a share of the mean.
_BIN_RAD, _LEAST_PEAK = np.deg2rad(0.05), 0.5
# Without peaks, rows of this height.
_ROW_RAD = np.deg2rad(0.5)


def ring_order(scan: Scan) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Sort the points of a sweep by ring, and within a ring in the order of measurement.

    The rings are those of the recording. Where it has none, they are found in a cloud that is stored ring after ring,
    as KITTI's, and else from the peaks of the elevations. Points without times are taken as stored, or by azimuth.

    Returns:
        Indices (N,) of the points, and the ring (N,) of each of these, ascending.
    """
    if scan.rings is not None:
        order = _by_ring(scan.rings.astype(np.int16), scan.time_offsets)
        return order, scan.rings[order].astype(np.intp)
    rings = _stored_rings(scan.points)
    if rings is not None:
        return np.arange(len(scan)), rings
    x, y, z = scan.points.T
    rings = _rings_of(np.arctan2(z, np.hypot(x, y)))
    order = np.lexsort((np.arctan2(y, x) if scan.time_offsets is None else scan.time_offsets, rings))
    return order, rings[order]


def _by_ring(rings: NDArray[np.int16], times: FloatArray | None) -> NDArray[np.intp]:
    """Order of points by ring, then by time.

    Most sensors deliver the points of a ring in order: then a stable sort by ring, a tenth of the time, is the same.
    """
    order = np.argsort(rings, kind="stable")
    if times is None:
        return order
    backwards = np.diff(times[order]) < 0.0
    return np.lexsort((times, rings)) if (backwards & (np.diff(rings[order]) == 0)).any() else order


def _stored_rings(points: FloatArray) -> NDArray[np.intp] | None:
    """Rings (N,) of points (N, 3) that are stored ring after ring; None for any other order.

    A ring begins straight ahead or straight behind, wherever the elevation steps more.
    """
    x, y = points[:, 0], points[:, 1]
    turned = x[:-1] * y[1:] - y[:-1] * x[1:]  # the sign of the step in azimuth
    crossings = np.flatnonzero(np.signbit(y[1:]) != np.signbit(y[:-1]))
    one_way = max(np.mean(turned > 0.0), np.mean(turned < 0.0)) if len(turned) else 0.0
    ahead = x[crossings] > 0.0
    if one_way < _SAME_WAY or min(ahead.sum(), (~ahead).sum()) < _FEWEST_RINGS:
        return None
    elevations = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (points[crossings], points[crossings + 1])]
    steps = np.abs(elevations[1] - elevations[0])
    ends = crossings[ahead == (np.median(steps[ahead]) > np.median(steps[~ahead]))]
    begins = np.zeros(len(points), dtype=np.intp)
    begins[ends + 1] = 1
    return np.cumsum(begins)


def _rings_of(elevations: FloatArray) -> NDArray[np.intp]:
    """Rings (N,) by the nearest peak of the histogram of elevations; even rows where there are no peaks."""
    from scipy.signal import find_peaks  # loads much of SciPy, and few recordings lack rings

    bins = np.arange(-0.5 * np.pi, 0.5 * np.pi + _BIN_RAD, _BIN_RAD)
    counts = np.histogram(elevations, bins)[0]
    smooth = np.convolve(counts, [0.25, 0.5, 0.25], "same")
    least = _LEAST_PEAK * smooth[smooth > 0.0].mean() if len(elevations) else 1.0
    peaks = bins[find_peaks(smooth, height=least)[0]] + 0.5 * _BIN_RAD
    if len(peaks) < _FEWEST_RINGS:
        peaks = np.arange(-0.5 * np.pi, 0.5 * np.pi, _ROW_RAD)
    return np.searchsorted(0.5 * (peaks[1:] + peaks[:-1]), elevations)
