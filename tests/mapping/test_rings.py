"""Rings that were derived are the rings the sensor has, whatever the storage and the mounting."""

from collections.abc import Callable

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from mapping.loam.rings import RingFinder, Rings, RingSource

SPINNING = ["vlp-16", "hdl-32e", "hdl-64e", "os0-64", "os1-64", "os1-128", "xt32"]
Scanner = Callable[..., Scan]


def same_partition(a: Rings | None, b: Rings | None) -> bool:
    if a is None or b is None:
        return False
    pairs = np.unique(np.stack([a, b]), axis=1).shape[1]
    return pairs == len(np.unique(a)) == len(np.unique(b))


@pytest.mark.parametrize("sensor", SPINNING)
def test_elevations_give_the_rings_of_every_spinning_sensor(scan_room: Scanner, sensor: str) -> None:
    scan = scan_room(sensor, sigma_m=0.02)
    finder = RingFinder()
    assert same_partition(finder.rings(scan.points, None), scan.rings)
    assert finder.source is RingSource.ELEVATION


@pytest.mark.parametrize("storage", ["ring after ring", "columns backwards", "shuffled"])
@pytest.mark.parametrize("mount", ["upright", "upside-down", "tilted"])
def test_neither_storage_nor_mounting_matters(
    scan_room: Scanner, rng: np.random.Generator, storage: str, mount: str
) -> None:
    scan = scan_room("vlp-16", mount)
    assert scan.rings is not None
    orders = {
        "ring after ring": np.argsort(scan.rings, kind="stable"),
        "columns backwards": np.arange(len(scan))[::-1],
        "shuffled": rng.permutation(len(scan)),
    }
    stored = scan.select(orders[storage])
    assert same_partition(RingFinder().rings(stored.points, None), stored.rings)


@pytest.mark.parametrize("seam_deg", [0.0, 90.0, 183.0])
@pytest.mark.parametrize("clockwise", [True, False])
def test_turns_give_the_rings_where_elevations_do_not(
    rng: np.random.Generator, seam_deg: float, clockwise: bool
) -> None:
    """Lasers beside the axis spread by as much as they lie apart; a tenth of the rays does not return."""
    azimuths = np.deg2rad(seam_deg + np.arange(0.1, 360.0, 0.4)) * (-1.0 if clockwise else 1.0)
    azimuth, elevation = np.tile(azimuths, 40), np.repeat(np.deg2rad(np.linspace(2.0, -14.0, 40)), len(azimuths))
    rings = np.repeat(np.arange(40), len(azimuths))
    elevation += rng.normal(0.0, np.deg2rad(0.2), len(elevation))
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    kept = rng.uniform(size=len(rings)) > 0.1
    points = (np.stack(rays, axis=1) * rng.uniform(3.0, 50.0, (len(rings), 1)))[kept]
    finder = RingFinder()
    found = finder.rings(points, None)
    assert finder.source is RingSource.STORAGE
    # The seam is found to a degree or so: a few points of a ring may count to the next one.
    assert found is not None
    assert np.mean(found == rings[kept]) > 0.99
    assert len(np.unique(found)) <= 41


@pytest.mark.real_data
def test_a_real_recording_is_stored_ring_after_ring(real_data) -> None:
    from lidarslam.datasets.config import ReaderConfig
    from lidarslam.datasets.kitti.odometry import open_recording

    finder = RingFinder()
    for scan in open_recording(real_data / "kitti_odometry_04", ReaderConfig()).scans(0, 20, 10):
        rings = finder.rings(scan.points, None)
        assert rings is not None
        assert len(np.unique(rings)) == 64
    assert finder.source is RingSource.STORAGE


def test_the_ring_field_is_used_as_it_is(scan_room: Scanner) -> None:
    scan, finder = scan_room("os1-64", "upside-down"), RingFinder()
    assert finder.rings(scan.points, scan.rings) is scan.rings
    assert finder.source is RingSource.FIELD


@pytest.mark.parametrize("field", ["constant", "numbers"])
def test_a_field_that_holds_no_rings_is_not_used(scan_room: Scanner, field: str) -> None:
    scan, finder = scan_room("vlp-16"), RingFinder()
    wrong = np.zeros(len(scan), dtype=np.int32) if field == "constant" else np.arange(len(scan), dtype=np.int32)
    assert same_partition(finder.rings(scan.points, wrong), scan.rings)
    assert finder.source is RingSource.ELEVATION


def test_lines_of_a_sensor_without_pattern_are_no_rings(scan_room: Scanner) -> None:
    scan, finder = scan_room("livox"), RingFinder()
    assert finder.rings(scan.points, scan.rings) is None
    assert finder.rings(scan.points, None) is None
    assert finder.source is RingSource.NONE


def test_lasers_that_saw_nothing_at_first_are_found_later(scan_room: Scanner) -> None:
    scan = scan_room("vlp-16")
    assert scan.rings is not None
    finder = RingFinder()
    finder.rings(scan.points[scan.rings < 12], None)
    assert same_partition(finder.rings(scan.points, None), scan.rings)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.array([[1.0, 2.0, 3.0]])])
def test_hardly_any_points(scan_room: Scanner, points: np.ndarray) -> None:
    finder = RingFinder()
    assert finder.rings(points, None) is None
    assert finder.source is None, "decides at the first scan that shows something"
    scan = scan_room("vlp-16")
    finder.rings(scan.points, None)
    found = finder.rings(points, None)
    assert found is not None
    assert len(found) == len(points)
