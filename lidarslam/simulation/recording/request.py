"""A recording to be made, and the recording that was made."""

from dataclasses import dataclass
from pathlib import Path

from lidarslam.core.tasks.tasks import SERIAL, Where


@dataclass(frozen=True)
class RecordRequest:
    """A recording to be made; the same request gives the same bytes."""

    out: Path  # the folder it becomes
    world: str  # names in their registries
    sensor: str
    motion: str
    mount: str
    scans: int | None  # None: 300, or as many as the trajectory lasts
    seed: int  # of the world, the motion and the noise
    format: str
    trajectory: Path | None = None  # TUM or KITTI file that `motion` moves along instead of the world's route
    speed_mps: float | None = None  # where no bend slows it down, instead of the carrier's own and the route's limit
    imu: bool = False  # whether an IMU is recorded too
    overwrite: bool = False  # whether an earlier recording in `out` is replaced
    where: Where = SERIAL  # whether scans are made one after another or side by side

    @property
    def moved(self) -> str:
        """The carrier, and its way or speed where it is not the usual one."""
        if self.trajectory is not None:
            return f"{self.motion} along {self.trajectory.name}"
        return self.motion + (f" at {self.speed_mps:g} m/s" if self.speed_mps is not None else "")


@dataclass(frozen=True)
class RecordingSummary:
    """A recording that was made."""

    source: Path  # the argument for `lidarslam run`
    rate_hz: float  # of the sensor, sweeps a second
    scans: int
    points_per_scan: int  # mean
    duration_s: float  # from the first stamp to the last
    length_m: float
    map_points: int
    map_spacing_m: float  # between the points of the reference map
    size_mb: float  # of the whole folder
