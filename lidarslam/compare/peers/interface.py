"""A peer: another program's estimator behind one protocol."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from lidarslam.core.errors import LidarSlamError
from lidarslam.core.geometry import FloatArray
from lidarslam.core.imu import ImuSamples
from lidarslam.core.scan import Scan

# The default of CT-ICP, of KISS-ICP and of others.
MAX_RANGE_M = 100.0


class PeerError(LidarSlamError):
    """A peer is not installed, cannot take the recording, or gave no usable poses."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """One scan as a peer takes it, with the instants of its first and last point."""

    scan: Scan
    start: float  # seconds; the stamp where the points have no times, which counts as motion compensated
    end: float

    @classmethod
    def of(cls, scan: Scan) -> "Sweep":
        """The sweep of a scan with points."""
        if scan.time_offsets is None:
            return cls(scan, scan.stamp, scan.stamp)
        first, last = float(scan.time_offsets.min()), float(scan.time_offsets.max())
        return cls(scan, scan.stamp + first, scan.stamp + last)

    @property
    def middle(self) -> float:
        """The instant halfway between the first and the last point."""
        return 0.5 * (self.start + self.end)

    @property
    def is_compensated(self) -> bool:
        """Whether the points are taken for motion compensated to the stamp."""
        return self.end <= self.start


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the LiDAR in the peer's world, and the instants that they belong to."""

    instants: FloatArray  # (M,) seconds, strictly increasing
    T_world_lidar: FloatArray  # (M, 4, 4)


class Estimator(Protocol):
    """A peer's estimator on one recording: all samples of the IMU up to the end of a sweep, the sweep, and so on."""

    def add_imu(self, samples: ImuSamples, number: int) -> None:
        """Take the sample with this number; called for peers that need an IMU alone."""

    def load(self, sweep: Sweep) -> Callable[[], None]:
        """Convert a sweep to the peer's own types; the registration, still to be called, which alone is timed."""

    def finish(self) -> Poses:
        """The poses, after the last scan."""
