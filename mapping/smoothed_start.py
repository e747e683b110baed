"""Smoothing of the first scans: their motions by registration backwards in time, to the map of the scans after them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper

if TYPE_CHECKING:  # GTSAM takes a while to load
    from lidarslam.mapping.inertial.inertial import Inertial

# Where the first two sweeps turn so differently that points at the median range are displaced this far within a sweep,
# in cells, the first turn is estimated apart. On drives it is below 0.5, where a robot begins to turn 3.
_LEAST_BEND_CELLS = 2.0
# Scans that are smoothed, and those of them that show whether that is needed, where a sweep makes a map.
SMOOTHED, SHOWING = 20, 8
_FEWEST_KNOWN, _LEAST_OK = 6, 0.7
# With an IMU, scans this far apart, seconds, or that do not constrain a direction, leave the first velocity open. It is
# the likeliest of these, m/s, at rest to running, by so many scans.
_LONG_S, TRIED, _SPACING_M_S = 0.15, 5, 1.0
# Mean evidence of motions along a corridor, in units of the least: in one, 0.55 to 1 for the right velocity, 0.25 to
# 0.35 for others.
_LEAST_CONSTRAINT = 0.45
# Walls of a corridor fit any motion along it: where the constraint is below the least, that of another start has to be
# so many times as large, however it fits.
_MORE_CONSTRAINED = 1.5
_VELOCITIES = [np.zeros(3)] + [
    speed * np.array([np.cos(angle), np.sin(angle), 0.0])
    for speed, count in ((1.0, 6), (2.0, 8))
    for angle in 2.0 * np.pi / count * np.arange(count)
]
# Factor by which scans must fit better when they are tracked from rest.
_BETTER = 1.05
# Places this far apart, cells, are different ones.
_APART_CELLS = 2.0
# Standard deviations of a smoothed motion, rotation first.
_COVARIANCE = np.diag(np.array([np.deg2rad(0.1)] * 3 + [0.005] * 3) ** 2)


@dataclass(frozen=True)
class SmoothedStart:
    """What the first scans show beforehand."""

    motions: dict[float, Prior] = field(default_factory=dict)  # each since the scan before, by stamp; where needed
    velocity: FloatArray | None = None  # (6,) after the first scan, rotation first; None where it is not certain


class _Tracking:
    """A mapper, with an IMU where there is one."""

    def __init__(self, config: MappingConfig, inertial: "Inertial | None") -> None:
        self._mapper, self.inertial = Mapper(config), inertial
        self._sampled: list[SampledScan] = []  # the first two
        self.results: list[MappedScan] = []
        self.has_rings = True

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Register the next scan."""
        if self.inertial is not None:
            prior = self.inertial.prior(scan, prior)
        sampled = self._mapper.sample(scan)
        self.has_rings &= sampled.has_rings
        self._sampled = [*self._sampled, sampled][:2]
        mapped = self._mapper.process(sampled, prior)
        if self.inertial is not None:
            self.inertial.update(scan, mapped)
        self.results.append(mapped)
        return mapped

    @property
    def is_at_rest(self) -> bool:
        """Whether an IMU and the scans show the sensor at rest."""
        return self.inertial is not None and self.inertial.is_at_rest

    @property
    def is_sparse(self) -> bool:
        """Whether sparse strokes alone measure the motion: they fit facades at any speed."""
        return self.inertial is None and not self.has_rings

    @property
    def is_bent(self) -> bool:
        """Whether the first sweep turned so differently from the second that the latter's motion would bend it."""
        (first, second), (_, moved) = self._sampled, self.results[:2]
        if first.is_followed_by(second):
            return False
        before = np.zeros(6) if moved.first_velocity is None else moved.first_velocity
        turned = (moved.state.velocity - before)[:3] * (first.seen_from_s + first.seen_until_s)
        return bool(np.linalg.norm(turned) * first.range_m > _LEAST_BEND_CELLS * first.cell_m)


