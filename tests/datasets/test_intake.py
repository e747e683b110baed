"""What is seen of every scan before it is worked on; faults are counted by kind, or raised where nobody counts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.intake import look_at, take_in
from lidarslam.datasets.mounting import MountedRecording
from lidarslam.datasets.recording import FileRecording


def seen(points, **fields):
    faults = Faults()
    return look_at(Scan(np.asarray(points, dtype=np.float64), 1.0, **fields), faults), faults


def test_a_usual_scan_is_left_as_it_is(rng):
    points = rng.uniform(-80.0, 80.0, (1000, 3))
    scan, faults = seen(points)
    assert scan.points is points or np.array_equal(scan.points, points)
    assert faults.warnings() == ()


def test_a_scan_of_two_million_points_is_thinned_and_said(rng):
    points = rng.uniform(-40.0, 40.0, (2_000_000, 3))
    offsets = points[:, 0] / 1000.0
    scan, faults = seen(points, time_offsets=offsets)
    assert 400_000 < len(scan) <= 1 << 20
    np.testing.assert_array_equal(scan.time_offsets, scan.points[:, 0] / 1000.0)
    assert faults.left_out == 0
    assert faults.warnings()[0].startswith("1 scan of more than 1,048,576 points was thinned")
    assert "2,000,000 points at 1.0" in faults.warnings()[0]


def at(directions: FloatArray, ranges: FloatArray) -> FloatArray:
    return directions * (ranges / np.linalg.norm(directions, axis=1))[:, None]


@pytest.mark.parametrize(
    ("is_narrow", "scale"), [(False, 1.0), (False, 100.0), (False, 1000.0), (True, 1.0), (True, 1000.0)]
)
def test_centimetres_and_millimetres_are_told(rng, is_narrow, scale):
    around = rng.normal(size=(1000, 3))
    directions = around * [0.2, 0.4, 0.2] + [1.0, 0.0, 0.0] if is_narrow else around
    scan, faults = seen(scale * at(directions, rng.uniform(0.8, 9.0, 1000)))
    assert len(scan) == 1000
    assert ["centimetres or millimetres" in said for said in faults.warnings()] == [True] * (scale > 1.0)


def test_an_aircraft_and_a_ship_see_far(rng):
    down = rng.normal(size=(1000, 3)) * [0.4, 0.4, 0.0] - [0.0, 0.0, 1.0]
    for height in (50.0, 500.0, 3000.0):
        assert seen(down * height * rng.uniform(0.8, 1.0, (1000, 1)))[1].warnings() == ()
    forward = rng.normal(size=(1000, 3)) * [0.1, 0.4, 0.2] + [1.0, 0.0, 0.0]
    assert seen(at(forward, rng.uniform(300.0, 2000.0, 1000)))[1].warnings() == ()
    around = rng.normal(size=(1000, 3)) * [1.0, 1.0, 0.1]
    assert seen(at(around, rng.uniform(30.0, 390.0, 1000)))[1].warnings() == ()


@pytest.mark.parametrize("span_s", [0.0, 1e-4])
def test_times_of_no_sweep_are_told(rng, span_s):
    points = rng.uniform(-8.0, 8.0, (1000, 3))
    _, faults = seen(points, time_offsets=np.linspace(0.0, span_s, 1000))
    assert "span less than a millisecond" in faults.warnings()[0]
    assert seen(points, time_offsets=np.linspace(0.0, 0.02, 1000))[1].warnings() == ()


@pytest.mark.parametrize(
    ("shift_s", "told"), [(0.0, ""), (-0.05, ""), (-0.12, ""), (0.05, "50 ms before"), (-0.15, "50 ms after")]
)
def test_times_shifted_away_from_the_stamp_are_told(rng, shift_s, told):
    points = rng.uniform(-8.0, 8.0, (1000, 3))
    _, faults = seen(points, time_offsets=np.linspace(0.0, 0.1, 1000) + shift_s)
    assert ["stamped outside the sweep" in said and told in said for said in faults.warnings()] == [True] * bool(told)


def test_points_without_a_time_are_counted(rng):
    points, times = rng.uniform(-8.0, 8.0, (1000, 3)), np.linspace(0.0, 0.1, 1000)
    times[::4] = np.nan
    faults = Faults()
    look_at(Scan.from_raw(points, 1.0, times), faults)
    (said,) = faults.warnings()
    assert said.startswith("1 scan has points without a time")
    assert said.endswith("250 points at 1.000000000")


def test_all_points_at_one_place_are_told():
    assert seen(np.full((1000, 3), 2.5))[1].warnings()[0].startswith("1 scan has all points at one place")


class Recorded:
    def __init__(self, *scans):
        self._scans = scans

    def __len__(self):
        return len(self._scans)

    def scans(self, start, stop, step, _):
        return iter(self._scans[start:stop:step])


def taken(recording):
    """The scans that are taken in, and what is said of them."""
    faults = Faults()
    return list(take_in(recording, range(len(recording)), faults)), faults


@pytest.mark.parametrize(("period_s", "told"), [(1e-6, True), (0.9e-3, True), (1e-3, False), (0.1, False)])
def test_stamps_that_no_lidar_has_are_told_once(period_s, told):
    scans, faults = taken(Recorded(*(Scan(np.ones((3, 3)), 1000.0 + period_s * number) for number in range(8))))
    assert len(scans) == 8
    assert [said.startswith("7 scans are stamped within a millisecond") for said in faults.warnings()] == [True] * told


def test_a_driver_that_hangs_repeats_a_scan_which_counts_once(rng):
    """The same points with new stamps would be a sensor at rest."""
    first, second = rng.uniform(-8.0, 8.0, (2, 1000, 3))

    clouds = (first, second, second, second, first)
    scans, faults = taken(Recorded(*(Scan(points.copy(), 0.1 * number) for number, points in enumerate(clouds))))
    assert [scan.stamp for scan in scans] == [0.0, 0.1, 0.4]
    assert faults.left_out == 2
    (said,) = faults.warnings()
    assert "they have the points of the scan before" in said
    assert said.endswith("the first: at 0.200000000")


def spinning(times_sign: float = 1.0, mirror: float = 1.0) -> Scan:
    """A sweep of a VLP-16 in a round room, clockwise as seen from above, with the ground 1 m below the sensor."""
    azimuths, elevations = -np.deg2rad(np.arange(0.0, 360.0, 0.2)), np.deg2rad(np.arange(-15.0, 16.0, 2.0))
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(azimuths, elevations, indexing="ij"))
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    reach = np.minimum(8.0, 1.0 / np.maximum(-directions[:, 2], 1e-9))
    offsets = times_sign * np.linspace(0.0, 0.1, len(azimuth))
    points = directions * reach[:, None] * [1.0, mirror, 1.0]
    return Scan(points, 1.0, time_offsets=offsets, rings=np.tile(np.arange(16, dtype=np.int32), len(azimuths)))


def strokes() -> Scan:
    """Of a scanning mirror, which are no turn."""
    scan = spinning(mirror=-1.0)
    bent = scan.points + [0.0, 0.0, 2.0] * np.sin(9.0 * np.arctan2(scan.points[:, 1], scan.points[:, 0]))[:, None]
    return replace(scan, points=bent)


@pytest.mark.parametrize(("recording", "told"), [
    (Recorded(spinning()), False), (Recorded(spinning(mirror=-1.0)), True), (Recorded(spinning(times_sign=-1.0)), True),
    (MountedRecording(Recorded(spinning()), "upside-down"), False), (Recorded(strokes()), False),
], ids=["clockwise", "mirrored", "reversed", "clockwise upside down", "strokes"])  # fmt: skip
def test_mirrored_axes_and_reversed_times_turn_the_other_way(recording, told):
    _, faults = taken(recording)
    assert ["turns counter-clockwise as seen from above" in said for said in faults.warnings()] == [True] * told


class Odd(FileRecording):
    """Scans of which those with an odd number are damaged."""

    reader = "odd"

    def __init__(self, numbers: list[int]) -> None:
        super().__init__(Path("drive"), ReaderConfig(), [Path(str(number)) for number in numbers])
        self.stamps = np.array(numbers, dtype=np.float64)

    def _read(self, index: int, faults: Faults) -> Scan:  # noqa: ARG002
        if self.stamps[index] % 2:
            raise InputError(f"{self._files[index]} is damaged")
        return Scan(np.ones((1, 3)), float(self.stamps[index]))


def test_kinds_are_counted_and_the_first_of_each_is_remembered():
    faults = Faults()
    faults.note("scans have a fault", "a")
    faults.leave_out("scans were left out: why", "b", 2)
    faults.note("scans have a fault", "c")
    assert faults.left_out == 2
    assert faults.warnings() == ("2 scans have a fault; the first: a", "2 scans were left out: why; the first: b")


def test_a_recording_is_described_by_its_first_readable_scan():
    info = Odd([1, 3, 4, 6]).describe()
    assert (info.first.stamp, info.scans, info.last_stamp) == (4.0, 4, 6.0)
    assert info.notes == ("2 scans were left out: not readable; the first: 1 is damaged",)
    with pytest.raises(InputError, match="1 is damaged"):
        Odd([1, 3]).describe()
    with pytest.raises(InputError, match="drive: holds no scan"):
        Odd([]).describe()
