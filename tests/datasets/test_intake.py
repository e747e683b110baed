"""What is seen of every scan before it is worked on."""

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at


def seen(points, **fields):
    faults = Faults()
    return look_at(Scan(np.asarray(points, dtype=np.float64), 1.0, **fields), faults), faults


def test_a_usual_scan_is_left_as_it_is(rng):
    points = rng.uniform(-80.0, 80.0, (1000, 3))
    scan, faults = seen(points)
    assert scan.points is points or np.array_equal(scan.points, points)
    assert faults.warnings() == ()


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((1, 3)), np.full((50, 3), 900.0)])
def test_a_few_points_say_nothing_about_their_unit(points):
    assert seen(points)[1].warnings() == ()


def test_a_scan_of_ten_million_points_is_thinned_and_said(rng):
    points = rng.uniform(-40.0, 40.0, (10_000_000, 3))
    offsets = points[:, 0] / 1000.0
    scan, faults = seen(points, time_offsets=offsets)
    assert 400_000 < len(scan) <= 1 << 20
    np.testing.assert_array_equal(scan.time_offsets, scan.points[:, 0] / 1000.0)
    assert faults.left_out == 0
    assert faults.warnings()[0].startswith("1 scan of more than 1,048,576 points was thinned")
    assert "10,000,000 points at 1.0" in faults.warnings()[0]


def test_millimetres_are_told(rng):
    room = rng.uniform(-6.0, 6.0, (1000, 3))
    scan, faults = seen(1000.0 * room)
    assert len(scan) == 1000
    assert faults.warnings()[0].startswith("1 scan looks like millimetres, where metres are expected")


def test_all_points_at_one_place_are_told():
    assert seen(np.full((1000, 3), 2.5))[1].warnings()[0].startswith("1 scan has all its points at one place")
