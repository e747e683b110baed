"""How a body rests on uneven ground."""

from dataclasses import dataclass

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import World

_SAMPLES = 24
_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground under a footprint.

    Attributes:
        height: (N,) z of the plane that fits the ground under the footprint, at its middle.
        slope: (N, 2) rise of that plane for each metre in x and y.
    """

    height: FloatArray
    slope: FloatArray


def ground_under(world: World, xy: FloatArray, radius_m: float) -> Ground:
    """Fit planes to the ground within a radius of (N, 2) positions; they depend on the position alone.

    Samples lie evenly in the disc, with weights that vanish at its rim: triangle edges pass gently under the body.
    """
    disc = _even_disc(_SAMPLES)
    weights = (1.0 - (disc**2).sum(axis=1)) ** 2
    weights /= weights.sum()
    offsets = radius_m * disc
    offsets -= weights @ offsets
    fit = np.linalg.solve(offsets.T @ (weights[:, None] * offsets), (weights[:, None] * offsets).T)
    heights = np.empty((len(xy), _SAMPLES))
    for start in range(0, len(xy), _BLOCK):
        block = xy[start : start + _BLOCK]
        heights[start : start + _BLOCK] = world.ground_at((block[:, None] + offsets).reshape(-1, 2)).reshape(
            -1, _SAMPLES
        )
    return Ground(heights @ weights, heights @ fit.T)


def _even_disc(count: int) -> FloatArray:
    """Points (count, 2) spread evenly over the unit disc: the seeds of a sunflower."""
    k = np.arange(count) + 0.5
    angle = np.pi * (1.0 + 5.0**0.5) * k
    return np.asarray(np.sqrt(k / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
