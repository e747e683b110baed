"""Scans of a recording as a run takes them: ordered by stamp, thinned where too large, checked once."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from lidarslam.core.errors import InputError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.text import count
from lidarslam.core.thinning import one_per_cell
from lidarslam.datasets.faults import Faults
from lidarslam.datasets.mounting import recorded_axes
from lidarslam.datasets.recording import Recording
from lidarslam.datasets.times.stamps import in_stamp_order

# No LiDAR measures more points in a sweep; the cells are finer than any method's.
_MOST_POINTS = 1 << 20
_CELL_M = 0.02
# Of ranges: this share is nearer than the near one, and farther than the far one.
_SHARE = 0.01
# A sensor on the ground always has nearer surfaces; sensors with a view all round have a shorter range.
_NEAR_M, _FAR_M = 20.0, 400.0
# From an aircraft all surfaces are on one side and at similar ranges; none are this far with such a spread.
_HALF_M, _SPREAD = 3000.0, 5.0
# Length of the points' mean direction: near 0 for points all round, 0.75 in a cone of 60 degrees about its axis.
_ALL_ROUND = 0.5
# No sweep is so short; the times of a flash are, and so are those in another unit.
_SHORTEST_SWEEP_S = 1e-3
# Share of a sweep by which its stamp may lie outside: clouds are stamped as they are published, too.
_OUTSIDE = 0.25
_FEW_POINTS = 50
_SAMPLE = 4096
# No LiDAR makes a thousand scans a second.
_LEAST_INTERVAL_S = 0.999e-3
# A whole turn of one laser, degrees, and how much its elevation may vary, which that of a scanning mirror does more.
_TURN_DEG, _SAME_ELEVATION_DEG = (330.0, 390.0), 0.5

_THINNED = f"scans of more than {_MOST_POINTS:,} points were thinned to at most so many, one in a cell of 2 cm"
_TOO_FAST = (
    "scans are stamped within a millisecond of the one before, which no LiDAR does: check the unit of the stamps"
)
_NOT_METRES = "scans look like centimetres or millimetres instead of metres: convert the points"
_AT_ONCE = (
    "scans have times of points that span less than a millisecond: motion during a sweep is not compensated; if"
    " the sensor turns, the times are wrong or in another unit (reader.time_unit, reader.time_reference=azimuth)"
)
_COUNTER_CLOCKWISE = (
    "scans turn counter-clockwise as seen from above, as few sensors do unless upside down: otherwise their axes are"
    " mirrored, and so is the map, or the times of their points run backwards (reader.time_scale=-1)"
)
_OUTSIDE_SWEEP = (
    "scans are stamped outside the sweep: poses belong to the stamps; check whether the times of the points are shifted"
    " or on another clock"
)
_UNTIMED = "scans have points without a time, interpolated between the neighbours"
_REPEATED = "scans were left out: they have the points of the scan before, as from a driver that hangs"
_ONE_PLACE = "scans have all points at one place, without geometry"


def choose_scans(recording: Recording, source: Path, start: int, stop: int | None, step: int) -> range:
    """Indices of the scans that --start, --stop and --step choose."""
    chosen = range(len(recording))[start:stop:step]
    if not chosen:
        raise InputError(f"{source}: none of its {len(recording)} scans is left after --start, --stop and --step")
    return chosen


def take_in(recording: Recording, chosen: range, faults: Faults) -> Iterator[Scan]:
    """The chosen scans of a recording, in the order of time, of bounded size; faults are counted."""
    scans = recording.scans(chosen.start, chosen.stop, chosen.step, faults)
    if np.array_equal(recorded_axes(recording)[1], np.eye(4)):
        scans = (_turn_looked_at(scan, faults) for scan in scans)
    ordered = in_stamp_order((look_at(scan, faults) for scan in scans), lambda scan: scan.stamp, faults)
    return _new_measurements(ordered, faults)


def _new_measurements(scans: Iterator[Scan], faults: Faults) -> Iterator[Scan]:
    """The scans without repeated ones: the noise of two measurements is never the same."""
    last: Scan | None = None
    for scan in scans:
        is_like_last = last is not None and len(scan) > _FEW_POINTS and np.array_equal(scan.points, last.points)
        if is_like_last and not _is_one_place(scan.points):
            faults.leave_out(_REPEATED, f"at {scan.stamp:.9f}")
            continue
        if last is not None and scan.stamp - last.stamp < _LEAST_INTERVAL_S:
            faults.note(_TOO_FAST, f"{1e6 * (scan.stamp - last.stamp):.3g} microseconds at {scan.stamp:.9f}")
        last = scan
        yield scan


def _is_one_place(points: FloatArray) -> bool:
    return bool((points == points[0]).all())


def _turn_looked_at(scan: Scan, faults: Faults) -> Scan:
    if _TURN_DEG[0] < (turned_deg := _turned_deg(scan)) < _TURN_DEG[1]:
        faults.note(_COUNTER_CLOCKWISE, f"by {turned_deg:.0f} degrees at {scan.stamp:.9f}")
    return scan


def _turned_deg(scan: Scan) -> float:
    """How far one laser of a spinning sensor turns about z within a sweep, counter-clockwise; 0 where unknown."""
    if scan.rings is None or scan.time_offsets is None or not len(scan):
        return 0.0
    ring = np.flatnonzero(scan.rings == scan.rings[len(scan) // 2])
    points = scan.points[ring[np.argsort(scan.time_offsets[ring], kind="stable")]]
    elevations = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    if len(points) < _FEW_POINTS or np.degrees(elevations.std()) > _SAME_ELEVATION_DEG:
        return 0.0
    steps = np.diff(np.arctan2(points[:, 1], points[:, 0]))
    return float(np.degrees(((steps + np.pi) % (2.0 * np.pi) - np.pi).sum()))


def look_at(scan: Scan, faults: Faults) -> Scan:
    """The scan, thinned if it is too large; faults are counted."""
    if len(scan) > _MOST_POINTS:
        faults.note(_THINNED, f"{len(scan):,} points at {scan.stamp:.9f}")
        scan = scan.select(one_per_cell(scan.points, _CELL_M))
    if len(scan) > _FEW_POINTS:
        sample = scan.points[:: max(1, len(scan) // _SAMPLE)]
        if (reach := _implausible_ranges(sample)) is not None:
            faults.note(_NOT_METRES, f"{reach} at {scan.stamp:.9f}")
        elif _is_one_place(sample) and _is_one_place(scan.points):
            faults.note(_ONE_PLACE, f"{len(scan)} points at {scan.stamp:.9f}")
        _look_at_times(scan, faults)
    return scan


def _look_at_times(scan: Scan, faults: Faults) -> None:
    if scan.untimed:
        faults.note(_UNTIMED, f"{count(scan.untimed, 'point')} at {scan.stamp:.9f}")
    if scan.time_offsets is None:
        return
    first_s, last_s = float(scan.time_offsets.min()), float(scan.time_offsets.max())
    span_s, outside_s = last_s - first_s, max(first_s, -last_s)
    if span_s < _SHORTEST_SWEEP_S:
        faults.note(_AT_ONCE, f"{span_s:.3g} s at {scan.stamp:.9f}")
    elif outside_s > _OUTSIDE * span_s:
        faults.note(
            _OUTSIDE_SWEEP, f"{1e3 * outside_s:.0f} ms {'before' if first_s > 0.0 else 'after'}, {scan.stamp:.9f}"
        )


def _implausible_ranges(points: FloatArray) -> str | None:
    """The ranges, where points (N, 3) in metres would have nothing near but things all round, far away."""
    ranges = np.linalg.norm(points, axis=1)
    near, half, far = (float(value) for value in np.quantile(ranges, (_SHARE, 0.5, 1.0 - _SHARE)))
    if near < _NEAR_M or far < _FAR_M:
        return None
    directions = points / np.maximum(ranges, _NEAR_M)[:, None]
    if not (np.linalg.norm(directions.mean(axis=0)) < _ALL_ROUND or (half > _HALF_M and far > _SPREAD * near)):
        return None
    return f"nearly all points are between {near:.0f} and {far:.0f} away, half of them beyond {half:.0f},"
