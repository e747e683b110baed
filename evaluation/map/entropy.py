"""Mean map entropy: crispness of a map, without a reference."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.thinning import first_per_cell

# Of a neighbourhood, and the edge of the cells that the map is thinned to: entropies are comparable with the same two.
RADIUS_M, SPACING_M = 0.3, 0.05
# Sampled neighbourhoods; the standard error of their mean is a hundredth.
MOST_SAMPLES = 50_000

# Of a sampled map: points, the edge of a block, and a hash of its coordinates (Teschner et al., VMV 2003; Knuth).
MOST_POINTS = 500_000
_BLOCK_M = 10.0
_PRIMES = np.array([73_856_093, 19_349_669])
_GOLDEN, _BITS = 2_654_435_761, 0xFFFF_FFFF
_QUICK_SAMPLES = 10_000

# Fewer neighbours do not determine a covariance.
_FEWEST_NEIGHBOURS = 5
# Standard deviation added in every direction, as the entropy of a flawless plane is -inf.
_RESOLUTION_M = 1e-3
# Neighbourhoods held in memory at a time, of at most some 900 points each of this radius and spacing.
_CHUNK = 4_000


@dataclass(frozen=True)
class MapEntropy:
    """Mean entropy of the neighbourhoods of a map's points; lower is crisper."""

    mean: float  # in nats; comparable between maps of the same place
    points: int  # number of neighbourhoods

    def to_json(self) -> dict[str, float | int]:
        """The entropy in metrics.json."""
        return {"mean_map_entropy": self.mean, "radius_m": RADIUS_M, "spacing_m": SPACING_M, "points": self.points}


def map_entropy(points: FloatArray, most_samples: int = MOST_SAMPLES) -> MapEntropy | None:
    """The mean of `ln(det(2 pi e S)) / 2` over the map's points (N, 3), S the covariance of the points around each.

    Droeschel, Stückler, Behnke, "Local multi-resolution representation for 6D motion estimation and mapping with a
    continuously rotating 3D laser scanner", ICRA 2014, with a spread of 1 mm added in every direction. The map is
    thinned first; of a large map an even sample of the points is taken, each with all its neighbours. None when no
    point has enough neighbours.
    """
    thinned = first_per_cell(points, SPACING_M)
    if len(thinned) < _FEWEST_NEIGHBOURS:
        return None
    import open3d as o3d

    thinned = thinned - thinned.mean(axis=0)
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(thinned))
    search.fixed_radius_index(RADIUS_M)
    sample = thinned[:: max(1, -(-len(thinned) // most_samples))]
    entropies = []
    for start in range(0, len(sample), _CHUNK):
        centres = sample[start : start + _CHUNK].copy()
        found, _, ends = search.fixed_radius_search(o3d.core.Tensor.from_numpy(centres), RADIUS_M, False)
        counts = np.diff(ends.numpy())
        entropies.append(_entropies(centres, thinned[found.numpy()], counts)[counts >= _FEWEST_NEIGHBOURS])
    values = np.concatenate(entropies)
    return MapEntropy(float(values.mean()), len(values)) if len(values) else None


def sampled_map_entropy(points: FloatArray, most_points: int = MOST_POINTS) -> MapEntropy | None:
    """`map_entropy` of whole blocks of a map, in a second or two whatever its size.

    Blocks of 10 m on the ground are drawn by a hash of their position: of two maps of one place the same ones.
    """
    share = most_points / max(1, len(points))
    if share < 1.0:
        cells = np.floor(points[:, :2] / _BLOCK_M).astype(np.int64)
        drawn = (cells @ _PRIMES) * _GOLDEN & _BITS
        points = points[drawn < share * _BITS]
    return map_entropy(points, most_samples=_QUICK_SAMPLES)


def _entropies(centres: FloatArray, neighbours: FloatArray, counts: NDArray[np.int64]) -> FloatArray:
    """The entropy (N,) around each centre (N, 3) from the neighbours of all, one after the other, and their counts."""
    offsets = neighbours - np.repeat(centres, counts, axis=0)  # small, so that squares keep their digits
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    share = 1.0 / counts[:, None]
    mean = np.add.reduceat(offsets, starts) * share
    upper = [(i, j) for i in range(3) for j in range(i, 3)]
    covariance = np.empty((len(centres), 3, 3))
    for i, j in upper:
        product = np.add.reduceat(offsets[:, i] * offsets[:, j], starts) * share[:, 0] - mean[:, i] * mean[:, j]
        covariance[:, i, j] = covariance[:, j, i] = product
    covariance += _RESOLUTION_M**2 * np.eye(3)
    _, log_determinant = np.linalg.slogdet(2.0 * np.pi * np.e * covariance)
    return np.asarray(0.5 * log_determinant, dtype=np.float64)
