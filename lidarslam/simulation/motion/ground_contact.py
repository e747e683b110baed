"""Bodies on uneven ground."""

from typing import NamedTuple

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.simulation.world import World

_SAMPLES = 24
_BLOCK = 4096


class Ground(NamedTuple):
    """Planes that fit the ground under footprints."""

    height: FloatArray  # (N,) z at the footprint's middle
    slope: FloatArray  # (N, 2) rise for each metre in x and y

    def pitch_and_roll(self, yaw: FloatArray, rise: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Pitch and roll (N,) of a body of that yaw (N,) on the planes, which rise by `rise` more for each metre."""
        c, s = np.cos(yaw), np.sin(yaw)
        pitch = -np.arctan(c * self.slope[:, 0] + s * self.slope[:, 1] + rise)
        return pitch, np.arctan(c * self.slope[:, 1] - s * self.slope[:, 0])


def ground_under(world: World, xy: FloatArray, radius_m: float) -> Ground:
    """Fit planes to the ground within a radius of (N, 2) positions, by weighted least squares.

    Samples are spread over the disc like the seeds of a sunflower, with weights that vanish at its rim: triangle edges
    pass gently under the body.
    """
    k = np.arange(_SAMPLES) + 0.5
    angle = np.pi * (1.0 + 5.0**0.5) * k
    disc = np.sqrt(k / _SAMPLES)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    weights = (1.0 - (disc**2).sum(axis=1)) ** 2
    weights /= weights.sum()
    offsets = radius_m * disc
    offsets -= weights @ offsets
    fit = np.linalg.solve(offsets.T @ (weights[:, None] * offsets), (weights[:, None] * offsets).T)
    heights = np.empty((len(xy), _SAMPLES))
    for start in range(0, len(xy), _BLOCK):
        samples = xy[start : start + _BLOCK, None] + offsets
        heights[start : start + _BLOCK] = world.ground_at(samples.reshape(-1, 2)).reshape(-1, _SAMPLES)
    return Ground(heights @ weights, heights @ fit.T)
