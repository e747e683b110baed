"""Scans keep their points, times and rings in step, whatever a driver delivers."""

import dataclasses

import numpy as np
import pytest

from lidarslam.core.scan import PointAttributes, Scan

INVALID = [[np.nan, 1, 1], [1, np.inf, 1], [1, 1, -np.inf], [0, 0, 0], [1e30, 1, 1], [1, -1e30, 1]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("invalid", INVALID)
def test_invalid_points_are_dropped_with_their_times_and_rings(invalid, dtype):
    points = np.array([[1, 2, 3], invalid, [4, 5, 6], [0, 0, 7]], dtype=dtype)
    scan = Scan.from_raw(points, 5.0, time_offsets=[0.0, 0.1, 0.2, 0.3], rings=[0, 1, 2, 3])
    assert scan.points.dtype == np.float64
    np.testing.assert_array_equal(scan.points, [[1, 2, 3], [4, 5, 6], [0, 0, 7]])
    np.testing.assert_array_equal(scan.time_offsets, [0.0, 0.2, 0.3])
    np.testing.assert_array_equal(scan.rings, [0, 2, 3])
    assert scan.rings.dtype == np.int32
    assert (len(scan), scan.dropped, scan.stamp) == (3, 1, 5.0)


def test_points_without_a_time_get_one_between_their_neighbours():
    points = np.ones((7, 3))
    points[5] = np.nan
    times = [np.nan, 0.0, np.nan, np.inf, 0.03, np.nan, 0.1]
    scan = Scan.from_raw(points, 0.0, times, rings=np.arange(7))
    assert scan.rings.tolist() == [0, 1, 2, 3, 4, 6]
    np.testing.assert_allclose(scan.time_offsets, [0.0, 0.0, 0.01, 0.02, 0.03, 0.1])
    assert (scan.dropped, scan.untimed) == (1, 3)


def test_a_ring_without_times_gets_the_middle_of_the_sweep():
    times = np.tile(np.linspace(0.0, 0.1, 50), (4, 1))
    times[1] = np.nan
    scan = Scan.from_raw(np.ones((4, 50, 3)), 0.0, times)
    np.testing.assert_allclose(scan.time_offsets[50:100], 0.05)
    assert scan.untimed == 50
    assert scan.select(np.arange(3)).untimed == 50


def test_times_of_which_most_are_worth_nothing_are_left_out_instead_of_the_points():
    points = np.vstack([np.ones((3, 3)), np.zeros((6, 3))])  # no returns, whose times do not count
    scan = Scan.from_raw(points, 0.0, time_offsets=[0.0, np.nan, np.inf, *np.zeros(6)])
    assert scan.time_offsets is None
    assert (len(scan), scan.dropped) == (3, 6)


@pytest.mark.parametrize("ring", [-1, 4096, 2**31, np.nan, 1e30, -np.inf])
def test_rings_that_are_no_lasers_are_left_out(ring):
    assert Scan.from_raw(np.ones((3, 3)), 0.0, rings=np.array([0, ring, 4095])).rings is None


def test_organised_clouds_are_flattened_row_by_row():
    cloud = np.arange(1.0, 25.0).reshape(2, 4, 3)
    cloud[0, 1] = np.nan
    rings = np.repeat([[0], [1]], 4, axis=1)
    times = np.tile([0.0, 0.1, 0.2, 0.3], (2, 1))
    scan = Scan.from_raw(cloud, 0.0, times, rings)
    assert len(scan) == 7
    assert scan.rings.tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert scan.time_offsets.tolist() == [0.0, 0.2, 0.3, 0.0, 0.1, 0.2, 0.3]
    np.testing.assert_array_equal(scan.points[1], [7, 8, 9])


@pytest.mark.parametrize("points", [[], np.zeros((0, 3)), np.zeros((5, 3)), np.full((2, 2, 3), np.nan)])
def test_a_scan_may_come_out_empty(points):
    scan = Scan.from_raw(points, 0.0)
    assert scan.points.shape == (0, 3)
    assert scan.time_offsets is scan.rings is None


@pytest.mark.parametrize("field", ["time_offsets", "rings"])
@pytest.mark.parametrize("entries", [2, 4])
def test_mismatched_lengths_are_refused(field, entries):
    with pytest.raises(ValueError, match=rf"{field} has {entries} entries for 3 points"):
        Scan.from_raw(np.ones((3, 3)), 0.0, **{field: np.zeros(entries)})


def test_construction_is_checked():
    points = np.ones((4, 3))
    with pytest.raises(ValueError, match=r"\(N, 3\), got \(4, 2\)"):
        Scan(points[:, :2], 0.0)
    with pytest.raises(ValueError, match=r"time_offsets must be \(4,\), got \(3,\)"):
        Scan(points, 0.0, time_offsets=np.zeros(3))
    with pytest.raises(ValueError, match=r"rings must be \(4,\), got \(4, 1\)"):
        Scan(points, 0.0, rings=np.zeros((4, 1), dtype=np.int32))
    with pytest.raises(ValueError, match="stamp must be finite, got nan"):
        Scan(points, np.nan)


@pytest.mark.parametrize("chosen", [np.array([True, False, True, False]), np.array([0, 2])], ids=["mask", "indices"])
def test_select_keeps_everything_in_step(chosen):
    scan = Scan.from_raw(np.arange(1.0, 16.0).reshape(5, 3) * np.c_[[1, 1, 0, 1, 1]], 3.0, np.arange(5.0), np.arange(5))
    part = scan.select(chosen)
    np.testing.assert_array_equal(part.points, [[1, 2, 3], [10, 11, 12]])
    assert part.time_offsets.tolist() == [0.0, 3.0]
    assert part.rings.tolist() == [0, 3]
    assert (part.stamp, part.dropped) == (3.0, 1)
    assert Scan(np.ones((4, 3)), 0.0).select(chosen).rings is None


def test_intensities_and_colours_go_with_their_points():
    points = np.array([[1, 2, 3], [0, 0, 0], [4, 5, 6], [7, 8, 9]])
    colours = np.arange(12).reshape(4, 3)
    scan = Scan.from_raw(points, 1.0, intensities=np.array([0, 65535, 7, 300], dtype=np.uint16), colours=colours)
    assert scan.intensities.dtype == np.float32
    assert scan.intensities.tolist() == [0.0, 7.0, 300.0]
    assert scan.colours.tolist() == [[0, 1, 2], [6, 7, 8], [9, 10, 11]]
    part = scan.select(np.array([2, 0]))
    assert part.intensities.tolist() == [300.0, 0.0]
    assert part.colours.tolist() == [[9, 10, 11], [0, 1, 2]]
    for name, value in (("intensities", np.zeros(3)), ("colours", np.zeros((3, 3))), ("colours", np.zeros((3, 4)))):
        with pytest.raises(ValueError, match=name):
            Scan.from_raw(points, 1.0, **{name: value})
        with pytest.raises(ValueError, match=rf"Scan\.{name} must be"):
            dataclasses.replace(scan, **{name: value[:-1]})


def test_attributes_are_those_that_are_wanted_and_there():
    scan = Scan.from_raw(np.ones((3, 3)), 5.0, [0.0, 0.1, 0.2], [4, 5, 6], intensities=[1, 2, 3])
    known = scan.attributes(["intensity", "rgb", "ring", "time"])
    assert known.intensity.tolist() == [1.0, 2.0, 3.0]
    assert known.rgb is None
    assert known.ring.tolist() == [4, 5, 6]
    assert known.time.tolist() == [5.0, 5.1, 5.2]
    assert not list(scan.attributes([]).present())
    untimed = Scan.from_raw(np.ones((2, 3)), 5.0).attributes(["time"])
    assert untimed.time.tolist() == [5.0, 5.0]


def test_the_construction_of_attributes_is_checked():
    with pytest.raises(ValueError, match=r"differ in length: \{'intensity': 2, 'time': 3\}"):
        PointAttributes(intensity=np.zeros(2, dtype=np.float32), time=np.zeros(3))
    with pytest.raises(ValueError, match=r"rgb must be \(N, 3\), got \(3, 4\)"):
        PointAttributes(rgb=np.zeros((3, 4), dtype=np.uint8))
