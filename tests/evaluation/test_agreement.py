"""Unrelated trajectories are called that; a drifting, a standing and an identical one are not."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, make_transform
from lidarslam.core.trajectory import Trajectory
from lidarslam.evaluation.trajectory.metrics import disagreement, evaluate_trajectory


def along(positions: FloatArray) -> Trajectory:
    return Trajectory(
        0.1 * np.arange(len(positions)), make_transform(np.tile(np.eye(3), (len(positions), 1, 1)), positions)
    )


@pytest.fixture
def bend() -> FloatArray:
    angle = np.linspace(0.0, 4.0, 60)
    return 10.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * angle])


def test_of_one_drive(bend: FloatArray, rng: np.random.Generator) -> None:
    drift = np.linspace(0.0, 3.0, len(bend))[:, None] * [1.0, 0.0, 0.0]
    for estimate in (bend, bend + drift, bend + rng.normal(0.0, 0.1, bend.shape)):
        assert disagreement(evaluate_trajectory(along(estimate), along(bend))) is None
    standing = rng.normal(0.0, 0.01, bend.shape)
    assert disagreement(evaluate_trajectory(along(standing), along(0.0 * bend))) is None


@pytest.mark.parametrize("kind", ["elsewhere", "lost", "stood still"])
def test_of_two_drives(bend: FloatArray, rng: np.random.Generator, kind: str) -> None:
    other = {"elsewhere": bend[:, [1, 2, 0]] * [3, 1, -2] + 9 * np.sin(bend), "lost": rng.normal(0, 50, bend.shape)}
    estimate = other.get(kind, 0.001 * bend[::-1])
    said = disagreement(evaluate_trajectory(along(estimate), along(bend)))
    assert said is not None
    assert "does not follow its reference" in said


def test_of_two_cars_on_straight_roads(rng: np.random.Generator) -> None:
    """One at a constant speed, one that brakes to a stand: aligned, they are nowhere far apart."""
    steady, braking = np.zeros((80, 3)), np.zeros((80, 3))
    steady[:, 0], braking[:, 0] = np.arange(80), np.cumsum(np.linspace(2.0, 0.0, 80))
    said = disagreement(evaluate_trajectory(along(steady + rng.normal(0.0, 0.02, (80, 3))), along(braking)))
    assert said is not None
    assert "does not follow its reference" in said


def test_millimetres(bend: FloatArray) -> None:
    said = disagreement(evaluate_trajectory(along(bend), along(1_000.0 * bend)))
    assert said is not None
    assert said.endswith("are both in metres?")
