"""Closures on a known round trip: true ones agree, a planted false one does not."""

import numpy as np
import pytest

from lidarslam.core.geometry import exp, make_transform
from lidarslam.mapping.config import LoopConfig
from lidarslam.mapping.loops.closure import CHI_SQUARED_99, RelativePose, Track

RATES = LoopConfig().drift_rates
SIGMAS = np.array([0.003] * 3 + [0.03] * 3)


def agree(a: RelativePose, b: RelativePose, track: Track) -> bool:
    """Whether the cycle of two links closes; links of other pairs of segments make none."""
    cycle = track.close_cycle(a, b)
    return cycle is not None and cycle[0] < CHI_SQUARED_99


@pytest.fixture
def round_trip() -> Track:
    """Forty keyframes on a circle of 20 m, twice round, and one of another segment at the end."""
    angles = np.linspace(0.0, 4.0 * np.pi, 80)
    R = exp(np.stack([0 * angles, 0 * angles, angles, 0 * angles, 0 * angles, 0 * angles], axis=1))[:, :3, :3]
    poses = make_transform(R, np.stack([20.0 * np.cos(angles), 20.0 * np.sin(angles), 0 * angles], axis=1))
    return Track(poses, 20.0 * angles, np.zeros(80, dtype=np.int64), RATES)


def link(track: Track, first: int, second: int, off=(0, 0, 0, 0, 0, 0)) -> RelativePose:
    return RelativePose(first, second, track.between(first, second) @ exp(off), np.diag(SIGMAS**2))


def test_true_links_agree_and_a_false_one_does_not(round_trip):
    a, b = link(round_trip, 3, 43), link(round_trip, 8, 48)
    false = link(round_trip, 6, 46, (0, 0, 0, 1.5, 0, 0))
    turned = link(round_trip, 6, 46, (0, 0, np.deg2rad(8.0), 0, 0, 0))
    assert agree(a, b, round_trip)
    assert agree(b, a, round_trip)
    assert not agree(a, false, round_trip)
    assert not agree(false, b, round_trip)
    assert not agree(a, turned, round_trip)


def test_the_uncertainty_of_a_link_turns_with_it(round_trip):
    """A link unsure along its own x, which differs by a quarter turn from the other's, excuses an error along it."""
    quarter = 40 // 4
    loose = np.diag(np.array([0.003] * 3 + [2.0, 0.03, 0.03]) ** 2)
    a = RelativePose(3, 43, round_trip.between(3, 43) @ exp([0, 0, 0, 1.5, 0, 0]), loose)
    across = RelativePose(3, 43, round_trip.between(3, 43) @ exp([0, 0, 0, 0, 1.5, 0]), loose)
    other = link(round_trip, 3 + quarter, 43 + quarter)
    near = link(round_trip, 4, 44)
    assert agree(a, near, round_trip)
    assert agree(near, a, round_trip)
    assert not agree(across, near, round_trip)
    assert agree(a, other, round_trip)


def test_longer_ways_excuse_more(round_trip):
    near, far = link(round_trip, 4, 44), link(round_trip, 30, 70)
    off = link(round_trip, 3, 43, (0, 0, 0, 0.6, 0, 0))
    assert not agree(off, near, round_trip)
    assert agree(off, far, round_trip)


def test_between_segments_only_ways_within_them_count(round_trip):
    """The second is in a world of its own."""
    segment, poses = np.arange(80) // 40, round_trip.T_world_lidar.copy()
    poses[40:] = exp([0.0, 0.0, 2.0, 50.0, -9.0, 3.0]) @ poses[40:]
    two = Track(poses, round_trip.way_m, segment, RATES)
    assert agree(link(round_trip, 3, 43), link(round_trip, 8, 48), two)
    assert not agree(link(round_trip, 3, 43), link(round_trip, 8, 48, (0, 0, 0, 0, 2.5, 0)), two)
    assert not agree(link(two, 3, 23), link(two, 6, 46), two)


def test_correction_is_counted_in_drift(round_trip):
    way = round_trip.way_m[43] - round_trip.way_m[3]
    assert round_trip.correction_sigmas(link(round_trip, 3, 43)) == pytest.approx(0.0, abs=1e-6)
    one = link(round_trip, 3, 43, (0, 0, np.deg2rad(2.0) * way / 100.0, 0, 0, 0))
    assert round_trip.correction_sigmas(one) == pytest.approx(1.0, rel=0.1)
    assert round_trip.correction_sigmas(link(round_trip, 3, 43, (0, 0, 0, 12.0, 0, 0))) > 3.0


def test_drift_grows_with_the_way_and_the_swing(round_trip):
    rotation, translation = round_trip.drift(np.array([42, 33, 3]), 43)
    assert (np.diff(rotation) > 0.0).all()
    assert (np.diff(translation) > 0.0).all()
    way = round_trip.way_m[43] - round_trip.way_m[3]
    assert rotation[2] == pytest.approx(np.deg2rad(0.1 + 0.02 * way), rel=1e-6)
    # The way round a circle lies, root mean square, sqrt(2) radii from a point of it.
    swing = 0.5 * rotation[2] * np.sqrt(2.0) * 20.0
    assert translation[2] == pytest.approx(np.hypot(0.02 + 0.01 * way, swing), rel=0.05)
