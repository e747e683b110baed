"""The bias that the velocities during successive sweeps have in common, observed by the motion between their poses.

Sweeps that are bent equally fit one another and the map that they make, so that their registration hardly observes a
bias in common. The motion between the poses of successive sweeps does: on average, it is their velocity.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from lidarslam.core.geometry import FloatArray, exp, inverse
from lidarslam.core.state import Shape
from lidarslam.mapping.motion.deskew import body_velocity
from lidarslam.mapping.motion.prediction import MotionState

# The largest difference that counts, rad/s and m/s: a sudden acceleration makes a larger one, and is no bias.
_MOST_CHANGE = np.array([np.deg2rad(3.0)] * 3 + [0.2] * 3)
# Sweeps follow one another where they cover this share of the interval between their stamps.
_COVERED = 0.8


def velocity_error(last: MotionState, state: MotionState, share: float) -> FloatArray:
    """Velocity (6,) of the motion between two sweeps' poses, less their mean velocity.

    In this share of the interval the sensor moves with the first sweep's velocity.
    """
    motion = body_velocity(inverse(last.T_world_lidar) @ state.T_world_lidar, state.stamp - last.stamp)
    return np.asarray(motion - (share * last.velocity + (1.0 - share) * state.velocity), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class VelocityBias:
    """The correction of estimated velocities: the integral of their difference from the motion between poses."""

    correction: Annotated[FloatArray, Shape(6)] = field(default_factory=lambda: np.zeros(6))  # rotation first

    def updated(self, last: MotionState, state: MotionState, seen_from_s: float, gains: FloatArray) -> "VelocityBias":
        """The bias after another sweep, as it was estimated, and the corrected one before; none after a gap.

        The sweep begins `seen_from_s` before its stamp. The gains (6,) are shares of the difference, rotation first.
        The map receives the corrected sweeps, and the next velocity is estimated from that: with a gain g, both
        together swing with a damping ratio of half its square root.
        """
        interval_s, covered_s = state.stamp - last.stamp, last.seen_until_s + seen_from_s
        if not covered_s > _COVERED * interval_s > 0.0:
            return VelocityBias()
        now = replace(state, velocity=state.velocity + self.correction)
        error = velocity_error(last, now, last.seen_until_s / covered_s)
        return VelocityBias(self.correction + gains * np.clip(error, -_MOST_CHANGE, _MOST_CHANGE))

    def corrected(self, state: MotionState) -> MotionState:
        """The state with the corrected velocity, and the pose that is most likely given that."""
        P = state.covariance
        step = P[:6, 6:] @ np.linalg.solve(P[6:, 6:], self.correction)
        T_world_lidar = state.T_world_lidar @ exp(step)
        return replace(state, T_world_lidar=T_world_lidar, velocity=state.velocity + self.correction)
