"""Rigid motions SE(3) in torch, batched and differentiable, also at the identity.

The conventions are those of `lidarslam.core.geometry`: a tangent vector is `(rotation vector, translation part)`,
rotation first, shape (..., 6). Every function keeps the dtype and the device of its arguments.
"""

import torch
from torch import Tensor
from torch.nn import functional

# Tangents of half an angle below which the series take over from the closed forms, which divide by zero there.
_SERIES_TANGENT = 0.05


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


def turn_about_z(angle: Tensor) -> Tensor:
    """Rotations (..., 3, 3) by angles (...) about z, radians, from x towards y where positive."""
    c, s = angle.cos(), angle.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).reshape(*angle.shape, 3, 3)


def log(T: Tensor) -> Tensor:
    """SE(3) logarithm (..., 6) of transforms (..., 4, 4), rotation first, for angles below pi.

    `where` passes zero times the gradient of the branch not taken, which must therefore be finite: each branch gets a
    harmless number where the other one holds.
    """
    q = quaternion_from_rotation(T[..., :3, :3])
    w, v = q[..., 0], q[..., 1:]  # the cosine of half the angle, and the axis times its sine
    squared = v.square().sum(-1)
    small = squared < (_SERIES_TANGENT * w) ** 2
    length = torch.where(small, 1.0, squared).sqrt()
    half = torch.atan2(length, torch.where(small, 0.0, w))
    tangent2 = torch.where(small, squared, 0.0) / torch.where(small, w, 1.0) ** 2
    series = (1.0 - tangent2 * (1 / 3 - tangent2 * (1 / 5 - tangent2 * (1 / 7 - tangent2 / 9)))) / torch.where(
        small, w, 1.0
    )  # the arc tangent over the sine
    omega = 2.0 * v * torch.where(small, series, half / length)[..., None]
    angle2 = torch.where(small, omega.square().sum(-1), 0.0)
    near = 1 / 12 + angle2 * (1 / 720 + angle2 * (1 / 30240 + angle2 / 1209600))
    coefficient = torch.where(small, near, (1.0 - half * w / length) / (4.0 * half.square()))
    K = skew(omega)
    V_inv = torch.eye(3, dtype=T.dtype, device=T.device) - 0.5 * K + coefficient[..., None, None] * (K @ K)
    return torch.cat([omega, (V_inv @ T[..., :3, 3:4])[..., 0]], dim=-1)


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
    a, b, c = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
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
