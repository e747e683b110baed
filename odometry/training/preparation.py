"""A recording prepared for training: its scans as images, and pseudo-labels of the motions between them.

The motions are found by alignment alone, from many initial estimates, without labels or a network. They compensate the
sweeps of the clouds that the geometric losses compare, and they are the target of the loss `alignment`.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.geometry import FloatArray, exp, log
from lidarslam.core.scan import Scan
from lidarslam.odometry.alignment.alignment import DOUBTFUL, Alignment, Effort, InitialEstimate, align_best, try_instead
from lidarslam.odometry.alignment.sweep_motion import SweepMotion, SweepPair
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.images.sweep_images import Imager, SweepImages

# Initial estimates of the turn from one scan to the next, degrees. Alignment converges over half a step.
_TURNS_DEG = (-20.0, -15.0, -10.0, -5.0, 5.0, 10.0, 15.0, 20.0)
_FINE = Effort(iterations=10, column_step=2)
_TURNING = math.radians(3.0)
# A pseudo-label that explains less, or has fewer inliers, is not valid; see `Alignment`.
_LEAST_EXPLAINED = 0.4
_LEAST_INLIERS = 60
_SHORTEST_S = 1e-3


@dataclass(frozen=True, eq=False)
class PreparedRecording:
    """N consecutive scans of one sensor, as images of the network's size."""

    points: Tensor  # (N, 3, H, W) metres in the LiDAR frame at the time of each point; zero where empty
    normals: Tensor  # (N, 3, H, W) unit, zero where there is none; they may be of half precision
    offsets: Tensor  # (N, H, W) seconds from the middle of the sweep, likewise; all zero where unknown
    interval_s: Tensor  # (N - 1,) from the middle of each sweep to the next
    T_prev_curr: Tensor  # (N - 1, 4, 4) pseudo-labels of the motions between the middles of sweeps
    valid: Tensor  # (N - 1,) whether they are reliable

    def __len__(self) -> int:
        return len(self.points)

    def require(self, scans: int, images: ImageConfig) -> None:
        """Raise ValueError for shapes that `prepare` cannot have made of `scans` scans; some may be left out."""
        count, size = len(self.points), (images.rows, images.columns)
        shapes = {
            "points": (count, 3, *size), "normals": (count, 3, *size), "offsets": (count, *size),
            "interval_s": (count - 1,), "T_prev_curr": (count - 1, 4, 4), "valid": (count - 1,),
        }  # fmt: skip
        found = {name: tuple(tensor.shape) for name, tensor in vars(self).items()}
        if found != shapes or not 2 <= count <= scans:
            raise ValueError(f"expected tensors of the shapes {shapes}, got {found}")


def prepare(scans: Iterable[Scan], config: ImageConfig) -> PreparedRecording:
    """Images of all scans, and each aligned with the one before; ValueError where there are fewer than two scans."""
    imager, T_last, last = Imager(config), np.eye(4), None
    images, middles, found = list[SweepImages](), list[float](), list[Alignment]()
    previous: SweepImages | None = None
    for scan in scans:
        made = imager.images(scan)
        images.append(made.network)
        middles.append(scan.stamp + scan.middle_offset_s)
        if previous is not None:
            interval_s = max(middles[-1] - middles[-2], _SHORTEST_S)
            best = _aligned(T_last, SweepPair(made.alignment, previous, interval_s, last))
            found.append(best)
            T_last, last = np.eye(4), None
            if _is_valid(best):
                T_last = best.T_prev_curr
                last = SweepMotion(log(T_last) / interval_s, best.velocity_change, interval_s)
        previous = made.alignment
    if len(images) < 2:
        raise ValueError(f"training needs pairs of scans, this recording has {len(images)}")
    return PreparedRecording(
        points=torch.from_numpy(np.stack([one.points for one in images])),
        normals=torch.from_numpy(np.stack([one.normals for one in images])),
        offsets=torch.from_numpy(np.stack([one.offsets for one in images])),
        interval_s=torch.from_numpy(np.diff(middles)).float().clamp(min=_SHORTEST_S),
        T_prev_curr=torch.from_numpy(np.stack([one.T_prev_curr for one in found])).float(),
        valid=torch.tensor([_is_valid(one) for one in found]),
    )


def _is_valid(alignment: Alignment) -> bool:
    return alignment.explained > _LEAST_EXPLAINED and alignment.inliers >= _LEAST_INLIERS


def _aligned(T_last: FloatArray, sweeps: SweepPair) -> Alignment:
    """From the last motion and from rest; from many turns unless that is good, or the sensor was turning."""
    best = align_best([InitialEstimate(T_last), InitialEstimate(np.eye(4), sigmas=1.0)], sweeps, _FINE)
    was_turning = float(np.linalg.norm(log(T_last)[:3])) > _TURNING
    if best.explained >= DOUBTFUL and not was_turning:
        return best
    turned = [exp([0.0, 0.0, math.radians(turn), 0.0, 0.0, 0.0]) @ T_last for turn in _TURNS_DEG]
    return try_instead(best, turned, sweeps, _FINE) or best