def smoothed_start(scans: Iterable[Scan], config: MappingConfig, inertial: "Inertial | None" = None) -> SmoothedStart:
    """Motions of the first scans, each since the previous one; none where registration in order suffices.

    The map of a single sweep is thin, and errors along directions that it leaves open stay in the map. So the first
    scans are registered in order; from the last of them back, with the motions of the latest known, to a new map;
    and the motions of the first half are those that this map shows, as is the first sweep's turn rate where the motion
    to the second would bend it. None is known where that loses track, or fits worse than in order, as on stairs, unless
    the motions in order are hardly constrained; nor where the sensor rests by its IMU. The IMU's samples are used in
    both directions of time; where scans refute the rest, its attribute `may_rest` ends.

    A row of houses fits at a displacement of one house as well as at rest. Where the second scan fits at several
    velocities, the first scans are tracked from each, and the later ones decide.
    """
    unlimited = config.model_copy(update={"budget_ms": None})
    ordered = _Tracking(unlimited, None if inertial is None else inertial.anew())
    taken, needed, least = list[Scan](), False, np.inf
    velocity: FloatArray | None = None
    for scan in scans:
        mapped = ordered.process(scan, Prior())
        taken.append(scan)
        needed |= not ordered.has_rings or mapped.status is not Status.OK
        if len(taken) == TRIED:
            chosen = _likeliest(taken, ordered, unlimited, inertial)
            is_found = chosen is not ordered and inertial is None  # with an IMU, velocities on a coarse grid are tried
            if chosen is not ordered:
                ordered, needed, least = chosen, True, np.inf if inertial is None else _LEAST_CONSTRAINT
            if is_found or all(one.status is Status.OK for one in ordered.results[1:]):
                velocity = body_velocity(_motions(ordered.results[1:3])[0], taken[2].stamp - taken[1].stamp)
            if ordered.is_at_rest:
                return SmoothedStart(velocity=velocity)
        if len(taken) == SMOOTHED or (len(taken) == SHOWING and not (needed or ordered.is_bent)):
            break
    if len(taken) < SHOWING or not (needed or ordered.is_bent):
        return SmoothedStart(velocity=velocity)
    return SmoothedStart(_smoothed(taken, ordered, unlimited, inertial, needed, least), velocity)


