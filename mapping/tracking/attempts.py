"""Laying one scan on the map: from its prediction, again and patiently, and at last from anywhere."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.tracking import Status
from mapping.config import MappingConfig
from mapping.deskew import body_velocity
from mapping.prediction import Carrier, Prediction, Prior, State, predict
from mapping.registration import Refined, Sweep, compensated, refine
from mapping.sampling import SampledScan
from mapping.surfels.surfel_map import LocalMap
from mapping.tracking.fit import Fit, measure_fit
from mapping.tracking.relocalisation import Floorplan
from mapping.tracking.start_poses import best_starts, best_supported, best_velocity, positions_around, start_poses

# A sweep compensated with a motion that turns out to be this different is compensated again.
_SAME_ROTATION = np.deg2rad(0.1)
_SAME_TRANSLATION_M = 0.01
# A search may end anywhere. After a scan was lost, most of what the next one sees must lie on the map for it to be
# believed where it is expected.
_ANYWHERE = np.diag([np.pi**2] * 3 + [10.0**2] * 3)
_SHARE_TO_RETURN = 0.5
# With the whole map to choose from, what meets the map must lie on it much better than that, and clearly better than at
# the next best place that is so far away, in cells. On simulated recordings 57 to 74 % of what met the map lay on it at
# wrong places, at right ones 94 % and more; how much meets it depends on how much of the view is new.
_RATIO_ANYWHERE = 0.85
_SHARE_ANYWHERE = 0.4
_SUPPORT_ANYWHERE = 0.6
_CLEARLY = 1.2
_ELSEWHERE_CELLS = 4.0
# How far around the sensor a scan is drawn from above, in median ranges, and in cells of the map one of the drawing's.
_DRAWN_RANGES = 3.0
_DRAWN_CELLS = 4.0
_PLACES = 24
# Changes of the rate of turning that are tried on a scan that lies badly, rad/s: from full speed one way round to full
# speed the other way between two sweeps.
_TURNS = np.deg2rad(np.arange(-400.0, 401.0, 50.0))
# Displacements since the last scan that are tried where the velocity is not known: as far as a car drives, but no
# farther than the median range; so many cells apart, within reach of the coarse ones.
_FASTEST_M_S = 50.0
_DISPLACED_CELLS = 3.0
_PATIENCE = {"coarse_iterations": 10, "max_iterations": 40}


@dataclass(frozen=True, eq=False)
class Placed:
    """A scan laid on the map, and how it lies; not registered when too little of it met a surface.

    `rivalled`: another displacement since the last scan fits nearly as well, and no velocity is known to decide.
    """

    refined: Refined | None
    fit: Fit
    status: Status
    rivalled: bool = False

    @property
    def is_certain(self) -> bool:
        """Whether it lies on the map so well that it need not have been near there before."""
        return self.fit.inlier_share > _SHARE_TO_RETURN

    @property
    def is_beyond_doubt(self) -> bool:
        """Whether it lies on the map so well that it need not have been anywhere before."""
        ratio, share, support = self.fit.inlier_ratio or 0.0, self.fit.inlier_share, self.fit.support or 0.0
        fits = ratio > _RATIO_ANYWHERE and share > _SHARE_ANYWHERE and support > _SUPPORT_ANYWHERE
        return self.status is Status.OK and fits

    @property
    def quality(self) -> float:
        """To choose by among places: the share of the scan that lies on the map, and how well that holds it."""
        return self.fit.inlier_share * (self.fit.support or 0.0)


def place(
    sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap, config: MappingConfig,
    coarse_first: bool,
) -> Placed:  # fmt: skip
    """Lay a scan on the map from where it is expected; where it does not fit there, by way of coarser cells.

    Args:
        sampled: the points.
        prediction: where the scan is expected.
        last: the scan before.
        local_map: what is laid on.
        config: how.
        coarse_first: whether to begin with coarser cells at once.
    """
    placed = _place_once(sampled, prediction, last, local_map, config, coarse_first)
    if coarse_first or placed.status is Status.OK:
        return placed
    again = _place_once(sampled, prediction, last, local_map, config, coarse_first=True)
    return again if again.fit.inlier_share > placed.fit.inlier_share else placed


def place_surprised(
    sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap, config: MappingConfig
) -> Placed:
    """Lay a scan on the map from where it is expected, though it may turn any way; patiently, by way of coarser cells.

    Args:
        sampled: the points.
        prediction: where the scan is expected, of a carrier that anything is believed of.
        last: the scan before.
        local_map: what is laid on.
        config: how.
    """
    sweep, T_world_lidar = sampled.sweep, prediction.T_world_lidar
    starts = [prediction.velocity]
    if config.continuous_time and sweep.times is not None:
        up = T_world_lidar[:3, :3].T @ local_map.vertical()
        velocities = prediction.velocity + np.outer(_TURNS, np.concatenate([up, np.zeros(3)]))
        turned = best_velocity(sweep.points, sweep.times, velocities, T_world_lidar, local_map)
        starts += [] if np.array_equal(turned, prediction.velocity) else [turned]
    tried = [
        _place_patiently(sampled, replace(prediction, velocity=velocity), last, local_map, config)
        for velocity in starts
    ]
    return max(tried, key=lambda placed: placed.quality)


def place_displaced(
    sampled: SampledScan, rotations: Sequence[FloatArray], last: State, local_map: LocalMap, config: MappingConfig
) -> list[tuple[Placed, Prediction]]:
    """Register a scan from displacements since the last one in every horizontal direction; those that are ok, each with
    what was expected there.

    A sensor that was at speed when the recording began, or whose odometry is wrong, is out of reach of the expected
    pose, and most of a street fits there too.

    Args:
        sampled: the points.
        rotations: poses (4, 4) whose rotations are tried.
        last: the scan before.
        local_map: what is registered to.
        config: how.
    """
    sweep, interval_s = sampled.sweep, sampled.stamp - last.stamp
    points = compensated(sweep.points, sweep.times, last.velocity)
    if not len(points) or interval_s <= 0.0:
        return []
    radius_m, up = min(_FASTEST_M_S * interval_s, sampled.range_m), local_map.vertical()
    step_m = _DISPLACED_CELLS * local_map.cell_m
    starts = []
    for rotation in rotations:
        T = last.T_world_lidar.copy()
        T[:3, :3] = rotation[:3, :3]
        starts.append(positions_around(T, up, radius_m, step_m))
    tried = []
    for start in best_supported(points, np.concatenate(starts), local_map):
        velocity = body_velocity(inverse(last.T_world_lidar) @ start, interval_s)
        moving = State.moving(last, velocity)
        prediction = predict(moving, sampled.stamp, Prior(), Carrier(), config, sampled.seen_from_s)
        tried.append((_place_patiently(sampled, prediction, last, local_map, config), prediction))
    return [found for found in tried if found[0].status is Status.OK]


def _place_patiently(
    sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap, config: MappingConfig
) -> Placed:
    refinement = config.refinement
    patience = {name: max(steps, getattr(refinement, name)) for name, steps in _PATIENCE.items()}
    patient = config.model_copy(update={"refinement": refinement.model_copy(update=patience)})
    return _place_once(sampled, prediction, last, local_map, patient, coarse_first=True)


def search(
    sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap, config: MappingConfig
) -> Placed | None:
    """Try a scan turned all around, where it is expected and where the last one was; None when nothing fits well."""
    sweep = sampled.sweep
    points = compensated(sweep.points, sweep.times, prediction.velocity)
    if not len(points):
        return None
    up, step_deg = local_map.vertical(), config.tracking.search_yaw_step_deg
    places = (prediction.T_world_lidar, last.T_world_lidar)
    starts = np.concatenate([start_poses(T_world_lidar, up, step_deg) for T_world_lidar in places])
    tried = _from_starts(best_starts(points, starts, local_map), sampled, prediction, last, local_map, config)
    return max((placed for placed in tried if placed.is_beyond_doubt), key=lambda placed: placed.quality, default=None)


def search_everywhere(
    sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap, config: MappingConfig
) -> Placed | None:
    """Try a scan all over the map, turned anyhow, leaning as the last one did.

    None when it fits well nowhere, or at two places nearly alike: rooms in a row look the same.
    """
    sweep = sampled.sweep
    points = compensated(sweep.points, sweep.times, prediction.velocity)
    if not len(points):
        return None
    plan = Floorplan.of(local_map.surface(), local_map.vertical(), _DRAWN_CELLS * local_map.cell_m)
    all_points = compensated(sampled.points, sampled.times, prediction.velocity)
    starts = plan.find(all_points, last.T_world_lidar, _DRAWN_RANGES * sampled.range_m, _PLACES)
    if not len(starts):
        return None
    tried = _from_starts(best_starts(points, starts, local_map), sampled, prediction, last, local_map, config)
    best = max(tried, key=lambda placed: placed.quality, default=None)
    if best is None or not best.is_beyond_doubt:
        return None
    return None if is_rivalled(best, tried, local_map) else best


def _from_starts(
    starts: FloatArray, sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap,
    config: MappingConfig,
) -> list[Placed]:  # fmt: skip
    """What a scan comes to from each of the poses (K, 4, 4), where it comes to something that is ok."""
    tried = []
    for start in starts:
        free = replace(prediction, T_world_lidar=start, covariance=_anywhere(prediction))
        tried.append(_place_patiently(sampled, free, last, local_map, config))
    return [placed for placed in tried if placed.status is Status.OK]


def _anywhere(prediction: Prediction) -> FloatArray:
    covariance = np.zeros((12, 12))
    covariance[:6, :6], covariance[6:, 6:] = _ANYWHERE, prediction.covariance[6:, 6:]
    return covariance


def is_rivalled(best: Placed, others: Sequence[Placed], local_map: LocalMap) -> bool:
    """Whether a scan fits nearly as well at another place."""
    rivals = [other for other in others if _apart_m(other, best) > _ELSEWHERE_CELLS * local_map.cell_m]
    return any(_CLEARLY * rival.quality > best.quality for rival in rivals)


def _apart_m(one: Placed, other: Placed) -> float:
    assert one.refined is not None
    assert other.refined is not None
    return float(np.linalg.norm(one.refined.T_world_lidar[:3, 3] - other.refined.T_world_lidar[:3, 3]))


def _place_once(
    sampled: SampledScan, prediction: Prediction, last: State, local_map: LocalMap, config: MappingConfig,
    coarse_first: bool,
) -> Placed:  # fmt: skip
    sweep, interval_s = sampled.sweep, sampled.stamp - last.stamp
    refined = refine(sweep, prediction, local_map, config.refinement, coarse_first, config.continuous_time)
    if refined is not None and not (config.continuous_time and sweep.times is not None) and interval_s > 0.0:
        refined = _with_own_motion(sweep, prediction, last, interval_s, local_map, config, refined)
    if refined is None:
        return Placed(None, Fit(0, 0.0, None, None), Status.LOST)
    points = compensated(sweep.points, sweep.times, refined.velocity)
    fit = measure_fit(points, refined.T_world_lidar, local_map, config.tracking)
    return Placed(refined, fit, fit.status(config.tracking))


def _with_own_motion(
    sweep: Sweep, prediction: Prediction, last: State, interval_s: float, local_map: LocalMap, config: MappingConfig,
    refined: Refined,
) -> Refined | None:  # fmt: skip
    """Without an estimate of its own, the velocity is that since the last scan.

    A sweep that was compensated with another one is compensated again, and registered again.
    """
    velocity = body_velocity(inverse(last.T_world_lidar) @ refined.T_world_lidar, interval_s)
    change = np.abs(velocity - prediction.velocity) * interval_s
    same = np.linalg.norm(change[:3]) < _SAME_ROTATION and np.linalg.norm(change[3:]) < _SAME_TRANSLATION_M
    if sweep.times is not None and config.second_deskew and not same:
        again = replace(prediction, T_world_lidar=refined.T_world_lidar, velocity=velocity)
        second = refine(sweep, again, local_map, config.refinement, coarse_first=False, with_velocity=False)
        if second is None:
            return None
        refined = second
        velocity = body_velocity(inverse(last.T_world_lidar) @ refined.T_world_lidar, interval_s)
    return replace(refined, velocity=velocity, covariance=_with_velocity(refined.covariance, last, interval_s))


def _with_velocity(covariance: FloatArray, last: State, interval_s: float) -> FloatArray:
    """The covariance of pose and velocity, the velocity being the difference of two poses over the time between."""
    both = np.zeros((12, 12))
    both[:6, :6] = covariance[:6, :6]
    both[:6, 6:] = both[6:, :6] = covariance[:6, :6] / interval_s
    both[6:, 6:] = (covariance[:6, :6] + last.covariance[:6, :6]) / interval_s**2
    return both
