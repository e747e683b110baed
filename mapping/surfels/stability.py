"""Geometrically stable sampling: the points of a scan that constrain directions that few others do.

The few points on the faces of boxes along a corridor determine its length, and an even sample has hardly any of them.
After Gelfand et al., "Geometrically Stable Sampling for the ICP Algorithm" (3DIM 2003), which sorts points by each
eigenvector of the information matrix; here by their statistical leverage, which is the same for all directions at once.
"""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.tracking import lever_scale
from lidarslam.mapping.registration.gauss_newton import point_to_plane_jacobian
from lidarslam.mapping.registration.local_map import Surfaces
from lidarslam.mapping.surfels.grid import SurfelGrid
from lidarslam.mapping.surfels.surfel_kernels import write_views
from lidarslam.mapping.surfels.surfel_map import match_planes

# Cells of a single scan's surfels, in cells of the map.
_CELLS = 2.0
# Points whose leverage exceeds the mean by this factor constrain a direction that few others do.
_MANIFOLD = 10.0
_RIDGE = 1e-4


def constraining_points(points: FloatArray, elevations: FloatArray, cell_m: float, most: int) -> NDArray[np.intp]:
    """Indices of the at most `most` points (N, 3) with by far the most leverage on a scan's registration, ascending.

    The points, in the LiDAR frame, have elevations (N,) above the sensor's equator, radians.
    """
    points, origin = np.ascontiguousarray(points), np.zeros(3)
    views = np.empty((len(points), 3), dtype=np.float32)
    write_views(points, origin, views)
    grid = SurfelGrid(_CELLS * cell_m)
    grid.insert(points, elevations, views)
    rows, surfaces = grid.find(points), Surfaces.none(len(points))
    spread_m = np.empty(len(points))
    match_planes(points, np.arange(len(points)), rows, grid.refreshed(rows), origin, spread_m, np.inf, surfaces)
    planar = np.flatnonzero(surfaces.counts)
    if not len(planar):
        return planar
    on_planes, normals = points.take(planar, axis=0), surfaces.normals[planar, 0]
    lever_m = float(np.sqrt(np.einsum("ij,ij->i", on_planes, on_planes).mean()))
    jacobian = point_to_plane_jacobian(on_planes, normals) / lever_scale(lever_m)
    information = jacobian.T @ jacobian / len(planar) + _RIDGE * np.eye(6)
    leverage = np.einsum("ij,ij->i", jacobian @ np.linalg.inv(information), jacobian)
    eligible = np.flatnonzero(leverage > _MANIFOLD * 6.0)
    chosen = eligible[np.argsort(leverage[eligible])[::-1][:most]]
    return np.sort(planar[chosen])
