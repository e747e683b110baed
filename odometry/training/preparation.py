"""A recording made ready for training: its scans as images, and how they lie on one another.

The motions are found by alignment alone, from many first guesses, with no label and no network. They compensate the
sweeps of the clouds that losses compare, and they are what the loss `alignment` pulls the network to.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lidarslam.core.geometry import FloatArray, exp, log
from lidarslam.core.scan import Scan
from odometry.alignment.alignment import Aligned, Guess
from odometry.alignment.alignment_config import AlignmentConfig
from odometry.alignment.search import align_best, try_instead
from odometry.images.image_config import ImageConfig
from odometry.images.sweep_images import Imager, middle_offset_s
from odometry.images.sweeps import LastMotion, SweepImages, SweepPair
from odometry.training.torch_images import RecordedImages

# Guesses about the turn from one scan to the next, degrees. Alignment finds its way over half a step.
_TURNS_DEG = (-20.0, -15.0, -10.0, -5.0, 5.0, 10.0, 15.0, 20.0)
_FINE = AlignmentConfig(column_step=2, iterations=10)
_TURNING = math.radians(3.0)
# A pair of scans that agree on less, or on fewer points, is not believed.
_BELIEVED = 0.4
_LEAST_POINTS = 60
_SHORTEST_S = 1e-3


@dataclass(frozen=True, eq=False)
class PreparedRecording:
    """N consecutive scans of one sensor.

    Attributes:
        images: of the raw sweeps, as the network sees them.
        interval_s: (N - 1,) from the middle of each sweep to the next.
        T_prev_curr: (N - 1, 4, 4) motions between the middles of sweeps, as alignment found them.
        believed: (N - 1,) whether the two scans lie well on one another.
        explained: (N - 1,) how much they agree on, see `odometry.alignment.alignment.Aligned`.
    """

    images: RecordedImages
    interval_s: Tensor
    T_prev_curr: Tensor
    believed: Tensor
    explained: Tensor

    def __len__(self) -> int:
        return len(self.images)


def prepare(scans: Iterable[Scan], config: ImageConfig) -> PreparedRecording:
    """Images of all scans, and the motions between them.

    Raises:
        ValueError: there are fewer than two scans.
    """
    imager, follower = Imager(config), _Follower()
    images, middles, found = [], [], []
    for scan in scans:
        made, middle = imager.images(scan), scan.stamp + middle_offset_s(scan)
        aligned = follower.follow(made.alignment, middle)
        images.append(made.network)
        middles.append(middle)
        found += [aligned] if aligned is not None else []
    if len(images) < 2:
        raise ValueError(f"training needs pairs of scans, this recording has {len(images)}")
    return PreparedRecording(
        images=RecordedImages.stacked(images),
        interval_s=torch.from_numpy(np.diff(middles)).float().clamp(min=_SHORTEST_S),
        T_prev_curr=torch.from_numpy(np.stack([one.T_prev_curr for one in found])).float(),
        believed=torch.tensor([_is_believed(one) for one in found]),
        explained=torch.tensor([one.explained for one in found]),
    )


def _is_believed(aligned: Aligned) -> bool:
    """Whether scans lie well on one another; one that says nothing at all does not."""
    return aligned.explained > _BELIEVED and aligned.matched >= _LEAST_POINTS


class _Follower:
    """Lays every scan on the one before it, of which it keeps no more than that."""

    def __init__(self) -> None:
        self._previous: tuple[SweepImages, float] | None = None
        self._last: LastMotion | None = None
        self._T_last = np.eye(4)

    def follow(self, images: SweepImages, middle: float) -> Aligned | None:
        """How the scan lies on the one before; None for the first."""
        previous, self._previous = self._previous, (images, middle)
        if previous is None:
            return None
        interval_s = max(middle - previous[1], _SHORTEST_S)
        best = _align_one(self._T_last, SweepPair(images, previous[0], interval_s, self._last))
        self._T_last, self._last = np.eye(4), None
        if _is_believed(best):
            self._T_last = best.T_prev_curr
            self._last = LastMotion(log(best.T_prev_curr) / interval_s, interval_s)
        return best


def _align_one(T_last: FloatArray, sweeps: SweepPair) -> Aligned:
    """From the last motion and from rest; from many turns unless that is good, or the sensor was turning."""
    best = align_best([Guess(T_last), Guess(np.eye(4), odds=1.0)], sweeps, _FINE)
    was_turning = float(np.linalg.norm(log(T_last)[:3])) > _TURNING
    if best.explained >= _FINE.doubtful and not was_turning:
        return best
    return try_instead(best, _turned(T_last), sweeps, _FINE) or best


def _turned(T_last: FloatArray) -> list[FloatArray]:
    """The last motion (4, 4) with other turns about z."""
    return [exp([0.0, 0.0, math.radians(turn), 0.0, 0.0, 0.0]) @ T_last for turn in _TURNS_DEG]
