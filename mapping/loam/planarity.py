"""Points on planes without knowledge of rings, for sensors that scan in no fixed pattern."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import one_per_cell

_NEIGHBOURS = 10
# Neighbourhoods are taken from a cloud with this many points to a voxel's edge, but not closer together than noise
# of a centimetre or two allows.
_FINER = 3.0
_CLOSEST_M = 0.1
# A neighbourhood lies on a plane when it is this much thinner than it is wide, and wider than a line.
_THINNEST_SHARE = 0.03
_LINE_SHARE = 0.1


def plane_cell_for(points: FloatArray) -> float:
    """A distance between planes that suits the scene: 1/25 of the median range of points (N, 3), 10 to 40 cm.

    LOAM and its descendants take 40 cm in streets and 20 cm indoors.
    """
    sampled = points[:: max(1, len(points) // 4096)]
    if not len(sampled):
        return 0.1
    return float(np.clip(np.median(np.linalg.norm(sampled, axis=1)) / 25.0, 0.1, 0.4))


def planar_points(points: FloatArray, cell_m: float) -> NDArray[np.intp]:
    """Indices, ascending, of points (N, 3), one in each voxel of this size, whose neighbours lie on a plane.

    A size of 0 takes all points.
    """
    from scipy.spatial import cKDTree

    if len(points) < _NEIGHBOURS:
        return np.empty(0, dtype=np.intp)
    thinned, chosen = np.arange(len(points)), np.arange(len(points))
    if cell_m > 0.0:
        thinned = one_per_cell(points, max(cell_m / _FINER, _CLOSEST_M))
        chosen = thinned[one_per_cell(points[thinned], cell_m)]
    if len(thinned) < _NEIGHBOURS:
        return np.empty(0, dtype=np.intp)
    cloud = points[thinned]
    _, neighbours = cKDTree(cloud).query(points[chosen], k=_NEIGHBOURS)
    around = cloud[neighbours]
    around -= around.mean(axis=1, keepdims=True)
    spread = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", around, around))
    planar = (spread[:, 0] < _THINNEST_SHARE * spread[:, 1]) & (spread[:, 1] > _LINE_SHARE * spread[:, 2])
    return np.asarray(chosen[planar], dtype=np.intp)
