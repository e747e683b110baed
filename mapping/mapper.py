"""Scan-to-map refinement: scan after scan is predicted, laid on the map, judged, and added to it.

LOAM's mapping (Zhang and Singh, RSS 2014), with any odometry before it or none.
"""

from dataclasses import dataclass, replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, log, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.tracking import Status
from mapping.config import MappingConfig
from mapping.deskew import body_velocity
from mapping.fit import Fit, measure_fit
from mapping.local_map import LocalMap
from mapping.recovery import best_starts, start_poses
from mapping.refinement import Prediction, Refined, Sweep, compensated, refine
from mapping.sampling import SampledScan, Sampler

# What the velocity may change by during one sweep beyond the prior's, as a motion: a carrier's acceleration.
_VELOCITY_CHANGE = np.array([np.deg2rad(60.0)] * 3 + [1.0] * 3)
_MEASURED_VELOCITY = 0.35
# A sweep compensated with a motion that turns out to be this different is compensated again.
_SAME_ROTATION = np.deg2rad(0.1)
_SAME_TRANSLATION_M = 0.01
# Predictions that were off by less than this share of a cell need no coarser cells first; what they were off by is
# forgotten by this factor a scan.
_FINE_ENOUGH = 0.5
_CAUTION = 0.8
_UNKNOWN_M = 10.0
# A search may end anywhere, but must then have found much of what it sees.
_ANYWHERE = np.array([np.pi] * 3 + [10.0] * 3)
_OVERLAP_TO_RETURN = 0.4
# A pose so many standard deviations from where it was expected is suspicious however it fits.
_MOST_SIGMAS = 4.0
# Nothing goes on as it did for ever: while lost, the velocity fades by this from scan to scan.
_FADING = 0.7


@dataclass(frozen=True, eq=False)
class Prior:
    """What an odometry says of a scan; None where it says nothing, and the last motion is gone on with.

    Attributes:
        T_prev_curr: (4, 4) the motion since the previous scan.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
    """

    T_prev_curr: FloatArray | None = None
    velocity: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class MappedScan:
    """A scan laid on the map.

    Attributes:
        T_world_lidar: (4, 4) at the stamp.
        T_prev_curr_prior: (4, 4) the motion that was expected.
        velocity: (6,) during the sweep, in the LiDAR frame, rotation first.
        covariance: (6, 6) of the pose, rotation first, in the LiDAR frame; None when it was not registered.
        status, message: whether to believe it, and why not.
        fit: how it lies on the map; None for the first scan.
        degenerate: the directions along which the prior was kept.
        iterations: how many it took.
    """

    T_world_lidar: FloatArray
    T_prev_curr_prior: FloatArray
    velocity: FloatArray
    covariance: FloatArray | None
    status: Status
    message: str
    fit: Fit | None
    degenerate: tuple[str, ...]
    iterations: int


@dataclass(frozen=True, eq=False)
class _Tracked:
    """The last scan."""

    stamp: float
    T_world_lidar: FloatArray
    velocity: FloatArray


