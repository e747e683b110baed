"""Registration of two clouds of one place without an initial pose."""

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.evaluation.map.voxel_thinning import thin

# Cells across the target; features of both sizes propose a pose.
_CELLS_ACROSS = (80, 160)
_MOST_POINTS = 12_000
# Radii of the normals' and the features' neighbourhoods, in cells (the choice of Open3D's tutorials).
_NORMAL_CELLS, _FEATURE_CELLS, _INLIER_CELLS = 2.0, 5.0, 1.5
_LEAST_EDGE_RATIO = 0.9
_ITERATIONS, _CONFIDENCE = 50_000, 0.9999


def candidate_poses(source: FloatArray, target: FloatArray) -> list[FloatArray]:
    """Poses `T_target_source` (4, 4) good to a few cells, one for each of two cell sizes.

    Correspondences of FPFH features (Rusu, Blodow, Beetz, ICRA 2009) that are mutual nearest neighbours, and RANSAC on
    triples of them, by Open3D. On 16 turned maps of rooms, an office and a street, RANSAC found every pose, fast global
    registration (Zhou, Park, Koltun, ECCV 2016) 14.

    Args:
        source: (N, 3), about the origin.
        target: (M, 3), about the origin.
    """
    import open3d as o3d

    o3d.utility.random.seed(0)
    size_m = float(np.linalg.norm(np.ptp(target, axis=0)))
    return [_register(source, target, size_m / cells) for cells in _CELLS_ACROSS]


def _register(source: FloatArray, target: FloatArray, cell_m: float) -> FloatArray:
    import open3d as o3d

    clouds = thin(source, cell_m), thin(target, cell_m)
    while max(map(len, clouds)) > _MOST_POINTS:
        cell_m *= 1.2
        clouds = thin(source, cell_m), thin(target, cell_m)
    registration, described = o3d.pipelines.registration, []
    for points in clouds:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(_NORMAL_CELLS * cell_m, 30))
        # The sensor's path is unknown; a common direction is enough for a feature to be the same in both clouds.
        cloud.orient_normals_to_align_with_direction([0.0, 0.0, 1.0])
        neighbourhood = o3d.geometry.KDTreeSearchParamHybrid(_FEATURE_CELLS * cell_m, 100)
        described.append((cloud, registration.compute_fpfh_feature(cloud, neighbourhood)))  # type: ignore[call-arg]
    (moving, features), (still, target_features) = described
    inlier_m = _INLIER_CELLS * cell_m
    found = registration.registration_ransac_based_on_feature_matching(
        moving,
        still,
        features,
        target_features,
        True,
        inlier_m,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(_LEAST_EDGE_RATIO),
            registration.CorrespondenceCheckerBasedOnDistance(inlier_m),
        ],
        registration.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE),
    )
    return np.array(found.transformation, dtype=np.float64)
