"""The request for a live run."""

from dataclasses import dataclass
from pathlib import Path

from lidarslam.config.settings import Config
from lidarslam.mapping.config import MapFormat
from lidarslam.viewer.viewer import RerunMode


@dataclass(frozen=True)
class LiveRequest:
    """Topic, configuration and destination of a live run."""

    out: Path  # the run directory
    config: Config  # of the computation
    topic: str | None = None  # of the clouds; None: the only one there is
    domain: int = 0  # of DDS
    # duration_s, scans: when it ends by itself, counted from the first scan; while none comes, from the beginning
    duration_s: float | None = None
    scans: int | None = None
    queue: int = 20  # scans that may wait for registration
    odom_frame: str = "odom"  # the fixed frame of the published poses
    base_frame: str | None = None  # the frame that moves, connected to the LiDAR's by /tf_static; None: the LiDAR's own
    publish_tf: bool = True  # whether the pose is published on /tf as well
    rerun: RerunMode = "off"
    map_formats: tuple[MapFormat, ...] = ()  # what the map is written as beside .ply
    overwrite: bool = False  # whether an earlier run in `out` is replaced
    report: bool = False  # whether a page and pictures are drawn, once all else is written
