"""Rigid motions SE(3) in torch, batched and differentiable, also at the identity.

The conventions are those of `lidarslam.core.geometry`: a tangent vector is `(rotation vector, translation part)`,
rotation first, shape (..., 6). Every function keeps the dtype and the device of what it is given.
"""

from contextlib import AbstractContextManager, nullcontext
from math import factorial

import torch
from torch import Tensor
from torch.nn import functional

# Below this angle the closed forms cancel digits, badly so in float32; the series reach float64 rounding up to here.
_SERIES_ANGLE = 0.5
# Tangents below which the arc tangent's series takes over; above, atan2 is well-conditioned.
_SERIES_TANGENT = 0.05

_SINE = tuple((-1) ** k / factorial(2 * k + 1) for k in range(8))  # sin(a) / a
_COSINE = tuple((-1) ** k / factorial(2 * k + 2) for k in range(8))  # (1 - cos(a)) / a^2
_CUBIC = tuple((-1) ** k / factorial(2 * k + 3) for k in range(8))  # (a - sin(a)) / a^3
_ARC_TANGENT = tuple((-1) ** k / (2 * k + 1) for k in range(7))  # atan(r) / r
# |B_2k| / (2k)!, k = 1..7, with Bernoulli's numbers: (1 - a/2 * cot(a/2)) / a^2
_COTANGENT = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600)


def full_precision(device: torch.device) -> AbstractContextManager[object]:
    """A context without autocast, which would leave the matrix products of motions no more than three digits."""
    if torch.is_autocast_enabled(device.type):
        return torch.autocast(device.type, enabled=False)
    return nullcontext()


def make_transform(R: Tensor, t: Tensor) -> Tensor:
    """Assemble rotations (..., 3, 3) and translations (..., 3) into transforms (..., 4, 4)."""
    top = torch.cat([R, t[..., None]], dim=-1)  # (..., 3, 4)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def inverse(T: Tensor) -> Tensor:
    """Invert rigid transforms (..., 4, 4): `inverse(T_a_b)` is `T_b_a`."""
    R_inv = T[..., :3, :3].mT
    return make_transform(R_inv, -(R_inv @ T[..., :3, 3:4])[..., 0])


def transform_points(T_a_b: Tensor, points_b: Tensor) -> Tensor:
    """Take points (..., N, 3) from frame b to frame a."""
    return points_b @ T_a_b[..., :3, :3].mT + T_a_b[..., None, :3, 3]


def rotate(T_a_b: Tensor, vectors_b: Tensor) -> Tensor:
    """Turn directions (..., N, 3), such as normals, from frame b to frame a; the translation plays no part."""
    return vectors_b @ T_a_b[..., :3, :3].mT


def skew(v: Tensor) -> Tensor:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): `skew(v) @ w == cross(v, w)`."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape[:-1], 3, 3)


def exp(xi: Tensor) -> Tensor:
    """SE(3) exponential (..., 4, 4) of tangent vectors (..., 6), rotation first.

    Rodrigues' formula for the rotation, the left Jacobian for the translation.
    """
    omega, v = xi[..., :3], xi[..., 3:]
    K = skew(omega)
    K2 = K @ K
    s, c, j = (x[..., None, None] for x in _trigonometry(omega.square().sum(-1)))
    identity = torch.eye(3, dtype=xi.dtype, device=xi.device)
    V = identity + c * K + j * K2
    return make_transform(identity + s * K + c * K2, (V @ v[..., None])[..., 0])


def turn_about_z(angle: Tensor) -> Tensor:
    """Transforms (..., 4, 4) that turn by angles (...) about z, radians, from x towards y where positive."""
    zero = torch.zeros_like(angle)
    return exp(torch.stack([zero, zero, angle, zero, zero, zero], dim=-1))


def log(T: Tensor) -> Tensor:
    """SE(3) logarithm (..., 6) of transforms (..., 4, 4), rotation first; the inverse of `exp` for angles below pi."""
    omega = _rotation_vector(quaternion_from_rotation(T[..., :3, :3]))
    squared = omega.square().sum(-1)
    s, c, _ = _trigonometry(squared)
    small = squared < _SERIES_ANGLE**2
    closed = (1.0 - s / (2.0 * c)) / torch.where(small, 1.0, squared)
    coefficient = torch.where(small, _polynomial(_COTANGENT, torch.where(small, squared, 0.0)), closed)
    K = skew(omega)
    V_inv = torch.eye(3, dtype=T.dtype, device=T.device) - 0.5 * K + coefficient[..., None, None] * (K @ K)
    return torch.cat([omega, (V_inv @ T[..., :3, 3:4])[..., 0]], dim=-1)


