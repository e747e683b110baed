"""Counting what is wrong with the scans of a recording."""

from pathlib import Path

import numpy as np
import pytest

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.datasets.faults import Faults, first_readable, readable_scans


def read(index):
    if index % 2:
        raise InputError(f"scan {index} is damaged")
    return Scan(np.ones((1, 3)), float(index))


def test_each_kind_is_counted_and_its_first_remembered():
    faults = Faults()
    faults.note("scans look odd", "scan 1")
    faults.note("scans look odd", "scan 2")
    faults.leave_out("scans were left out: too old", "scan 3")
    faults.leave_out("scans are missing", "the index", count=5)
    assert faults.left_out == 6
    assert faults.warnings() == (
        "2 scans look odd; the first: scan 1",
        "1 scan was left out: too old; the first: scan 3",
        "5 scans are missing; the first: the index",
    )


def test_scans_that_cannot_be_read_are_left_out_where_somebody_counts():
    faults = Faults()
    assert [scan.stamp for scan in readable_scans(range(5), read, faults)] == [0.0, 2.0, 4.0]
    assert faults.left_out == 2
    assert faults.warnings() == ("2 scans were left out: they could not be read; the first: scan 1 is damaged",)
    scans = readable_scans(range(5), read, None)
    next(scans)
    with pytest.raises(InputError, match="scan 1 is damaged"):
        next(scans)


def test_the_first_scan_that_can_be_read_describes_a_recording():
    index, scan, faults = first_readable(Path("drive"), [1, 3, 4, 6], read)
    assert (index, scan.stamp, faults.left_out) == (4, 4.0, 2)
    with pytest.raises(InputError, match="scan 1 is damaged"):
        first_readable(Path("drive"), [1, 3], read)
    with pytest.raises(InputError, match="drive: holds no scan"):
        first_readable(Path("drive"), [], read)
