"""Trajectories for the core's tests."""

from collections.abc import Callable

import numpy as np
import pytest

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory


@pytest.fixture
def random_trajectory(rng: np.random.Generator) -> Callable[..., Trajectory]:
    """Unrelated poses up to a kilometre away, with stamps as of a clock since 1970."""

    def make(poses: int = 20) -> Trajectory:
        stamps = 1.6e9 + np.cumsum(rng.uniform(0.05, 0.15, poses))
        return Trajectory(stamps, exp(rng.normal(0.0, [1.0, 1.0, 1.0, 300.0, 300.0, 30.0], (poses, 6))))

    return make
