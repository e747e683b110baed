"""Time of the points of a spinning sensor from their azimuth, where a sweep has no times but its order of firing."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.datasets.config import TimeReference
from lidarslam.datasets.faults import NO_POINT_TIME, Faults
from lidarslam.datasets.point_table import RawCloud
from lidarslam.datasets.times.point_time import LearnedTime, PointTimeModel

AZIMUTH_TIME = PointTimeModel("azimuth", "s", "relative")

# Number of blocks of consecutive points whose mean azimuth is followed round the circle.
_BLOCKS, _FEWEST_IN_BLOCK = 180, 8
# Length of a block's mean direction: 1 where all its points have one azimuth; 0.95 is about +-18 degrees.
_CONCENTRATED, _SHARE = 0.95, 0.95
_TURN_DEG = (340.0, 385.0)
# Ring by ring: how much of a turn may lack returns, the part of the points that lies in whole rings, and that of the
# points before the assumed start.
_MISSING_DEG, _SHARE_IN_RINGS, _FIRST = 60.0, 0.7, 1e-3
# Lasers of one firing differ in azimuth by at most this.
_WIDEST_FIRING_DEG = 12.0
# The seam: its width at the end and at the start of a sweep, the largest angle between two points that are
# compared, and the nearest and largest differences of range that count.
_END_DEG, _START_DEG, _SAME_DIRECTION, _NEAREST_M = 3.0, 8.0, np.radians(0.5), 2.0
_DIFFERS_M, _LARGEST_M = 0.05, 1.0
_FEWEST_COMPARED, _CLEAR = 100, 0.75
# No sensor turns more slowly; scans farther apart leave sweeps out between them.
_LONGEST_SWEEP_S = 0.25
_USED = "The points are in the order of one turn, and their times follow from the azimuth."
_NOT_USED = (
    "The points have no times, and the seams of the sweeps are closed as in motion compensated ones, or sweeps are"
    " missing between; none are made from the azimuth."
)
_OFFERED = (
    "The points have no times but are in the order of one turn; whether the sweeps are as measured or motion"
    " compensated does not show. If they are as measured, --set reader.time_reference=azimuth gives the points times."
)
_UNORDERED = "The points have no times, and are not in the order of one turn, from which times could follow."
_NO_ORDER = "Times were to follow from the azimuth, but the points are not in the order of one turn."
_TOO_SLOW = "Times were to follow from the azimuth, but the scans lie farther apart than a sweep lasts."
_NO_TIMES = (
    "; the scans are taken as measured at one instant, or motion compensated. If they are neither, name another field"
    " with --set reader.time_field=NAME, or give its unit with reader.time_unit; --set reader.time_reference=none"
    " accepts it."
)


class SweepOrder(NamedTuple):
    """Points of a sweep in the order of firing."""

    points: FloatArray  # (N, 3) the returns
    turned_deg: FloatArray  # (N,) the angle that the sensor has turned since the sweep's first point


def _one_after_the_other(points: FloatArray, rings: NDArray[np.generic] | None) -> FloatArray | None:
    """The mean azimuth of blocks of consecutive points has to run round the circle once, in either direction.

    Rings remove the constant angles between the lasers of one firing.
    """
    if len(points) < _BLOCKS * _FEWEST_IN_BLOCK:
        return None
    edges = np.linspace(0, len(points), _BLOCKS + 1).astype(np.intp)
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    means = np.add.reduceat(np.exp(1j * azimuths), edges[:-1]) / np.diff(edges)
    path = np.degrees(np.unwrap(np.angle(means)))
    direction = np.sign(path[-1] - path[0])
    path *= direction
    turn_deg = (path[-1] - path[0]) * _BLOCKS / (_BLOCKS - 1)
    is_even = np.mean(np.abs(means) > _CONCENTRATED) >= _SHARE and np.mean(np.diff(path) > 0.0) >= _SHARE
    if not (is_even and _TURN_DEG[0] < turn_deg < _TURN_DEG[1]):
        return None
    along = np.interp(np.arange(len(points)), 0.5 * (edges[:-1] + edges[1:] - 1), path)
    aside = (direction * np.degrees(azimuths) - along + 180.0) % 360.0 - 180.0
    for ring in () if rings is None else np.unique(rings):
        aside[rings == ring] -= np.median(aside[rings == ring])
    turned = along + np.clip(aside, -_WIDEST_FIRING_DEG, _WIDEST_FIRING_DEG)
    return np.asarray(turned - turned[: edges[1]].min()).clip(min=0.0)


def _ring_by_ring(points: FloatArray, rings: NDArray[np.generic]) -> FloatArray | None:
    """The azimuth has to run round the circle once in almost every ring, in one direction and from one start."""
    if len(points) < _BLOCKS * _FEWEST_IN_BLOCK:
        return None
    azimuths = np.arctan2(points[:, 1], points[:, 0])
    paths = {ring: np.degrees(np.unwrap(azimuths[rings == ring])) for ring in np.unique(rings)}
    direction = np.sign(sum(float(path[-1] - path[0]) for path in paths.values()))
    paths = {ring: direction * path for ring, path in paths.items()}
    full = [path for path in paths.values() if _is_turn(path)]
    if not full or sum(len(path) for path in full) < _SHARE_IN_RINGS * len(points):
        return None
    firsts = np.array([path[0] for path in full])
    start = float(np.median(firsts + 360.0 * np.round((firsts[0] - firsts) / 360.0)))  # all of one turn
    turned = np.empty(len(points))
    for ring, path in paths.items():
        # The middle decides which turn it is: returns at the start may be missing.
        turned[rings == ring] = path + 360.0 * np.round((start + 180.0 - np.median(path)) / 360.0)
    turned -= np.quantile(turned, _FIRST)
    is_one = np.mean(turned < _TURN_DEG[1]) >= _SHARE
    return turned.clip(min=0.0, max=_TURN_DEG[1]) if is_one else None


def _is_turn(path: FloatArray) -> bool:
    """Whether a ring's azimuth, unwrapped in the direction of turning, runs round the circle once."""
    is_even = len(path) > 1 and float(np.mean(np.diff(path) > 0.0)) >= _SHARE
    return is_even and _TURN_DEG[0] - _MISSING_DEG < path[-1] - path[0] < _TURN_DEG[1]


