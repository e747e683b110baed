"""Edge and planar features of a sweep by curvature along its rings, and the choice of those that are registered.

Zhang and Singh, "LOAM", RSS 2014, section V-A; thresholds as in the authors' program."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.thinning import central_per_cell, evenly, one_per_cell
from lidarslam.mapping.motion.deskew import Sweep
from lidarslam.mapping.registration.sampled_scan import MAP_SPACING, MOST_SPACING_M, Sampler

EDGE, PLANE = 1, 2
# Neighbours to either side that the curvature of a point is of, and that a chosen point excludes.
_REACH = 5
# Sectors of a ring, and the most edges of one.
_SECTORS, _EDGES = 6, 20
# Squared distance of neighbours on a ring across which no point is excluded.
_APART_M2 = 0.05
# Occlusion: squared distance of neighbours on a ring, and distance of their directions.
_GAP_M2, _BESIDE = 0.1, 0.1
# Surfaces nearly parallel to the beam: squared distances of both neighbours per squared range.
_PARALLEL = 0.0002
# Largest number of edges that are registered, and their spacing in cells.
_MOST_EDGES, _EDGE_SPACING = 1000, 1.0
# Curvature above which a point is an edge, square metres: that of the authors' program. All others are planar.
_CURVATURE_M2 = 0.1
# An edge needs this many times the median curvature of its sector as well, three standard deviations of the noise. Flat
# surfaces seen with a range noise of more than one centimetre exceed the published threshold all over, and so does
# rough ground seen at a grazing angle; these edges, on rings that move with the sensor, hold it back.
_ABOVE_NOISE = 20.0
# The median is taken over about so many of its points.
_SAMPLED = 64
# A cloud is stored ring after ring when nearly all azimuths run in one sense, over at least this many rings.
_SAME_WAY, _FEWEST_RINGS = 0.95, 4
# Width of the bins of elevation in which rings are peaks, and least height of a peak as a share of the mean.
_BIN_RAD, _LEAST_PEAK = np.deg2rad(0.05), 0.5
# Without peaks, rows of this height.
_ROW_RAD = np.deg2rad(0.5)


@compiled
def write_curvatures(points: FloatArray, rings: NDArray[np.intp], curvature: FloatArray) -> None:
    """Write the squared length (N,), m^2, of the sum of differences to ten neighbours on the ring; NaN at its ends.

    Points (N, 3) are in the order of their rings (N,).
    """
    for i in range(len(points)):
        curvature[i] = np.nan
        if i < _REACH or i + _REACH >= len(points) or rings[i - _REACH] != rings[i + _REACH]:
            continue
        squared = 0.0
        for axis in range(3):
            total = -(2 * _REACH + 1) * points[i, axis]
            for j in range(i - _REACH, i + _REACH + 1):
                total += points[j, axis]
            squared += total * total
        curvature[i] = squared


@compiled
def classify(
    points: FloatArray, ranges: FloatArray, rings: NDArray[np.intp], curvature: FloatArray, above_noise: float,
    kinds: NDArray[np.int8],
) -> None:  # fmt: skip
    """Write whether points (N, 3), ring after ring, are edges, planar, or neither.

    An edge needs `above_noise` times the median curvature of its sector; others are planar where they are reliable.
    """
    free = np.empty(len(points), dtype=np.bool_)
    _write_reliable(points, ranges, rings, curvature, kinds, free)
    begin = 0
    for end in range(1, len(points) + 1):
        if end == len(points) or rings[end] != rings[begin]:
            for sector in range(_SECTORS):
                first = begin + (end - begin) * sector // _SECTORS
                last = begin + (end - begin) * (sector + 1) // _SECTORS
                edge_above = max(_CURVATURE_M2, above_noise * _median(curvature[first:last]))
                _pick_edges(points, curvature, edge_above, first, last, free, kinds)
            begin = end


@compiled_part
def _median(values: FloatArray) -> float:
    """Of a sample of those that are finite; 0 where none is."""
    sample = values[:: max(1, len(values) // _SAMPLED)]
    known = sample[np.isfinite(sample)]
    return float(np.median(known)) if len(known) else 0.0


@compiled_part
def _write_reliable(
    points: FloatArray, ranges: FloatArray, rings: NDArray[np.intp], curvature: FloatArray, kinds: NDArray[np.int8],
    free: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Write which points are planar, those neither alone nor on a surface nearly parallel to the beam.

    Of these, `free` (N,) may be edges, as no nearer surface may hide a part of their own.
    """
    before = np.inf  # squared distance of the last point
    kinds[:], free[:] = 0, True
    for i in range(len(points)):
        after, beside = np.inf, np.inf
        if i + 1 < len(points) and rings[i + 1] == rings[i]:
            after, beside = 0.0, 0.0
            for axis in range(3):
                after += (points[i + 1, axis] - points[i, axis]) ** 2
                beside += (points[i + 1, axis] / ranges[i + 1] - points[i, axis] / ranges[i]) ** 2
        if after > _GAP_M2 and beside < _BESIDE**2:
            first = i - _REACH if ranges[i] > ranges[i + 1] else i + 1
            for j in range(max(first, 0), min(first + _REACH + 1, len(points))):
                free[j] = False
        if min(before, after) <= _PARALLEL * ranges[i] ** 2 and curvature[i] < np.inf:
            kinds[i] = PLANE
        before = after
    for i in range(len(points)):
        free[i] = free[i] and kinds[i] == PLANE


