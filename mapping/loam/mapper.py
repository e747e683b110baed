"""Scan-to-map refinement of LOAM (Zhang and Singh, RSS 2014, section VI), with any odometry or none.

Each sweep is compensated with the odometry's velocity and predicted by its motion; its features are registered to the
maps of edges and planes, and inserted there. Unlike the surfel mapper it estimates no velocity and does not relocalise.
"""

from dataclasses import replace

import numpy as np

from lidarslam.core.geometry import adjoint, exp, inverse, transform_points
from lidarslam.core.scan import Scan, squared_ranges
from lidarslam.core.state.stateful import Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MappingConfig
from lidarslam.mapping.loam.feature_map import FeatureMap
from lidarslam.mapping.loam.features import Features, extract_features
from lidarslam.mapping.loam.registration import FeatureMaps, register
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import FADING, LOST_MOTION, UNKNOWN_VELOCITY, MotionState, Prior
from lidarslam.mapping.scene_scale import MIN_POINTS, SceneScale
from lidarslam.mapping.surfels.voxel_hash import beyond_reach
from lidarslam.mapping.tracking.fit import Fit
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.pose_status import reservation
from lidarslam.mapping.tracking.tracking_state import GIVE_UP_AFTER

# Of maps that follow the scene: in sparser ones, neighbours are too far apart for a line or plane.
_MOST_SPACING_M = 0.4


class LoamMapper(Stateful):
    """Holds the maps of features and the state of the last scan."""

    _scale: SceneScale
    _edges: FeatureMap
    _planes: FeatureMap
    _last: MotionState | None
    _last_middle_s: float
    _lost_in_a_row: int
    _is_adrift: bool

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._scale = SceneScale(config)
        self._last = None
        self._last_middle_s = 0.0  # from its stamp to the middle of its sweep
        self._is_adrift = False  # whether the map is a new one, at an unknown pose in the one before
        self._begin_maps()

    def process(self, scan: Scan, prior: Prior) -> MappedScan:
        """Register the next scan to the map, and insert it."""
        cell_m = self._scale.update(squared_ranges(scan.points))
        spacing_m = self._config.cell_m or min(cell_m, _MOST_SPACING_M)
        features = extract_features(scan, self._config.min_range_m, self._config.max_range_m, spacing_m)
        last = self._last or MotionState(scan.stamp, np.eye(4), np.zeros(6), UNKNOWN_VELOCITY)
        predicted = _predict(scan.stamp, prior, last, self._config)
        near = last if prior.T_prev_curr is None else predicted  # an extrapolated velocity leads anywhere
        beyond = beyond_reach(near.T_world_lidar[:3, 3], self._config.max_range_m, spacing_m)
        if len(features) < MIN_POINTS:
            mapped = _lost(predicted, None, f"only {len(features)} features within range")
        elif beyond is not None:
            mapped = _lost(predicted, None, beyond)
        elif not len(self._edges) + len(self._planes):
            mapped = MappedScan(predicted, predicted.T_world_lidar, False, Status.OK, added=True)
            self._insert(features, predicted)
        else:
            mapped = self._track(features, prior, predicted, last)
        self._last, self._last_middle_s = mapped.state, features.middle_s
        return mapped

    def _track(self, features: Features, prior: Prior, predicted: MotionState, last: MotionState) -> MappedScan:
        """Register compensated features from the predicted pose, judge the pose by its fit, insert."""
        maps = FeatureMaps(self._edges, self._planes)
        registration = register(features, predicted, maps, self._config.keypoints)
        if registration is None:
            return self._lose(features, predicted, None, "too few features correspond to the map")
        fit, names = registration.fit, registration.degeneracy.names
        status, message = fit.status(self._config.tracking), fit.explain(self._config.tracking)
        if status is Status.LOST:
            return self._lose(features, predicted, fit, message)
        self._lost_in_a_row = 0
        covariance = UNKNOWN_VELOCITY.copy()
        covariance[:6, :6] = registration.covariance
        state = replace(predicted, T_world_lidar=registration.T_world_lidar, covariance=covariance)
        if prior.velocity is None:
            state = self._with_mean_velocity(state, features.middle_s, last)
        is_added = status is Status.OK
        if is_added:
            self._insert(features, state)
            message = reservation(names, names, self._is_adrift)
        return MappedScan(
            state=state,
            T_world_predicted=predicted.T_world_lidar,
            registered=True,
            status=Status.DEGRADED if message else Status.OK,
            message=message,
            fit=fit,
            degenerate=names,
            iterations=registration.iterations,
            added=is_added,
            measured=registration.measured,
        )

    def _with_mean_velocity(self, state: MotionState, middle_s: float, last: MotionState) -> MotionState:
        """The state with the mean velocity between the middles of two sweeps.

        A wrong velocity displaces the pose at the stamp, and hardly that of the middle. Velocities of poses at the
        stamps would oscillate where these are far from the middles.
        """
        interval_s = state.stamp + middle_s - last.stamp - self._last_middle_s
        if interval_s <= 0.0:
            return state
        T_world_middle = state.T_world_lidar @ exp(middle_s * state.velocity)
        T_world_before = last.T_world_lidar @ exp(self._last_middle_s * last.velocity)
        velocity = body_velocity(inverse(T_world_before) @ T_world_middle, interval_s)
        return replace(state, T_world_lidar=T_world_middle @ exp(-middle_s * velocity), velocity=velocity)

    def _lose(self, features: Features, predicted: MotionState, fit: Fit | None, reason: str) -> MappedScan:
        """A scan without a registration stays at its prediction; after many in a row a new map begins with it."""
        self._lost_in_a_row += 1
        if self._lost_in_a_row < GIVE_UP_AFTER:
            return _lost(predicted, fit, reason)
        self._begin_maps()
        self._insert(features, predicted)
        self._is_adrift = True
        return _lost(predicted, fit, f"{reason}; a new map begins here")

    def _begin_maps(self) -> None:
        self._edges, self._planes = (FeatureMap(self._config.radius_m) for _ in range(2))
        self._lost_in_a_row = 0

    def _insert(self, features: Features, state: MotionState) -> None:
        for sweep, feature_map in ((features.edges, self._edges), (features.planes, self._planes)):
            points = transform_points(state.T_world_lidar, sweep.compensated(state.velocity))
            feature_map.insert(points, state.T_world_lidar[:3, 3], features.spacing_m)


def _predict(stamp: float, prior: Prior, last: MotionState, config: MappingConfig) -> MotionState:
    """The odometry's motion and velocity; the last velocity where it has none."""
    velocity = last.velocity if prior.velocity is None else prior.velocity
    motion = exp(last.velocity * (stamp - last.stamp)) if prior.T_prev_curr is None else prior.T_prev_curr
    F, covariance = adjoint(inverse(motion)), UNKNOWN_VELOCITY.copy()
    covariance[:6, :6] = F @ last.covariance[:6, :6] @ F.T + prior.motion_covariance(config)
    state = MotionState(stamp, last.T_world_lidar @ motion, velocity, covariance)
    return state if prior.inertial is None else state.fused(prior.inertial)


def _lost(predicted: MotionState, fit: Fit | None, reason: str) -> MappedScan:
    state = replace(predicted, velocity=FADING * predicted.velocity, covariance=LOST_MOTION)
    return MappedScan(state, predicted.T_world_lidar, False, Status.LOST, reason, fit, is_connected=False)
