"""Trajectories of known shape."""

from collections.abc import Callable

import numpy as np
import pytest

from lidarslam.core.geometry import exp
from lidarslam.core.trajectory import Trajectory, chain


@pytest.fixture
def random_drive() -> Callable[..., Trajectory]:
    """A vehicle's drive: about a metre a scan at 10 Hz, turning, with a little pitch and roll; from a seed."""

    def drive(seed: int, scans: int = 400, step_m: float = 1.0) -> Trajectory:
        rng = np.random.default_rng(seed)
        yaw_rate = np.convolve(rng.normal(0.0, 0.08, scans - 1), np.ones(20) / 20.0, mode="same")
        xi = rng.normal(0.0, 0.003, (scans - 1, 6))
        xi[:, 2] += yaw_rate
        xi[:, 3] += step_m * rng.uniform(0.7, 1.3, scans - 1)
        return Trajectory(100.0 + 0.1 * np.arange(scans), chain(np.eye(4), exp(xi)))

    return drive


@pytest.fixture
def straight_drive() -> Callable[..., Trajectory]:
    """A drive along x at constant speed and 10 Hz, `T_prev_curr` of each scan given by a tangent vector."""

    def drive(scans: int, xi: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0)) -> Trajectory:
        return Trajectory(0.1 * np.arange(scans), exp(np.arange(scans)[:, None] * np.array(xi)))

    return drive


@pytest.fixture
def noisy() -> Callable[..., Trajectory]:
    """The same trajectory with each relative motion disturbed, so that it drifts."""

    def disturb(trajectory: Trajectory, seed: int, sigma: float = 0.005) -> Trajectory:
        noise = np.random.default_rng(seed).normal(0.0, sigma, (len(trajectory) - 1, 6))
        motions = trajectory.relative_motions() @ exp(noise * [0.1, 0.1, 0.1, 1.0, 1.0, 1.0])
        return Trajectory(trajectory.stamps, chain(trajectory.T_world_lidar[0], motions))

    return disturb
