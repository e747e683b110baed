"""Alignment of an estimate with a reference, whose worlds differ."""

from typing import Literal

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, make_transform, transform_points
from lidarslam.core.trajectory import Trajectory

AlignmentMethod = Literal["se3", "first_pose", "none"]

# Below either spread across the main direction, the rotation about it is taken from the orientations: GNSS noise of a
# few decimetres turns a path that bends by less than that by tens of degrees. Of KITTI's eleven sequences only 04, a
# street without a bend, is under 4 %; the motorway of 01 has 5 %.
_LEAST_SPREAD_M = 0.01
_LEAST_RELATIVE_SPREAD = 0.04
# Weight of the orientations relative to the positions' main direction: it affects only the unobservable rotation.
_TIE_BREAK = 1e-8
# Where the positions leave a rotation as uncertain as this, orientations determine it too.
_MOST_UNCERTAIN_RAD = np.deg2rad(5.0)
# Smaller errors are those of rounding, and do not determine the weights.
_LEAST_DISTANCE_M, _LEAST_ANGLE_RAD = 1e-3, 2e-4


def align(estimate: Trajectory, reference: Trajectory, method: AlignmentMethod = "se3") -> FloatArray:
    """`T_reference_estimate` (4, 4), which takes the estimate's world to the reference's; nothing is moved.

    Both trajectories hold the same instants. `se3` minimises the squared distances of all positions, `first_pose`
    lets the first poses coincide, `none` is the identity for trajectories that share a world already.
    """
    if method == "se3":
        return align_se3(estimate.T_world_lidar, reference.T_world_lidar)
    if method == "none":
        return np.eye(4)
    return np.asarray(reference.T_world_lidar[0] @ inverse(estimate.T_world_lidar[0]))


def align_se3(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Least-squares `T_reference_estimate` (4, 4) from poses (N, 4, 4) of the same instants, without scale.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991, eq. 39-41.
    The rotation about a straight line of positions (spread across it under 4 % of that along it), or the whole rotation
    of positions on one spot, is degenerate; it is the chordal mean of the orientations' differences. Positions near a
    line therefore agree a little less closely than in the least-squares solution.
    """
    centre_estimate, centre_reference = estimate[:, :3, 3].mean(axis=0), reference[:, :3, 3].mean(axis=0)
    covariance, orientations = _covariance(estimate, reference), _mean_difference(estimate, reference)
    U, spread_squared, Vt = np.linalg.svd(covariance)
    spread_m = np.sqrt(spread_squared)
    if spread_m[0] < _LEAST_SPREAD_M:
        R = _nearest_rotation(orientations)
    elif _are_on_a_line(spread_m):
        R = _nearest_rotation(np.outer(U[:, 0], Vt[0]) + _TIE_BREAK * orientations)
    else:
        R = _nearest_rotation(covariance)
    return make_transform(R, centre_reference - R @ centre_estimate)


def align_poses(
    estimate: Trajectory, reference: Trajectory, T_reference_estimate: FloatArray, method: AlignmentMethod = "se3"
) -> FloatArray:
    """`T_reference_estimate` (4, 4) for the orientations: that of the positions, unless they leave a rotation open.

    Positions determine the rotation about an axis as well as their errors are small against their distances from the
    axis: on a straight stretch, or with a weak reference, hardly. Where they leave one open by more than 5 degrees, the
    alignment is the maximum-likelihood one of both: with isotropic errors, d the positions' RMS distance after their
    own alignment and a the RMS angle after that of the orientations, the rotation minimises
    sum |p_ref - R p_est|^2 / d^2 + sum angle(R_ref, R R_est)^2 / a^2, the angle by its chord.

    Both are of the same instants and aligned by `align`, whose `first_pose` and `none` hold for the orientations too.
    """
    if method != "se3":
        return T_reference_estimate
    T_estimate, T_reference = estimate.T_world_lidar, reference.T_world_lidar
    aligned = transform_points(T_reference_estimate, estimate.positions)
    distance_m = np.sqrt(np.mean(np.sum((aligned - reference.positions) ** 2, axis=1)))
    covariance, orientations = _covariance(T_estimate, T_reference), _mean_difference(T_estimate, T_reference)
    if distance_m < _MOST_UNCERTAIN_RAD * _least_lever_m(covariance):
        return T_reference_estimate
    # Of a mean rotation M the nearest rotation R has the mean squared chord 2 (3 - trace(R^T M)), twice the angle's.
    angle_squared = 3.0 - np.sum(_nearest_rotation(orientations) * orientations)
    weight_m2 = max(distance_m, _LEAST_DISTANCE_M) ** 2 / (2.0 * max(angle_squared, _LEAST_ANGLE_RAD**2))
    R = _nearest_rotation(covariance + weight_m2 * orientations)
    return make_transform(R, reference.positions.mean(axis=0) - R @ estimate.positions.mean(axis=0))


def _least_lever_m(covariance: FloatArray) -> float:
    """RMS distance of the positions from their main direction; 0 where they have none, or a line has all of them."""
    spread_squared = np.linalg.svd(covariance, compute_uv=False)
    spread_m = np.sqrt(spread_squared)
    return 0.0 if _are_on_a_line(spread_m) else float(np.sqrt(spread_squared[1] + spread_squared[2]))


def _are_on_a_line(spread_m: FloatArray) -> bool:
    """Whether positions with this spread (3,) along their main directions, the largest first, lie on a line."""
    return bool(spread_m[1] < max(_LEAST_SPREAD_M, _LEAST_RELATIVE_SPREAD * spread_m[0]))


def _covariance(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Of the positions of poses (N, 4, 4) about their means, reference to estimate (3, 3)."""
    p_estimate, p_reference = (poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (estimate, reference))
    return np.asarray(p_reference.T @ p_estimate / len(estimate), dtype=np.float64)


def _mean_difference(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Mean (3, 3) of the rotations from the estimate's world to the reference's that make orientations coincide."""
    products = np.einsum("nij,nkj->ik", reference[:, :3, :3], estimate[:, :3, :3])
    return np.asarray(products / len(estimate), dtype=np.float64)


def _nearest_rotation(M: FloatArray) -> FloatArray:
    """The rotation R that maximises trace(R^T M)."""
    U, _, Vt = np.linalg.svd(M)
    handedness = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(U @ np.diag([1.0, 1.0, handedness]) @ Vt, dtype=np.float64)
