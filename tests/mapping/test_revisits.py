"""Closures of places that the local map still holds, and of those that it has forgotten."""

import numpy as np
import pytest

from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.mapping.loops.closure import LoopClosure
from lidarslam.mapping.pose_graph.edges import Keyframe
from lidarslam.mapping.pose_graph.submap_placement import Drawn, SubmapPlacement

SIGMA = np.array([1e-3] * 3 + [5e-3] * 3)
REGISTERED = np.diag(SIGMA**2)


@pytest.fixture
def round_trip() -> FloatArray:
    """Poses (101, 4, 4) once round a circle of 40 m across, and a little farther."""
    turn = np.array([0.0, 0.0, 2.0 * np.pi / 100.0, 2.0 * np.pi * 20.0 / 100.0, 0.0, 0.0])
    poses = [exp([0.1, 0.0, 0.3, 5.0, -2.0, 1.0])]
    for _ in range(100):
        poses.append(poses[-1] @ exp(1.002 * turn))
    return np.array(poses)


def closure(way: FloatArray, off: FloatArray, sigma: float = 0.01) -> LoopClosure:
    """Of its first and last pose, off by (6,) from what the way says."""
    T_first_second = inverse(way[0]) @ way[-1] @ exp(off)
    covariance = sigma**2 * np.eye(6)
    return LoopClosure(0, 25, T_first_second, covariance, 0.9, 0.01, 0.9, False, 3, "")


NEAR = np.array([0.0, 0.002, 0.0, 0.012, -0.01, 0.0])


def as_registered(
    measured: LoopClosure,
    way: FloatArray,
    radius_m: float,
    first: FloatArray | None = REGISTERED,
    drawn: tuple[Drawn, ...] = (),
) -> LoopClosure:
    """The closure of the first and last scan, in a local map of that radius."""
    placement = SubmapPlacement(radius_m)
    placement._drawn = [*drawn]
    ends = Keyframe(0, 0, 0.0, first), Keyframe(len(way) - 1, 0, 1.0, REGISTERED)
    return placement.as_registered(measured, *ends, list(way))


def test_where_the_map_held_the_place_the_trajectory_measures_the_closure(round_trip):
    found = as_registered(closure(round_trip, NEAR), round_trip, 100.0)
    np.testing.assert_allclose(found.T_first_second, inverse(round_trip[0]) @ round_trip[-1], atol=1e-12)
    assert found.accepted
    assert np.linalg.eigvalsh(found.covariance - REGISTERED).min() > 0.0, "both registrations err"


def test_a_submap_that_was_laid_elsewhere_is_measured_there(round_trip):
    """The local map was drawn anew before the last ten scans, which are registered to its surfaces."""
    T_odom_first = round_trip[0] @ exp(0.5 * NEAR)
    drawn = Drawn(len(round_trip) - 10, np.array([0]), 1, T_odom_first[None])
    found = as_registered(closure(round_trip, NEAR), round_trip, 30.0, drawn=(drawn,))
    np.testing.assert_allclose(found.T_first_second, inverse(T_odom_first) @ round_trip[-1], atol=1e-12)


@pytest.mark.parametrize(
    ("radius_m", "first", "off"),
    [
        (50.0, REGISTERED, NEAR),
        (0.0, REGISTERED, NEAR),
        (100.0, None, NEAR),
        (100.0, REGISTERED, np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])),
    ],
    ids=["the way left the map", "without a map", "not registered", "drifted off its own map"],
)
def test_elsewhere_the_closure_counts(round_trip, radius_m, first, off):
    measured = closure(round_trip, off)
    assert as_registered(measured, round_trip, radius_m, first) is measured
