"""Large surfaces: walls and floors, as against people and cars that move along with the sensor."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, transform_points
from lidarslam.core.tracking import lever_scale
from lidarslam.mapping.registration.gauss_newton import geman_mcclure, point_to_plane_jacobian
from lidarslam.mapping.registration.local_map import LEVELS, LocalMap, Surfaces

# The plane of a point is part of a large one where the coarsest cell has a plane of nearly its normal, no thicker than
# this share of that cell.
_SAME_COSINE, _MOST_THICKNESS = 0.94, 0.08
# Large surfaces suffice where they constrain every direction this many times as well as the noise of their normals.
_SUFFICIENT = 15.0
# They contradict a pose from which they alone would move this many cells away. On recordings without crowds: below 0.1.
_CONTRADICTION_CELLS = 0.2
# Factor by which small surfaces are less certain then.
INFLATION = 6.0
_FEWEST = 100
_RANGE_NOISE_M, _SCALE_PER_MEDIAN = 0.02, 1.5


def are_large(local_map: LocalMap, points: FloatArray, normals: FloatArray, sensor: FloatArray) -> NDArray[np.bool_]:
    """Whether planes (N, 3) at points (N, 3) of the world, seen from (3,), are part of large ones."""
    coarse, spread_m = local_map.coarse_planes(points, sensor)
    is_thin = spread_m < _MOST_THICKNESS * local_map.cell_m * LEVELS[-1]
    return np.asarray(is_thin & (np.abs(np.einsum("ij,ij->i", normals, coarse)) > _SAME_COSINE))


def inflation_of_small(
    points: FloatArray, T_world_lidar: FloatArray, surfaces: Surfaces, local_map: LocalMap
) -> FloatArray | None:
    """Factors (N,) on the standard deviations of the points' surfaces, larger for small ones; None where these agree.

    Relative to a crowd that walks along, a sensor is at rest; only walls, floor and ceiling differ. In a bare
    corridor or a stairwell, large surfaces do not suffice for a pose, and small ones count in full. The points (N,
    3) of the LiDAR frame were registered at the pose (4, 4) to all surfaces with equal weight.
    """
    matched = np.flatnonzero(surfaces.counts)
    world, normals = transform_points(T_world_lidar, points[matched]), surfaces.normals[matched, 0]
    is_large = are_large(local_map, world, normals, T_world_lidar[:3, 3])
    large = matched[is_large]
    if len(large) < _FEWEST:
        return None
    world, normals = world[is_large], normals[is_large]
    residuals = np.einsum("ij,ij->i", world - surfaces.points[large], normals)
    variances = surfaces.thickness_m[large, 0] ** 2 + _RANGE_NOISE_M**2
    scale_m = _SCALE_PER_MEDIAN * np.median(np.abs(residuals))
    weights = geman_mcclure(residuals, scale_m**2 + variances, variances)
    scale = lever_scale(float(np.sqrt(np.mean(np.sum(points[large] ** 2, axis=1)))))
    jacobian = point_to_plane_jacobian(points[large], normals @ T_world_lidar[:3, :3]) / scale
    hessian = (jacobian * weights[:, None]).T @ jacobian
    if np.linalg.eigvalsh(hessian)[0] < _SUFFICIENT * float(weights @ surfaces.tilt[large, 0] ** 2):
        return None
    step_m = np.linalg.norm(np.linalg.solve(hessian, jacobian.T @ (weights * residuals)))
    if step_m < _CONTRADICTION_CELLS * local_map.cell_m:
        return None
    inflation = np.full(len(points), INFLATION)
    inflation[large] = 1.0
    return inflation
