"""No odometry: scan-to-map registration goes on at its last velocity."""

import numpy as np

from lidarslam.core.scan import Scan
from lidarslam.core.state import Stateful
from lidarslam.odometry.interface import Motion


class ConstantVelocity(Stateful):
    """Measures nothing; implements `Odometry`."""

    def estimate(self, scan: Scan) -> Motion:  # noqa: ARG002
        """No motion, not measured."""
        return Motion(np.eye(4), points_used=0, failure="constant velocity measures nothing")

    def close(self) -> None:
        """Nothing is held."""