@compiled_part
def _pick_edges(
    points: FloatArray, curvature: FloatArray, edge_above: float, first: int, last: int, free: NDArray[np.bool_],
    kinds: NDArray[np.int8],
) -> None:  # fmt: skip
    """Mark the points of largest curvature of a sector [first, last) that are still free; exclude their neighbours.

    Those of an unreliable point are excluded, too: seen at a grazing angle, the last point of a wall is one, and those
    before it have its gap among their neighbours. As edges, they would follow the sensor.
    """
    picked = 0
    sharp = first + np.flatnonzero(curvature[first:last] > edge_above)
    for i in sharp[np.argsort(-curvature[sharp], kind="mergesort")]:
        if picked == _EDGES:
            break
        if free[i]:
            kinds[i], free[i] = EDGE, False
            picked += 1
        elif kinds[i] != 0:  # next to an edge, or hidden in part
            continue
        for step in (-1, 1):
            for j in range(i, i + step * _REACH, step):
                if not 0 <= j + step < len(points) or squared_distance(points[j], points[j + step]) > _APART_M2:
                    break
                free[j + step] = False


@compiled_part
def squared_distance(p: FloatArray, q: FloatArray) -> float:
    """Of two points (3,)."""
    return float((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


class FeatureSampler(Sampler):
    """Edges and planar points."""

    @property
    def _most_cell_m(self) -> float:
        return MOST_SPACING_M

    def _choose(self, scan: Scan, cell_m: float) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
        if self._has_rings is not False:
            order, kinds = find_features(scan)
        else:  # the ends of strokes are no edges, and points that lie on no plane find none in the map
            order, kinds = np.arange(len(scan)), np.full(len(scan), PLANE, dtype=np.int8)
        chosen = []
        for kind in (EDGE, PLANE):
            features = order.take(np.flatnonzero(kinds == kind))
            chosen.append(features.take(one_per_cell(scan.points.take(features, axis=0), MAP_SPACING * cell_m)))
        return np.concatenate(chosen), np.repeat(np.array([EDGE, PLANE], dtype=np.int8), [len(part) for part in chosen])

    def _keypoints(self, sweep: Sweep, cell_m: float) -> NDArray[np.intp]:
        assert sweep.kinds is not None
        edges, planes = (np.flatnonzero(sweep.kinds == kind) for kind in (EDGE, PLANE))
        edges = edges.take(central_per_cell(sweep.points.take(edges, axis=0), _EDGE_SPACING * cell_m))
        edges = evenly(edges, _MOST_EDGES)
        return np.concatenate([edges, planes.take(super()._keypoints(sweep.take(planes), cell_m))])


def find_features(scan: Scan) -> tuple[NDArray[np.intp], NDArray[np.int8]]:
    """The sharpest points of each sector of a ring, and all others that are reliable.

    Returns:
        Indices (N,) of the scan's points, ring after ring, and whether each is `EDGE`, `PLANE` or neither, 0.
    """
    order, rings = ring_order(scan)
    points = scan.points.take(order, axis=0)
    ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
    curvature, kinds = np.empty(len(points)), np.empty(len(points), dtype=np.int8)
    write_curvatures(points, rings, curvature)
    classify(points, ranges, rings, curvature, _ABOVE_NOISE, kinds)
    return order, kinds


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
