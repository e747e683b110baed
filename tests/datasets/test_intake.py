"""What is seen of every scan before it is worked on."""

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at, take_in


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


class Recorded:
    """Scans with these stamps."""

    def __init__(self, stamps):
        self.stamps = stamps

    def scans(self, start, stop, step, _):
        return (Scan(np.ones((3, 3)), stamp) for stamp in self.stamps[start:stop:step])


@pytest.mark.parametrize(("period_s", "told"), [(1e-6, True), (0.9e-3, True), (1e-3, False), (0.1, False)])
def test_stamps_that_no_lidar_has_are_told_once(period_s, told):
    faults = Faults()
    scans = list(take_in(Recorded([1000.0 + period_s * number for number in range(8)]), range(8), faults))
    assert len(scans) == 8
    assert len(faults.warnings()) == told
    if told:
        assert faults.warnings()[0].startswith("7 scans are stamped within a millisecond of the one before")
