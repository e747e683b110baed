"""Checks of a restored pose graph: GTSAM and the search for loops take its indices and covariances as they are."""

from collections.abc import Iterable, Sequence

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.mapping.loops.closure import LoopClosure, RelativePose
from lidarslam.mapping.pose_graph.attitude import Attitude
from lidarslam.mapping.pose_graph.keyframes import Keyframe

# Rounding of a covariance, as a share of its largest entry.
_ROUNDING = 1e-6


def require_poses(keyframes: int, poses: int, laid: int) -> None:
    """Refuse other numbers of poses than of keyframes.

    Raises:
        ValueError: they differ.
    """
    if not keyframes == poses == laid:
        raise ValueError(f"{keyframes} keyframes have {poses} and {laid} poses")


def require_scans(keyframes: Sequence[Keyframe], scans: int) -> None:
    """Refuse keyframes that are not of so many scans, in their order.

    Raises:
        ValueError: they are.
    """
    numbers = [keyframe.scan for keyframe in keyframes]
    if numbers != sorted({*numbers}) or max(numbers, default=-1) >= scans:
        raise ValueError(f"keyframes are not scans in order, of {scans}")
    segments = [keyframe.segment for keyframe in keyframes]
    if segments != sorted(segments) or segments[-1:] > [scans]:
        raise ValueError(f"segments {segments[:3]}, ... of {scans} scans")


def require_rows(rows: Iterable[int], count: int) -> None:
    """Refuse indices into a list of so many.

    Raises:
        ValueError: one is beyond its end.
    """
    if max(rows, default=-1) >= count:
        raise ValueError(f"an index is beyond the end of a list of {count}")


def require_edges(edges: Sequence[RelativePose], attitudes: Iterable[Attitude], keyframes: int) -> None:
    """Refuse edges and attitudes that are not of so many keyframes, or edges whose covariance is none.

    Raises:
        ValueError: one does.
    """
    require_rows((attitude.key for attitude in attitudes), keyframes)
    for edge in edges:
        if not 0 <= edge.first < edge.second < keyframes:
            raise ValueError(f"an edge joins the keyframes {edge.first} and {edge.second} of {keyframes}")
    accepted = [edge for edge in edges if not isinstance(edge, LoopClosure) or edge.accepted]
    require_covariances([edge.covariance for edge in accepted])


def require_covariances(covariances: Sequence[FloatArray]) -> None:
    """Refuse matrices (6, 6) that are not symmetric or have a negative eigenvalue.

    Raises:
        ValueError: one is.
    """
    if not covariances:
        return
    stacked = np.stack(covariances)
    rounding = _ROUNDING * np.abs(stacked).max(axis=(1, 2), keepdims=True)
    is_symmetric = (np.abs(stacked - np.swapaxes(stacked, 1, 2)) <= rounding).all()
    if not is_symmetric or (np.linalg.eigvalsh(stacked) < -rounding[:, 0]).any():
        raise ValueError("a covariance is none")
