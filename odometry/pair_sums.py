"""What all pairs of points and planes say together of a motion: the sums that alignment solves and judges by."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lidarslam.core.geometry import FloatArray
from odometry.alignment_config import AlignmentConfig
from odometry.pairing import Movement, Pairs, filled, pair, sample
from odometry.sweeps import SweepPairs


@dataclass(frozen=True, eq=False)
class Tally:
    """Counts and sums over the points of B sweeps at a motion; points lie well within twice the finest scale.

    Attributes:
        H: (B, 12, 12) of the normal equations, each point that lies well with a weight of 1.
        in_view, matched: (B, 3, 3) of the squares of normals in the previous frame: of all points in view, and of those
            that lie well.
        share_in_view, share: (B,) parts of the points with a normal that are in view, and that lie well.
        count: (B,) how many lie well.
        squares: (B,) sum of their squared distances from the planes.
    """

    H: FloatArray
    in_view: FloatArray
    matched: FloatArray
    share_in_view: FloatArray
    share: FloatArray
    count: NDArray[np.int64]
    squares: FloatArray


class PairSums(Protocol):
    """Sums over the pairs of B sweeps with the ones before them."""

    def normal_equations(self, movement: Movement, scale_m: float) -> tuple[FloatArray, FloatArray]:
        """H (B, 12, 12) and g (B, 12) of squared distances with Geman and McClure's weights of this scale,
        for changes of T_prev_curr from the left and of the bend.
        """

    def tally(self, movement: Movement) -> Tally:
        """How the sweeps lie on one another in the end."""


class TorchSums:
    """On any device, all pairs at once."""

    def __init__(self, sweeps: SweepPairs, config: AlignmentConfig) -> None:
        self._source = sample(sweeps.current, config.column_step)
        self._target = filled(sweeps.previous, config.fill_columns)
        self._config = config

    def normal_equations(self, movement: Movement, scale_m: float) -> tuple[FloatArray, FloatArray]:
        """See `PairSums`."""
        pairs = pair(movement, self._source, self._target, scale_m, self._config)
        squared = pairs.residuals.square() / scale_m**2
        H, g = _normal_equations(pairs, pairs.kept / (1.0 + squared).square())
        return _array(H), _array(g)

    def tally(self, movement: Movement) -> Tally:
        """See `PairSums`."""
        pairs = pair(movement, self._source, self._target, self._config.fine_m, self._config)
        near = pairs.kept & (pairs.residuals.abs() < 2.0 * self._config.fine_m)
        normals = self._source.normals @ torch.from_numpy(movement.T_prev_curr[:, :3, :3]).to(self._source.normals).mT
        valid, count = self._source.valid.sum(-1).clamp(min=1), near.sum(-1)
        return Tally(
            H=_array(_normal_equations(pairs, near.to(pairs.residuals.dtype))[0]),
            in_view=_array((normals * pairs.inside[..., None]).mT @ normals),
            matched=_array((normals * near[..., None]).mT @ normals),
            share_in_view=_array(pairs.inside.sum(-1) / valid),
            share=_array(count / valid),
            count=count.numpy(force=True),
            squares=_array((pairs.residuals.square() * near).sum(-1)),
        )


def _normal_equations(pairs: Pairs, weights: Tensor) -> tuple[Tensor, Tensor]:
    """H and g of the weighted squares.

    A point that is seen t seconds after the middle of its sweep, on a pixel seen t' after that of its own, moves with
    the bend (t + t') times as it does with the motion.
    """
    J = torch.cat([torch.linalg.cross(pairs.moved, pairs.normals), pairs.normals], dim=-1)  # (B, N, 6)
    J = torch.cat([J, J * pairs.offsets_s[..., None]], dim=-1)
    weighted = J * weights[..., None]
    return weighted.mT @ J, (weighted.mT @ pairs.residuals[..., None])[..., 0]


def _array(values: Tensor) -> FloatArray:
    # In float32 what a guess says would be lost beside what the images say of other directions.
    return values.double().numpy(force=True)
