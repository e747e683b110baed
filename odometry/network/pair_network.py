"""The protocol of the networks: images of pairs of scans in, motions with standard deviations out."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True, eq=False)
class PairImages:
    """The input of the networks for B pairs of scans."""

    # previous, current: (B, 6, H, W) points and normals
    previous: Tensor
    current: Tensor
    # bird_previous, bird_current: (B, CHANNELS, CELLS, CELLS) seen from above, the current scan turned by about the
    # turn between the two; None for networks that do not look from above
    bird_previous: Tensor | None = None
    bird_current: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Estimate:
    """The output of a network for B pairs."""

    T_prev_curr: Tensor  # (B, 4, 4)
    # (B, 6) logarithm of the standard deviation along each direction of a change of `T_prev_curr` from the left:
    # rotation in radians, then translation in metres
    log_sigma: Tensor
    # (B, S) log-likelihoods, up to a constant, of the turns about z by a whole number of feature columns; (B, 0) where
    # the network has none
    turn_scores: Tensor
    shift_scores: Tensor  # (B, SHIFTS, SHIFTS) the same of shifts by whole cells along y and x; (B, 0, 0) without


class PairNetwork(Protocol):
    """A network that estimates the motion between two scans."""

    def __call__(self, pairs: PairImages) -> Estimate:
        """The motions of B pairs."""


def has_normal(normals: Tensor, dim: int) -> Tensor:
    """Which pixels or points have a normal: those without hold zeros along the dimension of x, y and z."""
    return normals.square().sum(dim=dim) > 0.5
