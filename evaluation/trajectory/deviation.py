"""How far a trajectory is off along each axis, and how far it is turned about each."""

from dataclasses import dataclass

import numpy as np

from evaluation.trajectory.association import Association
from lidarslam.core.geometry import FloatArray, inverse


@dataclass(frozen=True, eq=False)
class Deviation:
    """The pose of the aligned estimate in the frame of the reference's LiDAR (x forward, y left, z up), M times.

    Attributes:
        distances_m: (M,) travelled along the reference.
        translation_m: (M, 3) ahead of, to the left of and above the reference.
        rotation_deg: (M, 3) roll, pitch and yaw; yaw is turned first, about z, then pitch about y, roll about x.
    """

    distances_m: FloatArray
    translation_m: FloatArray
    rotation_deg: FloatArray


def deviation(association: Association, T_reference_estimate: FloatArray) -> Deviation:
    """The deviation along the matched poses after the given alignment (4, 4)."""
    aligned = T_reference_estimate @ association.estimate.T_world_lidar
    T_true_estimated = inverse(association.reference.T_world_lidar) @ aligned
    R = T_true_estimated[:, :3, :3]
    # At a pitch of 90 degrees roll and yaw cannot be told apart; atan2 then answers without a warning, as SciPy's
    # Euler angles do not.
    pitch = np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0))
    roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return Deviation(
        distances_m=association.reference.distances,
        translation_m=T_true_estimated[:, :3, 3],
        rotation_deg=np.rad2deg(np.stack([roll, pitch, yaw], axis=-1)),
    )
