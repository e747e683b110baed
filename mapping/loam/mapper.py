"""Scan-to-map refinement of LOAM (Zhang and Singh, RSS 2014, section VI), with any odometry or none.

Each sweep is compensated with the odometry's velocity and predicted by its motion; its features are registered to the
maps of edges and planes, and inserted there. Unlike the surfel mapper it estimates no velocity and does not relocalise.
"""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse, transform_points
from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.core.tracking import Status
from mapping.config import MappingConfig
from mapping.deskew import body_velocity
from mapping.loam.feature_map import FeatureMap
from mapping.loam.features import Features, extract_features
from mapping.loam.registration import FeatureMaps, LoamRegistration, register
from mapping.prediction import LOST_MOTION, UNKNOWN_VELOCITY, MotionState, Prior
from mapping.scene_scale import MIN_POINTS, SceneScale
from mapping.tracking.fit import Fit
from mapping.tracking.mapped_scan import MappedScan

# Lost scans in a row after which the map begins anew. Those of a covered sensor do not count.
_GIVE_UP_AFTER = 20


class LoamMapper(Stateful):
    """Holds the maps of features and the state of the last scan."""

    _scale: SceneScale
    _edges: FeatureMap
    _planes: FeatureMap
    _last: MotionState | None
    _lost_in_a_row: int

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._scale = SceneScale(config)
        self._last = None
        self._begin_maps()

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Register the next scan to the map, and insert it."""
        spacing_m = self._scale.update(np.einsum("ij,ij->i", scan.points, scan.points))
        features = extract_features(scan, self._config.min_range_m, self._config.max_range_m, spacing_m)
        last = self._last or MotionState(scan.stamp, np.eye(4), np.zeros(6), UNKNOWN_VELOCITY)
        predicted = _predict(scan.stamp, prior, last)
        if len(features) < MIN_POINTS:
            mapped = _lost(predicted, None, f"only {len(features)} features within range")
        elif not len(self._edges) + len(self._planes):
            mapped = MappedScan(predicted, predicted.T_world_lidar, False, Status.OK, added=True)
        else:
            mapped = self._track(features, spacing_m, prior, predicted, last)
        if mapped.added:
            self._insert(features, spacing_m, mapped.state.T_world_lidar, predicted.velocity)
        self._last = mapped.state
        return mapped

    def _track(
        self, features: Features, spacing_m: float, prior: Prior, predicted: MotionState, last: MotionState
    ) -> MappedScan:
        """Register compensated features from the predicted pose, and judge the pose by its fit."""
        edges, planes = (sweep.compensated(predicted.velocity) for sweep in (features.edges, features.planes))
        covariance = prior.motion_covariance(self._config)
        maps = FeatureMaps(self._edges, self._planes)
        registration = register(edges, planes, predicted.T_world_lidar, covariance, maps, spacing_m)
        if registration is None:
            return self._lose(predicted, None, "too few features correspond to the map")
        fit, names = registration.fit, registration.degeneracy.names
        status, message = fit.status(self._config.tracking), fit.explain(self._config.tracking)
        if status is Status.LOST:
            return self._lose(predicted, fit, message)
        is_added = status is Status.OK
        if is_added and names:
            status, message = Status.DEGRADED, f"degenerate along {', '.join(names)}: the prediction was kept"
        self._lost_in_a_row = 0
        return MappedScan(
            state=_moved(predicted, registration, prior, last),
            T_world_predicted=predicted.T_world_lidar,
            registered=True,
            status=status,
            message=message,
            fit=fit,
            degenerate=names,
            added=is_added,
        )

    def _lose(self, predicted: MotionState, fit: Fit | None, reason: str) -> MappedScan:
        """A scan without a registration; after many a new map begins with it."""
        self._lost_in_a_row += 1
        begins = self._lost_in_a_row >= _GIVE_UP_AFTER
        if begins:
            self._begin_maps()
            reason += "; a new map begins here"
        return replace(_lost(predicted, fit, reason), added=begins)

    def _begin_maps(self) -> None:
        self._edges, self._planes = (FeatureMap(self._config.radius_m) for _ in range(2))
        self._lost_in_a_row = 0

    def _insert(self, features: Features, spacing_m: float, T_world_lidar: FloatArray, velocity: FloatArray) -> None:
        for sweep, feature_map in ((features.edges, self._edges), (features.planes, self._planes)):
            points = transform_points(T_world_lidar, sweep.compensated(velocity))
            feature_map.insert(points, T_world_lidar[:3, 3], spacing_m)


def _predict(stamp: float, prior: Prior, last: MotionState) -> MotionState:
    """The odometry's motion and velocity; the last velocity where it has none."""
    velocity = last.velocity if prior.velocity is None else prior.velocity
    motion = exp(last.velocity * (stamp - last.stamp)) if prior.T_prev_curr is None else prior.T_prev_curr
    return MotionState(stamp, last.T_world_lidar @ motion, velocity, UNKNOWN_VELOCITY)


def _lost(predicted: MotionState, fit: Fit | None, reason: str) -> MappedScan:
    """A scan without a registration stays at its prediction."""
    lost = replace(predicted, covariance=LOST_MOTION)
    return MappedScan(lost, predicted.T_world_lidar, False, Status.LOST, reason, fit, is_connected=False)


def _moved(predicted: MotionState, registration: LoamRegistration, prior: Prior, last: MotionState) -> MotionState:
    """The registered state; its velocity is the odometry's, else the mean since the last scan."""
    T_world_lidar, velocity, interval_s = registration.T_world_lidar, predicted.velocity, predicted.stamp - last.stamp
    if prior.velocity is None and interval_s > 0.0:
        velocity = body_velocity(inverse(last.T_world_lidar) @ T_world_lidar, interval_s)
    covariance = UNKNOWN_VELOCITY.copy()
    covariance[:6, :6] = registration.covariance
    return MotionState(predicted.stamp, T_world_lidar, velocity, covariance)
