"""Smoothing of the first scans: their motions by registration backwards in time, to the map of the scans after them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import Prior
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.surfel_mapper import SurfelMapper

# Scans that are smoothed, and those of them that show whether that is needed, where a sweep makes a map.
SMOOTHED, SHOWING = 20, 8
_FEWEST_KNOWN = 6
# Standard deviations of a smoothed motion, rotation first.
_COVARIANCE = np.diag(np.array([np.deg2rad(0.1)] * 3 + [0.005] * 3) ** 2)


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """The motion since the previous scan."""

    T_prev_curr: FloatArray  # (4, 4)
    interval_s: float

    @property
    def covariance(self) -> FloatArray:
        """(6, 6), as that of an odometry."""
        return _COVARIANCE

    @property
    def velocity(self) -> FloatArray:
        """(6,) body velocity, rotation first."""
        return body_velocity(self.T_prev_curr, self.interval_s)


def smoothed_start(scans: Iterable[Scan], config: MappingConfig) -> dict[float, SmoothedMotion]:
    """Motions of the first scans, by stamp; empty where registration in order suffices.

    The map of a single sweep is thin, and what it lets slide stays in the map. So the first scans are registered in
    order; from the last of them back, with the motions of the latest known, to a new map; and the motions of the
    first half are those that this map shows. None is known where that loses track.
    """
    unlimited = config.model_copy(update={"budget_ms": None})
    ordered, forwards, needed = SurfelMapper(unlimited), [], False
    taken: list[Scan] = []
    for scan in scans:
        sampled = ordered.sample(scan)
        forwards.append(ordered.process_sampled(sampled, Prior()))
        taken.append(scan)
        needed |= not sampled.has_rings or forwards[-1].status is not Status.OK
        if len(taken) == SMOOTHED or (len(taken) == SHOWING and not needed):
            break
    if not needed or len(taken) < SHOWING:
        return {}
    known = _tracked_at_last(forwards)[-(len(forwards) // 2 + 1) :]
    if len(known) < _FEWEST_KNOWN:
        return {}
    backwards = _backwards(taken, _motions(known), unlimited)
    if len(_tracked_at_last(backwards)) < len(backwards):
        return {}
    moved = zip(pairwise(scan.stamp for scan in taken), _motions(backwards[::-1]), strict=True)
    return {stamp: SmoothedMotion(T_prev_curr, stamp - before) for (before, stamp), T_prev_curr in moved}


def _backwards(scans: list[Scan], known: list[FloatArray], config: MappingConfig) -> list[MappedScan]:
    """The scans, last first, registered to a new map; the motions (4, 4) of the last of them are known."""
    mapper, results, end = SurfelMapper(config), [], scans[-1].stamp
    for number, scan in enumerate(reversed(scans)):
        prior, step = Prior(), max(number, 1)
        if step <= len(known):
            T_prev_curr = inverse(known[-step])
            velocity = body_velocity(T_prev_curr, scans[-step].stamp - scans[-step - 1].stamp)
            prior = Prior(T_prev_curr if number else None, velocity, _COVARIANCE)
        times = None if scan.time_offsets is None else -scan.time_offsets
        results.append(mapper.process(replace(scan, stamp=2.0 * end - scan.stamp, time_offsets=times), prior))
    return results


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
