"""Two ways to a scan's pose: the odometry's word, held against the scan before; or scan-to-map refinement."""

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lidarslam.config.settings import Config
from lidarslam.core.geometry import FloatArray, inverse
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.core.tracking import Status
from mapping.deskew import body_velocity, deskew
from mapping.mapper import Mapper
from mapping.prediction import Prior
from odometry.interface import Motion
from odometry.methods.consistency import Consistency, ConsistencyCheck


@dataclass(frozen=True, eq=False)
class Estimated:
    """A scan with what the odometry says of it.

    Attributes:
        scan: as read.
        motion: since the scan before.
        interval_s: that the motion took; None when nothing was measured.
    """

    scan: Scan
    motion: Motion
    interval_s: float | None

    def state(self) -> State:
        """All of it."""
        return {"scan": self.scan.state(), "motion": self.motion.state(), "interval_s": self.interval_s}

    @classmethod
    def restored(cls, saved: Saved) -> "Estimated":
        """What was saved."""
        scan, motion = Scan.restored(saved.part("scan")), Motion.restored(saved.part("motion"))
        return cls(scan, motion, saved.optional_number("interval_s"))

    @property
    def velocity(self) -> FloatArray | None:
        """(6,) between the previous stamp and this one; None when it was not measured."""
        return None if self.interval_s is None else body_velocity(self.motion.T_prev_curr, self.interval_s)


