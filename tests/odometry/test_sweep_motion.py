"""Motions between stamps from motions between the middles of sweeps, on ways that are known."""

from collections.abc import Callable

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse, log
from lidarslam.odometry.alignment.sweep_motion import StampInterpolator

AXIS = np.array([0.2, -0.1, 0.9, 3.0, 0.5, -0.2])  # a screw: along it poses of different times commute


def even(times: FloatArray) -> FloatArray:
    return 0.7 * times


def growing(times: FloatArray) -> FloatArray:
    return 0.4 * times + 1.5 * times**2


def on_the_way(way: Callable[[FloatArray], FloatArray], *times: float) -> FloatArray:
    """(N, 4, 4)."""
    return exp(np.multiply.outer(way(np.array(times)), AXIS))


def between(way: Callable[[FloatArray], FloatArray], start: float, end: float) -> FloatArray:
    T = on_the_way(way, start, end)
    return np.asarray(inverse(T[0]) @ T[1])


def retimed(
    way: Callable[[FloatArray], FloatArray], middles: FloatArray, stamps: FloatArray, change: float = 0.0
) -> list[FloatArray]:
    """Motions from stamp to stamp; the velocity changes by 2 * change from middle to middle, as a part of the axis."""
    interpolator = StampInterpolator()
    return [
        interpolator.between_stamps(
            between(way, middles[i], middles[i + 1]),
            change * (middles[i + 1] - middles[i]) * AXIS,
            (middles[i], middles[i + 1]),
            (stamps[i], stamps[i + 1]),
        )
        for i in range(len(middles) - 1)
    ]


@pytest.mark.parametrize("at", [-0.05, 0.0, 0.05, np.array([-0.05, 0.05, -0.03, 0.01, 0.0])])
@pytest.mark.parametrize(("way", "change"), [(even, 0.0), (growing, 1.5)])
def test_motions_are_those_between_stamps_wherever_these_are(way, change, at):
    middles = np.array([0.0, 0.1, 0.2, 0.35, 0.45])  # one sweep took longer to come
    stamps = middles + at
    for number, motion in enumerate(retimed(way, middles, stamps, change)):
        np.testing.assert_allclose(motion, between(way, stamps[number], stamps[number + 1]), atol=1e-12)


def test_the_way_is_along_the_middles_in_the_end():
    """Errors at stamps do not add up: after any number of motions the pose is where the last middle says."""
    middles = np.linspace(0.0, 2.0, 21)
    T = np.eye(4)
    for motion in retimed(growing, middles, middles - 0.05, change=0.0):  # changes that are not known
        T = T @ motion
    wrong = log(inverse(on_the_way(growing, -0.05)[0] @ T) @ on_the_way(growing, 1.95)[0])
    assert np.linalg.norm(wrong[:3]) < 0.02
