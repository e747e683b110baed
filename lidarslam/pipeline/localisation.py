"""The pose of each scan: scan-to-map registration, or the odometry alone with a check against the previous scan."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.errors import OutputError
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Restorable, State, Stateful
from lidarslam.core.tracking import Status
from lidarslam.mapping.config import MAPPINGS
from lidarslam.mapping.elevation import ElevationEstimator
from lidarslam.mapping.motion.prediction import GravityDirection, Prior
from lidarslam.mapping.pose_graph.submap_placement import SCANS_LATER
from lidarslam.mapping.registration.sampled_scan import SampledScan
from lidarslam.mapping.tracking.mapped_scan import MappedScan
from lidarslam.mapping.tracking.mapper import Mapper
from lidarslam.odometry.interface import Motion
from lidarslam.odometry.methods.consistency import Consistency, ConsistencyCheck
from lidarslam.pipeline.estimates import ScanEstimate, ScanOdometry, SweepMotion


@runtime_checkable
class ScanMapper(Restorable, Protocol):
    """A scan-to-map registration: with a local map, or in a map that is given."""

    def sample(self, scan: Scan) -> SampledScan | None:
        """The next scan, thinned on another thread for `process`; None where that takes the scan as it is."""

    def process(self, scan: Any, prior: Prior) -> MappedScan:
        """Register the next scan to the map."""


class InertialPrediction(Restorable, Protocol):
    """An IMU's part in the prior of each scan."""

    @property
    def direction(self) -> GravityDirection | None:
        """Gravity as measured until the last scan; None where it was not."""

    def prior(self, scan: Scan, prior: Prior) -> Prior:
        """The odometry's prior, with the state that the IMU predicts."""

    def update(self, scan: Scan, mapped: MappedScan) -> None:
        """Update with the result of a scan."""


class OdometryAlone(Stateful):
    """Chains the odometry, and checks that each scan fits the previous one."""

    _check: ConsistencyCheck
    _T_odom_lidar: Annotated[FloatArray, TRANSFORM]

    mapper: ClassVar[None] = None  # it has no map

    def __init__(self, check: ConsistencyCheck) -> None:
        self._check = check
        self._T_odom_lidar = np.eye(4)

    def sample(self, scan: Scan) -> SampledScan | None:
        """Nothing: there is no computation ahead of the pose."""

    def localise(self, odometry: ScanOdometry, following: ScanOdometry | None) -> ScanEstimate:
        """Chain the motion, and compare the scan with the previous one."""
        started, motion = time.perf_counter(), odometry.motion
        self._T_odom_lidar = self._T_odom_lidar @ motion.T_prev_curr
        sweep = SweepMotion(odometry.velocity, following.velocity if following else None)
        fit = self._check.check(sweep.compensate(self._check.sample(odometry.scan)), motion.T_prev_curr)
        status, message = _judge(motion, fit)
        return odometry.estimated(
            {"check": 1e3 * (time.perf_counter() - started)},
            T_world_lidar=self._T_odom_lidar,
            T_odom_lidar=self._T_odom_lidar,
            covariance=None,
            motion=sweep,
            status=status,
            message=message,
            belongs_in_map=status is not Status.LOST,
            points_used=motion.points_used,
            residual_m=fit.residual_m,
            inlier_ratio=fit.inlier_ratio,
            degenerate=motion.degenerate,
        )


