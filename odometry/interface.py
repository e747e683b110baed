"""The one protocol behind which every odometry stands."""

from dataclasses import dataclass
from typing import Protocol

from lidarslam.core.geometry import FloatArray
from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State


@dataclass(frozen=True, eq=False)
class Motion:
    """What an odometry says of one scan.

    Attributes:
        T_prev_curr: (4, 4), from this scan's LiDAR frame to the previous one's, each at its stamp; identity for the
            first scan.
        points_used: how many points of the scan the estimate rests on; 0 for a prediction.
        failure: why the motion is only a prediction, None when it was measured.
        covariance: (6, 6) of the error `xi` in `T_true = T_prev_curr @ exp(xi)`, rotation first; None when the method
            does not say.
        degenerate: names of the directions of motion that the scans say nothing about, where the method tells.
    """

    T_prev_curr: FloatArray
    points_used: int
    failure: str | None = None
    covariance: FloatArray | None = None
    degenerate: tuple[str, ...] = ()

    def state(self) -> State:
        """All of it."""
        return {**vars(self), "degenerate": list(self.degenerate)}

    @classmethod
    def restored(cls, saved: Saved) -> "Motion":
        """The motion with a state."""
        return cls(
            saved.array("T_prev_curr", (4, 4)),
            saved.integer("points_used"),
            saved.optional_text("failure"),
            saved.optional_array("covariance", (6, 6)),
            tuple(saved.texts("degenerate")),
        )


class Odometry(Protocol):
    """Says, scan after scan, how the sensor moved since the last one."""

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the previous scan given to this method; a scan that cannot be used gives a prediction."""

    def state(self) -> State | None:
        """What it remembers of the scans so far; None where that cannot be had, and it has to be given them again."""

    def restore(self, saved: Saved) -> None:
        """Go on from a state, before the first scan."""

    def close(self) -> None:
        """Let go of whatever the method holds."""
