"""Association of an estimate with a reference in time, and its alignment, as their worlds differ."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray, inverse, make_transform, transform_points
from lidarslam.core.text import count
from lidarslam.core.trajectory import Trajectory

# Interpolation over half a second at constant velocity errs by a * 0.5^2 / 8 at most, 6 cm when braking at 2 m/s^2.
DEFAULT_MAX_GAP_S = 0.5
DEFAULT_TOLERANCE_S = 0.02

_FEWEST_MATCHES = 3


@dataclass(frozen=True, eq=False)
class Association:
    """Pairs of poses of one instant, M of them."""

    estimate: Trajectory  # the matched poses of the estimate, `T_world_lidar` in the estimate's world
    reference: Trajectory  # the reference at the same M stamps, `T_world_lidar` in the reference's world
    rows: NDArray[np.intp]  # (M,) increasing, of the matched poses in the whole estimate
    estimate_count: int  # poses of the whole estimate
    reference_count: int  # poses of the whole reference

    def __len__(self) -> int:
        return len(self.rows)

    def to_json(self) -> dict[str, int]:
        """The counts, as metrics.json names them."""
        return {"matched": len(self), "estimate": self.estimate_count, "reference": self.reference_count}


def associate(
    estimate: Trajectory,
    reference: Trajectory,
    tolerance_s: float = DEFAULT_TOLERANCE_S,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
) -> Association:
    """The reference pose at the instant of each pose of the estimate.

    The reference is interpolated at constant body velocity. A stamp is matched when the reference poses around it are
    at most `max_gap_s` apart, or when one of them is at most `tolerance_s` away; so a stamp is extrapolated by
    `tolerance_s` at most. At equal stamps the reference pose is taken as it is, to the last bit.
    """
    matched = _is_matched(estimate.stamps, reference.stamps, tolerance_s, max_gap_s)
    rows = np.flatnonzero(matched)
    if len(rows) < _FEWEST_MATCHES or len(reference) < 2:
        raise InputError(_explain(estimate, reference, len(rows), tolerance_s, max_gap_s))
    stamps = estimate.stamps[rows]
    at_stamps = Trajectory(stamps, _reference_at(reference, stamps))
    return Association(estimate.select(rows), at_stamps, rows, len(estimate), len(reference))


def common_instants(estimate: Trajectory, reference: Trajectory) -> Association | None:
    """As `associate`; None where they have too few instants in common, as trajectories of different recordings."""
    with suppress(InputError):
        return associate(estimate, reference)
    return None


def _is_matched(stamps: FloatArray, reference: FloatArray, tolerance_s: float, max_gap_s: float) -> NDArray[np.bool_]:
    if not len(reference):
        return np.zeros(len(stamps), dtype=np.bool_)
    right = np.searchsorted(reference, stamps, side="left")
    before = reference[np.clip(right - 1, 0, len(reference) - 1)]
    after = reference[np.clip(right, 0, len(reference) - 1)]
    between = (before <= stamps) & (stamps <= after) & (after - before <= max_gap_s)
    nearest = np.minimum(np.abs(stamps - before), np.abs(after - stamps))
    return np.asarray(between | (nearest <= tolerance_s), dtype=np.bool_)


def _reference_at(reference: Trajectory, stamps: FloatArray) -> FloatArray:
    times = reference.stamps
    # Two reference poses a microsecond apart do not determine the velocity: extrapolate by one step at most.
    reached = np.clip(stamps, 2 * times[0] - times[1], 2 * times[-1] - times[-2])
    T_world_lidar = reference.at(reached, extrapolation_s=np.inf)
    candidates = np.clip(np.searchsorted(times, stamps), 0, len(times) - 1)
    equal = times[candidates] == stamps
    T_world_lidar[equal] = reference.T_world_lidar[candidates[equal]]
    return T_world_lidar


def _explain(estimate: Trajectory, reference: Trajectory, matched: int, tolerance_s: float, max_gap_s: float) -> str:
    spans = [
        f"{count(len(of), 'pose')}{f' from {of.stamps[0]:.3f} to {of.stamps[-1]:.3f} s' if len(of) else ''}"
        for of in (estimate, reference)
    ]
    cause = "correct the clock or the unit of the stamps, or check that the reference belongs to this recording"
    a, b = estimate.stamps, reference.stamps
    if len(a) < _FEWEST_MATCHES or len(b) < 2:
        cause = "one of them is too short; check that both files are complete"
    elif max(a[0], b[0]) <= min(a[-1], b[-1]) + tolerance_s:
        cause = f"poses more than {max_gap_s:g} s apart are not bridged; use a denser reference or allow a larger gap"
    return (
        f"expected {_FEWEST_MATCHES} or more poses with a reference pose at the same instant, found {matched}:"
        f" the estimate has {spans[0]}, the reference {spans[1]}; {cause}"
    )


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