class ScanToMap(Stateful):
    """Registers each scan to the map, with the odometry as initial guess.

    Args:
        mapper, inertial: registers; an IMU's part in the prior.
        elevation: is given the scans that are registered to surfels.
        start: motions of the first scans, by stamp, that replace those of the odometry in the prior.
    """

    _mapper: ScanMapper
    _inertial: InertialPrediction | None
    _elevation: ElevationEstimator | None
    _T_odom_lidar: Annotated[FloatArray, TRANSFORM]
    _T_world_last: Annotated[FloatArray, TRANSFORM]

    def __init__(
        self,
        mapper: ScanMapper,
        inertial: InertialPrediction | None = None,
        elevation: ElevationEstimator | None = None,
        start: Mapping[float, Prior] | None = None,
    ) -> None:
        self._mapper, self._inertial, self._elevation, self._start = mapper, inertial, elevation, start or {}
        self._T_odom_lidar, self._T_world_last = np.eye(4), np.eye(4)

    @property
    def mapper(self) -> Mapper | None:
        """The mapper, unless the map is given."""
        return self._mapper if isinstance(self._mapper, Mapper) else None

    def state(self) -> State:
        """The state it carries from scan to scan; OutputError where the mapper's cannot be saved."""
        state = super().state()
        if state["_mapper"] is None:
            raise OutputError("the mapping cannot save its state")
        return state

    def sample(self, scan: Scan) -> SampledScan | None:
        """The computation on the next scan ahead of its pose, on another thread."""
        return self._mapper.sample(scan)

    def localise(self, odometry: ScanOdometry, following: ScanOdometry | None) -> ScanEstimate:
        """Refine the odometry's pose; where it measured nothing, the mapper predicts with the last velocity."""
        started = time.perf_counter()
        measured, motion = odometry.interval_s is not None, odometry.motion
        prior = self._prior(odometry, following)
        if self._inertial is not None:
            prior = self._inertial.prior(odometry.scan, prior)
        sampled = self.sample(odometry.scan) if odometry.sampled is None else odometry.sampled
        turn_acceleration = None if sampled is None else self._turn_acceleration(odometry, following)
        if sampled is not None and turn_acceleration is not None:
            sampled = sampled.evened(turn_acceleration)
        mapped = self._mapper.process(odometry.scan if sampled is None else sampled, prior)
        if self._elevation is not None and sampled is not None:
            self._elevation.add(sampled, mapped)
        if self._inertial is not None:
            self._inertial.update(odometry.scan, mapped)
        expected = inverse(self._T_world_last) @ mapped.T_world_predicted
        self._T_odom_lidar = self._T_odom_lidar @ (motion.T_prev_curr if measured else expected)
        self._T_world_last = mapped.state.T_world_lidar
        refine_ms = odometry.stage_ms.get("refine", 0.0) + 1e3 * (time.perf_counter() - started)
        return odometry.estimated(
            {"refine": refine_ms},
            T_world_lidar=mapped.state.T_world_lidar,
            T_odom_lidar=self._T_odom_lidar,
            covariance=mapped.state.covariance[:6, :6] if mapped.registered else None,
            motion=SweepMotion(mapped.state.velocity, mapped.state.velocity, turn_acceleration),
            first_velocity=mapped.first_velocity,
            status=mapped.status,
            message=mapped.message,
            belongs_in_map=mapped.added,
            points_used=mapped.fit.matched if mapped.fit else 0,
            residual_m=mapped.fit.residual_m if mapped.fit else None,
            inlier_ratio=mapped.fit.inlier_ratio if mapped.fit else None,
            degenerate=mapped.degenerate,
            is_connected=mapped.is_connected,
            gravity=None if self._inertial is None else self._inertial.direction,
            cells_m=mapped.cells_m,
            has_surfels=mapped.has_surfels,
            turn_rate=mapped.turn_rate,
        )

    def _turn_acceleration(self, odometry: ScanOdometry, following: ScanOdometry | None) -> FloatArray | None:
        """By the odometry; None where a smoothed start replaces it, and with an IMU, for which sweeps are even.

        The first sweep cannot be compensated, and those of a young map hold together as they are.
        """
        local_map = None if self.mapper is None else self.mapper.local_map
        if self._inertial is not None or odometry.scan.stamp in self._start or local_map is None or local_map.is_young:
            return None
        return odometry.turn_acceleration(following)

    def _prior(self, odometry: ScanOdometry, following: ScanOdometry | None) -> Prior:
        measured = odometry.motion.T_prev_curr if odometry.interval_s is not None else None
        before = Prior(measured, odometry.velocity, odometry.motion.covariance)
        smoothed = self._start.get(odometry.scan.stamp, before)
        if before.T_prev_curr is None or smoothed.T_prev_curr is None or before.allows(smoothed.T_prev_curr):
            before = smoothed
        after = None if following is None else self._start.get(following.scan.stamp) or following
        velocity = SweepMotion(before.velocity, after.velocity if after else None).mean(odometry.scan)
        if before.turn_rate is not None and velocity is not None:
            velocity = np.concatenate([before.turn_rate, velocity[3:]])
        return replace(before, velocity=velocity)


Localiser = OdometryAlone | ScanToMap
"""Estimates the pose of one scan after the other, given the odometry of it and of the next."""


def _judge(motion: Motion, fit: Consistency) -> tuple[Status, str]:
    """Lost without a measured motion; else as the fit to the previous scan and degeneracy have it."""
    if motion.failure is not None:
        return Status.LOST, motion.failure
    if fit.status is Status.OK and motion.degenerate:
        return Status.DEGRADED, f"degenerate along {', '.join(motion.degenerate)}"
    if fit.status is Status.OK:
        return Status.OK, ""
    if fit.inlier_ratio is None:
        return fit.status, "too few planar points to check the motion against the previous scan"
    return fit.status, f"only {100.0 * fit.inlier_ratio:.0f} % of the points fit the previous scan"


def make_localiser(
    config: Config,
    inertial: InertialPrediction | None = None,
    elevation: ElevationEstimator | None = None,
    start: Mapping[float, Prior] | None = None,
) -> Localiser:
    """The configured scan-to-map registration, with an IMU where there is one, or the odometry alone.

    The first scans may be smoothed; with surfels, the error of the sensor's elevations is estimated as well.
    """
    if config.mapping.method == "off":
        return OdometryAlone(ConsistencyCheck())
    if config.mapping.method not in MAPPINGS.built_in:
        return ScanToMap(MAPPINGS.make(config.mapping.method, ScanMapper, config.mapping), inertial, None, start)
    is_surfels = config.mapping.method == "surfels"
    corrects = is_surfels and config.pose_graph.enabled and config.pose_graph.corrects_local_map
    mapper = Mapper(config.mapping, kept_scans=SCANS_LATER if corrects else 0)
    return ScanToMap(mapper, inertial, elevation if is_surfels else None, start)
