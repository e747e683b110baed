"""Two clouds of one place brought together without any guess."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from evaluation.map.voxel_thinning import thin
from lidarslam.core.geometry import FloatArray, make_transform, rotation_angle, transform_points

IntArray = NDArray[np.intp]

# Points that features are computed of, at most; the cells grow until there are no more.
_MOST_POINTS = 12_000
_CELLS_ACROSS = 80
# Radii of the normals' and the features' neighbourhoods, in cells (Rusu et al.; the choice of Open3D's tutorials).
_NORMAL_CELLS, _FEATURE_CELLS = 2.0, 5.0
_TRIPLES = 200_000
_MOST_HYPOTHESES = 2_000
# Lengths of corresponding sides of a triple may differ by this share.
_LEAST_RATIO = 0.9
_INLIER_CELLS = 1.5
_SCORED_POINTS = 4_000
# Poses that differ by less than both are one.
_SAME_ANGLE_RAD = np.deg2rad(8.0)
_SAME_PLACE_CELLS = 4.0


def candidate_poses(source: FloatArray, target: FloatArray, count: int = 4, seed: int = 0) -> list[FloatArray]:
    """Up to `count` different poses `T_target_source` (4, 4), the likeliest first, good to a few cells.

    Points are matched by their FPFH features (Rusu, Blodow, Beetz, "Fast Point Feature Histograms for 3D
    registration", ICRA 2009); triples of matches propose poses (RANSAC), which are judged by how much of the source
    comes to lie on the target. Tried with cells of two sizes. The same seed gives the same poses.

    Args:
        source: (N, 3), about the origin.
        target: (M, 3), about the origin.
        count: how many poses at most.
        seed: of the triples.
    """
    size_m = float(np.linalg.norm(np.ptp(target, axis=0)))
    found: list[tuple[float, FloatArray]] = []
    for cells_across in (_CELLS_ACROSS, 2 * _CELLS_ACROSS):
        cell_m = _cell_for(source, target, size_m / cells_across)
        found += _search(thin(source, cell_m), thin(target, cell_m), cell_m, np.random.default_rng(seed))
    distinct: list[FloatArray] = []
    for _, T in sorted(found, key=lambda scored: -scored[0]):
        if not any(is_same(T, other, _SAME_PLACE_CELLS * size_m / _CELLS_ACROSS) for other in distinct):
            distinct.append(T)
    return distinct[:count]


def is_same(T_a: FloatArray, T_b: FloatArray, distance_m: float) -> bool:
    """Whether two poses (4, 4) of one cloud about the origin are one up to the given distance and 8 degrees."""
    angle = float(rotation_angle(T_a[:3, :3].T @ T_b[:3, :3]))
    return angle < _SAME_ANGLE_RAD and float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])) < distance_m


def _cell_for(source: FloatArray, target: FloatArray, cell_m: float) -> float:
    while max(len(thin(source, cell_m)), len(thin(target, cell_m))) > _MOST_POINTS:
        cell_m *= 1.2
    return cell_m


def _search(
    source: FloatArray, target: FloatArray, cell_m: float, rng: np.random.Generator
) -> list[tuple[float, FloatArray]]:
    """Poses and the share of the source that lies on the target with each."""
    matches = _matches(_features(source, cell_m), _features(target, cell_m))
    if len(matches) < 3:
        return []
    p, q = source[matches[:, 0]], target[matches[:, 1]]
    proposed = _propose(p, q, rng)
    inliers = np.array([(np.linalg.norm(transform_points(T, p) - q, axis=1) < 2.0 * cell_m).sum() for T in proposed])
    best = np.argsort(-inliers, kind="stable")[:64]
    tree = cKDTree(target)
    judged = source[:: max(1, len(source) // _SCORED_POINTS)]
    return [(_share_on(tree, transform_points(proposed[i], judged), _INLIER_CELLS * cell_m), proposed[i]) for i in best]


def _features(points: FloatArray, cell_m: float) -> FloatArray:
    """FPFH features (N, 33) of points (N, 3)."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(_NORMAL_CELLS * cell_m, 30))
    # The path is unknown; one common side is enough for a feature to be the same in both clouds.
    cloud.orient_normals_to_align_with_direction([0.0, 0.0, 1.0])
    neighbourhood = o3d.geometry.KDTreeSearchParamHybrid(_FEATURE_CELLS * cell_m, 100)
    features = o3d.pipelines.registration.compute_fpfh_feature(  # type: ignore[call-arg] # the stub lacks the defaults
        cloud, neighbourhood
    )
    return np.asarray(features.data, dtype=np.float64).T


def _matches(source: FloatArray, target: FloatArray) -> IntArray:
    """Pairs (K, 2) of points whose features are each other's nearest."""
    nearest = np.asarray(cKDTree(target).query(source, workers=-1)[1], dtype=np.intp)
    back = np.asarray(cKDTree(source).query(target, workers=-1)[1], dtype=np.intp)
    mutual = np.flatnonzero(back[nearest] == np.arange(len(source)))
    return np.stack([mutual, nearest[mutual]], axis=1)


def _propose(p: FloatArray, q: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Poses (H, 4, 4) that take triples of p (K, 3) to those of q (K, 3), for triples of the same shape."""
    triples = rng.integers(0, len(p), (_TRIPLES, 3))
    sides = [np.linalg.norm(c[triples] - c[np.roll(triples, 1, axis=1)], axis=2) for c in (p, q)]
    shorter, longer = np.minimum(*sides), np.maximum(*sides)
    alike = (shorter > _LEAST_RATIO * longer).all(axis=1) & (shorter.min(axis=1) > 0.0)
    # Large triangles fix the rotation best.
    chosen = np.flatnonzero(alike)
    chosen = chosen[np.argsort(-shorter[chosen].min(axis=1), kind="stable")][:_MOST_HYPOTHESES]
    return _fit(p[triples[chosen]], q[triples[chosen]])


def _fit(p: FloatArray, q: FloatArray) -> FloatArray:
    """Least-squares rigid transforms (H, 4, 4) that take p (H, 3, 3 coordinates) to q (Arun et al., PAMI 1987)."""
    centre_p, centre_q = p.mean(axis=1), q.mean(axis=1)
    covariance = np.swapaxes(q - centre_q[:, None], 1, 2) @ (p - centre_p[:, None])
    U, _, Vt = np.linalg.svd(covariance)
    U = np.array(U)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return make_transform(R, centre_q - (R @ centre_p[:, :, None])[:, :, 0])


def _share_on(tree: cKDTree, points: FloatArray, distance_m: float) -> float:
    distances, _ = tree.query(points, distance_upper_bound=distance_m, workers=-1)
    return float(np.isfinite(distances).mean())
