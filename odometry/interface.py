"""The protocol of every odometry method, and the method without measurements."""

from dataclasses import dataclass, replace
from typing import Annotated, Protocol, runtime_checkable

import numpy as np

from lidarslam.core.geometry import FloatArray, inverse, make_transform
from lidarslam.core.scan import Scan
from lidarslam.core.state import TRANSFORM, Shape, State, Stateful
from lidarslam.core.tracking import AXES


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion since the previous scan."""

    # (4, 4), from this scan's LiDAR frame to the previous one's, each at its stamp; identity for the first scan
    T_prev_curr: Annotated[FloatArray, TRANSFORM]
    points_used: int  # number of points of the scan that the estimate is based on; 0 for a prediction
    failure: str | None = None  # why the motion is only a prediction, None when it was measured
    # (6, 6) of the error `xi` in `T_true = T_prev_curr @ exp(xi)`, rotation first; None where the method has none
    covariance: Annotated[FloatArray, Shape(6, 6)] | None = None
    degenerate: tuple[str, ...] = ()  # names of the degenerate directions, where the method finds them
    is_asked: bool = True  # False: left to the mapping's prediction, which is certain enough

    def in_axes(self, R_new_old: FloatArray) -> "Motion":
        """The motion in other axes (3, 3) of the LiDAR; degenerate directions take the names of the nearest axes."""
        T = make_transform(R_new_old, np.zeros(3))
        A = np.kron(np.eye(2), R_new_old)
        named = np.abs(A[:, [AXES.index(name) for name in self.degenerate]])
        return replace(
            self,
            T_prev_curr=T @ self.T_prev_curr @ inverse(T),
            covariance=None if self.covariance is None else A @ self.covariance @ A.T,
            degenerate=tuple(AXES[index] for index in sorted(set(named.argmax(axis=0).tolist()))),
        )


@runtime_checkable
class Odometry(Protocol):
    """Estimates the motion from scan to scan."""

    def estimate(self, scan: Scan) -> Motion:
        """The motion since the previous scan given to this method; a scan that cannot be used gives a prediction."""

    def state(self) -> State | None:
        """The state needed to resume; None where the method cannot save it, and has to be given the scans again."""

    def restore(self, saved: State) -> None:
        """Resume from a state, before the first scan."""

    def close(self) -> None:
        """Release the method's resources."""


@runtime_checkable
class SkippingOdometry(Odometry, Protocol):
    """An odometry that need not be asked at every scan."""

    def skip(self, scan: Scan) -> None:
        """Take a scan with points whose motion is not asked for; the next motion is relative to this scan."""


@runtime_checkable
class ExpectingOdometry(Protocol):
    """An odometry that chooses among motions by the velocity before, which may be known at the first one."""

    def expect(self, velocity: FloatArray) -> None:
        """Take the velocity (6,) before the first motion, rotation first, before the first scan."""


class StatefulOdometry(Stateful):
    """The part of an `Odometry` that saves its state and holds no resources."""

    def close(self) -> None:
        """Nothing is held."""


class ConstantVelocity(StatefulOdometry):
    """Measures nothing; implements `Odometry`."""

    def estimate(self, scan: Scan) -> Motion:  # noqa: ARG002
        """No motion, not measured."""
        return Motion(np.eye(4), points_used=0, failure="constant velocity measures nothing")