def offsets_from_order(cloud: RawCloud, sweep_s: float) -> FloatArray | None:
    """Seconds (N,) from the first point of a sweep that lasts so long; NaN without a return.

    None where the points are not in the order of firing.
    """
    order = sweep_order(cloud)
    if order is None:
        return None
    offsets = np.full(len(cloud.points), np.nan)
    # Sweeps of less than a turn lack returns.
    offsets[cloud.returns] = order.turned_deg * (sweep_s / max(360.0, order.turned_deg.max()))
    return offsets


def sweep_order(cloud: RawCloud) -> SweepOrder | None:
    """The returns of a sweep with the angles by which the sensor had turned since the first of them.

    The points are stored in the order of firing, or, where there are rings, ring by ring with each in this order; None
    where they are in another order, or not of one turn.
    """
    points, rings = cloud.points[cloud.returns], None if cloud.rings is None else cloud.rings[cloud.returns]
    turned = _one_after_the_other(points, rings)
    if turned is None and rings is not None:
        turned = _ring_by_ring(points, rings)
    return None if turned is None else SweepOrder(points, turned)


def are_as_measured(pairs: Iterable[tuple[SweepOrder, SweepOrder]]) -> bool | None:
    """Whether sweeps are as measured, by pairs of consecutive ones, each in its own frame.

    At the seam of a sweep as measured, its last points continue in the first points of the next sweep, while its own
    first points, in the same direction, are a whole turn older. Where the sensor moves, ranges across the seam then
    differ less between the sweeps than within one. In a motion compensated sweep, or where sweeps have been left out
    between, it is the other way round.

    Returns:
        None where too few ranges differ, as at rest, or the ranges contradict one another, as near things that move.
    """
    between, within = [np.empty(0)], [np.empty(0)]
    for sweep, following in pairs:
        differences = _across_seam(sweep, following)
        between.append(differences[0])
        within.append(differences[1])
    gain = np.concatenate(within) - np.concatenate(between)
    gain = gain[np.abs(gain) > _DIFFERS_M]
    if len(gain) < _FEWEST_COMPARED:
        return None
    share = float(np.mean(gain > 0.0))
    return True if share > _CLEAR else False if share < 1.0 - _CLEAR else None


def _across_seam(sweep: SweepOrder, following: SweepOrder) -> tuple[FloatArray, FloatArray]:
    """Differences of range (K,) of a sweep's last points to the next one's first points, and to its own."""
    from scipy.spatial import KDTree  # takes a while to load

    end = sweep.points[sweep.turned_deg > sweep.turned_deg.max() - _END_DEG]
    end = end[np.linalg.norm(end, axis=1) > _NEAREST_M]
    ranges = np.linalg.norm(end, axis=1, keepdims=True)
    differences, is_same = [], np.ones(len(end), dtype=bool)
    for points, turned_deg in (following, sweep):
        start = points[turned_deg < _START_DEG]
        start_ranges = np.linalg.norm(start, axis=1, keepdims=True)
        apart, nearest = KDTree(start / start_ranges).query(end / ranges)
        is_same &= apart < _SAME_DIRECTION
        differences.append(np.minimum(np.abs(start_ranges[nearest] - ranges)[:, 0], _LARGEST_M))
    return differences[0][is_same], differences[1][is_same]


