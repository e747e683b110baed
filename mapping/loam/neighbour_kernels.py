"""Principal axes of the neighbours of features in a map, compiled."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.compiled import compiled
from lidarslam.core.geometry import FloatArray
from mapping.surfels.symmetric import SYMMETRIC, write_eigenvalues, write_eigenvector


@compiled
def write_principal_axes(
    points: FloatArray, neighbours: NDArray[np.int32], which: int, means: FloatArray, variances: FloatArray,
    axes: FloatArray,
) -> None:  # fmt: skip
    """Write the means (K, 3), variances (K, 3), ascending, and one principal axis (K, 3) of neighbours (K, L).

    Args:
        points: (N, 3) that the neighbours are indices of.
        neighbours: indices.
        which: principal axis, 0 of the smallest variance.
        means, variances, axes: written.
    """
    scatter = np.empty(6)
    for k in range(len(neighbours)):
        share = 1.0 / neighbours.shape[1]
        means[k] = 0.0
        scatter[:] = 0.0
        for n in neighbours[k]:
            for axis in range(3):
                means[k, axis] += share * points[n, axis]
        for n in neighbours[k]:
            for entry in range(6):
                i, j = SYMMETRIC[entry]
                scatter[entry] += share * (points[n, i] - means[k, i]) * (points[n, j] - means[k, j])
        write_eigenvalues(scatter, variances[k])
        write_eigenvector(scatter, variances[k, which], axes[k])