@dataclass(frozen=True, eq=False)
class SweepMotion:
    """How the sensor moved before and after the stamp of a scan, (6,) each; None where that is not known."""

    before: FloatArray | None
    after: FloatArray | None

    @classmethod
    def restored(cls, saved: Saved) -> "SweepMotion":
        """What was saved, which is all of it."""
        return cls(saved.optional_array("before", (6,)), saved.optional_array("after", (6,)))

    def compensate(self, scan: Scan) -> FloatArray:
        """The scan's points (N, 3) as seen from the pose at its stamp.

        A sweep lies between two motions. Stamps stand at its start in most recordings, so that going on with the
        motion before would be a guess; the one after it is known by now.
        """
        known = [velocity for velocity in (self.before, self.after) if velocity is not None]
        if scan.time_offsets is None or not known:
            return scan.points
        return deskew(scan.points, scan.time_offsets, known[0], known[-1])

    def mean(self, scan: Scan) -> FloatArray | None:
        """One velocity (6,) for the whole sweep: the mean, by how much of it lies before and after the stamp."""
        if self.before is None or self.after is None or scan.time_offsets is None or not len(scan):
            return self.before if self.after is None else self.after
        begin, end = float(scan.time_offsets.min()), float(scan.time_offsets.max())
        share_after = 1.0 if end <= begin else np.clip(end / (end - begin), 0.0, 1.0)
        return np.asarray(share_after * self.after + (1.0 - share_after) * self.before, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Localised:
    """Where a scan was taken.

    Attributes:
        T_world_lidar: (4, 4), the pose at the stamp.
        T_odom_lidar: (4, 4), what the odometry alone says; where it measured nothing, what was expected.
        covariance: (6, 6) of the pose, rotation first, in the LiDAR frame; None when there is none.
        motion: during the sweep.
        status, message: whether to believe the pose, and why not.
        belongs_in_map: whether the pose is good enough to draw with.
        points_used: how many the pose rests on.
        residual_m, inlier_ratio: how the scan lies on what it was held against; None when that cannot be told.
        degenerate: names of the directions of motion that the scan says nothing about.
        stage_ms: wall time of the stages gone through.
        way_known: whether the sensor was followed here from the scan before.
    """

    T_world_lidar: FloatArray
    T_odom_lidar: FloatArray
    covariance: FloatArray | None
    motion: SweepMotion
    status: Status
    message: str
    belongs_in_map: bool
    points_used: int
    residual_m: float | None
    inlier_ratio: float | None
    degenerate: tuple[str, ...]
    stage_ms: dict[str, float]
    way_known: bool = True


class Localiser(Protocol):
    """Says where each scan was taken, one after the other."""

    def localise(self, estimated: Estimated, following: Estimated | None) -> Localised:
        """The pose of a scan; the one that follows is known already, None after the last."""

    def state(self) -> State:
        """What it remembers of the scans so far."""

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""


class OdometryAlone:
    """Believes the odometry, unless the scan does not fit the one before."""

    def __init__(self, check: ConsistencyCheck) -> None:
        self._check = check
        self._T_odom_lidar = np.eye(4)

    def state(self) -> State:
        """The pose, and the scan that the next is held against."""
        return {"T_odom_lidar": self._T_odom_lidar, "check": self._check.state()}

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        self._T_odom_lidar = saved.array("T_odom_lidar", (4, 4))
        self._check.restore(saved.part("check"))

    def localise(self, estimated: Estimated, following: Estimated | None) -> Localised:
        """Chain the motion, and hold the scan against the one before it."""
        started = time.perf_counter()
        motion = estimated.motion
        self._T_odom_lidar = self._T_odom_lidar @ motion.T_prev_curr
        sweep = SweepMotion(estimated.velocity, following.velocity if following else None)
        fit = self._check.check(sweep.compensate(self._check.sample(estimated.scan)), motion.T_prev_curr)
        status, message = _judge(motion, fit)
        return Localised(
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
            stage_ms={"check": 1e3 * (time.perf_counter() - started)},
        )


class ScanToMap:
    """Lays every scan on the map, from where the odometry says it is."""

    def __init__(self, mapper: Mapper) -> None:
        self._mapper = mapper
        self._T_odom_lidar = np.eye(4)
        self._T_world_last = np.eye(4)

    def state(self) -> State:
        """The poses, and the map."""
        return {
            "T_odom_lidar": self._T_odom_lidar,
            "T_world_last": self._T_world_last,
            "mapper": self._mapper.state(),
        }

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""
        self._T_odom_lidar = saved.array("T_odom_lidar", (4, 4))
        self._T_world_last = saved.array("T_world_last", (4, 4))
        self._mapper.restore(saved.part("mapper"))

    def localise(self, estimated: Estimated, following: Estimated | None) -> Localised:
        """Refine the odometry's pose; where it measured nothing, the mapper goes on with the motion it saw last."""
        started = time.perf_counter()
        measured = estimated.interval_s is not None
        odometry = SweepMotion(estimated.velocity, following.velocity if following else None)
        motion = estimated.motion
        prior = Prior(motion.T_prev_curr if measured else None, odometry.mean(estimated.scan), motion.covariance)
        mapped = self._mapper.process(estimated.scan, prior)
        expected = inverse(self._T_world_last) @ mapped.T_world_expected
        self._T_odom_lidar = self._T_odom_lidar @ (motion.T_prev_curr if measured else expected)
        self._T_world_last = mapped.state.T_world_lidar
        return Localised(
            T_world_lidar=mapped.state.T_world_lidar,
            T_odom_lidar=self._T_odom_lidar,
            covariance=mapped.state.covariance[:6, :6] if mapped.registered else None,
            motion=SweepMotion(mapped.state.velocity, mapped.state.velocity),
            status=mapped.status,
            message=mapped.message,
            belongs_in_map=mapped.added,
            points_used=mapped.fit.matched if mapped.fit else 0,
            residual_m=mapped.fit.residual_m if mapped.fit else None,
            inlier_ratio=mapped.fit.inlier_ratio if mapped.fit else None,
            degenerate=mapped.degenerate,
            stage_ms={"refine": 1e3 * (time.perf_counter() - started)},
            way_known=mapped.way_known,
        )


def _judge(motion: Motion, fit: Consistency) -> tuple[Status, str]:
    """A motion that was not measured is lost, whatever it fits; else the fit decides, and what both leave open."""
    if motion.failure is not None:
        return Status.LOST, motion.failure
    if fit.status is Status.OK and motion.degenerate:
        return Status.DEGRADED, f"nothing to see along {', '.join(motion.degenerate)}"
    if fit.status is Status.OK:
        return Status.OK, ""
    if fit.inlier_ratio is None:
        return fit.status, "too few planes to check the motion against the previous scan"
    return fit.status, f"only {100.0 * fit.inlier_ratio:.0f} % of the scan lies on the previous one"


def make_localiser(config: Config) -> Localiser:
    """Scan-to-map refinement when it is enabled, else the odometry's word."""
    if config.mapping.enabled:
        return ScanToMap(Mapper(config.mapping))
    return OdometryAlone(ConsistencyCheck(config.odometry.consistency))
