"""Rigid motions SE(3) as float64 matrices of shape (..., 4, 4).

Free functions, no mutation, broadcasting over leading dimensions. A tangent vector is `(rotation vector, translation
part)`, rotation first, as GTSAM orders it: `xi = (omega, v)`, shape (..., 6).
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# Below this angle the closed forms lose digits to cancellation and their Taylor series are exact to rounding.
SMALL_ANGLE = 1e-4


def make_transform(R: ArrayLike, t: ArrayLike) -> FloatArray:
    """Assemble rotations (..., 3, 3) and translations (..., 3) into transforms (..., 4, 4)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def inverse(T: FloatArray) -> FloatArray:
    """Invert rigid transforms (..., 4, 4): `inverse(T_a_b)` is `T_b_a`."""
    R_inv, T_inv = T[..., :3, :3].swapaxes(-1, -2), np.zeros(T.shape)
    T_inv[..., :3, :3], T_inv[..., :3, 3:], T_inv[..., 3, 3] = R_inv, -(R_inv @ T[..., :3, 3:]), 1.0
    return T_inv


def transform_points(T_a_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Take points (..., N, 3) from frame b to frame a."""
    return points_b @ np.swapaxes(T_a_b[..., :3, :3], -1, -2) + T_a_b[..., None, :3, 3]


def skew(v: FloatArray) -> FloatArray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): `skew(v) @ w == cross(v, w)`."""
    K = np.zeros((*v.shape[:-1], 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return K


def rotation_z(yaw: ArrayLike) -> FloatArray:
    """Rotations (..., 3, 3) about z by angles (...)."""
    R = np.zeros((*np.shape(yaw), 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(yaw)
    R[..., 1, 0] = np.sin(yaw)
    R[..., 0, 1], R[..., 2, 2] = -R[..., 1, 0], 1.0
    return R


def levelling(up: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that turns a unit vector (3,) to z; half a turn about x if that points down."""
    if up[2] < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    K = skew(np.array([up[1], -up[0], 0.0]))
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + up[2]), dtype=np.float64)


def rotation_angle(T: FloatArray) -> FloatArray:
    """Angle in [0, pi], radians, of rotations or transforms (..., >=3, >=3).

    Computed as atan2(|vee(R - R^T)|, trace(R) - 1), which keeps its digits at both ends, unlike arccos of the trace.
    """
    R = T[..., :3, :3]
    sine = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    cosine = np.trace(R, axis1=-2, axis2=-1) - 1.0
    return np.asarray(np.arctan2(np.linalg.norm(sine, axis=-1), cosine), dtype=np.float64)


def _series(angle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3, finite at zero."""
    small = angle < SMALL_ANGLE
    a = np.where(small, 1.0, angle)
    a2 = angle**2
    sin_a, half = np.sin(a), np.sin(0.5 * a)
    return (
        np.where(small, 1.0 - a2 / 6.0, sin_a / a),
        np.where(small, 0.5 - a2 / 24.0, 2.0 * half * half / a**2),
        np.where(small, 1.0 / 6.0 - a2 / 120.0, (a - sin_a) / a**3),
    )


def exp(xi: ArrayLike) -> FloatArray:
    """SE(3) exponential of tangent vectors (..., 6), rotation first (Rodrigues' formula and the left Jacobian)."""
    xi = np.asarray(xi, dtype=np.float64)
    if xi.size == 6:
        return _exp_one(xi).reshape(*xi.shape[:-1], 4, 4)
    omega, v = xi[..., :3], xi[..., 3:]
    K = skew(omega)
    K2 = K @ K
    s, c, j = (x[..., None, None] for x in _series(np.linalg.norm(omega, axis=-1)))
    identity = np.eye(3)
    V = identity + c * K + j * K2
    return make_transform(identity + s * K + c * K2, (V @ v[..., None])[..., 0])


def log(T: FloatArray) -> FloatArray:
    """SE(3) logarithm (..., 6) of transforms (..., 4, 4), rotation first; the inverse of `exp` for angles below pi."""
    if T.size == 16:
        return _log_one(T).reshape(*T.shape[:-2], 6)
    from scipy.spatial.transform import Rotation  # takes a while to load

    flat = T.reshape(-1, 4, 4)  # SciPy goes through quaternions, which stay accurate close to pi
    omega = Rotation.from_matrix(flat[:, :3, :3]).as_rotvec().reshape(*T.shape[:-2], 3)
    angle = np.linalg.norm(omega, axis=-1)
    s, c, _ = _series(angle)
    small = angle < SMALL_ANGLE
    a2 = np.where(small, 1.0, angle**2)
    coefficient = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - s / (2.0 * c)) / a2)
    K = skew(omega)
    V_inv = np.eye(3) - 0.5 * K + coefficient[..., None, None] * (K @ K)
    return np.concatenate([omega, (V_inv @ T[..., :3, 3:4])[..., 0]], axis=-1)


def _exp_one(xi: FloatArray) -> FloatArray:
    """As `exp`, (4, 4) of the only tangent vector; arrays would cost ten times as much as the arithmetic."""
    a, b, c, x, y, z = xi.reshape(6).tolist()
    angle = math.sqrt(a * a + b * b + c * c)
    if not math.isfinite(angle):
        return np.full((4, 4), np.nan)
    rows = exp_rows(a, b, c, x, y, z, *coefficients(angle))
    return np.array([*rows, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)


def _log_one(T: FloatArray) -> FloatArray:
    """As `log`, (6,) of the only transform."""
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = T.reshape(4, 4).tolist()
    a, b, c, angle = rotation_vector(r00, r01, r02, r10, r11, r12, r20, r21, r22)
    s, v, _ = coefficients(angle)
    return np.array([a, b, c, *log_translation(a, b, c, x, y, z, angle, s, v)])


# The following are also compiled, see `lidarslam.odometry.alignment.steps`.


def exp_rows(
    a: float, b: float, c: float, x: float, y: float, z: float, s: float, v: float, j: float
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """The first three rows of `exp` of (a, b, c, x, y, z), with the `coefficients` of its angle."""
    aa, bb, cc, ab, ac, bc = a * a, b * b, c * c, a * b, a * c, b * c
    u, w, h = b * z - c * y, c * x - a * z, a * y - b * x  # omega x v
    return (
        *(1.0 - v * (bb + cc), v * ab - s * c, v * ac + s * b, x + v * u + j * (b * h - c * w)),
        *(v * ab + s * c, 1.0 - v * (aa + cc), v * bc - s * a, y + v * w + j * (c * u - a * h)),
        *(v * ac - s * b, v * bc + s * a, 1.0 - v * (aa + bb), z + v * h + j * (a * w - b * u)),
    )


def rotation_vector(
    r00: float, r01: float, r02: float, r10: float, r11: float, r12: float, r20: float, r21: float, r22: float
) -> tuple[float, float, float, float]:
    """The rotation vector of a matrix, and its angle, by the best conditioned row of 4 q q^T."""
    i, j, k = r21 - r12, r02 - r20, r10 - r01
    p, q, r = r01 + r10, r02 + r20, r12 + r21
    real, by_x, by_y = 1.0 + r00 + r11 + r22, 1.0 + r00 - r11 - r22, 1.0 - r00 + r11 - r22
    by_z = 1.0 - r00 - r11 + r22
    if real >= by_x and real >= by_y and real >= by_z:
        w, a, b, c = real, i, j, k
    elif by_x >= by_y and by_x >= by_z:
        w, a, b, c = i, by_x, p, q
    elif by_y >= by_z:
        w, a, b, c = j, p, by_y, r
    else:
        w, a, b, c = k, q, r, by_z
    sine = math.sqrt(a * a + b * b + c * c)
    angle = 2.0 * math.atan2(sine, abs(w))
    scale = math.copysign(angle / sine if sine > 0.0 else 0.0, w)
    return scale * a, scale * b, scale * c, angle


def log_translation(
    a: float, b: float, c: float, x: float, y: float, z: float, angle: float, s: float, v: float
) -> tuple[float, float, float]:
    """The translation part of `log`, of a rotation vector and a translation, with the `coefficients` of its angle."""
    near = angle < SMALL_ANGLE
    coefficient = 1.0 / 12.0 + angle**2 / 720.0 if near else (1.0 - s / (2.0 * v)) / angle**2
    u, g, h = b * z - c * y, c * x - a * z, a * y - b * x  # omega x t
    return (
        x - 0.5 * u + coefficient * (b * h - c * g),
        y - 0.5 * g + coefficient * (c * u - a * h),
        z - 0.5 * h + coefficient * (a * g - b * u),
    )


def coefficients(angle: float) -> tuple[float, float, float]:
    """sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3 of an angle."""
    if angle < SMALL_ANGLE:
        a2 = angle * angle
        return 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    return sine / angle, 2.0 * half * half / (angle * angle), (angle - sine) / (angle * angle * angle)


def displacement_m(xi: FloatArray, range_m: float) -> float:
    """How far, at most, a motion (6,) moves a point at this range."""
    return float(np.linalg.norm(xi[3:]) + range_m * np.linalg.norm(xi[:3]))


def interpolate(T_w_a: FloatArray, T_w_b: FloatArray, fraction: ArrayLike) -> FloatArray:
    """Move from `T_w_a` (fraction 0) to `T_w_b` (fraction 1) at constant body velocity; other fractions extrapolate.

    Transforms (..., 4, 4), fractions (...), all broadcast together.
    """
    fraction = np.asarray(fraction, dtype=np.float64)
    return T_w_a @ exp(fraction[..., None] * log(inverse(T_w_a) @ T_w_b))


def principal_axes(neighbourhoods: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means (N, 3), eigenvalues (N, 3) of the scatter, ascending, and eigenvectors (N, 3, 3) of points (N, K, 3)."""
    means = neighbourhoods.mean(axis=1)
    offsets = neighbourhoods - means[:, None]
    return means, *np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))


def adjoint(T_a_b: FloatArray) -> FloatArray:
    """(6, 6): takes tangent vectors, rotation first, from frame b to frame a."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = skew(t) @ R
    return A


def is_rigid(T: FloatArray, tolerance: float = 1e-5) -> bool:
    """Whether every (4, 4) of the array is finite, orthonormal, right-handed and has the bottom row 0 0 0 1."""
    R = T[..., :3, :3]
    return bool(
        np.isfinite(T).all()
        and np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(initial=0.0) < tolerance
        and (np.linalg.det(R) > 0.0).all()
        and np.abs(T[..., 3, :] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0) < tolerance
    )


def orthonormalize(T: FloatArray) -> FloatArray:
    """The nearest rigid transforms to (..., 4, 4): the rotation part projected by SVD, as text files round it."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    U = np.array(U)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return make_transform(U @ Vt, T[..., :3, 3])
