"""A scan in the stages of the pipeline: with its odometry, then with its pose."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Shape
from lidarslam.core.tracking import Status
from lidarslam.mapping.motion.deskew import body_velocity, deskew, even
from lidarslam.mapping.motion.prediction import GravityDirection
from lidarslam.mapping.pose_graph.keyframe_graph import GraphScan
from lidarslam.mapping.registration.sampled_scan import CellSizes, SampledScan
from lidarslam.odometry.interface import Motion

STAGES = ("read", "odometry", "refine", "check", "deskew", "map")

# Larger angular accelerations are errors of the odometry.
_MOST_RAD_S2 = np.deg2rad(2000.0)


@dataclass(frozen=True, eq=False)
class ScanOdometry:
    """A scan with its odometry."""

    scan: Scan  # as read
    motion: Motion  # the estimated motion since the previous scan
    interval_s: float | None  # time between the two stamps; None when no motion was measured
    stage_ms: dict[str, float] = field(default_factory=dict)  # wall time of the stages so far, see `STAGES`
    sampled: SampledScan | None = None  # thinned for registration; None where the localiser does that

    @property
    def velocity(self) -> FloatArray | None:
        """(6,) body velocity since the previous stamp, rotation first; None when no motion was measured."""
        return None if self.interval_s is None else body_velocity(self.motion.T_prev_curr, self.interval_s)

    def turn_acceleration(self, following: "ScanOdometry | None") -> FloatArray | None:
        """Angular acceleration (3,) at the stamp, by the turns since the previous scan and to the next, rad/s^2.

        Less what their noise explains, as a Wiener filter has it; None where one was not measured, or has no
        covariance.
        """
        before, after = self._turn, None if following is None else following._turn
        if before is None or after is None:
            return None
        (before_s, rate_before, variance_before), (after_s, rate_after, variance_after) = before, after
        apart_s = 0.5 * (before_s + after_s)
        acceleration = np.clip((rate_after - rate_before) / apart_s, -_MOST_RAD_S2, _MOST_RAD_S2)
        signal = np.maximum(acceleration**2 - (variance_before + variance_after) / apart_s**2, 0.0)
        return np.asarray(acceleration * signal / np.maximum(acceleration**2, 1e-12), dtype=np.float64)

    @property
    def _turn(self) -> tuple[float, FloatArray, FloatArray] | None:
        """The interval since the previous stamp, the mean turn rate (3,) in it, rad/s, and its variances (3,)."""
        velocity, covariance = self.velocity, self.motion.covariance
        if self.interval_s is None or velocity is None or covariance is None:
            return None
        return self.interval_s, velocity[:3], np.diag(covariance)[:3] / self.interval_s**2

    def estimated(self, stage_ms: dict[str, float], **values: Any) -> "ScanEstimate":
        """The scan with its pose and quality, and the wall time of a further stage."""
        return ScanEstimate(
            stamp=self.scan.stamp,
            is_odometry_asked=self.motion.is_asked,
            points_read=len(self.scan),
            points_dropped=self.scan.dropped,
            stage_ms=self.stage_ms | stage_ms,
            **values,
        )


@dataclass(frozen=True, eq=False)
class SweepMotion:
    """Body velocities (6,) before and after the stamp of a scan, rotation first; None where unknown."""

    before: Annotated[FloatArray, Shape(6)] | None
    after: Annotated[FloatArray, Shape(6)] | None
    # (3,) rad/s^2, for which the sweep was evened before these velocities were estimated; None where it was not
    turn_acceleration: Annotated[FloatArray, Shape(3)] | None = None

    @property
    def latest(self) -> FloatArray | None:
        """The latest velocity (6,) that is known."""
        return self.before if self.after is None else self.after

    def compensate(self, scan: Scan) -> FloatArray:
        """Deskew: the scan's points (N, 3) in the LiDAR frame at its stamp.

        Most recordings stamp a sweep at its start, so that most of it moves with the velocity after the stamp.
        """
        known = [velocity for velocity in (self.before, self.after) if velocity is not None]
        if scan.time_offsets is None or not known:
            return scan.points
        points = scan.points
        if self.turn_acceleration is not None:
            points = even(points, scan.time_offsets, self.turn_acceleration, scan.middle_offset_s)
        return deskew(points, scan.time_offsets, known[0], known[-1])

    def mean(self, scan: Scan) -> FloatArray | None:
        """One velocity (6,) for the sweep: both, weighted by the shares of the sweep before and after the stamp."""
        if self.before is None or self.after is None or scan.time_offsets is None or not len(scan):
            return self.latest
        begin, end = float(scan.time_offsets.min()), float(scan.time_offsets.max())
        share_after = 1.0 if end <= begin else np.clip(end / (end - begin), 0.0, 1.0)
        return np.asarray(share_after * self.after + (1.0 - share_after) * self.before, dtype=np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanEstimate:
    """The pose of a scan as estimated when it came, and its quality."""

    stamp: float  # seconds
    T_world_lidar: Annotated[FloatArray, TRANSFORM]  # at the stamp; the world is the LiDAR frame of the first scan
    # whether no later scan changes the pose: not with a pose graph, whose loops correct the earlier ones
    is_final: bool = True
    # status, message: ok, degraded or lost, and the reason unless it is ok; the pose of a lost scan is a prediction
    status: Status
    message: str
    # (6, 6) of the error `xi` in `T_true = T_world_lidar @ exp(xi)`, rotation first, radians and metres; None where the
    # scan was not registered to a map
    covariance: Annotated[FloatArray, Shape(6, 6)] | None
    degenerate: tuple[str, ...]  # of roll, pitch, yaw, x, y, z of the LiDAR: those that the scan does not constrain
    points_used: int  # number of correspondences
    # residual_m, inlier_ratio: of the fit to the map or the previous scan; None when it could not be computed
    residual_m: float | None
    inlier_ratio: float | None
    T_odom_lidar: Annotated[FloatArray, TRANSFORM]  # the odometry alone; where it measured nothing, a prediction
    is_odometry_asked: bool  # whether the odometry was asked for the motion
    motion: SweepMotion  # of the sensor during the sweep
    first_velocity: Annotated[FloatArray, Shape(6)] | None = None  # of the first scan, as the second one shows it
    belongs_in_map: bool  # whether the pose is accurate enough to add the scan to the map
    is_connected: bool = True  # whether the pose follows from that of the previous scan; not when lost or relocalised
    gravity: GravityDirection | None = None  # as an IMU measured it, in the LiDAR frame; None where it did not
    cells_m: CellSizes | None = None  # of the local map; None without one
    has_surfels: bool = False  # whether that map is one of surfels
    turn_rate: Annotated[FloatArray, Shape(3)] | None = None  # rad/s as the sweep alone shows it, in the LiDAR frame
    stage_ms: dict[str, float]  # wall time of the stages so far, see `STAGES`
    # points_read, points_dropped: valid points of the raw scan, and invalid ones that were left out
    points_read: int
    points_dropped: int
    # in the LiDAR frame at the stamp, deskewed, within the map's range, one per voxel; none before they are deskewed
    points: Annotated[FloatArray, Shape(None, 3)] = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def velocity(self) -> FloatArray | None:
        """(6,) of the LiDAR in its own frame, rotation first, rad/s and m/s; None where unknown."""
        return self.motion.latest


def graph_scan(odometry: ScanOdometry, estimate: ScanEstimate) -> GraphScan:
    """A scan as the pose graph takes it."""
    is_lost = estimate.status is Status.LOST
    measured = odometry.interval_s is not None and (estimate.is_connected or is_lost)
    return GraphScan(
        T_world_lidar=estimate.T_world_lidar,
        points=estimate.points,
        covariance=estimate.covariance,
        T_prev_curr=odometry.motion.T_prev_curr if measured else None,
        motion_covariance=odometry.motion.covariance if measured else None,
        lost=is_lost or not estimate.is_connected,
        belongs_in_map=estimate.belongs_in_map,
        gravity=estimate.gravity,
    )
