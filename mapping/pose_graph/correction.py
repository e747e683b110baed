"""The optimised graph: the scans between keyframes corrected by it, and its text in the g2o format."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray, interpolate, inverse
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose

# Over a shorter path the sensor stood still, and scans are counted instead.
_STILL_M = 0.01
_UPPER = np.triu_indices(6)
_TRANSLATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True, eq=False)
class Corrected:
    """The optimised graph."""

    T_world_lidar: FloatArray  # (M, 4, 4) of all scans, one recording's after the other's
    keyframe_scans: NDArray[np.intp]  # (K,) the scans that are keyframes
    keyframe_poses: FloatArray  # (K, 4, 4) T_world_lidar
    closures: tuple[LoopClosure, ...]  # loop closures, rejected ones too
    inliers: tuple[bool, ...]  # for each closure, whether the optimiser kept it
    edges: tuple[RelativePose, ...]  # between keyframes, outlier closures left out
    first_scans: NDArray[np.intp]  # (R,) where the scans of each recording begin
    frames: NDArray[np.intp]  # (R,) the first recording of each one's connected component, in whose world it is

    @property
    def keyframe_recordings(self) -> NDArray[np.intp]:
        """(K,) the recording of each keyframe."""
        return recordings_of(self.keyframe_scans, self.first_scans)

    def scan_poses(self, recording: int) -> FloatArray:
        """(N, 4, 4) of the scans of a recording."""
        return np.split(self.T_world_lidar, self.first_scans[1:])[recording]


def recordings_of(scans: NDArray[np.intp], first_scans: NDArray[np.intp]) -> NDArray[np.intp]:
    """(N,) the recording of each scan (N,), given where recordings (R,) begin."""
    return np.searchsorted(first_scans, scans, side="right") - 1


def in_frames(poses: FloatArray, frames: NDArray[np.intp], registered: FloatArray) -> FloatArray:
    """Keyframe poses (K, 4, 4) moved rigidly for each frame (K,), its first keyframe to its registered pose."""
    moved = poses.copy()
    for frame in np.unique(frames):
        keys = np.flatnonzero(frames == frame)
        moved[keys] = registered[keys[0]] @ inverse(poses[keys[0]]) @ poses[keys]
    return moved


def corrected_recordings(
    T_world_lidar: FloatArray, first_scans: NDArray[np.intp], keyframe_scans: NDArray[np.intp], poses: FloatArray
) -> FloatArray:
    """All scans (M, 4, 4), each recording's by the poses (K, 4, 4) of its own keyframes; as registered without."""
    scans, of = T_world_lidar.copy(), recordings_of(keyframe_scans, first_scans)
    for recording, (begin, end) in enumerate(pairwise([*first_scans, len(scans)])):
        own = of == recording
        if own.any():
            scans[begin:end] = corrected(scans[begin:end], keyframe_scans[own] - begin, poses[own])
    return scans


def corrected(T_world_lidar: FloatArray, keyframe_scans: NDArray[np.intp], keyframe_poses: FloatArray) -> FloatArray:
    """All scans (M, 4, 4), the increasing keyframes (N,) among them, one or more, at their new poses (N, 4, 4).

    A scan between two keyframes is interpolated between the pose that its motion since the one gives, and the pose
    that its motion up to the other gives, in proportion to the path, or to the scans where the sensor stood still.
    Both poses are near the scan, so there is no lever arm from the origin. Scans before the first keyframe keep their
    motion up to it, those after the last their motion since it.
    """
    scans = np.arange(len(T_world_lidar))
    after = np.searchsorted(keyframe_scans, scans, side="right")
    left = np.clip(after - 1, 0, None)
    right = np.clip(after, None, len(keyframe_scans) - 1)
    motion_since = inverse(T_world_lidar[keyframe_scans[left]]) @ T_world_lidar
    motion_until = inverse(T_world_lidar[keyframe_scans[right]]) @ T_world_lidar
    # The fraction of the path between the keyframes before and after it that each scan has covered.
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T_world_lidar[:, :3, 3], axis=0), axis=1))])
    before, after = keyframe_scans[left], keyframe_scans[right]
    still = path[after] - path[before] < _STILL_M
    behind = np.where(still, scans - before, path - path[before])
    whole = np.where(still, after - before, path[after] - path[before])
    share = np.clip(behind / np.where(whole > 0.0, whole, 1.0), 0.0, 1.0)
    moved = interpolate(keyframe_poses[left] @ motion_since, keyframe_poses[right] @ motion_until, share)
    moved[keyframe_scans] = keyframe_poses
    return moved


def format_g2o(poses: FloatArray, edges: Sequence[RelativePose]) -> str:
    """The graph as g2o text, which GTSAM, g2o and Ceres read: poses (N, 4, 4), whose keys are their rows, and edges.

    `VERTEX_SE3:QUAT key x y z qx qy qz qw` is a pose, `EDGE_SE3:QUAT first second x y z qx qy qz qw` followed by the
    upper triangle of the information matrix, row by row, a relative pose. The information is translation first; here
    covariances are rotation first. g2o measures rotation by the quaternion's vector part, half the angle; GTSAM and the
    tools around it take the same numbers for the angle's, unscaled, and so does this file. Not `gtsam.writeG2o`, whose
    six digits are a millimetre at a kilometre.
    """
    lines = [f"VERTEX_SE3:QUAT {key} {_text(_seven(T))}" for key, T in enumerate(poses)]
    for edge in edges:
        information = np.linalg.inv(edge.covariance)[np.ix_(_TRANSLATION_FIRST, _TRANSLATION_FIRST)]
        upper = (0.5 * (information + information.T))[_UPPER]
        lines.append(f"EDGE_SE3:QUAT {edge.first} {edge.second} {_text([*_seven(edge.T_first_second), *upper])}")
    return "".join(f"{line}\n" for line in lines)


def _seven(T: FloatArray) -> FloatArray:
    """x y z qx qy qz qw, qw >= 0."""
    from scipy.spatial.transform import Rotation  # takes a while to load

    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)
