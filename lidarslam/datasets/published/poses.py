"""Poses from positions and quaternions in columns, as published tables have them."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from lidarslam.core.geometry import FloatArray, make_transform


def poses_wxyz(positions: ArrayLike, quaternions: ArrayLike) -> FloatArray:
    """Transforms (..., 4, 4) of positions (..., 3) and quaternions (..., 4) with the scalar first.

    Raises:
        ValueError: a number is not finite, or a quaternion is zero.
    """
    t, q = np.asarray(positions, dtype=np.float64), np.asarray(quaternions, dtype=np.float64)
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise ValueError("expected finite positions and quaternions")
    return make_transform(Rotation.from_quat(np.roll(q, -1, axis=-1)).as_matrix(), t)
