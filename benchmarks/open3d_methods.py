"""Open3D's methods for steps that the project implements itself."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, adjoint
from lidarslam.mapping.loops.verification import CORRELATION, SubmapCloud

POINT_TO_PLANE, GENERALISED, MULTI_SCALE = "point-to-plane ICP", "generalised ICP", "multi-scale ICP"
# Number of planes that `refine` fits on both sides.
_SOURCE_POINTS = 6000
_PLANE_POINTS = 12
_CRITERIA = (1e-6, 1e-6, 30)


def planes_of(cloud: SubmapCloud) -> Any:
    """Points of a submap on planes, with their normals."""
    made = _cloud(cloud.points[~cloud.is_line])
    made.normals = o3d.utility.Vector3dVector(cloud.axes[~cloud.is_line])
    return made


def dense_clouds(target: FloatArray, source: FloatArray, kind: str) -> tuple[Any, Any]:
    """Both clouds with the normals that a method needs, the source with as many points as `refine` has residuals."""
    clouds = _cloud(target), _cloud(source)
    for cloud in clouds if kind == GENERALISED else clouds[:1]:
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_PLANE_POINTS))
    return clouds[0], clouds[1].uniform_down_sample(max(1, len(source) // _SOURCE_POINTS))


def icp(
    kind: str, target: Any, source: Any, T: FloatArray, levels: Sequence[tuple[float, float]], cell_m: float
) -> FloatArray:
    """`T_target_source` (4, 4); levels are gates and scales of the Geman-McClure kernel in cells."""
    if kind == MULTI_SCALE:
        return _multi_scale(target, source, T, levels, cell_m)
    module = o3d.pipelines.registration
    for gate, scale in levels:
        kernel, criteria = module.GMLoss((scale * cell_m) ** 2), module.ICPConvergenceCriteria(*_CRITERIA)
        if kind == GENERALISED:
            by_planes = module.TransformationEstimationForGeneralizedICP(1e-3, kernel)
            found = module.registration_generalized_icp(source, target, gate * cell_m, T, by_planes, criteria)
        else:
            to_planes = module.TransformationEstimationPointToPlane(kernel)
            found = module.registration_icp(source, target, gate * cell_m, T, to_planes, criteria)
        T = np.array(found.transformation, dtype=np.float64)
    return T


def _multi_scale(
    target: Any, source: Any, T: FloatArray, levels: Sequence[tuple[float, float]], cell_m: float
) -> FloatArray:
    """One kernel for all levels, that of the last."""
    module = o3d.t.pipelines.registration
    method = module.robust_kernel.RobustKernelMethod.GMLoss
    kernel = module.robust_kernel.RobustKernel(method, (levels[-1][1] * cell_m) ** 2, 0.0)
    clouds = [o3d.t.geometry.PointCloud.from_legacy(one, o3d.core.float64) for one in (source, target)]
    found = module.multi_scale_icp(
        *clouds,
        o3d.utility.DoubleVector([*(0.5 * gate * cell_m for gate, _ in levels[:-1]), -1.0]),
        [module.ICPConvergenceCriteria(*_CRITERIA)] * len(levels),
        o3d.utility.DoubleVector([gate * cell_m for gate, _ in levels]),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(T)),
        module.TransformationEstimationPointToPlane(kernel),
    )
    return np.array(found.transformation.numpy(), dtype=np.float64)


def information(target: Any, source: Any, T: FloatArray, gate_m: float) -> FloatArray:
    """(6, 6) of a perturbation from the right: Open3D's of the correspondences, with their variance and correlation."""
    module = o3d.pipelines.registration
    sums = module.get_information_matrix_from_point_clouds(source, target, gate_m, T)
    variance = module.evaluate_registration(source, target, gate_m, T).inlier_rmse ** 2 / 3.0
    A = adjoint(T)
    return np.asarray(A.T @ sums @ A / (CORRELATION * variance))


def match_features(target: FloatArray, source: FloatArray, cell_m: float, fast: bool) -> FloatArray:
    """`T_target_source` (4, 4) by FPFH and RANSAC or fast global registration; radii as for the alignment of maps."""
    module, described = o3d.pipelines.registration, []
    for points in (source, target):
        cloud = _cloud(points).voxel_down_sample(cell_m)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2.0 * cell_m, 30))
        cloud.orient_normals_to_align_with_direction([0.0, 0.0, 1.0])
        neighbourhood = o3d.geometry.KDTreeSearchParamHybrid(5.0 * cell_m, 100)
        described.append((cloud, module.compute_fpfh_feature(cloud, neighbourhood)))  # type: ignore[call-arg]
    (moving, here), (still, there) = described
    if fast:
        option = module.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * cell_m)
        found = module.registration_fgr_based_on_feature_matching(moving, still, here, there, option)
        return np.array(found.transformation, dtype=np.float64)
    found = module.registration_ransac_based_on_feature_matching(
        moving,
        still,
        here,
        there,
        True,
        1.5 * cell_m,
        module.TransformationEstimationPointToPoint(False),
        3,
        [
            module.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            module.CorrespondenceCheckerBasedOnDistance(1.5 * cell_m),
        ],
        module.RANSACConvergenceCriteria(50_000, 0.9999),
    )
    return np.array(found.transformation, dtype=np.float64)


def thinned(points: FloatArray, cell_m: float) -> FloatArray:
    """Means (M, 3) of cells."""
    return np.asarray(_cloud(points).voxel_down_sample(cell_m).points)


def thinned_tensor(points: FloatArray, cell_m: float) -> FloatArray:
    """Means (M, 3) of cells."""
    return np.asarray(_tensor_cloud(points).voxel_down_sample(cell_m).point.positions.numpy())


def normals(points: FloatArray, neighbours: int, radius_m: float | None) -> FloatArray:
    """Normals (N, 3) from the nearest points, within a radius if given."""
    cloud = _tensor_cloud(points)
    cloud.estimate_normals(neighbours, radius_m)
    return np.asarray(cloud.point.normals.numpy())


def distances(points: FloatArray, others: FloatArray) -> FloatArray:
    """(N,) to the nearest of the others."""
    search = o3d.core.nns.NearestNeighborSearch(_tensor(others))
    search.knn_index()
    return np.asarray(np.sqrt(search.knn_search(_tensor(points), 1)[1].numpy()[:, 0]))


def cloud_distances(points: FloatArray, others: FloatArray) -> FloatArray:
    """(N,) to the nearest of the others."""
    return np.asarray(_cloud(points).compute_point_cloud_distance(_cloud(others)))


def neighbours(points: FloatArray, others: FloatArray, radius_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices of the others within a radius of each point, in order, and their number (N,) per point."""
    search = o3d.core.nns.NearestNeighborSearch(_tensor(others))
    search.fixed_radius_index(radius_m)
    found, _, splits = search.fixed_radius_search(_tensor(points), radius_m, False)
    return np.asarray(found.numpy()), np.diff(splits.numpy())


def _cloud(points: FloatArray) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _tensor(points: FloatArray) -> Any:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(points))


def _tensor_cloud(points: FloatArray) -> Any:
    return o3d.t.geometry.PointCloud(_tensor(points))