def rotation_angle(T: Tensor) -> Tensor:
    """Angle (...) in [0, pi], radians, of rotations or transforms (..., >=3, >=3).

    As `lidarslam.core.geometry.rotation_angle`; the gradient at the identity, where the angle has a kink, is zero.
    """
    R = T[..., :3, :3]
    cosine = R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0
    return torch.atan2(torch.linalg.vector_norm(_twice_sine_axis(R), dim=-1), cosine)


def rotation_from_quaternion(q: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of quaternions (..., 4) in the order w, x, y, z.

    Each quaternion is normalised on its own; one of length zero gives the identity.
    """
    w, x, y, z = functional.normalize(q, dim=-1).unbind(-1)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quaternion_from_rotation(R: Tensor) -> Tensor:
    """Unit quaternions (..., 4), order w, x, y, z with w >= 0, of rotations (..., 3, 3).

    The matrix 4 q q^T is linear in R, and each of its rows is a multiple of q; the row with the largest diagonal is the
    best conditioned, and at no rotation is a square root taken of zero.
    """
    a, b, c = _twice_sine_axis(R).unbind(-1)
    xx, yy, zz = R.diagonal(dim1=-2, dim2=-1).unbind(-1)
    xy, xz, yz = R[..., 0, 1] + R[..., 1, 0], R[..., 0, 2] + R[..., 2, 0], R[..., 1, 2] + R[..., 2, 1]
    entries = [
        *(1.0 + xx + yy + zz, a, b, c),
        *(a, 1.0 + xx - yy - zz, xy, xz),
        *(b, xy, 1.0 - xx + yy - zz, yz),
        *(c, xz, yz, 1.0 - xx - yy + zz),
    ]
    outer = torch.stack(entries, dim=-1).reshape(*R.shape[:-2], 4, 4)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]  # (..., 1, 1)
    row = outer.take_along_dim(best, dim=-2)[..., 0, :]  # (..., 4, 4) -> (..., 4)
    return functional.normalize(torch.where(row[..., :1] < 0.0, -row, row), dim=-1)


def _rotation_vector(q: Tensor) -> Tensor:
    """Rotation vectors (..., 3) of unit quaternions (..., 4) with w >= 0: twice the half angle along the axis."""
    w, v = q[..., 0], q[..., 1:]
    squared = v.square().sum(-1)
    small = squared < (_SERIES_TANGENT * w) ** 2
    length = torch.where(small, 1.0, squared).sqrt()
    safe_w = torch.where(small, w, 1.0)
    series = _polynomial(_ARC_TANGENT, torch.where(small, squared, 0.0) / safe_w**2) / safe_w
    return 2.0 * v * torch.where(small, series, torch.atan2(length, w) / length)[..., None]


def _twice_sine_axis(R: Tensor) -> Tensor:
    """The rotation axes (..., 3) times twice the sine of the angle."""
    pairs = [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]]
    return torch.stack(pairs, dim=-1)


def _trigonometry(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1-cos(a))/a^2 and (a-sin(a))/a^3 from a^2, smooth at zero.

    `where` passes zero times the gradient of the branch not taken, which must therefore be finite: each branch sees a
    harmless number where the other one holds.
    """
    small = squared < _SERIES_ANGLE**2
    near = torch.where(small, squared, 0.0)
    far = torch.where(small, 1.0, squared)
    a = far.sqrt()
    closed = (a.sin() / a, 2.0 * (0.5 * a).sin() ** 2 / far, (a - a.sin()) / (far * a))
    series = (_polynomial(coefficients, near) for coefficients in (_SINE, _COSINE, _CUBIC))
    s, c, j = (torch.where(small, x, y) for x, y in zip(series, closed, strict=True))
    return s, c, j


def _polynomial(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    """Horner's scheme, the constant first."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * x + coefficient
    return value
