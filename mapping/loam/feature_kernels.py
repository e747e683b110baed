"""Curvature, reliability and choice of points along the rings of a sweep, compiled.

Zhang and Singh, "LOAM", RSS 2014, section V-A; thresholds as in the authors' program.
"""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled, compiled_part
from lidarslam.core.geometry import FloatArray

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


@compiled
def write_curvatures(points: FloatArray, rings: NDArray[np.intp], curvature: FloatArray) -> None:
    """Write the squared length (N,) of the sum of differences to ten neighbours on the ring; NaN at its ends.

    Args:
        points: (N, 3) ring after ring.
        rings: (N,) ascending.
        curvature: written, square metres.
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
    points: FloatArray, ranges: FloatArray, rings: NDArray[np.intp], curvature: FloatArray, edge_above: float,
    kinds: NDArray[np.int8],
) -> None:  # fmt: skip
    """Write whether points are edges, planar, or neither.

    Args:
        points, ranges: (N, 3) and (N,), ring after ring.
        rings, curvature: (N,) of the points.
        edge_above: threshold of the curvature, square metres; the others are planar where they are reliable.
        kinds: (N,) written.
    """
    free = np.empty(len(points), dtype=np.bool_)
    _write_reliable(points, ranges, rings, curvature, kinds, free)
    begin = 0
    for end in range(1, len(points) + 1):
        if end == len(points) or rings[end] != rings[begin]:
            for sector in range(_SECTORS):
                first = begin + (end - begin) * sector // _SECTORS
                last = begin + (end - begin) * (sector + 1) // _SECTORS
                _pick_edges(points, curvature, edge_above, first, last, free, kinds)
            begin = end


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
    """Mark the points of largest curvature of a sector [first, last) that are still free; exclude their neighbours."""
    picked = 0
    sharp = first + np.flatnonzero(curvature[first:last] > edge_above)
    for i in sharp[np.argsort(-curvature[sharp], kind="mergesort")]:
        if picked == _EDGES:
            break
        if not free[i]:
            continue
        kinds[i], free[i] = EDGE, False
        picked += 1
        for step in (-1, 1):
            for j in range(i, i + step * _REACH, step):
                if not 0 <= j + step < len(points) or _squared_distance(points[j], points[j + step]) > _APART_M2:
                    break
                free[j + step] = False


@compiled_part
def _squared_distance(p: FloatArray, q: FloatArray) -> float:
    return float((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