class Mapper:
    """Holds the local map and the last pose."""

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._sampler = Sampler(config)
        self._map: LocalMap | None = None
        self._last: _Tracked | None = None
        self._interval_s = 0.0
        self._expected_error_m = _UNKNOWN_M
        self._lost_in_a_row = 0

    @property
    def local_map(self) -> LocalMap | None:
        """What scans are laid on; None before the first."""
        return self._map

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Lay the next scan on the map, and add it."""
        sampled = self._sampler.sample(scan)
        self._interval_s = 0.0 if self._last is None else scan.stamp - self._last.stamp
        expected = self._predict(prior)
        local_map = self._map
        mapped = self._begin(sampled, expected) if local_map is None else self._lay(sampled, expected, local_map)
        self._last = _Tracked(scan.stamp, mapped.T_world_lidar, mapped.velocity)
        return mapped

    def _predict(self, prior: Prior) -> tuple[FloatArray, Prediction]:
        """The expected motion since the last scan, and pose and velocity that follow."""
        last = self._last
        if last is None:
            velocity = np.zeros(6) if prior.velocity is None else prior.velocity
            return np.eye(4), self._prediction(np.eye(4), velocity, prior, 0.0)
        interval_s = self._interval_s
        T_prev_curr = exp(last.velocity * interval_s) if prior.T_prev_curr is None else prior.T_prev_curr
        velocity = last.velocity if prior.velocity is None else prior.velocity
        return T_prev_curr, self._prediction(last.T_world_lidar @ T_prev_curr, velocity, prior, interval_s)

    def _prediction(
        self, T_world_lidar: FloatArray, velocity: FloatArray, prior: Prior, interval_s: float
    ) -> Prediction:
        rotation, translation = np.deg2rad(self._config.prior_rotation_deg), self._config.prior_translation_m
        pose_sigmas = np.array([rotation] * 3 + [translation] * 3)
        if prior.T_prev_curr is None:
            pose_sigmas = pose_sigmas + interval_s * _VELOCITY_CHANGE
        change = _VELOCITY_CHANGE * (_MEASURED_VELOCITY if prior.velocity is not None else 1.0)
        return Prediction(T_world_lidar, velocity, pose_sigmas, change)

    def _begin(self, sampled: SampledScan, expected: tuple[FloatArray, Prediction]) -> MappedScan:
        """The first scan makes the map."""
        T_prev_curr, prediction = expected
        if not len(sampled):
            return _unregistered(T_prev_curr, prediction, Status.LOST, "there is no point within range")
        self._map = LocalMap(sampled.cell_m, self._config.radius_m)
        self._add(sampled, prediction.T_world_lidar, prediction.velocity)
        return _unregistered(T_prev_curr, prediction, Status.OK, "")

    def _lay(self, sampled: SampledScan, expected: tuple[FloatArray, Prediction], local_map: LocalMap) -> MappedScan:
        """Register a scan to the map; when it fits nowhere near, search; when it fits nowhere, keep it out."""
        T_prev_curr, prediction = expected
        if sampled.cell_m != local_map.cell_m:
            local_map = self._map = local_map.resized(sampled.cell_m)
        sweep = sampled.sweep
        coarse = self._expected_error_m > _FINE_ENOUGH * local_map.cell_m
        refined, fit = self._register(sweep, prediction, local_map, coarse)
        if not coarse and fit.status(self._config.tracking) is not Status.OK:
            again, fit_again = self._register(sweep, prediction, local_map, coarse=True)
            if fit_again.inlier_share > fit.inlier_share:
                refined, fit = again, fit_again
        if fit.status(self._config.tracking) is Status.LOST:
            refined, fit = self._search(sweep, prediction, local_map) or (None, fit)
        if refined is None:
            return self._miss(sampled, expected, fit)
        self._lost_in_a_row = 0
        correction = log(inverse(prediction.T_world_lidar) @ refined.T_world_lidar)
        self._expected_error_m = max(_CAUTION * self._expected_error_m, _displacement(correction, sampled))
        if fit.inlier_ratio is not None and fit.inlier_ratio >= self._config.tracking.degraded_below:
            self._add(sampled, refined.T_world_lidar, refined.velocity)
        status, message = self._judge(fit, refined, correction, prediction)
        return MappedScan(
            T_world_lidar=refined.T_world_lidar,
            T_prev_curr_prior=T_prev_curr,
            velocity=refined.velocity,
            covariance=refined.covariance,
            status=status,
            message=message,
            fit=fit,
            degenerate=refined.degeneracy.names,
            iterations=refined.iterations,
        )

    def _register(
        self, sweep: Sweep, prediction: Prediction, local_map: LocalMap, coarse: bool
    ) -> tuple[Refined | None, Fit]:
        """Lay a sweep on the map from a prediction, and see how it lies."""
        config = self._config
        refined = refine(sweep, prediction, local_map, config.refinement, coarse, config.continuous_time)
        if refined is not None and not (config.continuous_time and sweep.is_rolling):
            refined = self._with_own_motion(sweep, prediction, local_map, refined)
        if refined is None:
            return None, Fit(0, 0.0, None, None)
        points = compensated(sweep.planes, sweep.plane_times, refined.velocity)
        return refined, measure_fit(points, refined.T_world_lidar, local_map, config.tracking)

    def _with_own_motion(
        self, sweep: Sweep, prediction: Prediction, local_map: LocalMap, refined: Refined
    ) -> Refined | None:
        """Without an estimate of its own, the velocity is that since the last scan.

        A sweep that was compensated with another one is compensated again, and registered again.
        """
        last, interval_s = self._last, self._interval_s
        if last is None or interval_s <= 0.0:
            return refined
        velocity = body_velocity(inverse(last.T_world_lidar) @ refined.T_world_lidar, interval_s)
        refined = replace(refined, velocity=velocity)
        change = np.abs(velocity - prediction.velocity) * interval_s
        same = np.linalg.norm(change[:3]) < _SAME_ROTATION and np.linalg.norm(change[3:]) < _SAME_TRANSLATION_M
        if same or not sweep.is_rolling or not self._config.second_deskew:
            return refined
        again = replace(prediction, T_world_lidar=refined.T_world_lidar, velocity=velocity)
        return refine(sweep, again, local_map, self._config.refinement, coarse_first=False, with_velocity=False)

    def _search(self, sweep: Sweep, prediction: Prediction, local_map: LocalMap) -> tuple[Refined, Fit] | None:
        """Try the scan turned all around, where it is expected and where the last one was; None when nothing fits."""
        tracking = self._config.tracking
        points = compensated(sweep.planes, sweep.plane_times, prediction.velocity)
        places = [prediction.T_world_lidar]
        if self._last is not None:
            places.append(self._last.T_world_lidar)
        up = local_map.vertical()
        starts = np.concatenate([start_poses(place, up, tracking.search_yaw_step_deg) for place in places])
        best: tuple[Refined, Fit] | None = None
        for start in best_starts(points, starts, local_map):
            free = Prediction(start, prediction.velocity, _ANYWHERE, prediction.velocity_sigmas)
            refined, fit = self._register(sweep, free, local_map, coarse=True)
            if refined is None or fit.status(tracking) is not Status.OK or fit.overlap < _OVERLAP_TO_RETURN:
                continue
            if best is None or fit.inlier_share > best[1].inlier_share:
                best = refined, fit
        return best

    def _miss(self, sampled: SampledScan, expected: tuple[FloatArray, Prediction], fit: Fit) -> MappedScan:
        """A scan that fits nowhere: it stays where it was expected, out of the map."""
        T_prev_curr, prediction = expected
        self._lost_in_a_row += 1
        self._expected_error_m = _UNKNOWN_M
        message = fit.explain(self._config.tracking)
        if self._lost_in_a_row >= self._config.tracking.give_up_after and len(sampled):
            self._map = LocalMap(sampled.cell_m, self._config.radius_m)
            self._add(sampled, prediction.T_world_lidar, prediction.velocity)
            self._lost_in_a_row = 0
            message += "; a new map is begun here"
        return _unregistered(T_prev_curr, prediction, Status.LOST, message, fit)

    def _add(self, sampled: SampledScan, T_world_lidar: FloatArray, velocity: FloatArray) -> None:
        assert self._map is not None
        points = compensated(sampled.points, sampled.times, velocity)
        edges = compensated(sampled.edges, sampled.edge_times, velocity)
        self._map.add(
            planes=transform_points(T_world_lidar, points),
            elevations=sampled.elevations,
            edges=transform_points(T_world_lidar, edges),
            sensor=T_world_lidar[:3, 3],
        )

    def _judge(self, fit: Fit, refined: Refined, correction: FloatArray, prediction: Prediction) -> tuple[Status, str]:
        """The fit decides; a fitting scan far from where it was expected is degraded, one held by the prior as well."""
        status, message = fit.status(self._config.tracking), fit.explain(self._config.tracking)
        if status is not Status.OK:
            return status, message
        jump = np.abs(correction) / prediction.pose_sigmas
        if float(jump.max()) > _MOST_SIGMAS:
            angle_deg, distance_m = np.rad2deg(np.linalg.norm(correction[:3])), np.linalg.norm(correction[3:])
            return Status.DEGRADED, f"{angle_deg:.0f} deg and {distance_m:.2f} m from where it was expected"
        if len(refined.degeneracy):
            return Status.DEGRADED, f"nothing to see along {', '.join(refined.degeneracy.names)}; the prior was kept"
        return Status.OK, ""


def _displacement(correction: FloatArray, sampled: SampledScan) -> float:
    """How far a correction moves a typical point, metres."""
    lever_m = sampled.range_m
    return float(np.linalg.norm(correction[3:]) + lever_m * np.linalg.norm(correction[:3]))


def _unregistered(
    T_prev_curr: FloatArray, prediction: Prediction, status: Status, message: str, fit: Fit | None = None
) -> MappedScan:
    return MappedScan(
        T_world_lidar=prediction.T_world_lidar,
        T_prev_curr_prior=T_prev_curr,
        velocity=prediction.velocity * (_FADING if status is Status.LOST else 1.0),
        covariance=None,
        status=status,
        message=message,
        fit=fit,
        degenerate=(),
        iterations=0,
    )
