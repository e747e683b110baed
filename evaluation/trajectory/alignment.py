"""Alignment of an estimate with a reference, whose worlds differ."""

from typing import Literal

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.core.trajectory import Trajectory

AlignmentMethod = Literal["se3", "first_pose", "none"]

# Below either spread across the main direction, the rotation about it is taken from the orientations: GNSS noise of a
# few decimetres turns a path that bends by less than that by tens of degrees. Of KITTI's eleven sequences only 04, a
# street without a bend, is under 4 %; the motorway of 01 has 5 %.
_LEAST_SPREAD_M = 0.01
_LEAST_RELATIVE_SPREAD = 0.04
# Weight of the orientations beside the positions' main direction: it affects only the unobservable rotation.
_TIE_BREAK = 1e-8


def align(estimate: Trajectory, reference: Trajectory, method: AlignmentMethod = "se3") -> FloatArray:
    """`T_reference_estimate` (4, 4), which takes the estimate's world to the reference's; nothing is moved.

    Both trajectories hold the same instants. `se3` minimises the squared distances of all positions, `first_pose`
    lets the first poses coincide, `none` is the identity for trajectories that share a world already.

    Raises:
        ValueError: the trajectories are empty, differ in length, or the method is unknown.
    """
    if len(estimate) != len(reference) or not len(estimate):
        raise ValueError(f"alignment needs poses of the same instants, got {len(estimate)} and {len(reference)}")
    if method == "se3":
        return align_se3(estimate.T_world_lidar, reference.T_world_lidar)
    if method == "first_pose":
        T_reference_estimate: FloatArray = reference.T_world_lidar[0] @ inverse(estimate.T_world_lidar[0])
        return T_reference_estimate
    if method == "none":
        return np.eye(4)
    raise ValueError(f"alignment must be se3, first_pose or none, got {method!r}")


def align_se3(estimate: FloatArray, reference: FloatArray) -> FloatArray:
    """Least-squares `T_reference_estimate` (4, 4) from poses (N, 4, 4) of the same instants, without scale.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991, eq. 39-41.
    The rotation about a straight line of positions (spread across it under 4 % of that along it), or the whole rotation
    of positions on one spot, is degenerate; it is the chordal mean of the orientations' differences. Positions near a
    line therefore agree a little less closely than in the least-squares solution.
    """
    centre_estimate, centre_reference = estimate[:, :3, 3].mean(axis=0), reference[:, :3, 3].mean(axis=0)
    p_estimate, p_reference = estimate[:, :3, 3] - centre_estimate, reference[:, :3, 3] - centre_reference
    covariance = p_reference.T @ p_estimate / len(estimate)
    orientations = np.einsum("nij,nkj->ik", reference[:, :3, :3], estimate[:, :3, :3]) / len(estimate)
    U, spread_squared, Vt = np.linalg.svd(covariance)
    spread_m = np.sqrt(spread_squared)
    if spread_m[0] < _LEAST_SPREAD_M:
        R = _nearest_rotation(orientations)
    elif spread_m[1] < max(_LEAST_SPREAD_M, _LEAST_RELATIVE_SPREAD * spread_m[0]):
        R = _nearest_rotation(np.outer(U[:, 0], Vt[0]) + _TIE_BREAK * orientations)
    else:
        R = _nearest_rotation(covariance)
    return make_transform(R, centre_reference - R @ centre_estimate)


def _nearest_rotation(M: FloatArray) -> FloatArray:
    """The rotation R that maximises trace(R^T M)."""
    U, _, Vt = np.linalg.svd(M)
    handedness = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray(U @ np.diag([1.0, 1.0, handedness]) @ Vt, dtype=np.float64)
