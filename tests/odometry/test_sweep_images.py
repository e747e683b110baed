"""Images of scans whose points are known."""

from dataclasses import replace

import numpy as np
import pytest

from lidarslam.core.scan import Scan
from lidarslam.odometry.config import ImageConfig
from lidarslam.odometry.images.sweep_images import Imager, SweepImages

CONFIG = ImageConfig(rows=16, columns=360)
TWIST = (0.0, 0.0, 0.5, 1.0, 0.0, 0.0)
EMPTY = Scan(np.zeros((0, 3)), 0.0, np.zeros(0))


def images_of(scan: Scan, imager: Imager | None = None) -> SweepImages:
    """What the network sees."""
    return (imager or Imager(CONFIG)).images(scan).network


def test_pixels_are_the_points_with_their_times(box_room):
    imager = Imager(CONFIG)
    for exact, scan in zip(box_room.sweeps(2, TWIST), box_room.scans(2, TWIST), strict=True):
        images = images_of(scan, imager)
        assert np.array_equal(images.points, exact.points)
        np.testing.assert_allclose(images.offsets, exact.offsets, atol=1e-7)
        assert (images.low, images.high) == pytest.approx((exact.low, exact.high), abs=1e-7)


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_offsets_are_from_the_middle_of_the_sweep_wherever_the_stamp_is(box_room, stamp_at):
    scan = box_room.scans(1, TWIST)[0]
    stamped = Scan(scan.points, scan.stamp, scan.time_offsets - stamp_at * 0.1)
    assert stamped.middle_offset_s == pytest.approx(0.05 - stamp_at * 0.1, abs=1e-8)
    np.testing.assert_allclose(images_of(stamped).offsets, box_room.sweeps(1, TWIST)[0].offsets, atol=1e-7)


def test_a_scan_of_few_points_or_none_does_not_fix_the_rows(box_room):
    """Each image says where its own rows lie; those of the scan with most points, until one has enough."""
    full = box_room.scans(1, TWIST)[0]
    elevation = np.rad2deg(np.arcsin(full.points[:, 2] / np.linalg.norm(full.points, axis=1)))
    fewer, few = (full.select(np.flatnonzero(elevation > above)[:most]) for above, most in ((10.0, 20), (3.0, 150)))
    imager = Imager(CONFIG)
    _, *made = [images_of(scan, imager) for scan in (EMPTY, fewer, few, fewer, full, few)]
    low, high = (np.rad2deg([getattr(one, name) for one in made]) for name in ("low", "high"))
    assert 10.0 < low[0] < 18.0
    assert 3.0 < low[1] == low[2] < 10.0
    np.testing.assert_allclose(low[3:], -18.0, atol=1e-4)
    np.testing.assert_allclose(high[3:], 18.0, atol=1e-4)


@pytest.mark.parametrize("azimuth_deg", [360.0, 70.0])
def test_points_that_lie_in_no_rows_are_shown_to_alignment_as_to_the_network(azimuth_deg):
    """As of a scanner that draws rosettes, all around or ahead alone."""
    rng = np.random.default_rng(0)
    azimuth, elevation = np.deg2rad(rng.uniform((0.0, -25.0), (azimuth_deg, 25.0), (24_000, 2))).T
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1)
    images = Imager(ImageConfig()).images(Scan(5.0 * rays, 0.0))
    assert images.alignment is images.network


def test_more_rows_for_alignment_leave_the_images_of_the_network_as_they_are(box_room, monkeypatch, through_disk):
    (scan,) = replace(box_room, rows=64, columns=720).scans(1, TWIST)
    imager, restored = Imager(CONFIG), Imager(CONFIG)
    both = imager.images(scan)
    restored.restore(through_disk(imager.state()))  # the rows are remembered
    assert np.array_equal(restored.images(scan).alignment.points, both.alignment.points)
    monkeypatch.setattr("lidarslam.odometry.images.sweep_images.rows_of_sensor", lambda *_: CONFIG.rows)
    alone = Imager(CONFIG).images(scan)
    assert both.alignment.points.shape == (3, 64, 360)
    for name in ("points", "normals", "offsets"):
        assert np.array_equal(getattr(both.network, name), getattr(alone.network, name))
