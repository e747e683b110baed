"""What recording is to be made, and what came of it."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RecordRequest:
    """A recording to be made.

    Attributes:
        out: the folder it becomes.
        world, sensor, motion, mount, format: names in their registries.
        scans: how many; None: 300, or as many as the trajectory lasts.
        seed: of the world, the motion and the noise; the same request gives the same bytes.
        trajectory: TUM or KITTI file to move along instead of the world's route; `motion` is what moves along it.
        speed_mps: of the carrier where no bend slows it down, instead of its own and of the route's limit.
        overwrite: whether an earlier recording in `out` is replaced.
    """

    out: Path
    world: str
    sensor: str
    motion: str
    mount: str
    scans: int | None
    seed: int
    format: str
    trajectory: Path | None = None
    speed_mps: float | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class RecordingSummary:
    """A recording that was made.

    Attributes:
        source: what to give to `lidarslam run`.
        rate_hz: of the sensor, sweeps a second.
        scans, points_per_scan: how many; the points are the mean.
        duration_s, length_m: from the first stamp to the last.
        map_points, map_spacing_m: points of the reference map, and how far apart they are.
        size_mb: of the whole folder.
    """

    source: Path
    rate_hz: float
    scans: int
    points_per_scan: int
    duration_s: float
    length_m: float
    map_points: int
    map_spacing_m: float
    size_mb: float
