"""Relative poses between keyframes, and loop closures among them."""

from dataclasses import dataclass
from typing import Annotated

from lidarslam.core.geometry import FloatArray
from lidarslam.core.state import TRANSFORM, Shape

# Chi-squared with six degrees of freedom: 99 % of consistent measurements are below.
CHI_SQUARED_99 = 16.8


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A measured motion between two keyframes, an edge of the pose graph."""

    # first, second: the keyframes
    first: int
    second: int
    T_first_second: Annotated[FloatArray, TRANSFORM]  # (4, 4)
    # (6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first, as GTSAM has it
    covariance: Annotated[FloatArray, Shape(6, 6)]


@dataclass(frozen=True, eq=False)
class LoopClosure(RelativePose):
    """A loop closure that was verified; the second keyframe is the later one."""

    overlap: float  # 0 to 1, inliers among the points that either side sees of the other; the worse side
    residual_m: float  # root mean square residual of the inliers
    inlier_ratio: float  # inliers among the second keyframe's points
    by_appearance: bool  # found by its descriptor, not near the estimate
    consistent: int  # number of other closures that agree
    reason: str  # why it was rejected; empty for one that was accepted
    given: tuple[int, int] | None = None  # the scans that it was given by; None for one that was found

    @property
    def accepted(self) -> bool:
        """Whether it became an edge of the graph."""
        return not self.reason
