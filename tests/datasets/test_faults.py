"""Faults of a recording's scans: counted by kind, or raised where nobody counts."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import ReaderConfig
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.stored_recording import FileRecording


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


def test_unreadable_scans_are_left_out_where_they_are_counted_and_raised_elsewhere():
    faults = Faults()
    assert [scan.stamp for scan in Odd([0, 1, 2, 3, 4]).scans(faults=faults)] == [0.0, 2.0, 4.0]
    assert faults.left_out == 2
    scans = Odd([0, 1]).scans()
    assert next(scans).stamp == 0.0
    with pytest.raises(InputError, match="1 is damaged"):
        next(scans)


def test_a_recording_is_described_by_its_first_readable_scan():
    info = Odd([1, 3, 4, 6]).describe()
    assert (info.first.stamp, info.scans, info.last_stamp) == (4.0, 4, 6.0)
    assert info.notes == ("2 scans were left out: not readable; the first: 1 is damaged",)
    with pytest.raises(InputError, match="1 is damaged"):
        Odd([1, 3]).describe()
    with pytest.raises(InputError, match="drive: holds no scan"):
        Odd([]).describe()
