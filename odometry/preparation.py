"""A recording made ready for training: its scans as images, and how they lie on one another.

The motions are found by alignment alone, from many first guesses, with no label and no network. They compensate the
sweeps of the clouds that losses compare, and they are what the loss `alignment` pulls the network to.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

import torch
from torch import Tensor

from lidarslam.core.scan import Scan
from odometry.alignment import Aligned
from odometry.alignment_config import AlignmentConfig
from odometry.alignment_search import align_best, try_instead
from odometry.image_config import ImageConfig
from odometry.sweep_images import Imager, middle_offset_s
from odometry.sweeps import LastMotion, SweepImages, SweepPairs, compensate, consecutive
from odometry.torch_geometry import log, turn_about_z

# Scans that are made into images, and pairs that are aligned, at a time: what fits a CPU's cache.
_AT_ONCE = 8
# Guesses about the turn from one scan to the next, degrees. Alignment finds its way over half a step.
_TURNS_DEG = (-20.0, -15.0, -10.0, -5.0, 5.0, 10.0, 15.0, 20.0)
_FINE = AlignmentConfig(column_step=2, iterations=10)
_TURNING = math.radians(3.0)
# A pair of scans that agree on less, or on fewer points, is not believed.
_BELIEVED = 0.4
_LEAST_POINTS = 60


@dataclass(frozen=True, eq=False)
class PreparedRecording:
    """N consecutive scans of one sensor.

    Attributes:
        images: of the raw sweeps.
        interval_s: (N - 1,) from the middle of each sweep to the next.
        T_prev_curr: (N - 1, 4, 4) motions between the middles of sweeps, as alignment found them.
        believed: (N - 1,) whether the two scans lie well on one another.
        explained: (N - 1,) how much they agree on, see `odometry.alignment.Aligned`.
    """

    images: SweepImages
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
    imager, parts, middles = Imager(config), [], []
    remaining = iter(scans)
    while batch := list(islice(remaining, _AT_ONCE)):
        parts.append(imager.images(batch))
        middles += [scan.stamp + middle_offset_s(scan) for scan in batch]
    if len(middles) < 2:
        raise ValueError(f"training needs pairs of scans, this recording has {len(middles)}")
    images = SweepImages(*(torch.cat([getattr(part, name) for part in parts]) for name in vars(parts[0])))
    interval_s = torch.tensor(middles, dtype=torch.float64).diff().float().clamp(min=1e-3)
    aligned = _align_all(images, interval_s)
    return PreparedRecording(images, interval_s, aligned.T_prev_curr, _believed(aligned), aligned.explained)


def _believed(aligned: Aligned) -> Tensor:
    """(B,) whether scans lie well on one another; one that says nothing at all does not."""
    return (aligned.explained > _BELIEVED) & (aligned.matched >= _LEAST_POINTS)


def _align_all(images: SweepImages, interval_s: Tensor) -> Aligned:
    """Every scan on the one before it: from the last motion and from rest, and unless that is good from many turns."""
    found: list[Aligned] = []
    T_last, last = torch.eye(4), None
    for number in range(len(images) - 1):
        interval = interval_s[number : number + 1]
        best = _align_one(T_last, consecutive(images, number, interval, last))
        T_last, last = torch.eye(4), None
        if _believed(best):
            T_last = best.T_prev_curr[0]
            last = LastMotion(log(best.T_prev_curr) / interval[:, None], interval)
        found.append(best)
    return Aligned(*(torch.cat([getattr(one, name) for one in found]) for name in vars(found[0])))


def _align_one(T_last: Tensor, sweeps: SweepPairs) -> Aligned:
    """From the last motion and from rest; from many turns unless that is good, or the sensor was turning."""
    best, _ = align_best(torch.stack([T_last, torch.eye(4)]), sweeps, _FINE)
    was_turning = float(log(T_last)[:3].norm()) > _TURNING
    if float(best.explained) >= _FINE.doubtful and not was_turning:
        return best
    return try_instead(best, _turned(T_last), sweeps, _FINE) or best


def _turned(T_last: Tensor) -> Tensor:
    """(K, 4, 4) the last motion with other turns about z."""
    return turn_about_z(torch.deg2rad(torch.tensor(_TURNS_DEG))) @ T_last


def compensated(images: SweepImages, velocity: Tensor) -> SweepImages:
    """Sweeps as seen from their middles, for bodies that move evenly at velocities (B, 6)."""
    shape, offsets = images.points.shape, images.offsets.flatten(1)
    points, normals = images.points.flatten(2).mT, images.normals.flatten(2).mT
    seen = points.square().sum(-1, keepdim=True) > 0.0
    points = compensate(points, offsets, velocity) * seen
    normals = compensate(normals, offsets, velocity, is_direction=True)
    return SweepImages(
        points.mT.reshape(shape), normals.mT.reshape(shape), torch.zeros_like(images.offsets), images.low, images.high
    )
