"""A whole trajectory corrected where some of its poses, the keyframes, were."""

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, interpolate, inverse

# Over a shorter way the sensor is taken to have stood still, and scans are counted instead.
_STILL_M = 0.01


def corrected(T_world_lidar: FloatArray, keyframe_scans: NDArray[np.intp], keyframe_poses: FloatArray) -> FloatArray:
    """Correct all scans (M, 4, 4) so that the keyframes (N,) of them get their new poses (N, 4, 4).

    A scan between two keyframes would be at one place if it kept its motion since the first, and at another if it kept
    that up to the second. It goes from the one to the other in proportion to the path behind it, or to the scans where
    the sensor stood still. Both places are near the scan, so no lever arm from a far origin comes in. Scans before the
    first keyframe keep their motion up to it, those after the last their motion since it.

    Raises:
        ValueError: there is no keyframe, they do not increase, or shapes do not fit.
    """
    _check(T_world_lidar, keyframe_scans, keyframe_poses)
    scans = np.arange(len(T_world_lidar))
    after = np.searchsorted(keyframe_scans, scans, side="right")
    left = np.clip(after - 1, 0, None)
    right = np.clip(after, None, len(keyframe_scans) - 1)
    motion_since = inverse(T_world_lidar[keyframe_scans[left]]) @ T_world_lidar
    motion_until = inverse(T_world_lidar[keyframe_scans[right]]) @ T_world_lidar
    share = _shares(T_world_lidar[:, :3, 3], scans, keyframe_scans[left], keyframe_scans[right])
    moved = interpolate(keyframe_poses[left] @ motion_since, keyframe_poses[right] @ motion_until, share)
    moved[keyframe_scans] = keyframe_poses
    return moved


def _shares(
    positions: FloatArray, scans: NDArray[np.intp], left: NDArray[np.intp], right: NDArray[np.intp]
) -> FloatArray:
    """How much (M,) of the way from its keyframe on the left to that on the right lies behind each scan."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    still = path[right] - path[left] < _STILL_M
    behind = np.where(still, scans - left, path - path[left])
    whole = np.where(still, right - left, path[right] - path[left])
    return np.asarray(np.clip(behind / np.where(whole > 0.0, whole, 1.0), 0.0, 1.0), dtype=np.float64)


def _check(T_world_lidar: FloatArray, keyframe_scans: NDArray[np.intp], keyframe_poses: FloatArray) -> None:
    if T_world_lidar.shape[1:] != (4, 4) or keyframe_poses.shape != (len(keyframe_scans), 4, 4):
        raise ValueError(
            f"expected poses (M, 4, 4) and one (4, 4) for each of {len(keyframe_scans)} keyframes,"
            f" got {T_world_lidar.shape} and {keyframe_poses.shape}"
        )
    if not len(keyframe_scans):
        raise ValueError("expected a keyframe or more, got none")
    inside = (keyframe_scans >= 0) & (keyframe_scans < len(T_world_lidar))
    if not inside.all() or (np.diff(keyframe_scans) <= 0).any():
        raise ValueError(f"keyframe_scans must increase within 0 to {len(T_world_lidar) - 1}, got {keyframe_scans}")
