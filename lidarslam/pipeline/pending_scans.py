"""Scans that wait in the pipeline until it is known what comes next, and how they are kept."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from lidarslam.pipeline.localisation import Estimated, SweepMotion


@dataclass(frozen=True, eq=False)
class Timed:
    """A scan whose motion is known, and the time that took: milliseconds of the stages read and odometry."""

    estimated: Estimated
    stage_ms: dict[str, float]

    def state(self) -> State:
        """All of it."""
        return {"estimated": self.estimated.state(), "stage_ms": dict(self.stage_ms)}

    @classmethod
    def restored(cls, saved: Saved) -> "Timed":
        """What was saved."""
        ms = saved.part("stage_ms")
        return cls(Estimated.restored(saved.part("estimated")), {s: ms.number(s) for s in ("read", "odometry")})


@dataclass(frozen=True, eq=False)
class Compensated:
    """A scan that waits to be added to the map until the motion it was compensated with is checked.

    Attributes:
        number: which of the run's scans, from 0.
        thinned: its points that belong in the map, as read.
        motion: what it was compensated with.
        points: (N, 3) in the LiDAR frame at the stamp, compensated.
        T_world_lidar: (4, 4), its pose.
    """

    number: int
    thinned: Scan
    motion: SweepMotion
    points: FloatArray
    T_world_lidar: FloatArray

    def state(self) -> State:
        """All of it."""
        motion = dict(vars(self.motion))
        return {**vars(self), "thinned": self.thinned.state(), "motion": motion}

    @classmethod
    def restored(cls, saved: Saved) -> "Compensated":
        """What was saved."""
        thinned, motion = Scan.restored(saved.part("thinned")), SweepMotion.restored(saved.part("motion"))
        points, T_world_lidar = saved.array("points", (len(thinned), 3)), saved.array("T_world_lidar", (4, 4))
        return cls(saved.integer("number"), thinned, motion, points, T_world_lidar)