def _smoothed(
    taken: list[Scan], ordered: _Tracking, config: MappingConfig, inertial: "Inertial | None", needed: bool,
    least: float,
) -> dict[float, Prior]:  # fmt: skip
    """The motions backwards in time, or the first turn rate alone unless they are needed; empty where no better."""
    if ordered.is_sparse:
        slow = _tracked_from(np.zeros(3), taken, config, None)
        ordered = slow if _quality(slow.results[1:]) > _BETTER * _quality(ordered.results[1:]) else ordered
    forwards = ordered.results
    known = _tracked_at_last(forwards)[-(len(forwards) // 2 + 1) :]
    is_plausible = sum(one.status is Status.OK for one in known) >= _LEAST_OK * len(known) or _constraint(known) > least
    if len(known) < _FEWEST_KNOWN or not is_plausible:
        return {}
    end_s = taken[-1].stamp
    reverse = _Tracking(config, None if inertial is None else inertial.reversed(end_s))
    backwards = _backwards(taken, _motions(known), reverse)
    earlier = len(taken) - len(known)  # scans; the first of them has nothing to fit
    again = backwards[len(known) : -1]
    # Scans that were inserted at their predictions, into a map that was too thin, are no measure.
    in_order = [one for one in forwards[1:earlier] if one.registered or not one.added] or known
    is_better = _quality(again) >= _quality(in_order) or _constrains_better(again, in_order)
    if len(_tracked_at_last(backwards)) < len(backwards) or not is_better:
        return {}
    first = {taken[0].stamp: Prior(turn_rate=-backwards[-1].state.velocity[:3])} if ordered.is_bent else {}
    if not needed:
        return first
    moved = zip(pairwise(scan.stamp for scan in taken), _motions(backwards[::-1]), strict=True)
    return first | {
        now: Prior(T, body_velocity(T, now - before), _COVARIANCE, is_smoothed=True) for (before, now), T in moved
    }


def _quality(results: list[MappedScan]) -> float:
    """How well scans fit: the mean share of inliers times support."""
    return float(np.mean([one.quality for one in results]))


def _constraint(results: list[MappedScan]) -> float:
    """How well inliers constrain the weakest direction, on average."""
    return float(np.mean([one.fit.constraint for one in results if one.fit is not None]))


def _constrains_better(again: list[MappedScan], in_order: list[MappedScan]) -> bool:
    """Whether scans that hardly constrained a direction in order constrain it another time."""
    constraint = _constraint(in_order)
    return constraint < 1.0 and _constraint(again) > _MORE_CONSTRAINED * constraint


def _likeliest(scans: list[Scan], ordered: _Tracking, config: MappingConfig, inertial: "Inertial | None") -> _Tracking:
    """The first scans, tracked in order, or from another velocity where that is likelier."""
    best = reduce(_better, _from_elsewhere(scans, ordered, config, inertial), ordered)
    if inertial is None or ordered.inertial is None:
        return best
    if best is not ordered:
        inertial.may_rest = False
        return best
    if ordered.is_at_rest:
        return ordered
    inertial.may_rest, is_long = ordered.inertial.may_rest, scans[1].stamp - scans[0].stamp > _LONG_S
    are_constrained = all(one.fit is None or one.fit.is_constrained for one in ordered.results)
    if not is_long and inertial.may_rest and are_constrained:
        return ordered
    # The IMU's measurements relate the velocity to the motion between all scans, and so the later ones decide.
    score = _quality if is_long else _constraint
    tracked = (_tracked_from(velocity, scans, config, inertial.anew()) for velocity in _VELOCITIES)
    return max(tracked, key=lambda tracking: score(tracking.results))


def _from_elsewhere(
    scans: list[Scan], ordered: _Tracking, config: MappingConfig, inertial: "Inertial | None"
) -> Iterator[_Tracking]:
    """The first scans, tracked from the other velocities at which the second one fits."""
    first_two = ordered
    if inertial is not None:  # which may take the sensor to be at rest
        first_two = _Tracking(config, None)
        for scan in scans[:2]:
            first_two.process(scan, Prior())
    first, second = first_two.results[:2]
    interval_s, tried = scans[1].stamp - scans[0].stamp, [ordered.results[1].state.T_world_lidar[:3, 3]]
    apart_m = _APART_CELLS * second.cells_m[0] if second.cells_m else np.inf
    for T_world_lidar in second.elsewhere:
        if min(np.linalg.norm(T_world_lidar[:3, 3] - position) for position in tried) > apart_m:
            tried.append(T_world_lidar[:3, 3])
            own = None if inertial is None else inertial.anew()
            if own is not None:
                own.may_rest = False
            moved = inverse(first.state.T_world_lidar) @ T_world_lidar
            yield _tracked_from(moved[:3, 3] / interval_s, scans, config, own)


def _better(one: _Tracking, other: _Tracking) -> _Tracking:
    """The other where its scans fit clearly better, or better and with more constraint."""
    results, others = one.results[1:], other.results[1:]
    ratio = _quality(others) / max(_quality(results), 1e-9)
    is_better = ratio > _BETTER or (ratio > 1.0 and _constraint(others) > _MORE_CONSTRAINED * _constraint(results))
    return other if is_better else one


def _tracked_from(
    velocity: FloatArray, scans: list[Scan], config: MappingConfig, inertial: "Inertial | None"
) -> _Tracking:
    """The first scans, tracked from a velocity (3,), m/s."""
    tracking, interval_s = _Tracking(config, inertial), scans[1].stamp - scans[0].stamp
    tracking.process(scans[0], Prior())
    moved = exp(np.concatenate([np.zeros(3), velocity * interval_s]))
    covariance = np.diag([np.pi**2] * 3 + [(0.5 * _SPACING_M_S * interval_s) ** 2] * 3)
    tracking.process(scans[1], Prior(moved, covariance=covariance, caution=1.0))
    for scan in scans[2:]:
        tracking.process(scan, Prior())
    return tracking


def _backwards(scans: list[Scan], known: list[FloatArray], tracking: _Tracking) -> list[MappedScan]:
    """The scans, last first, registered to a new map; the motions (4, 4) of the last of them are known."""
    end = scans[-1].stamp
    for number, scan in enumerate(reversed(scans)):
        prior, step = Prior(), max(number, 1)
        if step <= len(known):
            T_prev_curr = inverse(known[-step])
            velocity = body_velocity(T_prev_curr, scans[-step].stamp - scans[-step - 1].stamp)
            prior = Prior(T_prev_curr if number else None, velocity, _COVARIANCE, is_smoothed=tracking.is_sparse)
        times = None if scan.time_offsets is None else -scan.time_offsets
        tracking.process(replace(scan, stamp=2.0 * end - scan.stamp, time_offsets=times), prior)
    return tracking.results


def _motions(results: list[MappedScan]) -> list[FloatArray]:
    """(4, 4) from each to the one before."""
    poses = [result.state.T_world_lidar for result in results]
    return [np.asarray(inverse(before) @ after, dtype=np.float64) for before, after in pairwise(poses)]


def _tracked_at_last(results: list[MappedScan]) -> list[MappedScan]:
    """The last of them that were tracked from one to the next."""
    first = 0
    for number, result in enumerate(results):
        if result.status is Status.LOST:
            first = number + 1
        elif not result.is_connected:
            first = number
    return results[first:]
