"""Scans of a recording on their way to a run: ordered by stamp, thinned where too large, checked once."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.scan import Scan
from lidarslam.core.thinning import one_per_cell
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.times.stamp_order import in_stamp_order

# No LiDAR measures more points in a sweep; the cells are finer than any method's.
_MOST_POINTS = 1 << 20
_CELL_M = 0.02
# Half of a sweep's points lie nearer than this, out of doors too; in millimetres a small room's lie farther.
_FAR_M = 400.0
_FEW_POINTS = 50
_SAMPLE = 4096
# No LiDAR makes a thousand scans a second.
_LEAST_INTERVAL_S = 0.999e-3

_THINNED = f"scans of more than {_MOST_POINTS:,} points were thinned to at most so many, one in a cell of 2 cm"
_MILLIMETRES = "scans look like millimetres, where metres are expected: convert the points"
_TOO_FAST = (
    "scans are stamped within a millisecond of the one before, which no LiDAR does: check the unit of the stamps"
)
_ONE_PLACE = "scans have all their points at one place and carry no geometry"


def choose_scans(recording: Recording, source: Path, start: int, stop: int | None, step: int) -> range:
    """Indices of the scans that --start, --stop and --step choose.

    Raises:
        InputError: none is left.
    """
    chosen = range(len(recording))[start:stop:step]
    if not chosen:
        raise InputError(f"{source}: none of its {len(recording)} scans is left after --start, --stop and --step")
    return chosen


def take_in(recording: Recording, chosen: range, faults: Faults) -> Iterator[Scan]:
    """The chosen scans of a recording, in the order of time, of bounded size; faults are counted.

    Raises:
        InputError: the recording is damaged where no scan can be left out, or its clock was set back.
    """
    scans = recording.scans(chosen.start, chosen.stop, chosen.step, faults)
    ordered = in_stamp_order((look_at(scan, faults) for scan in scans), lambda scan: scan.stamp, faults)
    return _with_paces_checked(ordered, faults)


def _with_paces_checked(scans: Iterator[Scan], faults: Faults) -> Iterator[Scan]:
    latest = -np.inf
    for scan in scans:
        if scan.stamp - latest < _LEAST_INTERVAL_S:
            faults.note(_TOO_FAST, f"{1e6 * (scan.stamp - latest):.3g} microseconds at {scan.stamp:.9f}")
        latest = scan.stamp
        yield scan


def look_at(scan: Scan, faults: Faults) -> Scan:
    """The scan, thinned if it is too large; faults are counted."""
    if len(scan) > _MOST_POINTS:
        faults.note(_THINNED, f"{len(scan):,} points at {scan.stamp:.9f}")
        scan = scan.select(one_per_cell(scan.points, _CELL_M))
    if len(scan) > _FEW_POINTS:
        sample = scan.points[:: max(1, len(scan) // _SAMPLE)]
        median_m = float(np.median(np.linalg.norm(sample, axis=1)))
        if median_m > _FAR_M:
            faults.note(_MILLIMETRES, f"half of the points are farther away than {median_m:.0f} at {scan.stamp:.9f}")
        elif not np.ptp(scan.points, axis=0).any():
            faults.note(_ONE_PLACE, f"{len(scan)} points at {scan.stamp:.9f}")
    return scan