def offsets_from_azimuth(points: NDArray[np.floating], before_s: float, after_s: float) -> FloatArray:
    """Seconds (N,) from the stamp at which points (N, 3) of one sweep of KITTI's raw data were measured, in any order.

    Seen from above the laser turns clockwise: it starts at the rear (azimuth pi), sweeps the left side, faces
    forward (azimuth 0) at the stamp, sweeps the right side and ends at the rear (azimuth -pi). Measured on the
    drives 0005 and 0009: deskewed in this direction, scans half a second apart lie closer to each other's planes
    than without deskewing, deskewed in the opposite direction less close.
    """
    half_turns: FloatArray = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64) / -np.pi
    return np.where(half_turns < 0.0, before_s * half_turns, after_s * half_turns)


@dataclass(frozen=True)
class PointTiming:
    """Where the times of a recording's points come from; inferred once, so that all scans are read in the same way."""

    model: PointTimeModel | None = None  # None where points have no times
    sweep_s: float | None = None  # the duration of a sweep, where the times follow from the azimuth
    notes: tuple[str, ...] = ()  # facts for the user
    warnings: tuple[str, ...] = ()  # faults of the time field and their effect; times that the azimuth could give

    def offsets(self, cloud: RawCloud, stamp: float) -> FloatArray | None:
        """Seconds (N,) from the stamp at which the points were measured; None where this cloud does not tell."""
        if self.sweep_s is not None:
            return offsets_from_order(cloud, self.sweep_s)
        if self.model is None or cloud.times is None or cloud.time_field != self.model.field:
            return None
        return self.model.offsets(cloud.times, stamp)

    def scan(self, cloud: RawCloud, stamp: float, faults: Faults, example: str) -> Scan:
        """The valid points; a scan without usable point times, where others have them, is counted."""
        scan = cloud.scan(stamp, self.offsets(cloud, stamp))
        if self.model is not None and scan.time_offsets is None and len(scan):
            faults.note(NO_POINT_TIME, example)
        return scan


def point_timing(
    learned: LearnedTime, runs: Iterable[Iterable[RawCloud]], period_s: float | None, reference: TimeReference
) -> PointTiming:
    """By a time field, or where that gives no times by the azimuth.

    Args:
        learned: of the time field.
        runs: two or more consecutive scans each; read only as far as needed.
        period_s: seconds between scans; None for a single one.
        reference: "azimuth" does not question that sweeps are as measured; other than "auto", the azimuth is not used.
    """
    fault = learned.warning
    if learned.model is not None:
        return PointTiming(learned.model, warnings=() if fault is None else (fault,))
    said = None
    if reference in ("auto", "azimuth") and period_s is not None:
        orders = ([sweep_order(cloud) for cloud in run] for run in runs)
        said = _by_azimuth(orders, period_s, reference == "azimuth")
    is_used, is_warning = said == _USED, said in (_OFFERED, _NO_ORDER, _TOO_SLOW)
    if fault is not None:
        fault += "; the times follow from the azimuth instead." if is_used else "." if is_warning else _NO_TIMES
    warnings = tuple(warning for warning in (fault, said if is_warning else None) if warning is not None)
    notes = () if said is None or is_warning else (said,)
    return PointTiming(AZIMUTH_TIME, period_s, notes, warnings) if is_used else PointTiming(None, None, notes, warnings)


def _by_azimuth(runs: Iterable[list[SweepOrder | None]], period_s: float, is_asked: bool) -> str | None:
    """Whether the azimuth gives the times, as it is told to the user: `_USED` where it does."""
    if is_asked and all(order is None for run in runs for order in run):
        return _NO_ORDER
    if period_s >= _LONGEST_SWEEP_S:
        return _TOO_SLOW if is_asked else None
    if is_asked:
        return _USED
    if not (pairs := list(_ordered_pairs(runs))):
        return _UNORDERED
    decision = are_as_measured(pairs)
    return _OFFERED if decision is None else _USED if decision else _NOT_USED


def _ordered_pairs(runs: Iterable[list[SweepOrder | None]]) -> Iterator[tuple[SweepOrder, SweepOrder]]:
    """Consecutive sweeps that are in the order of firing; none where the first sweeps are not."""
    for number, run in enumerate(runs):
        if number == 0 and all(order is None for order in run):
            return
        for sweep, following in pairwise(run):
            if sweep is not None and following is not None:
                yield sweep, following
