"""No odometry: the sensor goes on moving as scan-to-map refinement saw it move last."""

import numpy as np

from lidarslam.core.scan import Scan
from lidarslam.core.state import Saved, State
from odometry.interface import Motion


class ConstantVelocity:
    """Measures nothing, and says so; what follows has the last velocity to go on with."""

    def estimate(self, scan: Scan) -> Motion:  # noqa: ARG002
        """No motion, not measured."""
        return Motion(np.eye(4), points_used=0, failure="constant velocity measures nothing")

    def state(self) -> State:
        """Nothing is remembered."""
        return {}

    def restore(self, saved: Saved) -> None:
        """Nothing is remembered."""

    def close(self) -> None:
        """Nothing is held."""
