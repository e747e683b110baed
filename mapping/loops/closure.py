"""Relative poses between keyframes, and loop closures among them."""

from dataclasses import dataclass

from lidarslam.core.geometry import FloatArray

# Chi-squared with six degrees of freedom: 99 % of consistent measurements are below.
CHI_SQUARED_99 = 16.8


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A measured motion between two keyframes, an edge of the pose graph.

    Attributes:
        first, second: the keyframes.
        T_first_second: (4, 4).
        covariance: (6, 6) of xi in `T_true = T_first_second @ exp(xi)`, rotation first, as GTSAM has it.
    """

    first: int
    second: int
    T_first_second: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class LoopClosure(RelativePose):
    """A loop closure that was verified; the second keyframe is the later one.

    Attributes:
        overlap: 0 to 1, inliers among the points that either side sees of the other; the worse side.
        residual_m: root mean square residual of the inliers.
        inlier_ratio: inliers among the second keyframe's points.
        by_appearance: found by its descriptor, not near the estimate.
        consistent: number of other closures that agree.
        reason: why it was rejected; empty for one that was accepted.
    """

    overlap: float
    residual_m: float
    inlier_ratio: float
    by_appearance: bool
    consistent: int
    reason: str

    @property
    def accepted(self) -> bool:
        """Whether it became an edge of the graph."""
        return not self.reason
