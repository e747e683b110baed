"""Motions between stamps from motions between the middles of sweeps, on ways that are known."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.alignment.sweep_motion import StampInterpolator

AXIS = np.array([0.2, -0.1, 0.9, 3.0, 0.5, -0.2])  # a screw: along it poses of different times commute


def on_the_way(*times: float) -> FloatArray:
    """(N, 4, 4)."""
    return exp(np.multiply.outer(0.4 * np.array(times) + 1.5 * np.square(times), AXIS))


def between(start: float, end: float) -> FloatArray:
    T = on_the_way(start, end)
    return np.asarray(inverse(T[0]) @ T[1])


def retimed(middles: FloatArray, stamps: FloatArray, change: float = 0.0) -> list[FloatArray]:
    """Motions from stamp to stamp; the velocity changes by 2 * change from middle to middle, as a part of the axis."""
    interpolator = StampInterpolator()
    return [
        interpolator.between_stamps(
            between(middles[i], middles[i + 1]),
            change * (middles[i + 1] - middles[i]) * AXIS,
            (middles[i], middles[i + 1]),
            (stamps[i], stamps[i + 1]),
        )
        for i in range(len(middles) - 1)
    ]


@pytest.mark.parametrize("at", [-0.05, 0.0, 0.05, np.array([-0.05, 0.05, -0.03, 0.01, 0.0])])
def test_motions_are_those_between_stamps_wherever_these_are(at):
    middles = np.array([0.0, 0.1, 0.2, 0.35, 0.45])  # one sweep took longer to come
    stamps = middles + at
    for number, motion in enumerate(retimed(middles, stamps, 1.5)):
        np.testing.assert_allclose(motion, between(stamps[number], stamps[number + 1]), atol=1e-12)


def test_the_way_is_along_the_middles_in_the_end():
    """Errors at stamps do not add up: after any number of motions the pose is where the last middle says."""
    middles = np.linspace(0.0, 2.0, 21)
    T = np.eye(4)
    for motion in retimed(middles, middles - 0.05):  # changes that are not known
        T = T @ motion
    wrong = log(inverse(on_the_way(-0.05)[0] @ T) @ on_the_way(1.95)[0])
    assert np.linalg.norm(wrong[:3]) < 0.02
