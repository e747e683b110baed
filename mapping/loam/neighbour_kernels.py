"""Lines and planes through the neighbours of features in a map, compiled."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector


@compiled
def write_principal_axes(
    points: FloatArray, neighbours: NDArray[np.int32], which: int, means: FloatArray, variances: FloatArray,
    axes: FloatArray, farthest_m: FloatArray,
) -> None:  # fmt: skip
    """Write the mean, the variances and one principal axis of each of K sets of neighbours.

    Args:
        points: (N, 3).
        neighbours: (K, L) indices of points.
        which: principal axis, 0 of the smallest variance.
        means: (K, 3) written.
        variances: (K, 3) written, ascending.
        axes: (K, 3) written, unit.
        farthest_m: (K,) written, largest distance of a neighbour from the plane through the mean across the axis.
    """
    scatter, share = np.empty(6), 1.0 / neighbours.shape[1]
    for k in range(len(neighbours)):
        means[k], scatter[:], farthest_m[k] = 0.0, 0.0, 0.0
        for n in neighbours[k]:
            for axis in range(3):
                means[k, axis] += share * points[n, axis]
        for n in neighbours[k]:
            for entry in range(6):
                i, j = SYMMETRIC[entry]
                scatter[entry] += share * (points[n, i] - means[k, i]) * (points[n, j] - means[k, j])
        write_eigenvalues(scatter, variances[k])
        write_eigenvector(scatter, variances[k, which], axes[k])
        for n in neighbours[k]:
            distance = 0.0
            for axis in range(3):
                distance += (points[n, axis] - means[k, axis]) * axes[k, axis]
            farthest_m[k] = max(farthest_m[k], abs(distance))
