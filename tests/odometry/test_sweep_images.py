"""Images of scans whose points are known."""

import math

import numpy as np
import pytest
import torch

from lidarslam.core.scan import Scan
from odometry.image_config import ImageConfig
from odometry.sweep_images import Imager, middle_offset_s

CONFIG = ImageConfig(rows=16, columns=360)
TWIST = (0.0, 0.0, 0.5, 1.0, 0.0, 0.0)
EMPTY = Scan(np.zeros((0, 3)), 0.0, np.zeros(0))


def test_pixels_are_the_points_with_their_times(box_room):
    exact = box_room.sweeps(2, TWIST)
    images = Imager(CONFIG).images(box_room.scans(2, TWIST))
    assert torch.equal(images.points, exact.points)
    torch.testing.assert_close(images.offsets, exact.offsets, rtol=0, atol=1e-7)
    torch.testing.assert_close(images.low, exact.low)
    torch.testing.assert_close(images.high, exact.high)


def test_normals_are_those_of_the_walls(box_room):
    exact = box_room.sweeps(1, (0.0,) * 6)
    images = Imager(CONFIG).images(box_room.scans(1, (0.0,) * 6))
    there = images.normals.square().sum(1) > 0.5
    agree = (images.normals * exact.normals).sum(1) > math.cos(math.radians(0.5))
    assert there.float().mean() > 0.85
    assert agree[there].float().mean() > 0.8  # the others are near edges


@pytest.mark.parametrize("stamp_at", [0.0, 0.5, 1.0])
def test_offsets_are_from_the_middle_of_the_sweep_wherever_the_stamp_is(box_room, stamp_at):
    scan = box_room.scans(1, TWIST)[0]
    assert scan.time_offsets is not None
    stamped = Scan(scan.points, scan.stamp, scan.time_offsets - stamp_at * 0.1)
    assert middle_offset_s(stamped) == pytest.approx(0.05 - stamp_at * 0.1, abs=1e-8)
    offsets = Imager(CONFIG).images([stamped]).offsets
    torch.testing.assert_close(offsets, box_room.sweeps(1, TWIST).offsets, rtol=0, atol=1e-7)


def test_the_middle_of_a_sweep_is_between_its_ends_however_its_points_are_spread():
    scan = Scan(np.ones((4, 3)), 5.0, np.array([0.02, 0.09, 0.0, 0.01]))
    assert middle_offset_s(scan) == pytest.approx(0.045)


def test_scans_without_times_have_no_offsets(box_room):
    scan = box_room.scans(1, TWIST)[0]
    untimed = Scan(scan.points, scan.stamp)
    assert middle_offset_s(untimed) == 0.0
    images = Imager(CONFIG).images([untimed])
    assert not images.offsets.any()
    assert torch.equal(images.points, box_room.sweeps(1, TWIST).points)


def test_an_empty_scan_is_an_empty_image():
    assert middle_offset_s(EMPTY) == 0.0
    images = Imager(CONFIG).images([EMPTY])
    assert images.points.shape == (1, 3, 16, 360)
    assert images.offsets.shape == (1, 16, 360)
    assert not images.points.any()
    assert not images.normals.any()
    assert not images.offsets.any()
    assert images.low < images.high


@pytest.mark.parametrize("in_one_call", [True, False])
def test_the_rows_are_those_of_the_first_scan_that_has_points(box_room, in_one_call):
    full = box_room.scans(1, TWIST)[0]
    level = np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.1]])
    other = Scan(level, 0.2)  # on its own, its rows would span a single degree
    imager = Imager(CONFIG)
    if not in_one_call:
        imager.images([EMPTY])
        imager.images([full])
    images = imager.images([EMPTY, full, other])
    assert images.low[1:].rad2deg().tolist() == pytest.approx([-18.0] * 2, abs=1e-4)
    assert images.high[1:].rad2deg().tolist() == pytest.approx([18.0] * 2, abs=1e-4)
    torch.testing.assert_close(images.points[1], box_room.sweeps(1, TWIST).points[0])


@pytest.mark.parametrize("in_one_call", [True, False])
def test_a_scan_of_few_points_does_not_fix_the_rows(box_room, in_one_call):
    """Each image says where its own rows lie; those of the scan with most points, until one has enough."""
    full = box_room.scans(1, TWIST)[0]
    elevation = np.rad2deg(np.arcsin(full.points[:, 2] / np.linalg.norm(full.points, axis=1)))
    fewer, few = (full.select(np.flatnonzero(elevation > above)[:most]) for above, most in ((10.0, 20), (3.0, 150)))
    imager, scans = Imager(CONFIG), [fewer, few, fewer, full, few]
    made = [imager.images(scans)] if in_one_call else [imager.images([scan]) for scan in scans]
    low, high = (torch.cat([getattr(one, name) for one in made]).rad2deg() for name in ("low", "high"))
    assert 10.0 < low[0] < 18.0
    assert 3.0 < low[1] == low[2] < 10.0
    torch.testing.assert_close(low[3:], torch.full((2,), -18.0), rtol=0, atol=1e-4)
    torch.testing.assert_close(high[3:], torch.full((2,), 18.0), rtol=0, atol=1e-4)


def test_an_imager_begins_anew(box_room):
    """Two sensors' imagers do not share their rows."""
    Imager(CONFIG).images(box_room.scans(1, TWIST))
    narrow = Imager(CONFIG).images([Scan(np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 1.0]]), 0.0)])
    assert float(narrow.high.rad2deg()) == pytest.approx(math.degrees(math.atan(0.1)), abs=1e-4)


def _two_rings():
    """Ring 12 lies lower than ring 3, as no elevation would have it."""
    return Scan(np.array([[5.0, 0.1, 0.0], [5.0, 0.1, 0.5]]), 0.0, None, np.array([12, 3], dtype=np.int32))


def test_rows_are_rings_where_asked_for():
    images = Imager(ImageConfig(columns=360, order="ring")).images([_two_rings()])
    (rows, _) = images.points[0].square().sum(0).nonzero(as_tuple=True)
    assert rows.tolist() == [3, 12]
    assert images.points[0, 2, 3].max() == 0.5
    by_elevation = Imager(ImageConfig(columns=360)).images([_two_rings()])
    (rows, _) = by_elevation.points[0].square().sum(0).nonzero(as_tuple=True)
    assert rows.tolist() == [0, 15]


def test_rings_that_are_not_there_leave_elevations():
    scan = _two_rings()
    images = Imager(ImageConfig(columns=360, order="ring")).images([Scan(scan.points, 0.0)])
    (rows, _) = images.points[0].square().sum(0).nonzero(as_tuple=True)
    assert rows.tolist() == [0, 15]
