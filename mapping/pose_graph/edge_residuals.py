"""How far poses are from what edges measured."""

from collections.abc import Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, log
from mapping.pose_graph.g2o import Edge
from mapping.pose_graph.pose_graph_config import PoseGraphConfig

# A variance, in square radians or metres, that says as much as infinity.
_INFINITE = 1e20


class EdgeResiduals:
    """Edges as arrays, so that all of them are held against poses at once."""

    def __init__(self, edges: Sequence[Edge], keys: Sequence[int]) -> None:
        """`keys` (N,), increasing, are those of the poses that `squares` will be given."""
        ends = np.array([(edge.first, edge.second) for edge in edges], dtype=np.int64).reshape(-1, 2)
        self._first, self._second = np.searchsorted(np.asarray(keys, dtype=np.int64), ends).T
        self._T_second_first = inverse(np.array([edge.T_first_second for edge in edges]).reshape(-1, 4, 4))
        self._roots = np.linalg.cholesky(np.array([edge.covariance for edge in edges]).reshape(-1, 6, 6))

    def squares(self, poses: FloatArray) -> FloatArray:
        """(E,) squared Mahalanobis distances of poses (N, 4, 4) from each edge: chi-squared, 6 degrees of freedom."""
        found = inverse(poses[self._first]) @ poses[self._second]
        xi = log(self._T_second_first @ found)
        whitened = np.linalg.solve(self._roots, xi[..., None])[..., 0]
        return np.asarray((whitened**2).sum(axis=-1), dtype=np.float64)


def bounded(covariance: FloatArray, config: PoseGraphConfig) -> FloatArray:
    """The covariance (6, 6) made symmetric, its spread kept between the least and the largest that are allowed.

    Directions are compared in units of the least deviations, so that radians and metres can be mixed. An axis with an
    infinite entry is one of which nothing is known.

    Raises:
        ValueError: it is not (6, 6), or holds a NaN.
    """
    if covariance.shape != (6, 6) or np.isnan(covariance).any():
        raise ValueError(f"a covariance must be (6, 6) and without NaN, got {covariance.tolist()}")
    unit = np.array([np.deg2rad(config.least_rotation_deg)] * 3 + [config.least_translation_m] * 3)
    most = config.largest_ratio**2
    unknown = np.flatnonzero((np.abs(covariance) >= _INFINITE).any(axis=0))
    known = covariance.copy()
    known[unknown, :] = known[:, unknown] = 0.0
    scaled = 0.5 * (known + known.T) / np.outer(unit, unit)
    scaled[unknown, unknown] = most
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1.0 or values[-1] > most:
        scaled = (vectors * np.clip(values, 1.0, most)) @ vectors.T
    return np.asarray(0.5 * (scaled + scaled.T) * np.outer(unit, unit), dtype=np.float64)
