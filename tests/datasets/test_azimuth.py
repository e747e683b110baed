"""Times of points from the azimuth: of a spinning sensor that drives through a room, in closed form."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.recfunctions import append_fields, repack_fields

from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.point_table import RawCloud
from lidarslam.datasets.registry import open_recording
from lidarslam.datasets.times.azimuth import are_as_measured, offsets_from_order, sweep_order

from .conftest import point_table, stamps_ns

PERIOD_S, COLUMNS = 0.1, 900
ELEVATIONS = np.radians(np.arange(-15.0, 16.0, 2.0))
HALF_ROOM = np.array([14.0, 9.0, 4.0])
SPEED, TURN_RATE = 3.0, 0.5  # m/s, rad/s


def sweep(first_s, compensated=False, direction=-1.0, start=2.2, speed=SPEED, turn_rate=TURN_RATE, order="firing"):
    """Points, times and rings of one turn that begins at a time; lasers of one column fire one after the other."""
    column, ring = np.divmod(np.arange(COLUMNS * 16), 16)
    times = PERIOD_S * (column + ring / 16.0) / COLUMNS
    azimuth = start + direction * 2.0 * np.pi * times / PERIOD_S
    level = np.cos(ELEVATIONS[ring])
    rays = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(ELEVATIONS[ring])])
    heading, position = _pose(first_s + times, speed, turn_rate)
    world = _turned(rays, heading)
    reach = (np.sign(world) * HALF_ROOM - position) / np.where(world == 0.0, 1e-9, world)
    points = rays * reach.min(axis=1, keepdims=True)
    if compensated:
        heading_0, position_0 = _pose(np.full(len(times), first_s + 0.5 * PERIOD_S), speed, turn_rate)
        points = _turned(_turned(points, heading) + position - position_0, -heading_0)
    shuffled = np.random.default_rng(0).permutation(len(ring))
    orders = {"firing": np.arange(len(ring)), "rings": np.argsort(ring, kind="stable"), "none": shuffled}
    chosen = orders[order][column[orders[order]] % 7 != 2]
    return points[chosen], times[chosen], ring[chosen]


def _pose(times, speed, turn_rate):
    along = speed * times - 6.0
    return turn_rate * times, np.column_stack([along, 0.3 * along, np.zeros(len(times))])


def _turned(points, angles):
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y, z = points.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])


def record(folder: Path, every=1, stamps=True, rings=True, count=12, **options) -> Path:
    folder.mkdir()
    for number in range(count):
        points, _, ring = sweep(number * every * PERIOD_S, **options)
        np.save(folder / f"{number:03d}.npy", point_table(points, **({"ring": ring} if rings else {})))
    if stamps:
        np.savetxt(folder / "times.txt", np.arange(count) * every * PERIOD_S)
    return folder


@pytest.mark.parametrize(("direction", "start"), [(-1.0, 2.2), (1.0, -3.1), (-1.0, np.pi), (1.0, 0.0)])
@pytest.mark.parametrize("with_rings", [True, False])
def test_times_of_a_sweep(direction, start, with_rings):
    points, times, rings = sweep(0.0, direction=direction, start=start)
    found = offsets_from_order(RawCloud(points, rings=rings if with_rings else None), PERIOD_S)
    expected = (times - times.min()) * PERIOD_S / np.ptp(times)
    np.testing.assert_allclose(found, expected, atol=PERIOD_S / COLUMNS)


def test_a_sector_without_returns_does_not_stretch_the_times():
    points, times, rings = sweep(0.0)
    seen = times - times.min() < PERIOD_S * 5.0 / 6.0
    found = offsets_from_order(RawCloud(points[seen], rings=rings[seen]), PERIOD_S)
    np.testing.assert_allclose(found, times[seen] - times.min(), atol=2 * PERIOD_S / COLUMNS)


def test_angles_between_the_lasers_of_one_firing_are_removed_by_rings():
    points, times, rings = sweep(0.0, start=0.5)
    points = _turned(points, np.radians(np.where(rings % 2, 6.0, -6.0)))
    found = offsets_from_order(RawCloud(points, rings=rings), PERIOD_S)
    np.testing.assert_allclose(found, (times - times.min()) * PERIOD_S / np.ptp(times), atol=2 * PERIOD_S / COLUMNS)


@pytest.mark.parametrize("order", ["firing", "rings"])
def test_a_recording_as_measured_gets_times(tmp_path, order):
    recording = open_recording(record(tmp_path / "raw", order=order))
    info = recording.describe()
    assert (info.point_time.field, info.point_time.unit, info.point_time.reference) == ("azimuth", "s", "relative")
    assert any("follow from the azimuth" in note for note in info.notes)
    assert recording.warnings == ()
    _, times, _ = sweep(0.0, order=order)
    for scan in recording.scans(0, None, 7):
        np.testing.assert_allclose(scan.time_offsets, times - times.min(), atol=2 * PERIOD_S / COLUMNS)


@pytest.mark.parametrize("options", [
    {"compensated": True}, {"every": 2}, {"every": 3, "stamps": False}, {"order": "rings", "compensated": True},
    {"order": "rings", "rings": False}, {"order": "none"},
], ids=str)  # fmt: skip
def test_others_get_none(tmp_path, options):
    recording = open_recording(record(tmp_path / "scans", **options))
    assert next(recording.scans()).time_offsets is None
    assert recording.describe().point_time is None


def test_at_rest_times_are_offered(tmp_path):
    folder = record(tmp_path / "rest", speed=0.0, turn_rate=0.0)
    recording = open_recording(folder)
    assert next(recording.scans()).time_offsets is None
    assert any("--set reader.time_reference=azimuth" in warning for warning in recording.warnings)
    asked = open_recording(folder, ReaderConfig(time_reference="azimuth"))
    assert next(asked.scans()).time_offsets.max() == pytest.approx(PERIOD_S)
    assert asked.warnings == ()


def test_times_that_cannot_be_had_are_a_warning(tmp_path):
    asked = ReaderConfig(time_reference="azimuth")
    shuffled = open_recording(record(tmp_path / "rings", order="none"), asked)
    assert any("not in the order" in said for said in shuffled.warnings)
    every_fifth = open_recording(record(tmp_path / "fifth", every=5), asked)
    assert any("farther apart" in said for said in every_fifth.warnings)


def test_ranges_that_contradict_one_another_are_not_taken_for_compensation():
    # As where little but other cars moves: as many ranges speak for it as against it.
    measured = [sweep_order(RawCloud(points)) for points, _, _ in (sweep(number * PERIOD_S) for number in range(30))]
    compensated = [
        sweep_order(RawCloud(points))
        for points, _, _ in (sweep(n * PERIOD_S, compensated=True, speed=10.0, turn_rate=0.0) for n in range(4))
    ]
    pairs = [*pairwise(measured)]
    assert are_as_measured(pairs) is True
    assert are_as_measured(pairwise(compensated)) is False
    assert are_as_measured([*pairs[:16], *pairwise(compensated)]) is None


def test_times_that_are_all_alike_are_told_and_made_from_the_azimuth(tmp_path):
    folder = record(tmp_path / "raw")
    for path in folder.glob("*.npy"):
        table = np.load(path)
        np.save(path, append_fields(table, "time", np.zeros(len(table), "f4"), usemask=False))
    recording = open_recording(folder)
    assert next(recording.scans()).time_offsets.max() == pytest.approx(PERIOD_S, abs=1e-3)
    (warning,) = recording.warnings
    assert "'time' holds one value alone (0); the times follow from the azimuth" in warning


@pytest.mark.parametrize("pause_s", [0.0, 4.0, 3600.0])
def test_clouds_of_a_bag(bag_kit, pause_s):
    """Also where the recording pauses, or the clock is set."""
    messages = []
    for number, regular_ns in enumerate(stamps_ns(60)):
        stamp_ns = regular_ns + round(1e9 * pause_s) * (number > 30)
        points, times, rings = sweep(number * PERIOD_S)
        records = point_table(points, ring=rings.astype("u2"))[None]
        messages.append((stamp_ns, bag_kit.cloud(records, stamp_ns)))
    recording = open_recording(bag_kit.write({"/points": messages}))
    assert recording.describe().point_time.field == "azimuth"
    scan = next(recording.scans())
    np.testing.assert_allclose(scan.time_offsets, times - times.min(), atol=2 * PERIOD_S / COLUMNS)


@pytest.mark.real_data
def test_a_real_drive_with_its_times_hidden(tmp_path, real_data):
    source = real_data / "vlp16_loop"
    if not source.is_dir():
        pytest.skip("needs vlp16_loop")
    for path in source.glob("*.npy"):
        np.save(tmp_path / path.name, repack_fields(np.load(path)[["x", "y", "z", "ring"]]))
    found, known = open_recording(tmp_path), open_recording(source)
    for mine, given in zip(found.scans(0, None, 50), known.scans(0, None, 50), strict=True):
        scale = given.time_offsets.max() / mine.time_offsets.max()
        assert scale == pytest.approx(1.0, abs=0.02)  # the rate is assumed
        np.testing.assert_allclose(scale * mine.time_offsets, given.time_offsets, atol=1e-4)
